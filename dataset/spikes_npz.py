"""NumPy archives of spikes: our own, packed and complete, and those of others, one byte (or more) a pixel.

Foreign archives disagree about the order of axes and do not say it, so it has to be given. They are read along their
first axis piece by piece and packed at once: a 200x250x250 archive of bytes never stands in memory as such.
Nothing is ever unpickled.
"""

from __future__ import annotations

import math
import zipfile
import zlib
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.stream import SpikeFile, SpikeStream

Bits = NDArray[np.uint8]
OURS = "spikerig-spikes-1"
_PIECE = 32 << 20
_FAULTS = (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, NotImplementedError, RuntimeError)


def write_npz(path: Path, stream: SpikeStream) -> None:
    """Write a stream with everything it knows, packed; numbers and one short text, nothing pickled."""
    rate = np.nan if stream.rate_hz is None else stream.rate_hz
    with path.open("wb") as file:
        np.savez(
            file, format=np.array(OURS), bits=stream.bits, width=stream.width, rate_hz=rate, t0_ns=stream.t0_ns,
            clock=np.array(stream.clock), lost=stream.lost, allow_pickle=False,
        )  # fmt: skip


class Cursor:
    """Reads an array's data at rising offsets without starting over; going back starts over."""

    def __init__(self, archive: zipfile.ZipFile, name: str) -> None:
        self.archive, self.name = archive, name
        self.file: IO[bytes] | None = None
        self.at = 0

    def take(self, start: int, n: int) -> bytes:
        """`n` bytes of data from byte `start`; EOFError where there are fewer."""
        if self.file is None or start < self.at:
            self.close()
            self.file, self.at = self.archive.open(self.name), 0
            _past_header(self.file)
        while self.at < start:
            self.at += len(_exactly(self.file, min(start - self.at, _PIECE)))
        data = _exactly(self.file, n)
        self.at += n
        return data

    def close(self) -> None:
        """Forget the place."""
        if self.file is not None:
            self.file.close()
        self.file = None


class Member(NamedTuple):
    """An array of an archive, as its header says."""

    name: str
    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype


def open_npz(path: Path, axes: str | None = None) -> SpikeFile:
    """Open an archive: our own, or a foreign one with exactly one three-dimensional array.

    Args:
        path: of the archive.
        axes: "THW" or "HWT", needed for a foreign one.

    Raises:
        UsageError: the axes are needed and not given, or given and not needed.
        DataError: not such an archive, damaged, or values other than 0 and 1.

    Cost:
        Of a foreign archive everything up to the ticks asked for is decompressed; all of it with HWT, and then the
        packed stream (an eighth of the array's bytes or less) stays in memory.
    """
    try:
        archive = zipfile.ZipFile(path)
        members = [_header(archive, name) for name in archive.namelist() if name.endswith(".npy")]
    except _FAULTS as error:
        raise _damaged(path, error) from error
    if any(m.name == "format.npy" for m in members):
        try:
            return _open_ours(path, archive, members, axes)
        except BaseException:
            archive.close()
            raise
    movies = [m for m in members if len(m.shape) == 3 and m.dtype.kind in "biuf"]
    if len(movies) != 1:
        archive.close()
        raise DataError(
            "an archive of spikes has one array of three axes",
            value=f"{path}: " + ", ".join(f"{m.name[:-4]}{m.shape}" for m in members),
        )
    if axes not in ("THW", "HWT"):
        archive.close()
        raise UsageError(
            "archives do not say the order of their axes",
            value=f"{path}: {movies[0].name[:-4]}{movies[0].shape}" + (f", axes {axes}" if axes else ""),
            expected="THW or HWT",
            next="give --axes THW or --axes HWT; the time axis is usually the one unlike a picture's side",
        )
    return _open_foreign(path, archive, movies[0], axes)


def _header(archive: zipfile.ZipFile, name: str) -> Member:
    with archive.open(name) as file:
        shape, fortran, dtype = _past_header(file)
        held = archive.getinfo(name).file_size - file.tell()
    if not dtype.hasobject and math.prod(shape) * dtype.itemsize != held:
        raise ValueError(f"{name} claims {shape} of {dtype} and holds {held} bytes")
    return Member(name, shape, fortran, dtype)


def _damaged(path: Path, error: Exception) -> DataError:
    return DataError("the archive is damaged", value=path, cause=str(error), next="get it again from its source")


def _open_ours(path: Path, archive: zipfile.ZipFile, members: list[Member], axes: str | None) -> SpikeFile:
    if axes:
        raise UsageError("our own archives say their axes themselves", value=axes, next="leave out --axes")
    by_name = {m.name[:-4]: m for m in members}
    try:
        bits = by_name.pop("bits")
        if any(math.prod(m.shape) * m.dtype.itemsize > _PIECE for m in by_name.values()):
            raise ValueError("an array that should be small is not")
        with np.load(path, allow_pickle=False) as data:
            kept = {name: data[name] for name in by_name}
        width, rate, lost = int(kept["width"]), float(kept["rate_hz"]), kept["lost"]
        ticks, height, row = bits.shape
        if str(kept["format"]) != OURS or bits.dtype != np.uint8 or bits.fortran or row != (width + 7) // 8:
            raise ValueError(f"format {kept['format']!s}, bits {bits.dtype}{bits.shape} for a width of {width}")
        if lost.dtype != np.int64 or lost.ndim != 2 or lost.shape[1] != 2:
            raise ValueError("lost is not a list of ranges")
        start, clock = int(kept["t0_ns"]), str(kept["clock"])
    except (*_FAULTS, KeyError, TypeError) as error:
        raise _damaged(path, error) from error

    cursor = Cursor(archive, bits.name)

    def decode(t0: int, t1: int) -> Bits:
        try:
            data = cursor.take(t0 * height * row, (t1 - t0) * height * row)
            out = np.frombuffer(data, np.uint8).reshape(-1, height, row)
            if width % 8 and np.any(out[:, :, -1] >> (width % 8)):
                raise ValueError("padding bits are set")
            return out
        except _FAULTS as error:
            raise _damaged(path, error) from error

    rate_hz = None if np.isnan(rate) else rate
    return SpikeFile(path, "npz", ticks, height, width, decode, archive.close, rate_hz, start, clock, lost)


def _open_foreign(path: Path, archive: zipfile.ZipFile, array: Member, axes: str) -> SpikeFile:
    ticks, height, width = (array.shape[axes.index(a)] for a in "THW")
    if width < 1 or height < 1:
        archive.close()
        raise DataError("the archive holds no pixels", value=f"{path}: {array.shape}")
    stored = axes[::-1] if array.fortran else axes
    whole: list[Bits] = []
    cursor = Cursor(archive, array.name)

    def decode(t0: int, t1: int) -> Bits:
        try:
            if stored == "THW":
                return _read_ticks(cursor, array, (height, width), t0, t1)
            if not whole:
                whole.append(_read_whole(cursor, array, stored, (ticks, height, width)))
            return whole[0][t0:t1]
        except (*_FAULTS, MemoryError) as error:
            raise _damaged(path, error) from error

    facts = {"array": array.name[:-4], "axes": axes, "dtype": str(array.dtype)}
    return SpikeFile(path, "npz", ticks, height, width, decode, archive.close, facts=facts)


def _read_ticks(cursor: Cursor, array: Member, picture: tuple[int, int], t0: int, t1: int) -> Bits:
    height, width = picture
    tick = height * width * array.dtype.itemsize
    step = max(1, _PIECE // tick)
    out = np.empty((t1 - t0, height, (width + 7) // 8), np.uint8)
    for first in range(t0, t1, step):
        n = min(step, t1 - first)
        pixels = _ones(cursor.take(first * tick, n * tick), array, (n, height, width))
        out[first - t0 : first - t0 + n] = np.packbits(pixels, axis=2, bitorder="little")
    return out


def _read_whole(cursor: Cursor, array: Member, stored: str, shape: tuple[int, int, int]) -> Bits:
    """Any other order of axes, slab by slab along the first one in the file."""
    size = dict(zip("THW", shape, strict=True))
    slab = (size[stored[1]], size[stored[2]])
    step = math.prod(slab) * array.dtype.itemsize
    out = np.empty((shape[0], shape[1], (shape[2] + 7) // 8), np.uint8)
    for i in range(0, size[stored[0]], 8 if stored[0] == "W" else 1):
        if stored == "WHT":  # a byte's bits lie in eight slabs
            n = min(8, shape[2] - i)
            eight = _ones(cursor.take(i * step, n * step), array, (n, *slab))
            out[:, :, i // 8] = np.packbits(eight, axis=0, bitorder="little")[0].T
        elif stored == "HWT":
            out[:, i] = np.packbits(_ones(cursor.take(i * step, step), array, slab).T, axis=1, bitorder="little")
        else:  # TWH
            out[i] = np.packbits(_ones(cursor.take(i * step, step), array, slab).T, axis=1, bitorder="little")
    return out


def _past_header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    return read(file)


def _exactly(file: IO[bytes], n: int) -> bytes:
    data = file.read(n)
    if len(data) != n:
        raise EOFError(f"{len(data)} of {n} bytes")
    return data


def _ones(data: bytes, array: Member, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    values = np.frombuffer(data, array.dtype)
    ones = values != 0
    if not np.all(values[ones] == 1):
        odd = values[ones][values[ones] != 1][0]
        raise ValueError(f"{array.name[:-4]} holds {odd}, spikes are 0 or 1")
    return ones.reshape(shape)
