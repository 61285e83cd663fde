"""Bytes of GPMF items and MP4 boxes, as a GoPro writes them."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

_NUMBERS = {"b": ">i1", "B": ">u1", "s": ">i2", "S": ">u2", "l": ">i4", "L": ">u4", "J": ">u8", "f": ">f4"}


def item(key: str, kind: str, values: ArrayLike | str | bytes) -> bytes:
    """One GPMF item.

    Args:
        key: four letters.
        kind: a number's type letter, "c" for text, "F" for a key as value.
        values: numbers [N] or [N,C] (a sample of C columns each), or text.
    """
    if isinstance(values, str):
        raw = values.encode("latin-1")
        size, repeat = (4, len(raw) // 4) if kind == "F" else (1, len(raw))
    elif isinstance(values, bytes):
        raw, size, repeat = values, 1, len(values)
    else:
        rows = np.atleast_1d(np.asarray(values)).astype(_NUMBERS[kind])
        raw, repeat = rows.tobytes(), rows.shape[0]
        size = len(raw) // repeat if repeat else rows.dtype.itemsize
    return struct.pack(">4sBBH", key.encode(), ord(kind), size, repeat) + raw + b"\0" * (-len(raw) % 4)


def nest(key: str, *inside: bytes) -> bytes:
    """An item that holds items."""
    raw = b"".join(inside)
    return struct.pack(">4sBBH", key.encode(), 0, 1, len(raw)) + raw


def box(kind: str, *inside: bytes) -> bytes:
    """An MP4 box; of more than 4 GB with the long header."""
    size = 8 + sum(len(part) for part in inside)
    head = struct.pack(">I4s", size, kind.encode("latin-1"))
    if size >= 1 << 32:
        head = struct.pack(">I4sQ", 1, kind.encode("latin-1"), size + 8)
    return head + b"".join(inside)


def full_box(kind: str, *inside: bytes, flags: int = 0) -> bytes:
    """A box with a version (0) and flags."""
    return box(kind, struct.pack(">I", flags), *inside)


def telemetry_track(
    number: int, sizes: Sequence[int], offsets: Sequence[int], durations_ms: Sequence[int], movie_timescale: int
) -> bytes:
    """A `trak` of format gpmd, a payload a chunk, 1000 units a second; 64-bit offsets only where they must be."""
    count, total = len(sizes), sum(durations_ms)
    unity = struct.pack(">9I", 0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000)
    lasting = total * movie_timescale // 1000
    head = full_box(
        "tkhd", struct.pack(">5I", 0, 0, number, 0, lasting), bytes(16), unity, bytes(8), flags=15
    )  # fmt: skip
    name = b"\x0bGoPro MET  "
    lengths = [(len(list(same)), d) for d, same in itertools.groupby(durations_ms)]
    runs = b"".join(struct.pack(">II", *run) for run in lengths)
    wide = max(offsets, default=0) >= 1 << 32
    table = box(
        "stbl",
        full_box("stsd", struct.pack(">I", 1), box("gpmd", bytes(6), struct.pack(">HI", 1, 0))),
        full_box("stts", struct.pack(">I", len(lengths)), runs),
        full_box("stsc", struct.pack(">4I", 1, 1, 1, 1)),
        full_box("stsz", struct.pack(">II", 0, count), struct.pack(f">{count}I", *sizes)),
        full_box(
            "co64" if wide else "stco",
            struct.pack(">I", count),
            struct.pack(f">{count}{'Q' if wide else 'I'}", *offsets),
        ),
    )
    media = box(
        "mdia",
        full_box("mdhd", struct.pack(">4IHH", 0, 0, 1000, total, 0, 0)),
        full_box("hdlr", b"mhlrmeta", bytes(12), name),
        box(
            "minf",
            box("gmhd", full_box("gmin", bytes.fromhex("0040800080008000") + bytes(4)), box("gpmd", bytes(4))),
            box("dinf", full_box("dref", struct.pack(">I", 1), full_box("alis", flags=1))),
            table,
        ),
    )
    return box("trak", head, media)
