"""White balance: the camera's gains of the three colours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spikerig.rigctl.sim.caster.world import Vec3
from spikerig.rigctl.sim.effects import Floats, Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits


@dataclass(frozen=True, slots=True)
class WhiteBalance:
    """Linear light, cut at the sensor's full scale, is multiplied by three gains: what of the camera's own balance does
    not fit the light.

    Args:
        gains: of red, green and blue; 1 is neutral. Cut highlights take the gains' colour, as in real pictures.
    """

    gains: Vec3 = limits((1.08, 1.0, 0.92), 0, 100, "of the light")

    name: ClassVar[str] = "white_balance"
    stage: ClassVar[Stage] = Stage.RGB
    per: ClassVar[str] = "frame"
    source: ClassVar[str] = "von Kries: a gain a colour in the sensor's own primaries"
    vanishes: ClassVar[str] = "gains = 1"
    cost_ns: ClassVar[float] = 6.0
    on_noise: ClassVar[bool] = True  # its bound is taken with the noise that reaches it

    def begin(self, site: Site) -> Hooks:
        """The same for every view."""
        return Hooks() if self.gains == (1.0, 1.0, 1.0) else Hooks(linear=self.balanced)

    def balanced(self, light: Floats) -> Floats:
        """Linear light [..., 3] after the gains."""
        return np.minimum(light, 1) * np.array(self.gains, light.dtype)

    def magnitude(self, facts: Facts) -> Bound:
        """|gain - 1| light, through the sRGB curve."""
        far = max(abs(g - 1) for g in self.gains)
        return Bound(0.0, facts.dn(self.balanced), f"light x up to {far:.3g}, light {facts.most(facts.rgb):.3g}")
