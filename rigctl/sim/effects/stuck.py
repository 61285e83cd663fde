"""Stuck pixels: some never fire, some always do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.effects import Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits


@dataclass(frozen=True, slots=True)
class StuckPixels:
    """Pixels, the same in every view, that read 0 or 1 whatever their charge.

    Args:
        dead: share of the pixels that never fire, each by chance.
        lit: share that fires every tick; of a pixel drawn for both, the first holds.
    """

    dead: float = limits(0.0005, 0, 1, "of the pixels")
    lit: float = limits(0.0001, 0, 1, "of the pixels")

    name: ClassVar[str] = "stuck_pixels"
    stage: ClassVar[Stage] = Stage.SPIKES
    per: ClassVar[str] = "tick"
    source: ClassVar[str] = "a common sensor defect; none in the real clips measured, so the shares are ours"
    vanishes: ClassVar[str] = "dead = lit = 0"
    cost_ns: ClassVar[float] = 0.05

    def begin(self, site: Site) -> Hooks:
        """The sensor's stuck pixels."""
        rng = site.draw_fixed(self.name)
        dead, lit = (rng.random((site.height, site.width)) < share for share in (self.dead, self.lit))
        keep = np.packbits(~dead, axis=1, bitorder="little")
        fire = np.packbits(lit & ~dead, axis=1, bitorder="little")

        def bits(packed: NDArray[np.uint8], width: int) -> None:
            packed &= keep
            packed |= fire

        return Hooks(bits=bits)

    def magnitude(self, facts: Facts) -> Bound:
        """A share of the pixels loses its count, a share gains the ticks without a spike."""
        share = self.dead + self.lit * (1 - self.dead)
        size = facts.normal().shape[1:]
        dead = np.random.default_rng(95).random(size) * share < self.dead
        spikes = facts.counted(np.where(dead, -facts.rate, 1 - facts.rate) * facts.ticks, share=share)
        told = f"{100 * self.dead:g} % lose {facts.most(facts.counts):.3g}, {100 * self.lit:g} % gain the rest"
        return Bound(spikes, 0.0, told)
