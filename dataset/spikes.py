"""Spike streams: packed one-bit frames in memory, and files of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import frozen_array, tick_from_ns
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

    def tick_at(self, at_ns: int) -> float:
        """The (fractional) tick at a time on this stream's clock; tick k covers [k, k+1)."""
        if self.rate_hz is None:
            raise UsageError("this stream has no rate, so it has no time", next="give --rate-hz")
        return float(tick_from_ns(at_ns, self.rate_hz, self.t0_ns))
