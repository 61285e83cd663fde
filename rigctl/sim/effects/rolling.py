"""Rolling shutter: rows are read, and exposed, one after the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spikerig.rigctl.sim.arms import in_views
from spikerig.rigctl.sim.effects import Floats, Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits
from spikerig.rigctl.sim.rgb import shares_of
from spikerig.rigctl.sim.sensor import Light

STEPS = 256  # of an exposure, where the bound is computed


@dataclass(frozen=True, slots=True)
class RollingShutter:
    """Each row of the RGB sensor is exposed a little later than the one above it, all for as long.

    The middle row's exposure is the view's; half the read-out before and after it must lie within the margins.

    Args:
        readout_ms: from the first row to the end of the last, whatever the picture's height: what a GoPro file calls
            SROT. A row takes readout_ms / height.
    """

    readout_ms: float = limits(7.0, 0, 10_000, "ms")

    name: ClassVar[str] = "rolling_shutter"
    stage: ClassVar[Stage] = Stage.RGB
    per: ClassVar[str] = "knot"
    source: ClassVar[str] = "GPMF's SROT: 20.6 ms of a GoPro MAX at 30 fps; at 119.88 fps it must be below 8.34 ms"
    vanishes: ClassVar[str] = "readout_ms = 0"
    cost_ns: ClassVar[float] = 3.0

    def row_ns(self, height: int) -> float:
        """Read-out time of one row."""
        return self.readout_ms * 1e6 / height

    def beyond(self, height: int, margin_ticks: int, tick_ns: float) -> str:
        """What is wrong with margins that do not hold the rows' exposures: in words, empty when they do."""
        needed = self.row_ns(height) * (height // 2) / tick_ns
        if needed <= margin_ticks:
            return ""
        told = f"is {margin_ticks}, but rolling_shutter exposes the first row {needed:.4g} ticks before the middle one"
        return f"{told}: raise it, or lower readout_ms"

    def begin(self, site: Site) -> Hooks:
        """The same for every view."""
        return Hooks(row_ns=self.row_ns(site.height))

    def magnitude(self, facts: Facts) -> Bound:
        """What each row sees at its own time against the middle row's."""
        row_ns = self.row_ns(facts.size[0])
        pairs = [(mean, _rolled(look, row_ns)) for look, (_, mean) in zip(facts.looks, facts.means, strict=True)]
        words = f"rows up to {self.readout_ms / 2:g} ms off, light moves {facts.most(facts.motion):.3g} px an exposure"
        return Bound(0.0, facts.dn_between(*np.stack(pairs, 1)), f"{words}; {in_views(facts)}")


def _rolled(light: Light, row_ns: float) -> Floats:
    """What the rows see at their own times, float64[H,W,3]; beyond the light looked at, it runs back again."""
    height = light.rgb.shape[1]
    begin, end = light.exposure
    first = begin + (np.arange(height) - height // 2) * (row_ns * 1e-9 * light.rate_hz)
    at = first[:, None] + (np.arange(STEPS) + 0.5) * ((end - begin) / STEPS)
    return np.einsum("rk,krwc->rwc", shares_of(light, at, 1 / STEPS), light.rgb)
