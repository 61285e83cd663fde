"""Dark current: charge that comes without light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spikerig.rigctl.sim.effects import Floats, Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits


@dataclass(frozen=True, slots=True)
class DarkCurrent:
    """A constant charge a tick, with a fixed pattern.

    Args:
        rate: thresholds a tick (0.0047 measured by SCSim; the demo's sensor has 0.002).
        sd: of the fixed pattern between pixels, thresholds a tick; cut at zero.
    """

    rate: float = limits(0.002, 0, 1, "thresholds a tick")
    sd: float = limits(0.0, 0, 1, "thresholds a tick")

    name: ClassVar[str] = "dark_current"
    stage: ClassVar[Stage] = Stage.CHARGE
    per: ClassVar[str] = "knot"
    source: ClassVar[str] = "SCSim (arXiv 2304.03129): 0.47 % of the threshold a tick, sd 0.18 %"
    vanishes: ClassVar[str] = "rate = sd = 0"
    cost_ns: ClassVar[float] = 1.3

    def begin(self, site: Site) -> Hooks:
        """The sensor's dark charge."""
        dark: Floats | np.float32 = np.float32(self.rate)
        if self.sd > 0:
            pattern = site.draw_fixed(self.name).standard_normal((site.height, site.width))
            dark = np.maximum(self.rate + self.sd * pattern, 0).astype(np.float32)

        def light(block: Floats) -> None:
            block += dark

        return Hooks(light=light)

    def magnitude(self, facts: Facts) -> Bound:
        """(rate + sd z) ticks, z normal; no more than fit below one spike a tick."""
        dark = np.maximum(self.rate + self.sd * facts.normal()[0], 0)
        return Bound(facts.spikes(dark), 0.0, f"({self.rate:g} + {self.sd:g} z) x {facts.ticks}")
