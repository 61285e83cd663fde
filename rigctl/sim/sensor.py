"""Light over time, and the spike sensor under it: pixels that integrate and fire."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.bayer import mosaic
from spikerig.dataset.errors import NumericsError, UsageError
from spikerig.dataset.kernels import fire
from spikerig.dataset.sim_kernels import fire_noisy
from spikerig.rigctl.sim.effects import Hooks
from spikerig.rigctl.sim.spec import Sensor

Floats = NDArray[np.floating]  # float32 unless said


@dataclass(frozen=True, slots=True)
class Light:
    """Linear light on both sensors over time.

    Args:
        rgb: float32[K,H,W,3], 1.0 = display white.
        knots: ticks, int64[K] (light is linear in between) or int64[K+1] (picture k holds for knots k to k+1).
        exposure: (first tick, end tick) of the RGB exposure; both are knots.
        rate_hz: ticks a second.
        t0_ns: start of tick knots[0].
        arm: what the RGB arm sees, where that is not what the spike arm sees (as rgb).
    """

    rgb: Floats
    knots: NDArray[np.int64]
    exposure: tuple[int, int]
    rate_hz: float
    t0_ns: int = 0
    arm: Floats | None = None

    def __post_init__(self) -> None:
        k = len(self.rgb)
        if self.arm is not None and self.arm.shape != self.rgb.shape:
            raise UsageError("the two arms' light differs in shape", value=self.arm.shape, expected=str(self.rgb.shape))
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

    @property
    def at_s(self) -> NDArray[np.float64]:
        """The rig's time at each picture, seconds, float64[K]: at its knot, or the middle of the slot it holds for."""
        knots = self.knots.astype(np.float64)
        ticks = (knots[:-1] + knots[1:]) / 2 if self.hold else knots
        return self.t0_ns * 1e-9 + (ticks - knots[0]) / self.rate_hz


def refined(light: Light, step_s: float) -> Light:
    """The same light with samples no further apart than asked for; a new one, whose pictures may be changed.

    Args:
        light: linear in time between its knots, or held.
        step_s: longest time between samples; not below a tick.

    Edges:
        No step asked for (0) only copies. Where pictures hold, a slot that is cut holds the same picture in its parts.
    """
    most = max(1.0, step_s * light.rate_hz) if step_s > 0 else np.inf
    spans = np.diff(light.knots)
    parts = np.clip(np.ceil(spans / most - 1e-9), 1, spans).astype(np.int64)
    if not parts.size or parts.max() == 1:  # nothing to cut
        return replace(light, rgb=light.rgb.copy(), arm=None if light.arm is None else light.arm.copy())
    k = np.repeat(np.arange(len(spans)), parts)
    first = np.concatenate([[0], np.cumsum(parts)[:-1]])
    share = (np.arange(len(k)) - np.repeat(first, parts)) / parts[k]
    cut = np.rint(light.knots[k] + share * spans[k]).astype(np.int64)
    knots = np.append(cut, light.knots[-1])

    def along(pictures: Floats) -> Floats:
        if light.hold:
            return pictures[k]
        w = ((cut - light.knots[k]) / spans[k]).astype(np.float32)[:, None, None, None]
        inner = pictures[k] * (1 - w) + pictures[k + 1] * w
        return np.concatenate([inner, pictures[-1:]])

    return replace(light, rgb=along(light.rgb), knots=knots, arm=None if light.arm is None else along(light.arm))


def delayed(light: Floats, knots: NDArray[np.int64], by: NDArray[np.float64]) -> tuple[Floats, NDArray[np.int64]]:
    """Light as a sensor sees it whose tick n looks at time n - by: its clock is ahead.

    Args:
        light: float32[K,H,W] at knots [K] (linear) or [K+1] (hold).
        knots: ticks.
        by: ticks, float64 at each knot; what is asked for beyond the ends stands still.

    Returns:
        The light on a grid that has a knot at the nearest tick to each kink, and its knots.
    """
    if not np.any(by):
        return light, knots
    hold = len(knots) == len(light) + 1
    moved = knots + by
    if np.any(np.diff(moved) <= 0):
        raise UsageError("a clock may not run backwards within a view", value=by)
    inner = np.clip(np.rint(moved), knots[0], knots[-1]).astype(np.int64)
    grid = np.unique(np.concatenate([[knots[0], knots[-1]], inner]))
    if hold:
        slot = np.clip(np.searchsorted(moved, (grid[:-1] + grid[1:]) / 2, side="right") - 1, 0, len(light) - 1)
        return light[slot], grid
    at = np.clip(grid, moved[0], moved[-1])
    k = np.clip(np.searchsorted(moved, at, side="right") - 1, 0, len(light) - 2)
    w = ((at - moved[k]) / (moved[k + 1] - moved[k])).astype(np.float32)[:, None, None]
    return light[k] * (1 - w) + light[k + 1] * w, grid


def spike_light(rgb: Floats, sensor: Sensor) -> Floats:
    """Light as the spike pixels see it, in thresholds a tick, float32[K,H,W].

    gain * (response . rgb); of a colour sensor gain * channel_gain * its own colour.

    Raises:
        NumericsError: a value is negative or not finite.
    """
    if sensor.bayer is not None:
        light = mosaic(rgb, sensor.bayer)
        light *= np.float32(sensor.gain)
    else:
        k = np.array(sensor.response, np.float32) * np.float32(sensor.gain)
        light = rgb[..., 0] * k[0]
        light += rgb[..., 1] * k[1]
        light += rgb[..., 2] * k[2]
    if not (np.min(light, initial=0) >= 0 and np.isfinite(np.max(light, initial=0))):
        bad = int(np.count_nonzero(~(light >= 0) | ~np.isfinite(light)))
        raise NumericsError("light must be finite and not negative", value=f"{bad} of {light.size} values are not")
    return light


def integrate(
    light: Floats, knots: NDArray[np.int64], start: NDArray[np.float64], steps: Sequence[Hooks] = ()
) -> tuple[NDArray[np.uint8], NDArray[np.uint32] | NDArray[np.int64], NDArray[np.float64]]:
    """Integrate and fire (Eq. 5 and 6), the surplus kept, at most one spike a tick.

    Args:
        light: float32[K,H,W], thresholds a tick; taken over (effects may change it in place).
        knots: int64[K] or [K+1], as in `Light`.
        start: float64[H,W] charge before the first tick, 0 to 1 thresholds.
        steps: hooks of the effects in stage order.

    Returns:
        bits uint8[T,H,ceil(W/8)]; charge left [H,W] in 2^-32 thresholds, uint32, or int64 where effects inside the
        pixel can leave it below 0 or above one; charge lost (clipped, or gone in resets) float64[H,W] in thresholds:
        in = fired + left + lost, `in` after shot noise.

    Raises:
        UsageError: two effects that set the same thing inside a pixel.

    Cost:
        The light is only touched at its knots; effects inside the pixel cost what their kernel does.
    """
    pixel: dict[str, Any] = {}
    for h in steps:
        if h.light is not None:
            h.light(light)
        twice = set(pixel) & set(h.pixel)
        if twice:
            raise UsageError("two effects set the same thing inside a pixel", value=", ".join(sorted(twice)))
        pixel |= h.pixel
    charge = np.minimum(np.floor(start * 2.0**32), 2.0**32 - 1).astype(np.uint32)
    hold = len(knots) == len(light) + 1
    if not set(pixel) - {"carry"}:
        return fire(light, knots, charge, hold=hold, **pixel)
    return fire_noisy(light, knots, charge, hold=hold, **pixel)
