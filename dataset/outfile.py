"""Files that appear whole or not at all, and never replace another unasked."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from spikerig.dataset.errors import HostError, UsageError

STALE_S = 600.0  # since what a dead process left was last written to, after which it is removed


def refuse_existing(path: Path, force: bool) -> None:
    """Raise a UsageError where `path` exists and `force` is not given: call it before the work begins."""
    if path.exists() and not force:
        raise UsageError("the file exists already", value=path, next="give --force to replace it")


@contextmanager
def whole_file(path: str | Path, *, force: bool = False) -> Iterator[Path]:
    """A name beside `path` to write to; it becomes `path` when the block ends well, and is gone when it does not.

    Raises:
        UsageError: `path` exists and force is not given, or its folder does not exist.
        HostError: the system refuses (disk full, no permission).
    """
    target = Path(path)
    refuse_existing(target, force)
    if not target.parent.is_dir():
        raise UsageError("there is no such folder", value=target.parent, next=f"mkdir -p {target.parent}")
    part = target.with_name(f".{target.stem}.{os.getpid()}.partial{target.suffix}")
    try:
        yield part
        os.replace(part, target)
    except OSError as error:
        raise HostError("the file cannot be written", value=f"{target}: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def stand_in(target: Path, task: str) -> Iterator[Path]:
    """A name beside `target` for a file that takes its place when the block ends well; the old one stays until then.

    Args:
        target: that may exist and be read meanwhile.
        task: a word that tells what left a file, should the process be killed.

    Edges:
        `kill -9` and a power cut leave `target` as it was, and a hidden file beside it; the next such task removes it,
        once its process is gone and it has not been written to for ten minutes.

    Raises:
        HostError: the system refuses.
    """
    _sweep(target, task)
    beside = target.with_name(f".{target.stem}.{task}.{os.getpid()}{target.suffix}")
    try:
        yield beside
        os.replace(beside, target)
        sync_folder(target.parent)
    except OSError as error:
        raise HostError("the file cannot be replaced", value=f"{target}: {error.strerror or error}") from error
    finally:
        beside.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Have a folder's names on disk, so that a power cut does not undo a rename; nothing where the system cannot."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(handle)
    except OSError:
        pass
    finally:
        os.close(handle)


def _sweep(target: Path, task: str) -> None:
    """Remove what killed processes left of the same task on the same file."""
    before, after = re.escape(f".{target.stem}.{task}."), re.escape(target.suffix)
    name = re.compile(rf"{before}(\d{{1,10}}){after}(\.partial)?")
    for left in target.parent.glob(".*"):
        found = name.fullmatch(left.name)
        try:
            if found and not _alive(int(found[1])) and time.time() - left.stat().st_mtime > STALE_S:
                left.unlink()
        except OSError:
            continue  # gone already, or not ours to remove


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        pass  # somebody else's
    return True
