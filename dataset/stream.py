"""Spikes in memory and in an open file: packed one-bit frames with their time."""

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
