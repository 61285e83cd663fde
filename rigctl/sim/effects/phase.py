"""Initial phase: pixels have integrated for a while before the first tick."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.effects import Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts


@dataclass(frozen=True, slots=True)
class InitialPhase:
    """Charge before the first tick, even between 0 and the threshold, new in each view."""

    name: ClassVar[str] = "initial_phase"
    stage: ClassVar[Stage] = Stage.CHARGE
    per: ClassVar[str] = "frame"
    source: ClassVar[str] = "SpikeCV video_to_spike: U(0, threshold)"
    vanishes: ClassVar[str] = "left out, or exposure.phase = zero: the paper's zero charge"
    cost_ns: ClassVar[float] = 26.0

    def begin(self, site: Site) -> Hooks:
        """Charges of one view."""
        rng = site.draw(self.name)

        def charge(start: NDArray[np.float64]) -> None:
            start += rng.random(start.shape)

        return Hooks(charge=charge)

    def magnitude(self, facts: Facts) -> Bound:
        """Each pixel's phase at both ends of the exposure: one spike more or less."""
        return Bound(1.0 if facts.counts.any() else 0.0, 0.0, "one spike")
