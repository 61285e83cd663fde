"""MP4 boxes and sample tables, read from files that may be hostile: every size and count is checked before use."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, HostError, UsageError

MAX_MOOV_BYTES = 64 << 20  # an hour at 120 fps takes 6 MB
MAX_TOP, MAX_BOXES, MAX_DEPTH = 4096, 20_000, 8
MAX_SAMPLES = 8_000_000
_INSIDE = {"moov", "trak", "mdia", "minf", "stbl", "udta", "edts"}


@dataclass(frozen=True, slots=True)
class Box:
    """A box inside `moov`: its four letters, where its payload starts and ends there, how deep it lies."""

    kind: str
    start: int
    end: int
    depth: int


@dataclass(frozen=True, slots=True)
class Track:
    """One track, its sample table resolved.

    Args:
        handler: "vide", "soun", "meta", "tmcd".
        format: of the samples: "avc1", "hvc1", "gpmd", ...
        timescale: units a second of `dts`, `pts` and `duration`.
        sizes, offsets: int64[N], bytes of each sample and where they lie in the file, in decoding order.
        dts, pts: int64[N], when a sample is decoded and shown.
        durations: int64[N] of each sample.
        key: bool[N], coded by itself (stss); all where the file does not tell.
    """

    handler: str
    format: str
    timescale: int
    width: int
    height: int
    sizes: NDArray[np.int64]
    offsets: NDArray[np.int64]
    dts: NDArray[np.int64]
    pts: NDArray[np.int64]
    durations: NDArray[np.int64]
    key: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Movie:
    """The tracks of an MP4 and the raw payloads of its `udta` boxes (the first of each kind)."""

    path: Path
    size_bytes: int
    tracks: tuple[Track, ...]
    user: dict[str, bytes]


def damaged(path: object, cause: str, *, next: str = "copy it again from the card; compare the sizes") -> DataError:
    """The one error for an MP4 that breaks the rules."""
    return DataError("this MP4 is damaged, cut off, or not one", value=path, cause=cause, next=next)


def read_movie(path: str | Path) -> Movie:
    """Read the tables of an MP4; pictures and sound are not touched.

    Raises:
        UsageError: there is no such file.
        DataError: not an MP4, cut off, or a size or count that cannot be.
        HostError: it may not be read.

    Cost:
        The size of `moov` (bounded by 64 MiB), whatever the size of the file.
    """
    target = Path(path)
    try:
        if not target.is_file():
            raise UsageError("there is no such file", value=target)
        with target.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            start, end = _find_moov(file, size, target)
            file.seek(start)
            moov = file.read(end - start)
    except OSError as error:
        raise HostError("the file cannot be read", value=f"{target}: {error.strerror}") from error
    except ValueError as error:  # a NUL byte in the path
        raise UsageError("not a file name", value=repr(str(path))) from error
    if len(moov) != end - start:
        raise damaged(target, "the file shrank while it was read")
    try:
        return _movie(target, size, moov)
    except (struct.error, IndexError, OverflowError, MemoryError) as error:
        raise damaged(target, f"a table is shorter than it says ({error})") from error


def read_samples(path: Path, track: Track, limit_bytes: int = 512 << 20) -> Iterator[bytes]:
    """The samples of a track, one after another; refused where they overlap themselves beyond the file's size."""
    total = int(track.sizes.sum())
    if total > limit_bytes:
        raise damaged(path, f"a track of {total} bytes; at most {limit_bytes} are read")
    with path.open("rb") as file:
        for offset, size in zip(track.offsets.tolist(), track.sizes.tolist(), strict=True):
            file.seek(offset)
            data = file.read(size)
            if len(data) != size:
                raise damaged(path, f"a sample of {size} bytes at {offset} runs over the end")
            yield data


def _find_moov(file: BinaryIO, size: int, path: Path) -> tuple[int, int]:
    at, seen, found = 0, [], None
    while at < size:
        file.seek(at)
        head = file.read(16)
        if len(head) < 8:
            break  # a few bytes after the last box harm nobody
        length, kind = struct.unpack(">I4s", head[:8])
        skip = 8
        if length == 1:
            if len(head) < 16:
                raise damaged(path, "it ends inside a box header")
            length, skip = struct.unpack(">Q", head[8:16])[0], 16
        elif length == 0:
            length = size - at  # the last box reaches to the end
        name = _name(kind)
        if not seen and name not in ("ftyp", "moov", "mdat", "free", "wide", "skip", "styp"):
            raise DataError("not an MP4 file", value=path, cause=f"it begins with {kind!r}")
        if length < skip:
            raise damaged(path, f"box {name!r} at {at} claims {length} bytes")
        if at + length > size:
            raise damaged(path, f"box {name!r} at {at} claims {length} bytes, {size - at} are left: it was cut off")
        if name == "moov":
            if length - skip > MAX_MOOV_BYTES:
                raise damaged(path, f"moov of {length} bytes; at most {MAX_MOOV_BYTES} are read")
            if found is not None:
                raise damaged(path, "two moov boxes")
            found = (at + skip, at + length)
        seen.append(name)
        if len(seen) > MAX_TOP:
            raise damaged(path, f"more than {MAX_TOP} boxes")
        at += length
    if found is None:
        why = "it is empty" if not size else f"no moov box among {seen[:8]}: the camera writes it last, on stopping"
        raise damaged(path, why, next="put the card back into the camera: it offers to repair a clip that broke off")
    return found


def _name(kind: bytes) -> str:
    return kind.decode("latin-1")


def _boxes(data: bytes, path: Path) -> Iterator[Box]:
    """Every box below moov, parents first; no recursion, and no more than MAX_BOXES."""
    stack, count = [(0, len(data), 0, "moov")], 0
    while stack:
        at, end, depth, inside = stack.pop()
        if end - at < 8:
            if end - at and any(data[at:end]):
                raise damaged(path, f"{end - at} stray bytes in {inside!r}")
            continue  # QuickTime ends udta with four zero bytes
        length, kind = struct.unpack_from(">I4s", data, at)
        skip = 8
        if length == 1 and end - at >= 16:
            length, skip = struct.unpack_from(">Q", data, at + 8)[0], 16
        name = _name(kind)
        if length == 0 and inside == "udta" and not any(data[at:end]):
            continue
        if length < skip or at + length > end:
            raise damaged(path, f"box {name!r} in {inside!r} claims {length} bytes of {end - at}")
        count += 1
        if count > MAX_BOXES or depth > MAX_DEPTH:
            raise damaged(path, f"more than {MAX_BOXES} boxes, or deeper than {MAX_DEPTH}")
        stack.append((at + length, end, depth, inside))
        yield Box(name, at + skip, at + length, depth)
        if name in _INSIDE:
            stack.append((at + skip, at + length, depth + 1, name))


def _movie(path: Path, size: int, moov: bytes) -> Movie:
    tracks: list[dict[str, bytes]] = []
    user: dict[str, bytes] = {}
    own_user: tuple[int, int] | None = None
    for box in _boxes(moov, path):
        if box.kind == "trak":
            tracks.append({})
            if len(tracks) > 64:
                raise damaged(path, "more than 64 tracks")
        elif box.kind == "udta" and box.depth == 0:
            own_user = (box.start, box.end)
        elif own_user and own_user[0] <= box.start < own_user[1]:
            user.setdefault(box.kind, moov[box.start : box.end])
        elif tracks and box.depth > 0 and box.kind not in _INSIDE:
            tracks[-1].setdefault(box.kind, moov[box.start : box.end])
    return Movie(path, size, tuple(_track(path, size, t) for t in tracks if "stsd" in t and "mdhd" in t), user)


def _track(path: Path, size: int, raw: dict[str, bytes]) -> Track:
    version = raw["mdhd"][0]
    (timescale,) = struct.unpack_from(">I", raw["mdhd"], 20 if version == 1 else 12)
    if not timescale:
        raise damaged(path, "a track counts 0 units a second")
    handler = _name(raw.get("hdlr", b"")[8:12]) or "????"
    form = _name(raw["stsd"][12:16])
    width = height = 0
    if handler == "vide":
        width, height = struct.unpack_from(">HH", raw["stsd"], 40)
    sizes = _sizes(path, raw)
    durations = _runs(path, raw.get("stts", b"\0" * 8), ">u4", len(sizes), "stts")
    dts = np.cumsum(durations) - durations
    shift = _runs(path, raw["ctts"], ">i4", len(sizes), "ctts") if "ctts" in raw else np.zeros(len(sizes), np.int64)
    offsets = _offsets(path, raw, sizes)
    if len(sizes) and (offsets.min() < 0 or (offsets + sizes).max() > size):
        raise damaged(path, f"a {form!r} sample lies beyond the end of the file")
    if handler != "vide" and int(sizes.sum()) > size:
        raise damaged(path, f"the samples of {form!r} overlap")
    return Track(
        handler,
        form,
        timescale,
        width,
        height,
        sizes,
        offsets,
        dts,
        dts + shift,
        durations,
        _keys(path, raw, len(sizes)),
    )


def _keys(path: Path, raw: dict[str, bytes], count: int) -> NDArray[np.bool_]:
    """Which samples need no other; without a table every one."""
    if "stss" not in raw:
        return np.ones(count, bool)
    number = _table(path, raw["stss"], "stss", 8, ">u4", 1)[:, 0]
    if len(number) and (number.min() < 1 or number.max() > count):
        raise damaged(path, f"stss names samples {number.min()} to {number.max()}, there are {count}")
    key = np.zeros(count, bool)
    key[number - 1] = True
    return key


def _table(path: Path, data: bytes, what: str, head: int, dtype: str, columns: int) -> NDArray[np.int64]:
    """A table of `count` rows after `head` bytes, the count in the last four of them."""
    (count,) = struct.unpack_from(">I", data, head - 4)
    kind = np.dtype(dtype)
    if count * columns * kind.itemsize > len(data) - head:
        raise damaged(path, f"{what} claims {count} entries in {len(data) - head} bytes")
    flat = np.frombuffer(data, kind, count * columns, head)
    if kind.itemsize == 8 and flat.size and flat.max() > np.iinfo(np.int64).max:
        raise damaged(path, f"{what} holds an offset of {flat.max()}")
    return flat.astype(np.int64).reshape(count, columns)


def _sizes(path: Path, raw: dict[str, bytes]) -> NDArray[np.int64]:
    if "stsz" not in raw:
        return np.zeros(0, np.int64)
    same, count = struct.unpack_from(">II", raw["stsz"], 4)
    if count > MAX_SAMPLES:
        raise damaged(path, f"{count} samples; at most {MAX_SAMPLES} are read")
    if same:
        return np.full(count, same, np.int64)
    return _table(path, raw["stsz"], "stsz", 12, ">u4", 1)[:, 0]


def _runs(path: Path, data: bytes, second: str, count: int, what: str) -> NDArray[np.int64]:
    """A table of (how many, value) spread to one value a sample."""
    many = _table(path, data, what, 8, ">u4", 2)[:, 0]
    values = _table(path, data, what, 8, second, 2)[:, 1]
    if (many > MAX_SAMPLES).any() or int(many.sum()) != count:
        raise damaged(path, f"{what} speaks of {int(many.sum())} samples, there are {count}")
    return np.repeat(values, many)


def _offsets(path: Path, raw: dict[str, bytes], sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    wide = "co64" in raw
    chunks = _table(path, raw.get("co64" if wide else "stco", b"\0" * 8), "stco", 8, ">u8" if wide else ">u4", 1)[:, 0]
    rows = _table(path, raw.get("stsc", b"\0" * 8), "stsc", 8, ">u4", 3)
    if not len(sizes):
        return np.zeros(0, np.int64)
    first, per = rows[:, 0] - 1, rows[:, 1]
    if not len(rows) or not len(chunks) or first[0] != 0 or np.any(np.diff(first) <= 0) or first[-1] >= len(chunks):
        raise damaged(path, "the table of chunks contradicts itself")
    if int(per.max()) > MAX_SAMPLES:
        raise damaged(path, f"a chunk of {int(per.max())} samples")
    held = np.repeat(per, np.diff(np.append(first, len(chunks))))
    if int(held.sum()) != len(sizes):
        raise damaged(path, f"chunks hold {int(held.sum())} samples, there are {len(sizes)}")
    chunk = np.repeat(np.arange(len(chunks)), held)
    before = np.cumsum(sizes) - sizes
    starts = np.cumsum(held) - held
    base = before[np.minimum(starts, len(sizes) - 1)]
    return chunks[chunk] + before - base[chunk]
