"""Read noise of the RGB camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spikerig.rigctl.sim.effects import Floats, Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits


@dataclass(frozen=True, slots=True)
class ReadNoise:
    """Normal noise on every channel of the encoded (sRGB) picture, before rounding to 8 bits.

    Args:
        sd: of the full scale.
    """

    sd: float = limits(0.004, 0, 1, "of the encoded full scale")

    name: ClassVar[str] = "read_noise"
    stage: ClassVar[Stage] = Stage.RGB
    per: ClassVar[str] = "frame"
    source: ClassVar[str] = "the sensor of the feasibility study: one digital number"
    vanishes: ClassVar[str] = "sd = 0"
    cost_ns: ClassVar[float] = 20.0

    def begin(self, site: Site) -> Hooks:
        """Noise of one view's picture."""
        rng = site.draw(self.name)

        def encoded(picture: Floats) -> None:
            picture += np.float32(self.sd) * rng.standard_normal(picture.shape, dtype=np.float32)

        return Hooks(encoded=encoded)

    def magnitude(self, facts: Facts) -> Bound:
        """255 sd z, z normal."""
        return Bound(0.0, facts.counted(255 * self.sd * facts.normal()[0]), f"255 x {self.sd:g} z")
