"""Comparator noise: the threshold is not quite the same at any two looks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spikerig.rigctl.sim.effects import Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits


@dataclass(frozen=True, slots=True)
class ComparatorNoise:
    """Each tick a pixel's charge is compared to 1 + sd * normal; one threshold is taken off when it fires.

    Charge is conserved, so a spike that comes early makes the next interval longer. (SCSim takes off the noisy
    threshold instead, so that its errors add up: intervals spread by sd there and by sqrt(2) sd here.)

    Args:
        sd: of the threshold.
    """

    sd: float = limits(0.0058, 0, 0.2, "of the threshold")

    name: ClassVar[str] = "comparator_noise"
    stage: ClassVar[Stage] = Stage.CHARGE
    per: ClassVar[str] = "tick"
    source: ClassVar[str] = "SCSim (arXiv 2304.03129), v2s.py: sd 0.00636 V of a swing of 1.0924 V, 0.58 %"
    vanishes: ClassVar[str] = "sd = 0"
    cost_ns: ClassVar[float] = 2.2

    def begin(self, site: Site) -> Hooks:
        """The kernel's noise of one view."""
        return Hooks(pixel={"comparator": (self.sd, site.key(self.name))}) if self.sd > 0 else Hooks()

    def magnitude(self, facts: Facts) -> Bound:
        """Spikes at both ends of the exposure sooner or later by sd (|z| + sqrt(2 ln(1 + sd / rate))), z normal."""
        early = np.sqrt(2 * np.log1p(self.sd / np.maximum(facts.rate, 1e-9)))
        start, end = self.sd * (np.abs(facts.normal(2)) + early) * (facts.rate > 0)
        start = start if facts.margin_ticks else np.zeros_like(start)
        told = f"{self.sd:g} (|z| + {facts.most(early):.3g}) thresholds at each end"
        return Bound(facts.counted(end - start, start), 0.0, told)
