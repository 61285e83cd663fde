"""Two sensors under the same light: integrate-and-fire pixels, and an RGB camera that averages its exposure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import NumericsError, UsageError
from spikerig.dataset.images import srgb_from_linear
from spikerig.dataset.kernels import fire
from spikerig.rigctl.sim.effects import Hooks
from spikerig.rigctl.sim.spec import Sensor

Floats = NDArray[np.floating]  # float32 unless said
BLOCK = 300_000  # pixel-ticks of light made at once where an effect needs every tick


@dataclass(frozen=True, slots=True)
class Light:
    """Linear light on both sensors over time.

    Args:
        rgb: float32[K,H,W,3], 1.0 = display white.
        knots: ticks, int64[K] (light is linear in between) or int64[K+1] (picture k holds for knots k to k+1).
        exposure: (first tick, end tick) of the RGB exposure; both are knots.
        rate_hz: ticks a second.
        t0_ns: start of tick knots[0].
    """

    rgb: Floats
    knots: NDArray[np.int64]
    exposure: tuple[int, int]
    rate_hz: float
    t0_ns: int = 0

    def __post_init__(self) -> None:
        k = len(self.rgb)
        if self.rgb.ndim != 4 or self.rgb.shape[3] != 3 or len(self.knots) not in (k, k + 1):
            raise UsageError("light is rgb[K,H,W,3] with K or K+1 knots", value=(self.rgb.shape, len(self.knots)))
        if np.any(np.diff(self.knots) <= 0):
            raise UsageError("knots must increase strictly", value=self.knots)
        if not set(self.exposure) <= set(self.knots.tolist()) or self.exposure[0] >= self.exposure[1]:
            raise UsageError("an exposure starts and ends at knots", value=self.exposure, expected=f"of {self.knots}")

    @property
    def hold(self) -> bool:
        """Whether pictures hold rather than blend."""
        return len(self.knots) == len(self.rgb) + 1

    def weights(self) -> NDArray[np.float64]:
        """Share of each picture in the exposure, float64[K], sum 1: trapezoid rule, or slot lengths where they hold."""
        inside = np.diff(self.knots) * ((self.knots[:-1] >= self.exposure[0]) & (self.knots[1:] <= self.exposure[1]))
        if self.hold:
            return inside / inside.sum()
        both = np.concatenate([inside, [0]]) + np.concatenate([[0], inside])
        return both / both.sum()


def spike_light(rgb: Floats, sensor: Sensor) -> Floats:
    """Light as the spike pixels see it, in thresholds a tick: gain * (response . rgb), float32[K,H,W].

    Raises:
        NumericsError: a value is negative or not finite.
    """
    k = np.array(sensor.response, np.float32) * np.float32(sensor.gain)
    light = rgb[..., 0] * k[0]
    light += rgb[..., 1] * k[1]
    light += rgb[..., 2] * k[2]
    if not (np.min(light, initial=0) >= 0 and np.isfinite(np.max(light, initial=0))):
        bad = int(np.count_nonzero(~(light >= 0) | ~np.isfinite(light)))
        raise NumericsError("light must be finite and not negative", value=f"{bad} of {light.size} values are not")
    return light


def integrate(
    light: Floats, knots: NDArray[np.int64], start: NDArray[np.float64], steps: Sequence[tuple[bool, Hooks]] = ()
) -> tuple[NDArray[np.uint8], NDArray[np.uint32], NDArray[np.float64]]:
    """Integrate and fire (Eq. 5 and 6), the surplus kept, at most one spike a tick.

    Args:
        light: float32[K,H,W], thresholds a tick; taken over (effects may change it in place).
        knots: int64[K] or [K+1], as in `Light`.
        start: float64[H,W] charge before the first tick, 0 to 1 thresholds.
        steps: (per_tick, hooks) of the effects in stage order.

    Returns:
        bits uint8[T,H,ceil(W/8)], charge left uint32[H,W] in 2^-32 thresholds, charge clipped float64[H,W] in
        thresholds: in = fired + left + clipped.

    Cost:
        Without per-tick effects the light is only touched at its knots.
    """
    hooks = [(per_tick, h.light) for per_tick, h in steps if h.light is not None]
    first = next((i for i, (per_tick, _) in enumerate(hooks) if per_tick), len(hooks))
    for _, change in hooks[:first]:
        change(light)
    charge = np.minimum(np.floor(start * 2.0**32), 2.0**32 - 1).astype(np.uint32)
    hold = len(knots) == len(light) + 1
    if first == len(hooks):
        return fire(light, knots, charge, hold=hold)
    bits = np.empty((int(knots[-1] - knots[0]), light.shape[1], (light.shape[2] + 7) // 8), np.uint8)
    clipped = np.zeros(light.shape[1:])
    at = 0
    for block in _ticks(light, knots, hold):
        for _, change in hooks[first:]:
            change(block)
        n = len(block)
        bits[at : at + n], charge, lost = fire(block, np.arange(n + 1), charge, hold=True)
        clipped += lost
        at += n
    return bits, charge, clipped


def _ticks(light: Floats, knots: NDArray[np.int64], hold: bool) -> Iterable[Floats]:
    """The light of every tick (at its midpoint), in blocks float32[n,H,W]."""
    most = max(1, BLOCK // max(1, light[0].size))
    for k in range(len(knots) - 1):
        ticks = int(knots[k + 1] - knots[k])
        for top in range(0, ticks, most):
            n = min(most, ticks - top)
            if hold:
                yield np.repeat(light[k : k + 1], n, axis=0)
            else:
                w = ((np.arange(top, top + n) + 0.5) / ticks).astype(np.float32)[:, None, None]
                block = (light[k + 1] - light[k]) * w
                block += light[k]
                yield block


def expose(light: Light) -> NDArray[np.float64]:
    """Mean linear light over the exposure, float64[H,W,3]."""
    total = np.zeros(light.rgb.shape[1:])
    for weight, picture in zip(light.weights(), light.rgb, strict=True):
        if weight:
            total += weight * picture
    return total


def encode(linear: NDArray, hooks: Iterable[Hooks] = ()) -> NDArray[np.uint8]:
    """8-bit sRGB of linear light: clip to 0..1, sRGB, the effects on the encoded picture, round; uint8[H,W,3]."""
    picture = srgb_from_linear(np.clip(linear, 0, 1)).astype(np.float32)
    for h in hooks:
        if h.encoded is not None:
            h.encoded(picture)
    return np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)
