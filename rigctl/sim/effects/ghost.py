"""Ghost: the back of the beam splitter reflects too."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spikerig.rigctl.sim.arms import ARMS, looked_at, on_arm
from spikerig.rigctl.sim.effects import Floats, Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits
from spikerig.rigctl.sim.warp import resampler, shift_map


@dataclass(frozen=True, slots=True)
class Ghost:
    """A weak copy of the picture, shifted, is added to it: picture + share * shifted picture.

    Args:
        arm: spike, rgb or both.
        share: ghost over picture. A 50:50 plate whose back reflects R sends R / 2 after the picture on either arm:
            0.02 from bare glass (R = 4 %), 0.005 from a back coated to 1 %.
        dx, dy: by how much it lies to the right and below.
    """

    arm: str = limits("spike", unit="arm", choices=ARMS)
    share: float = limits(0.01, 0, 1, "of the picture")
    dx: float = limits(4.0, -10_000, 10_000, "px")
    dy: float = limits(0.0, -10_000, 10_000, "px")

    name: ClassVar[str] = "ghost"
    stage: ClassVar[Stage] = Stage.OPTICS
    per: ClassVar[str] = "knot"
    source: ClassVar[str] = "Fresnel: glass of n = 1.5 reflects ((n - 1) / (n + 1))^2 = 4 % at each surface"
    vanishes: ClassVar[str] = "share = 0"
    cost_ns: ClassVar[float] = 5.0

    def begin(self, site: Site) -> Hooks:
        """The same for every view."""
        return Hooks() if self.share == 0 else on_arm(self.arm, self._added(site.height, site.width))

    def _added(self, height: int, width: int):
        shifted = resampler(height, width, shift_map(self.dx, self.dy))

        def added(pictures: Floats) -> Floats:
            return pictures + np.float32(self.share) * shifted(pictures)

        return added

    def magnitude(self, facts: Facts) -> Bound:
        """share x the shifted picture."""
        return looked_at(
            facts, self.arm, self._added(*facts.size), f"{self.share:g} x light {self.dx:g}, {self.dy:g} px off"
        )
