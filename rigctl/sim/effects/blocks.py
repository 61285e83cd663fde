"""Lost blocks: stretches of ticks that never arrive."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.spikes import SpikeStream
from spikerig.rigctl.sim.effects import Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits

LOOKS = 2000  # exposures tried for the bound


@dataclass(frozen=True, slots=True)
class LostBlocks:
    """Blocks of ticks are lost between camera and disk: their bits are zero, and the stream lists them as lost.

    Args:
        chance: that a block begins to be lost at a tick (overlapping blocks are one).
        mean_ticks: of a block; lengths are geometric.
    """

    chance: float = limits(1e-5, 0, 1, "a tick")
    mean_ticks: float = limits(50.0, 1, 1e7, "ticks")

    name: ClassVar[str] = "lost_blocks"
    stage: ClassVar[Stage] = Stage.WIRE
    per: ClassVar[str] = "tick"
    source: ClassVar[str] = (
        "SpikeCV's SDK drops whole blocks (cusum 50 ticks) when a buffer is full; the chance is ours"
    )
    vanishes: ClassVar[str] = "chance = 0"
    cost_ns: ClassVar[float] = 0.01

    def begin(self, site: Site) -> Hooks:
        """Losses of one view."""
        rng = site.draw(self.name)

        def wire(stream: SpikeStream) -> SpikeStream:
            lost = self.lost(rng, stream.ticks)
            if not len(lost):
                return stream
            bits = stream.bits.copy()
            for first, stop in lost:
                bits[first:stop] = 0
            return replace(stream, bits=bits, lost=merged(np.concatenate([stream.lost, lost])))

        return Hooks(wire=wire)

    def lost(self, rng: np.random.Generator, ticks: int) -> NDArray[np.int64]:
        """Half-open ranges of lost ticks, int64[N,2], apart and in order."""
        first = np.flatnonzero(rng.random(ticks, dtype=np.float32) < self.chance)
        length = rng.geometric(1 / self.mean_ticks, len(first))
        return merged(np.stack([first, np.minimum(first + length, ticks)], axis=1))

    def magnitude(self, facts: Facts) -> Bound:
        """The spikes of the ticks lost in 19 of 20 exposures."""
        rng = np.random.default_rng(95)
        # a block that began up to ten mean lengths before the exposure may reach into it
        before = int(min(facts.margin_ticks, 10 * self.mean_ticks))
        most = np.empty(LOOKS)
        for k in range(LOOKS):
            begun = rng.binomial(before + facts.ticks, self.chance)
            first = rng.integers(0, before + facts.ticks, begun) - before
            spans = np.stack([first, first + rng.geometric(1 / self.mean_ticks, begun)], axis=1)
            most[k] = np.diff(merged(np.clip(spans, 0, facts.ticks))).sum()
        ticks = float(np.percentile(most, 95, method="inverted_cdf"))
        hit = 20.0 * float(np.mean(most > 0)) if ticks == 0 else 0.0  # below 1: hardly ever, but it adds up
        counts = facts.most(facts.rate * ticks)
        return Bound(
            float(np.ceil(counts)) or min(hit, 1.0), 0.0, f"{facts.most(facts.rate):.3g} x {ticks:g} ticks lost"
        )


def merged(ranges: NDArray[np.int64]) -> NDArray[np.int64]:
    """Half-open ranges int64[N,2] as ranges that are apart, in order; empty ones vanish."""
    out: list[list[int]] = []
    for first, stop in sorted(ranges.tolist()):
        if first >= stop:
            continue
        if out and first <= out[-1][1]:
            out[-1][1] = max(out[-1][1], stop)
        else:
            out.append([first, stop])
    return np.array(out, np.int64).reshape(-1, 2)
