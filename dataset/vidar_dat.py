"""Raw rasters: ticks of H rows one after the other, without header, footer or time; the Vidar's `.dat`.

A tick is H * row_bits bits, padded to whole bytes, LSB first, rows BOTTOM-UP. Where row_bits exceeds the width the
rest of each row is the camera's trailer and is skipped. A 250x400 Vidar writes 400-bit rows (12,500 B a tick) or, with
trailer, 416-bit rows (13,000 B): the size of the file decides, and has to be asked where it cannot.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.stream import SpikeFile, SpikeStream

Bits = NDArray[np.uint8]
VIDAR = (250, 400)
TRAILER = 16
_STEP = 256  # ticks at a time where rows do not begin on byte boundaries


class Raster(NamedTuple):
    """A layout: rows and pixels of the picture, and bits a row on disk."""

    height: int
    width: int
    row_bits: int

    @property
    def frame(self) -> int:
        """Bytes a tick."""
        return (self.height * self.row_bits + 7) // 8


def layout(
    path: Path, size: int, height: int | None, width: int | None, row_bits: int | None, drop_tail: bool = False
) -> Raster:
    """The layout of a file of `size` bytes.

    Args:
        path: for messages.
        size: bytes.
        height, width: of the picture, both or none; 250x400 by default.
        row_bits: bits a row; by default whichever fits: the width, the width with the 16-bit trailer, and for widths
            that are no multiple of 8 rows padded to bytes.
        drop_tail: a layout need not divide the size.

    Raises:
        UsageError: several layouts divide the size, or the arguments contradict each other.
        DataError: none does.
    """
    if (height is None) != (width is None):
        raise UsageError("a raster needs both its height and its width", value=(height, width))
    h, w = (height, width) if height is not None and width is not None else VIDAR
    if h < 1 or w < 1 or (row_bits is not None and row_bits < w):
        raise UsageError(
            "a raster has at least one pixel, and rows of at least its width", value=f"{h} rows of {w} in {row_bits}"
        )
    rows = (row_bits,) if row_bits is not None else tuple(dict.fromkeys((w, (w + 7) // 8 * 8, w + TRAILER)))
    choices = [Raster(h, w, n) for n in rows]
    fits = [c for c in choices if size % c.frame == 0]
    if drop_tail and not fits:
        fits = [c for c in choices if size >= c.frame]
    if len(fits) > 1:
        raise UsageError(
            "the size of the file fits more than one layout",
            value=f"{path}, {size} bytes",
            expected="; ".join(f"{size // c.frame} ticks of {c.frame} B with --row-bits {c.row_bits}" for c in fits),
            cause="a raw file does not say how long its rows are",
            next=f"give --row-bits {fits[0].row_bits} or {fits[-1].row_bits}; the wrong one slants the picture",
        )
    if not fits:
        left = "; ".join(f"{size % c.frame} left over after {size // c.frame} ticks of {c.frame} B" for c in choices)
        raise DataError(
            f"the file is not a whole number of ticks of {h}x{w} pixels",
            value=f"{path}, {size} bytes: {left}",
            cause="a recording or a copy that broke off, or another sensor",
            next="give --height, --width and --row-bits of the sensor, or --drop-tail to leave out the unfinished tick",
        )
    return fits[0]


def open_raster(
    path: Path,
    height: int | None = None,
    width: int | None = None,
    row_bits: int | None = None,
    drop_tail: bool = False,
) -> SpikeFile:
    """Open a raw raster; see `layout` for arguments and faults."""
    size = path.stat().st_size
    raster = layout(path, size, height, width, row_bits, drop_tail)
    file = path.open("rb")
    facts = {"row_bits": raster.row_bits, "tick_bytes": raster.frame}
    if size % raster.frame:
        facts["dropped_bytes"] = size % raster.frame

    def decode(t0: int, t1: int) -> Bits:
        out = np.empty((t1 - t0, raster.height, (raster.width + 7) // 8), np.uint8)
        for first in range(t0, t1, _STEP):
            stop = min(first + _STEP, t1)
            unpack_rows(read_bytes(file, path, first * raster.frame, (stop - first) * raster.frame), raster,
                        out[first - t0 : stop - t0])  # fmt: skip
        return out

    return SpikeFile(path, "dat", size // raster.frame, raster.height, raster.width, decode, file.close, facts=facts)


def read_bytes(file: BinaryIO, path: Path, start: int, n: int) -> Bits:
    """`n` bytes of a file from `start`; fewer is a DataError."""
    file.seek(start)
    data = np.frombuffer(file.read(n), np.uint8)
    if len(data) != n:
        raise DataError("the file ended early", value=f"{path}: {len(data)} of {n} bytes at {start}",
                        cause="it shrank while it was being read")  # fmt: skip
    return data


def unpack_rows(data: Bits, raster: Raster, out: Bits) -> None:
    """Raw ticks to packed ones: turn rows top first, cut trailers, pad rows to bytes."""
    ticks, tail = len(out), raster.width % 8
    if raster.row_bits % 8 == 0:
        rows = data.reshape(ticks, raster.height, raster.row_bits // 8)
        out[:] = rows[:, ::-1, : out.shape[2]]
        if tail:
            out[:, :, -1] &= (1 << tail) - 1
        return
    pixels = np.unpackbits(data.reshape(ticks, -1), axis=1, bitorder="little")[:, : raster.height * raster.row_bits]
    rows = pixels.reshape(ticks, raster.height, raster.row_bits)[:, ::-1, : raster.width]
    out[:] = np.packbits(rows, axis=2, bitorder="little")


def write_raster(path: Path, stream: SpikeStream, row_bits: int) -> None:
    """Write a stream as a raw raster with rows of `row_bits` bits, trailer bits zero."""
    raster = Raster(stream.height, stream.width, row_bits)
    if row_bits < stream.width or stream.height < 1:
        raise UsageError("rows on disk must hold the width", value=(row_bits, stream.width))
    with path.open("wb") as file:
        for t in range(0, stream.ticks, _STEP):
            file.write(pack_rows(stream.bits[t : t + _STEP], raster))


def pack_rows(bits: Bits, raster: Raster) -> bytes:
    """Packed ticks [T,H,ceil(W/8)] as the bytes of a raster; the inverse of `unpack_rows`."""
    ticks = bits[:, ::-1]
    if raster.row_bits % 8 == 0:
        rows = np.zeros((len(ticks), raster.height, raster.row_bits // 8), np.uint8)
        rows[:, :, : ticks.shape[2]] = ticks
        return rows.tobytes()
    pixels = np.zeros((len(ticks), raster.height, raster.row_bits), np.uint8)
    pixels[:, :, : raster.width] = np.unpackbits(ticks, axis=2, bitorder="little")[:, :, : raster.width]
    return np.packbits(pixels.reshape(len(ticks), -1), axis=1, bitorder="little").tobytes()
