"""Segment files being written: set aside in advance, past the page cache where the file system allows, synced."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
from collections.abc import Callable
from pathlib import Path

from spikerig.dataset.errors import HostError
from spikerig.rigctl.host import Host

SEGMENT_BYTES = 1 << 30
Tell = Callable[[str, str], None]  # kind, words

_libc = ctypes.CDLL(None, use_errno=True)


class SegmentWriter:
    """Writes whole chunks one after the other, in files of at most `segment_bytes`.

    Args:
        folder: of the segments; numbers go on after those that are there.
        host: for the time between syncs.
        tell: hears (kind, words) of what an operator should know: "direct-io", "set-aside".
        segment_bytes: of a file; a chunk is never divided.
        sync_s: at most so long after a chunk was written it is told to be safe from a power cut.
        direct: try O_DIRECT.

    Raises:
        HostError: the folder cannot be written, or the disk is full.

    Edges:
        The next file is made when one is half full, so that changing files takes no time. A file is cut to its length
        when it is closed; a crash leaves zeros at its end, and a file NNNN.next.
    """

    def __init__(
        self,
        folder: Path,
        host: Host,
        tell: Tell,
        *,
        segment_bytes: int = SEGMENT_BYTES,
        sync_s: float = 1.0,
        direct: bool = True,
    ) -> None:
        self.folder, self.host, self.tell = folder, host, tell
        self.segment_bytes, self.sync_s, self.direct = segment_bytes, sync_s, direct
        self.synced = self.written = 0  # chunks
        self._fd: int | None = None
        self._path = folder
        self._ready: tuple[int, Path] | None = None
        self._at = 0
        self._synced_ns = host.now_ns()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            there = [int(p.stem) for p in folder.glob("[0-9]*.*") if p.stem.isdigit()]
        except OSError as error:
            raise _refused(folder, error) from error
        self._number = max(there, default=-1) + 1

    def write(self, data: memoryview) -> tuple[Path, int]:
        """Write a chunk (whole pages from an aligned buffer); where its header is. On return it survives a kill."""
        try:
            fd = self._fd
            if fd is None or (self._at and self._at + len(data) > self.segment_bytes):
                fd = self._change()
            at = self._at
            self._write_all(fd, data, at)
            self._at += len(data)
            self.written += 1
            if self._ready is None and self._at * 2 >= self.segment_bytes:
                self._ready = self._make()
            if self.host.now_ns() - self._synced_ns >= self.sync_s * 1e9:
                self.sync()
        except OSError as error:
            raise _refused(self._path, error) from error
        return self._path, at

    def sync(self) -> None:
        """Push what was written through the disk's own cache.

        Raises:
            HostError: the disk refuses.
        """
        if self._fd is not None:
            try:
                os.fdatasync(self._fd)
            except OSError as error:
                raise _refused(self._path, error) from error
        self.synced, self._synced_ns = self.written, self.host.now_ns()

    def close(self) -> None:
        """Cut the file to its length, sync, remove what was made in advance; may be called twice."""
        try:
            self._finish()
            if self._ready is not None:
                fd, path = self._ready
                self._ready = None
                os.close(fd)
                path.unlink(missing_ok=True)
            sync_folder(self.folder)
        except OSError as error:
            raise _refused(self._path, error) from error

    def _write_all(self, fd: int, data: memoryview, at: int) -> None:
        done = 0
        while done < len(data):
            try:
                wrote = os.pwrite(fd, data[done:], at + done)
            except OSError as error:
                if error.errno != errno.EINVAL or not self.direct:
                    raise
                self._buffered(error)
                fcntl.fcntl(fd, fcntl.F_SETFL, fcntl.fcntl(fd, fcntl.F_GETFL) & ~os.O_DIRECT)
                continue
            if wrote == 0:
                raise OSError(errno.EIO, "the disk takes no more bytes")
            done += wrote

    def _change(self) -> int:
        self._finish()
        fd, part = self._ready or self._make()
        self._ready = None
        self._path = part.with_suffix(".seg")
        os.rename(part, self._path)
        sync_folder(self.folder)
        self._fd, self._at = fd, 0
        return fd

    def _finish(self) -> None:
        if self._fd is None:
            return
        fd, self._fd = self._fd, None
        try:
            os.ftruncate(fd, self._at)
            os.fdatasync(fd)
            self.synced, self._synced_ns = self.written, self.host.now_ns()
        finally:
            os.close(fd)

    def _make(self) -> tuple[int, Path]:
        path = self.folder / f"{self._number:04d}.next"
        self._number += 1
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        try:
            fd = os.open(path, flags | (os.O_DIRECT if self.direct else 0), 0o644)
        except OSError as error:
            if error.errno != errno.EINVAL or not self.direct:
                raise
            self._buffered(error)
            path.unlink(missing_ok=True)  # some systems make the file and then refuse
            fd = os.open(path, flags, 0o644)
        if _libc.fallocate(fd, 0, ctypes.c_long(0), ctypes.c_long(self.segment_bytes)) != 0:
            number = ctypes.get_errno()
            if number == errno.ENOSPC:
                os.close(fd)
                path.unlink(missing_ok=True)
                raise OSError(number, os.strerror(number))
            self.tell("set-aside", f"the file system sets no room aside ({os.strerror(number)}): writes may be slower")
        return fd, path

    def _buffered(self, error: OSError) -> None:
        self.direct = False
        self.tell(
            "direct-io",
            f"the file system takes no O_DIRECT ({error.strerror}): written through the page cache, which stalls under "
            "load; record to a local ext4 or xfs disk",
        )


def sync_folder(folder: Path) -> None:
    """Make the names in a folder safe."""
    fd = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def _refused(path: Path, error: OSError) -> HostError:
    full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    return HostError(
        "the disk is full" if full else "the segment cannot be written",
        value=f"{path}: {error.strerror or error}",
        next="free some room, then go on with --resume" if full else "look at the disk, then go on with --resume",
    )
