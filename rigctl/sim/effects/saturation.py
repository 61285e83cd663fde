"""Saturation: what becomes of charge beyond one spike a tick."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spikerig.rigctl.sim.effects import Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts, surplus
from spikerig.rigctl.sim.limits import limits


@dataclass(frozen=True, slots=True)
class Saturation:
    """Charge beyond one spike a tick is clipped (and counted), as without this effect, or carried to later ticks.

    A pixel that carries keeps on firing after a highlight has passed, until its surplus is spent.

    Args:
        mode: `carry` as the public simulators that only subtract a threshold do, or `clip`.
    """

    mode: str = limits("carry", unit="mode", choices=("clip", "carry"))

    name: ClassVar[str] = "saturation"
    stage: ClassVar[Stage] = Stage.CHARGE
    per: ClassVar[str] = "tick"
    source: ClassVar[str] = "SpikeCV, S-SDM and SpikingSIM: soft reset without a limit; one read-out a tick clips"
    vanishes: ClassVar[str] = "mode = clip, or light below one threshold a tick"
    cost_ns: ClassVar[float] = 0.06

    def begin(self, site: Site) -> Hooks:
        """What the kernel does with the surplus."""
        return Hooks(pixel={"carry": True}) if self.mode == "carry" else Hooks()

    def magnitude(self, facts: Facts) -> Bound:
        """Light beyond one threshold a tick, of exposure and margin; no more than ticks without a spike."""
        if self.mode == "clip":
            return Bound(0.0, 0.0, "clip: as without")
        beyond = surplus(facts.light, facts.light_max)
        ticks = facts.ticks + facts.margin_ticks
        change = np.minimum((1 - facts.rate) * facts.ticks, beyond * ticks)
        return Bound(facts.counted(change), 0.0, f"{facts.most(beyond):.3g} x {ticks}, at most idle ticks")
