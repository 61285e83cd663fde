"""What the bounds of effects are computed from: a sample of a scene's pixels, and what is known of its timing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.images import srgb_from_linear

if TYPE_CHECKING:
    from spikerig.rigctl.sim.sensor import Light

Floats = NDArray[np.floating]
PART = 95.0  # a bound holds for this share of the pixels, percent
SLACK = 1.25  # bounds take changes of charge this much larger than computed: a survey is a sample
RARE = 1 - PART / 100
SURE = 3.0  # standard deviations of a share of one picture's pixels
DRAWS = 8192  # of a noise, at least, where a bound needs its distribution


@dataclass(frozen=True, slots=True)
class Bound:
    """How much an effect can change the two outputs, in 95 % of the pixels.

    Counts are whole, and the phases of pixels are as good as even, so a change of charge by c thresholds changes a
    count by floor(c) or ceil(c), by the latter with chance c - floor(c): a tenth of a threshold changes one count in
    ten by one, and the 95th percentile of the change is 1, not 0.1. Charge gained before the exposure begins counts
    too: it moves the spike that falls in first. See `Facts.counted`.

    Args:
        spikes: change of the spike count of one exposure: whole from 1 on; below 1 the 95th percentile is no change
            at all, and the number is the share of pixels that change, over 5 %, so that small bounds may be summed.
        dn: change of an RGB value, digital numbers of 255; these are whole too, and told in the same way.
        formula: where it comes from, with this scene's numbers.
    """

    spikes: float
    dn: float
    formula: str


def told(difference: NDArray[Any]) -> float:
    """A change that happened, told as `Bound` tells bounds: what 95 % of the values stay within; where 95 % do not
    change at all, the share that does, over 5 %."""
    size = np.abs(np.asarray(difference, np.float64))
    moved = float(np.mean(size > 0)) if size.size else 0.0
    return moved / RARE if moved <= RARE else float(np.percentile(size, PART, method="inverted_cdf"))


@dataclass(frozen=True, slots=True)
class Facts:
    """A scene as its effects see it, from a survey of a few views; all arrays are over the same n sampled pixels.

    Args:
        light: float64[n], the exposure's mean light on the spike sensor, thresholds a tick.
        light_max: float64[n], its highest value within the exposure.
        gradient: float64[n], steepest change of that light from pixel to pixel, thresholds a tick and pixel.
        rgb: float64[n,3], the exposure's mean linear light.
        rgb_gradient: float64[n,3], its steepest change from pixel to pixel, linear light a pixel.
        slope: float64[n], how much the light changes from start to end of one exposure, thresholds a tick.
        rgb_slope: float64[n,3], the same of linear light.
        bend: float64[n], largest difference between the light and the same light one pixel around it, averaged over
            the eight neighbours (what a blur removes), thresholds a tick.
        rgb_bend: float64[n,3], the same of linear light.
        radius: float64[n], distance from the picture's centre over half its diagonal, 0 to 1.
        motion: float64[n], image motion over one exposure, pixels.
        ticks: of an exposure.
        rate_hz: ticks a second.
        margin_ticks: spikes kept on each side.
        size: (height, width).
        focal_px: focal length.
        views: how many.
        period_s: from one exposure to the next.
        depth: (nearest, median) distance along the axis, world units; infinite where not known.
        looks: the light of the surveyed views, for effects whose change is not a function of single pixels.
        means: of each look, the exposure's mean light on the spike sensor float64[H,W] and in RGB float64[H,W,3].
        response: of the spike sensor to linear red, green and blue, thresholds a tick.
    """

    light: Floats
    light_max: Floats
    gradient: Floats
    rgb: Floats
    rgb_gradient: Floats
    slope: Floats
    rgb_slope: Floats
    bend: Floats
    rgb_bend: Floats
    radius: Floats
    motion: Floats
    ticks: int
    rate_hz: float
    margin_ticks: int
    size: tuple[int, int]
    focal_px: float
    views: int
    period_s: float
    depth: tuple[float, float] = (np.inf, np.inf)
    looks: tuple[Light, ...] = ()
    means: tuple[tuple[Floats, Floats], ...] = ()
    response: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def exposure_s(self) -> float:
        """Seconds of an exposure."""
        return self.ticks / self.rate_hz

    @property
    def rate(self) -> Floats:
        """float64[n], spikes a tick: the light, less what is clipped."""
        return self.light - surplus(self.light, self.light_max)

    @property
    def counts(self) -> Floats:
        """float64[n], spikes an exposure."""
        return self.rate * self.ticks

    def most(self, values: Floats | float) -> float:
        """The value that 95 % of the pixels stay below; of a change [n] or [n,3]."""
        values = np.asarray(values, np.float64)
        return float(np.percentile(np.abs(values), PART)) if values.size else 0.0

    def spikes(self, change: Floats | Callable[[Floats], Floats], share: float = 1.0) -> float:
        """Change of the spike count when the light changes: by an amount [..,n] in thresholds a tick, or a function's.

        The count of a steady pixel moves by the light times the ticks, and not beyond one spike a tick.
        """
        after = change(self.light) if callable(change) else self.light + np.asarray(change)
        after = np.maximum(after, 0)
        moved = after - surplus(after, after + (self.light_max - self.light)) - self.rate
        return self.counted(moved * self.ticks, moved * self.margin_ticks, share)

    def spikes_between(self, before: Floats, after: Floats, share: float = 1.0) -> float:
        """Change of the spike count between two lights, thresholds a tick; any shapes that go together."""
        moved = np.clip(after, 0, 1) - np.clip(before, 0, 1)
        return self.counted(moved * self.ticks, moved * self.margin_ticks, share)

    def counted(self, change: Floats, before: Floats | float = 0.0, share: float = 1.0, together: float = 1.0) -> float:
        """Change of the spike count that 95 % of the pixels stay within, as `Bound.spikes` says.

        Args:
            change: of the charge over the exposure, thresholds [..,n].
            before: of the charge until the exposure begins, thresholds [..,n].
            share: of the pixels (or views) that change at all.
            together: pixels that change at once, as a row does: shares of a picture scatter the more for it, and the
                bound takes three standard deviations of that.

        Edges:
            The count is floor(phase + charge) at the end less the same at the start, both phases even and independent:
            exact where the counts of a picture spread over a few spikes, which a picture's do.
        """
        start = SLACK * np.asarray(before, np.float64)
        end = start + SLACK * np.asarray(change, np.float64)
        start, end = (a.reshape(-1) for a in np.broadcast_arrays(start, end))
        if not start.size:
            return 0.0
        whole = (np.floor(end) - np.floor(start)).astype(np.int64)
        more, less = end - np.floor(end), start - np.floor(start)
        tally = np.zeros(int(np.abs(whole).max()) + 2)
        for step, chance in (
            (-1, (1 - more) * less),
            (0, more * less + (1 - more) * (1 - less)),
            (1, more * (1 - less)),
        ):
            found = np.bincount(np.abs(whole + step), chance)
            tally[: len(found)] += found
        beyond = share * np.maximum(1 - np.cumsum(tally) / start.size, 0)
        beyond += SURE * np.sqrt(beyond * (together / max(self.size[0] * self.size[1], 1)))
        least = int(np.argmax(beyond <= RARE))  # the last is 0 but for rounding
        return float(least) if least else float(beyond[0]) / RARE

    def normal(self, kinds: int = 1) -> Floats:
        """Fixed draws of independent unit normals to compute with, float64[kinds,m,n], m * n at least `DRAWS`."""
        n = max(1, self.light.size)
        return np.random.default_rng(95).standard_normal((kinds, -(-DRAWS // n), n))

    def dn(self, change: Floats | Callable[[Floats], Floats]) -> float:
        """Change of an RGB value when linear light changes: by an amount [..,n,3] either way, or to a function's."""
        if callable(change):
            return self.dn_between(self.rgb, change(self.rgb))
        return max(self.dn_between(self.rgb, self.rgb + sign * np.asarray(change)) for sign in (1, -1))

    def dn_between(self, before: Floats, after: Floats) -> float:
        """Change of an RGB value between two linear lights; whole values, so told as `counted` tells counts."""
        codes = [srgb_from_linear(np.clip(light, 0, 1)) for light in (before, after)]
        return self.counted(255 * (codes[1] - codes[0]))


def surplus(mean: Floats, most: Floats) -> Floats:
    """Light beyond one threshold a tick, on average, of light whose values over time spread evenly around its mean.

    Edges:
        They reach from twice the mean less the most, or if that is negative from 0 for a part of the time.
    """
    least = np.maximum(2 * mean - most, 0)
    span = np.maximum(most - least, 1e-12)
    part = np.minimum(1, 2 * mean / np.maximum(most, 1e-12))
    return np.where(least < 1, part * np.maximum(most - 1, 0) ** 2 / (2 * span), np.maximum(mean - 1, 0))
