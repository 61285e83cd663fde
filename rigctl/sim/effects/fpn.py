"""Threshold fixed-pattern noise: no two pixels fire at quite the same charge."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spikerig.rigctl.sim.effects import Floats, Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits


@dataclass(frozen=True, slots=True)
class ThresholdFpn:
    """Each pixel's threshold is 1 + sd * normal, the same in every view; never below 0.1.

    Args:
        sd: relative (0.045 measured by SCSim, at most 0.037 in the one real clip measured).
    """

    sd: float = limits(0.04, 0, 0.3, "of the threshold")

    name: ClassVar[str] = "threshold_fpn"
    stage: ClassVar[Stage] = Stage.CHARGE
    per: ClassVar[str] = "knot"
    source: ClassVar[str] = "SCSim (arXiv 2304.03129): 4.5 %; SpikingSIM real_spike: at most 3.7 % rms"
    vanishes: ClassVar[str] = "sd = 0"
    cost_ns: ClassVar[float] = 1.2

    def begin(self, site: Site) -> Hooks:
        """The sensor's thresholds."""
        pattern = site.draw_fixed(self.name).standard_normal((site.height, site.width))
        inverse = (1 / np.maximum(1 + self.sd * pattern, 0.1)).astype(np.float32)

        def light(block: Floats) -> None:
            block *= inverse

        return Hooks(light=light)

    def magnitude(self, facts: Facts) -> Bound:
        """sd z of the count, z normal."""
        threshold = np.maximum(1 + self.sd * facts.normal()[0], 0.1)
        counts = facts.most(facts.counts)
        return Bound(facts.spikes(lambda light: light / threshold), 0.0, f"{self.sd:g} z x {counts:.3g} spikes")
