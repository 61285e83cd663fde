"""Noise of the RGB sensor: photo-electrons come one by one, and reading them adds some."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spikerig.rigctl.sim.effects import Floats, Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits


@dataclass(frozen=True, slots=True)
class RgbNoise:
    """Linear light x gives a normal number of electrons, mean m = x full_well_e and variance m + read_e^2.

    More than the full well is lost. The black level is kept: what is below it is only cut when it is encoded. Each
    pixel and channel takes one normal draw, whatever its light, so that other effects leave the draws as they are;
    mean and variance are those of Poisson electrons and normal read noise, skewness below some 20 electrons is not.

    Args:
        full_well_e: electrons at white.
        read_e: standard deviation of reading.
    """

    full_well_e: float = limits(6000.0, 1, 1e15, "electrons")
    read_e: float = limits(2.5, 0, 1e6, "electrons")

    name: ClassVar[str] = "rgb_noise"
    stage: ClassVar[Stage] = Stage.RGB
    per: ClassVar[str] = "frame"
    source: ClassVar[str] = "EMVA 1288's linear model; the defaults are usual for pixels of 1.1 to 1.5 um, not measured"
    vanishes: ClassVar[str] = "full_well_e -> infinity with read_e / full_well_e -> 0"
    cost_ns: ClassVar[float] = 35.0

    def begin(self, site: Site) -> Hooks:
        """Noise of one view's picture."""
        rng = site.draw(self.name)

        def linear(light: Floats) -> Floats:
            z = rng.standard_normal(light.shape, dtype=np.float32)
            return np.minimum(light + z * self.spread(light).astype(np.float32), 1)

        return Hooks(linear=linear)

    def spread(self, light: Floats) -> Floats:
        """Standard deviation of linear light."""
        variance = np.maximum(np.asarray(light, np.float64), 0) * self.full_well_e + self.read_e**2
        return np.sqrt(variance) / self.full_well_e

    def magnitude(self, facts: Facts) -> Bound:
        """Draws of that deviation, through the sRGB curve."""
        light = facts.most(facts.rgb)
        z = facts.normal(3).transpose(1, 2, 0)
        words = f"normal, sd sqrt({light:.3g} x {self.full_well_e:g} + {self.read_e:g}^2) / {self.full_well_e:g}"
        return Bound(0.0, facts.dn_between(facts.rgb, facts.rgb + z * self.spread(facts.rgb)), words)
