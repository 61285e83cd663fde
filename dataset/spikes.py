"""Spike streams: packed one-bit frames in memory, and files of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import NS, frozen_array, ns_from_tick, tick_from_ns
from spikerig.dataset.errors import DataError, UsageError


@dataclass(frozen=True, slots=True)
class SpikeStream:
    """Spikes of a time span, one bit a pixel and tick.

    Args:
        bits: uint8[T,H,ceil(W/8)]: TOP row first, rows padded to bytes, LSB first (pixel x is bit x%8 of byte x//8);
            padding bits are zero.
        width: W, pixels a row.
        rate_hz: ticks a second, None where the file does not say.
        t0_ns: start of tick 0 on `clock`.
        clock: name of that clock.
        lost: int64[N,2], half-open tick ranges that were lost: zero bits, and textures touching them are not known.
    """

    bits: NDArray[np.uint8]
    width: int
    rate_hz: float | None = None
    t0_ns: int = 0
    clock: str = "rig"
    lost: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))

    def __post_init__(self) -> None:
        object.__setattr__(self, "bits", frozen_array(self.bits))
        object.__setattr__(self, "lost", frozen_array(np.asarray(self.lost, np.int64).reshape(-1, 2)))
        if self.bits.ndim != 3 or self.bits.dtype != np.uint8 or self.bits.shape[2] != (self.width + 7) // 8:
            raise DataError(
                "packed spikes are uint8[T,H,ceil(W/8)]",
                value=(self.bits.shape, str(self.bits.dtype), self.width),
            )

    @property
    def ticks(self) -> int:
        """T."""
        return self.bits.shape[0]

    @property
    def height(self) -> int:
        """H."""
        return self.bits.shape[1]

    @staticmethod
    def from_pixels(spikes: NDArray, rate_hz: float | None = None, t0_ns: int = 0) -> SpikeStream:
        """Pack unpacked spikes [T,H,W], bool or 0/1, any integer type."""
        if spikes.ndim != 3 or spikes.shape[2] < 1:
            raise UsageError("unpacked spikes are [T,H,W]", value=spikes.shape)
        return SpikeStream(np.packbits(spikes != 0, axis=2, bitorder="little"), spikes.shape[2], rate_hz, t0_ns)

    def tick_at(self, at_ns: int) -> float:
        """The (fractional) tick at a time on this stream's clock; tick k covers [k, k+1)."""
        return float(tick_from_ns(at_ns, self._rate(), self.t0_ns))

    def tick_range(self, t0_ns: int, t1_ns: int) -> tuple[int, int]:
        """The half-open range of ticks that overlap [t0_ns, t1_ns), clipped to the stream; empty where none does.

        Edges:
            A tick that only touches the window, or overlaps it by less than a hundredth of a nanosecond, is left out.
        """
        slack = 1e-2 * self._rate() / NS
        first = int(np.floor(self.tick_at(t0_ns) + slack))
        last = int(np.ceil(self.tick_at(t1_ns) - slack))
        first = min(max(first, 0), self.ticks)
        return first, min(max(last, first), self.ticks)

    def slice(self, t0: int, t1: int) -> SpikeStream:
        """Ticks [t0, t1) as a stream of its own; shares memory, moves t0_ns (where the rate is known) and `lost`."""
        if not 0 <= t0 <= t1 <= self.ticks:
            raise UsageError("a slice must lie in the stream", value=f"[{t0}, {t1})", expected=f"in [0, {self.ticks})")
        start = self.t0_ns if self.rate_hz is None else int(ns_from_tick(t0, self.rate_hz, self.t0_ns))
        lost = np.clip(self.lost, t0, t1) - t0
        return SpikeStream(self.bits[t0:t1], self.width, self.rate_hz, start, self.clock, lost[lost[:, 0] < lost[:, 1]])

    def lost_before(self) -> NDArray[np.int64]:
        """int64[T+1]: how many of the ticks before each one were lost; differences count lost ticks in a range."""
        edges = np.zeros(self.ticks + 1, np.int64)
        for first, stop in np.clip(self.lost, 0, self.ticks):
            edges[first + 1 : stop + 1] = 1
        return edges.cumsum()

    def _rate(self) -> float:
        if self.rate_hz is None:
            raise UsageError("this stream has no rate, so it has no time", next="give --rate-hz")
        return self.rate_hz


@dataclass(frozen=True, slots=True)
class SpikeFile:
    """An open file of spikes: what it holds is known, nothing is decoded until it is read. A context manager.

    Args:
        path: of the file.
        format: "dat", "m1k40", "npz" or "spikes-h5".
        ticks, height, width: of the whole stream.
        decode: (t0, t1) -> packed uint8[t1-t0,H,ceil(W/8)], padding bits zero.
        close: releases the file.
        rate_hz, t0_ns, clock, lost: as in SpikeStream.
        facts: what else the format knows, JSON-ready.
    """

    path: Path
    format: str
    ticks: int
    height: int
    width: int
    decode: Callable[[int, int], NDArray[np.uint8]]
    close: Callable[[], object]
    rate_hz: float | None = None
    t0_ns: int = 0
    clock: str = "rig"
    lost: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    facts: dict[str, Any] = field(default_factory=dict)

    def __enter__(self) -> SpikeFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def read(self, t0: int = 0, t1: int | None = None) -> SpikeStream:
        """Ticks [t0, t1) of the file, by default all; memory is a few times that of the packed ticks asked for.

        Raises:
            UsageError: the range leaves the file.
            DataError: the bytes there are damaged.
        """
        t1 = self.ticks if t1 is None else t1
        if not 0 <= t0 <= t1 <= self.ticks:
            raise UsageError("these ticks are not in the file", value=f"[{t0}, {t1})", expected=f"in [0, {self.ticks})")
        start = self.t0_ns if self.rate_hz is None else int(ns_from_tick(t0, self.rate_hz, self.t0_ns))
        lost = np.clip(self.lost, t0, t1) - t0
        lost = lost[lost[:, 0] < lost[:, 1]]
        return SpikeStream(self.decode(t0, t1), self.width, self.rate_hz, start, self.clock, lost)

    def blocks(self, ticks: int | None = None) -> Iterator[SpikeStream]:
        """The whole file in order, `ticks` at a time; by default about 8 MB of packed spikes."""
        step = ticks or max(1, (8 << 20) // max(self.height * ((self.width + 7) // 8), 1))
        for t0 in range(0, self.ticks, step):
            yield self.read(t0, min(t0 + step, self.ticks))


def open_spikes(
    path: str | Path,
    *,
    height: int | None = None,
    width: int | None = None,
    row_bits: int | None = None,
    axes: str | None = None,
    rate_hz: float | None = None,
    drop_tail: bool = False,
) -> SpikeFile:
    """Open a file of spikes; what it is shows in its bytes, not in its name.

    Args:
        path: HDF5 of our own, .npz, M1K40 blocks, or anything else as a raw Vidar raster.
        height, width, row_bits: layout of a raw raster (`vidar_dat.layout`); by default 250x400 and what fits.
        axes: "THW" or "HWT", order of the array of a foreign .npz.
        rate_hz: ticks a second; overrides what the file says.
        drop_tail: leave out an unfinished last tick of a raw raster instead of refusing it.

    Returns:
        A SpikeFile; use it in a `with` block.

    Raises:
        UsageError: there is no such file, or the bytes fit several layouts.
        DataError: the bytes fit none, or are damaged.

    Source:
        facts of the formats: docs/format.md.
    """
    source = Path(path)
    start = _first_bytes(source)
    raster = (height, width, row_bits) != (None, None, None)
    kind = "spikes-h5" if start.startswith(b"\x89HDF") else "npz" if start.startswith(b"PK\x03\x04") else "raw"
    if (raster and kind != "raw") or (axes and kind != "npz"):
        raise UsageError(
            "the file says its layout itself", value=source, next="leave out --height, --width, --row-bits and --axes"
        )
    if kind == "spikes-h5":
        from spikerig.dataset.spikes_h5 import open_h5

        return _with_rate(open_h5(source), rate_hz)
    if kind == "npz":
        from spikerig.dataset.spikes_npz import open_npz

        return _with_rate(open_npz(source, axes), rate_hz)
    from spikerig.dataset import m1k40, vidar_dat

    if not raster and (source.suffix.lower() == ".bin" or m1k40.looks_like(source)):
        return _with_rate(m1k40.open_m1k40(source), rate_hz)
    return _with_rate(vidar_dat.open_raster(source, height, width, row_bits, drop_tail), rate_hz)


def write_spikes(
    path: str | Path,
    stream: SpikeStream,
    *,
    format: str | None = None,
    row_bits: int | None = None,
    force: bool = False,
) -> None:
    """Write a stream to a file that `open_spikes` reads back exactly.

    Args:
        path: of the file; it appears whole or not at all.
        stream: what to write.
        format: "dat", "m1k40", "npz" or "spikes-h5"; by default by the ending: .dat .bin .npz .h5.
        row_bits: of a .dat: bits a row on disk, at least the width, which is the default (416 for a Vidar's dumps).
        force: replace an existing file.

    Raises:
        UsageError: unknown format, the file exists, or the format cannot hold the stream.

    Edges:
        .dat and .bin hold bits only: the rate and the start are not written, and a stream with lost ticks is refused.
    """
    from spikerig.dataset import m1k40, spikes_h5, spikes_npz, vidar_dat
    from spikerig.dataset.outfile import whole_file

    target = Path(path)
    endings = {".dat": "dat", ".bin": "m1k40", ".npz": "npz", ".h5": "spikes-h5", ".hdf5": "spikes-h5"}
    kind = format or endings.get(target.suffix.lower(), "")
    if kind not in endings.values():
        raise UsageError("no such spike format", value=kind or target.name, expected="dat, m1k40, npz or spikes-h5")
    if kind in ("dat", "m1k40") and len(stream.lost):
        raise UsageError(
            "this format cannot say which ticks were lost", value=f"{kind}, lost {stream.lost.tolist()[:4]}",
            next="write .h5 or .npz",
        )  # fmt: skip
    if row_bits is not None and kind != "dat":
        raise UsageError("only .dat has a choice of row bits", value=row_bits)
    with whole_file(target, force=force) as part:
        if kind == "dat":
            vidar_dat.write_raster(part, stream, row_bits or stream.width)
        elif kind == "m1k40":
            m1k40.write_m1k40(part, stream)
        elif kind == "npz":
            spikes_npz.write_npz(part, stream)
        else:
            with spikes_h5.H5Writer(part, stream) as out:
                out.append(stream)


def _with_rate(file: SpikeFile, rate_hz: float | None) -> SpikeFile:
    from dataclasses import replace

    if rate_hz is None:
        return file
    if not (np.isfinite(rate_hz) and rate_hz > 0):
        file.close()
        raise UsageError("a tick rate must be positive and finite", value=rate_hz, expected="e.g. 40000")
    return replace(file, rate_hz=float(rate_hz))


def _first_bytes(path: Path) -> bytes:
    try:
        if path.is_dir():
            raise UsageError("this is a folder, not a file", value=path)
        with path.open("rb") as file:
            start = file.read(8)
    except FileNotFoundError as error:
        raise UsageError("there is no such file", value=path) from error
    except OSError as error:
        from spikerig.dataset.errors import HostError

        raise HostError("the file cannot be opened", value=f"{path}: {error.strerror}") from error
    if not start:
        raise DataError("the file is empty", value=path, cause="a recording that never began, or a failed copy")
    return start
