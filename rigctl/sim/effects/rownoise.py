"""Row noise: now and then a row is not read out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.effects import Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits


@dataclass(frozen=True, slots=True)
class RowNoise:
    """In each tick each row's read-out fails by chance: its latches still hold the tick before, or read as zero.

    The pixels reset all the same, so that the spikes of that row and tick are gone. A row that fails in its first tick
    reads zero.

    Args:
        chance: that a row's read-out of a tick fails.
        mode: `repeat` what was read last, or `drop`: no spike.
    """

    chance: float = limits(1e-4, 0, 1, "a row and tick")
    mode: str = limits("repeat", unit="mode", choices=("repeat", "drop"))

    name: ClassVar[str] = "row_noise"
    stage: ClassVar[Stage] = Stage.SPIKES
    per: ClassVar[str] = "tick"
    source: ClassVar[str] = "row-parallel read-out over one bus (the Vidar's raster); the chance is ours"
    vanishes: ClassVar[str] = "chance = 0"
    cost_ns: ClassVar[float] = 0.05

    def begin(self, site: Site) -> Hooks:
        """Failures of one view."""
        rng = site.draw(self.name)

        def bits(packed: NDArray[np.uint8], width: int) -> None:
            ticks, rows = packed.shape[:2]
            failed = rng.random((ticks, rows), dtype=np.float32) < self.chance
            at, row = np.nonzero(failed)
            if self.mode == "drop":
                packed[at, row] = 0
                return
            tick = np.where(failed, -1, np.arange(ticks)[:, None])
            last = np.maximum.accumulate(tick, axis=0)[at, row]  # the last one that was read; -1: none yet
            packed[at, row] = np.where(last[:, None] < 0, np.uint8(0), packed[last, row])

        return Hooks(bits=bits)

    def magnitude(self, facts: Facts) -> Bound:
        """Spikes lost (and doubled), each Poisson around chance x count."""
        mean = self.chance * facts.counts
        rng = np.random.default_rng(95)
        size = facts.normal().shape[1:]
        change = -rng.poisson(mean, size).astype(np.float64)
        if self.mode == "repeat":
            change += rng.poisson(mean * (1 - facts.rate), size)
        counts = facts.most(facts.counts)
        hit = max(float(facts.rate.mean()) * facts.size[1], 1.0)  # pixels of a row that lose a spike at once
        return Bound(facts.counted(change, together=hit), 0.0, f"Poisson({self.chance:g} x {counts:.3g} spikes)")
