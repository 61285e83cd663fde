"""Brightness ramp: light that grows or fades over the take."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.effects import Floats, Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits

PIXELS = 4000  # that the bound is computed from


@dataclass(frozen=True, slots=True)
class BrightnessRamp:
    """All light is multiplied by 1 + per_s t, t from the start of the take; never below zero.

    Between light samples h apart the product of two lines is off by at most per_s h / 4 of the light's own change.

    Args:
        per_s: relative change a second; 0.001 is a sky that dims by 6 % a minute.
    """

    per_s: float = limits(0.001, -1000, 1000, "of the first light, a second")

    name: ClassVar[str] = "brightness_ramp"
    stage: ClassVar[Stage] = Stage.LIGHT
    per: ClassVar[str] = "knot"
    source: ClassVar[str] = "stated definition"
    vanishes: ClassVar[str] = "per_s = 0"
    cost_ns: ClassVar[float] = 0.2

    def begin(self, site: Site) -> Hooks:
        """The same ramp for every view."""
        if self.per_s == 0:
            return Hooks()

        def radiance(rgb: Floats, at_s: NDArray[np.float64]) -> None:
            rgb *= np.maximum(1 + self.per_s * at_s, 0).astype(np.float32)[:, None, None, None]

        return Hooks(radiance=radiance)

    def magnitude(self, facts: Facts) -> Bound:
        """per_s t light, over the times of all views."""
        views = np.unique(np.linspace(1, facts.views, min(facts.views, 32)).astype(int))
        times = views * facts.period_s + facts.exposure_s / 2
        factors = np.maximum(1 + self.per_s * times, 0)
        some = slice(None, None, max(1, len(facts.light) // PIXELS))
        spikes = facts.spikes_between(facts.light[some], facts.light[some] * factors[:, None])
        dn = facts.dn_between(facts.rgb[some], facts.rgb[some] * factors[:, None, None])
        light = facts.most(facts.counts)
        return Bound(spikes, dn, f"{abs(self.per_s):g} x up to {times[-1]:.3g} s x light, {light:.3g} spikes")
