"""M1K40 (SPS100) megapixel streams: 1000x1000, 2,000 tagged blocks of 64 bytes a tick, no row flip.

A block holds 500 pixels, LSB first, and a 12-bit tag in the rest of its last little-endian word: bits 4-13 a line
(1..500), bits 14-15 a channel (0..3). Two blocks make a row: pixel columns 0..499 and 512..1011 of 1024. A tick begins
with the block tagged (channel 0, line 500) and ends with the one tagged (3, 500). Recordings start in the middle of a
tick, so the first whole one has to be looked for; what lies before it and after the last one is not a tick.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.stream import SpikeFile, SpikeStream
from spikerig.dataset.vidar_dat import read_bytes

Bits = NDArray[np.uint8]
SIDE, BLOCK, FRAME = 1000, 64, 128_000
HALF, LINES = 500, 500
FIRST, LAST = (0 << 10) | LINES, (3 << 10) | LINES  # tags as channel * 1024 + line
_STEP = 32  # ticks at a time


def find_start(data: Bits, *, sure: bool = False) -> int | None:
    """Byte offset of the first whole tick in the first bytes of a stream, None where there is none.

    A tick starts where its first block is tagged (0, 500) and its last one (3, 500). Pixels can look like that once
    in a hundred files, so a start whose blocks all have a line of 1..500 goes first; `sure` takes no other.
    """
    if len(data) < FRAME:
        return None
    tags = _tags(np.lib.stride_tricks.sliding_window_view(data, BLOCK)[:, -2:])  # at every byte: the hunt has no grid
    starts = len(data) - FRAME + 1
    hits = np.flatnonzero((tags[:starts] == FIRST) & (tags[FRAME - BLOCK :][:starts] == LAST))
    for hit in hits:
        lines = tags[hit : hit + FRAME : BLOCK] & 1023
        if np.all((lines >= 1) & (lines <= LINES)):
            return int(hit)
    return None if sure or not len(hits) else int(hits[0])


def looks_like(path: Path) -> bool:
    """Whether a file is certainly M1K40, by its first 256,000 bytes."""
    with path.open("rb") as file:
        return find_start(np.frombuffer(file.read(2 * FRAME), np.uint8), sure=True) is not None


def open_m1k40(path: Path) -> SpikeFile:
    """Open an M1K40 recording, from its first whole tick to its last.

    Raises:
        DataError: no whole tick in the first 256,000 bytes; on reading, a tick whose tags are not in place.
    """
    size = path.stat().st_size
    file = path.open("rb")
    start = find_start(np.frombuffer(file.read(2 * FRAME), np.uint8))
    if start is None:
        file.close()
        raise DataError(
            "no tick of an M1K40 camera begins in this file",
            value=f"{path}, {size} bytes",
            expected="64-byte blocks tagged (channel 0, line 500) .. (channel 3, line 500), 128,000 bytes a tick",
            cause="a raster of another camera, or less than two ticks of recording",
            next="for a raw raster give --height, --width and --row-bits",
        )
    ticks, tail = divmod(size - start, FRAME)

    def decode(t0: int, t1: int) -> Bits:
        out = np.empty((t1 - t0, SIDE, SIDE // 8), np.uint8)
        for first in range(t0, t1, _STEP):
            stop = min(first + _STEP, t1)
            _decode(file, path, start, first, out[first - t0 : stop - t0])
        return out

    facts = {"row_bits": 1024, "tick_bytes": FRAME, "bytes_before_first_tick": start, "bytes_after_last_tick": tail}
    return SpikeFile(path, "m1k40", ticks, SIDE, SIDE, decode, file.close, facts=facts)


def _decode(file: BinaryIO, path: Path, start: int, first: int, out: Bits) -> None:
    data = read_bytes(file, path, start + first * FRAME, len(out) * FRAME).reshape(len(out), -1, BLOCK)
    tags = _tags(data[:, [0, -1], -2:])
    wrong = np.flatnonzero((tags[:, 0] != FIRST) | (tags[:, 1] != LAST))
    if len(wrong):
        tick = first + int(wrong[0])
        raise DataError(
            "the stream lost its frame",
            value=f"{path}: tick {tick}, byte {start + tick * FRAME}",
            cause="the host dropped data while recording; how many ticks are missing is not in the file",
            next=f"use the ticks before {tick}, or cut the file behind it and read the rest as a recording of its own",
        )
    unpack_blocks(data.reshape(-1), out)


def unpack_blocks(data: Bits, out: Bits) -> None:
    """Whole ticks of blocks, uint8[n * 128000], as packed ticks uint8[n,1000,125]; the inverse of `pack_blocks`."""
    # 500 pixels are 62.5 bytes: the second half of a row starts in the middle of byte 62
    rows = data.reshape(len(out), SIDE, 2, BLOCK)
    left, right = rows[:, :, 0, :63], rows[:, :, 1, :63]
    out[:, :, :62] = left[:, :, :62]
    out[:, :, 62] = (left[:, :, 62] & 15) | (right[:, :, 0] << 4)
    out[:, :, 63:] = (right[:, :, :62] >> 4) | (right[:, :, 1:] << 4)


def _tags(ends: Bits) -> NDArray[np.uint16]:
    words = ends[..., 0].astype(np.uint16) | (ends[..., 1].astype(np.uint16) << 8)
    return (words >> 4).astype(np.uint16)


def write_m1k40(path: Path, stream: SpikeStream) -> None:
    """Write a stream as M1K40 blocks, whole ticks only.

    Edges:
        Only the tags of a tick's first and last block are known from the vendor's reader. The others are written as
        lines counting down from 500 in channels 0 and 1 and up to 500 in channels 2 and 3; no reader looks at them.
    """
    if (stream.height, stream.width) != (SIDE, SIDE):
        raise UsageError("an M1K40 stream is 1000x1000", value=f"{stream.height}x{stream.width}")
    with path.open("wb") as file:
        for t in range(0, stream.ticks, _STEP):
            file.write(pack_blocks(stream.bits[t : t + _STEP]).tobytes())


def pack_blocks(ticks: Bits) -> Bits:
    """Packed ticks [T,1000,125] as tagged blocks, uint8[T,1000,2,64]; see `write_m1k40` for the tags."""
    line = np.concatenate([np.arange(HALF, 0, -1), np.arange(1, HALF + 1)])
    channel = np.repeat([0, 2], HALF)
    tags = ((channel[:, None] + [0, 1]) * 1024 + line[:, None]).astype(np.uint16)
    rows = np.zeros((len(ticks), SIDE, 2, BLOCK), np.uint8)
    rows[:, :, 0, :62] = ticks[:, :, :62]
    rows[:, :, 0, 62] = ticks[:, :, 62] & 15
    rows[:, :, 1, :62] = (ticks[:, :, 62:124] >> 4) | (ticks[:, :, 63:125] << 4)
    rows[:, :, 1, 62] = ticks[:, :, 124] >> 4
    rows[..., 62] |= ((tags & 15) << 4).astype(np.uint8)
    rows[..., 63] = (tags >> 4).astype(np.uint8)
    return rows
