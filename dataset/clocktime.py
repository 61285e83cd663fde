"""Time: int64 nanoseconds on a named clock, half-open windows, ticks of a spike camera, and clock models."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikerig.dataset.errors import UsageError

NS = 1_000_000_000
Int64 = NDArray[np.int64]


def frozen_array(value: ArrayLike, dtype: type | np.dtype | None = None) -> NDArray:
    """A read-only view (or converted copy) of an array, for frozen records; the caller's array stays writable."""
    view = np.asarray(value, dtype=dtype).view()
    view.flags.writeable = False
    return view


def ns_from_tick(tick: ArrayLike, rate_hz: float, t0_ns: int) -> Int64:
    """Start of a tick in nanoseconds, rounded to the nearest.

    Args:
        tick: tick numbers, any shape; fractions allowed.
        rate_hz: ticks a second, > 0.
        t0_ns: start of tick 0.

    Returns:
        int64 nanoseconds, the shape of `tick`.

    Raises:
        UsageError: the rate is not positive and finite.
    """
    _check_rate(rate_hz)
    return np.rint(np.asarray(tick, np.float64) * (NS / rate_hz)).astype(np.int64) + np.int64(t0_ns)


def tick_from_ns(at_ns: ArrayLike, rate_hz: float, t0_ns: int) -> NDArray[np.float64]:
    """The (fractional) tick at a time; tick k covers [k, k+1). Inverse of `ns_from_tick` to half a nanosecond."""
    _check_rate(rate_hz)
    return (np.asarray(at_ns, np.int64) - np.int64(t0_ns)).astype(np.float64) * (rate_hz / NS)


def _check_rate(rate_hz: float) -> None:
    if not (np.isfinite(rate_hz) and rate_hz > 0):
        raise UsageError("a tick rate must be positive and finite", value=rate_hz, expected="e.g. 40000 Hz")


@dataclass(frozen=True, slots=True)
class ClockModel:
    """Rig time from a device's own time: piecewise linear between knots, extended by the end slopes.

    Args:
        device_ns: int64[K], strictly increasing.
        rig_ns: int64[K], the rig's time at the same instants, strictly increasing.
        sigma_ns: float64[K], standard deviation at the knots.
        drift_ppm: how fast the uncertainty grows outside the knots (hold-over).

    Edges:
        One knot means a constant offset and unit rate.
    """

    device_ns: Int64
    rig_ns: Int64
    sigma_ns: NDArray[np.float64]
    drift_ppm: float = 50.0

    def __post_init__(self) -> None:
        for name, dtype in (("device_ns", np.int64), ("rig_ns", np.int64), ("sigma_ns", np.float64)):
            object.__setattr__(self, name, frozen_array(getattr(self, name), dtype))
        k = len(self.device_ns)
        if k < 1 or len(self.rig_ns) != k or len(self.sigma_ns) != k:
            raise UsageError(
                "a clock model needs equally many device, rig and sigma values, at least one",
                value=(k, len(self.rig_ns), len(self.sigma_ns)),
            )
        if np.any(np.diff(self.device_ns) <= 0) or np.any(np.diff(self.rig_ns) <= 0):
            raise UsageError("clock knots must increase strictly: a clock that steps back needs a new epoch")

    @staticmethod
    def identity() -> ClockModel:
        """The rig's own clock."""
        return ClockModel(np.zeros(1, np.int64), np.zeros(1, np.int64), np.zeros(1), 0.0)

    def rig_from_device(self, device_ns: ArrayLike) -> Int64:
        """Rig time at device times; int64 nanoseconds of the same shape."""
        return _piecewise(np.asarray(device_ns, np.int64), self.device_ns, self.rig_ns)

    def device_from_rig(self, rig_ns: ArrayLike) -> Int64:
        """Device time at rig times; the inverse to a nanosecond."""
        return _piecewise(np.asarray(rig_ns, np.int64), self.rig_ns, self.device_ns)

    def sigma_at(self, device_ns: ArrayLike) -> NDArray[np.float64]:
        """Standard deviation in ns at device times: interpolated between knots, growing by `drift_ppm` outside."""
        at = np.asarray(device_ns, np.int64)
        outside = np.maximum(np.maximum(self.device_ns[0] - at, at - self.device_ns[-1]), 0)
        inside = np.interp(at.astype(np.float64), self.device_ns.astype(np.float64), self.sigma_ns)
        return inside + outside.astype(np.float64) * self.drift_ppm * 1e-6


def _piecewise(x: Int64, xs: Int64, ys: Int64) -> Int64:
    # Differences are formed in int64 before any float: a float64 of a Unix time in ns is good to 256 ns only.
    if len(xs) == 1:
        return x - xs[0] + ys[0]
    k = np.clip(np.searchsorted(xs, x, side="right") - 1, 0, len(xs) - 2)
    dx = (xs[k + 1] - xs[k]).astype(np.float64)
    dy = (ys[k + 1] - ys[k]).astype(np.float64)
    excess = np.rint((x - xs[k]).astype(np.float64) * ((dy - dx) / dx)).astype(np.int64)
    return x - xs[k] + excess + ys[k]
