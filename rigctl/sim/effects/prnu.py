"""Photo-response non-uniformity: no two pixels turn quite the same share of the light into charge."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spikerig.rigctl.sim.effects import Floats, Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits


@dataclass(frozen=True, slots=True)
class Prnu:
    """Each pixel's gain for light is 1 + sd * normal, the same in every view, never below 0. Dark current stays.

    Args:
        sd: relative.
    """

    sd: float = limits(0.058, 0, 0.5, "of the gain")

    name: ClassVar[str] = "prnu"
    stage: ClassVar[Stage] = Stage.CHARGE
    per: ClassVar[str] = "knot"
    source: ClassVar[str] = "SCSim (arXiv 2304.03129), v2s.py: alpha N(1.0128, 0.0584), 5.8 %"
    vanishes: ClassVar[str] = "sd = 0"
    cost_ns: ClassVar[float] = 1.3

    def begin(self, site: Site) -> Hooks:
        """The sensor's gains."""
        pattern = site.draw_fixed(self.name).standard_normal((site.height, site.width))
        gain = np.maximum(1 + self.sd * pattern, 0).astype(np.float32)

        def light(block: Floats) -> None:
            block *= gain

        return Hooks(light=light)

    def magnitude(self, facts: Facts) -> Bound:
        """sd z of the count, z normal."""
        gain = np.maximum(1 + self.sd * facts.normal()[0], 0)
        counts = facts.most(facts.counts)
        return Bound(facts.spikes(lambda light: light * gain), 0.0, f"{self.sd:g} z x {counts:.3g} spikes")
