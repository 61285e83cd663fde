"""Reset loss: a pixel that has just fired is deaf while it resets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from spikerig.rigctl.sim.effects import Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits


@dataclass(frozen=True, slots=True)
class ResetLoss:
    """The charge of the tick after a spike is 1 - loss of what arrives; the rest is gone.

    Args:
        loss: share of a tick that a reset takes.
    """

    loss: float = limits(0.002, 0, 0.99, "of a tick's charge")

    name: ClassVar[str] = "reset_loss"
    stage: ClassVar[Stage] = Stage.CHARGE
    per: ClassVar[str] = "tick"
    source: ClassVar[str] = "SCSim (arXiv 2304.03129), v2s.py: x 0.998, a reset of 100 ns in a tick of 50 us"
    vanishes: ClassVar[str] = "loss = 0"
    cost_ns: ClassVar[float] = 0.5

    def begin(self, site: Site) -> Hooks:
        """The kernel's share of charge lost."""
        return Hooks(pixel={"reset_loss": self.loss}) if self.loss > 0 else Hooks()

    def magnitude(self, facts: Facts) -> Bound:
        """A spike loses loss x light: rate -> light / (1 + loss light), the ticks times over."""
        rate = facts.most(facts.rate)
        told = f"{self.loss:g} x {rate:.3g}^2 x {facts.ticks}"
        return Bound(facts.spikes(lambda light: light / (1 + self.loss * light)), 0.0, told)
