"""Hot pixels: a few with far more dark current than the rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spikerig.rigctl.sim.effects import Floats, Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits


@dataclass(frozen=True, slots=True)
class HotPixels:
    """Some pixels, the same in every view, gain extra charge each tick.

    Args:
        share: of the pixels, each by chance.
        rate: extra, in the pixel's own thresholds a tick.
    """

    share: float = limits(0.0005, 0, 1, "of the pixels")
    rate: float = limits(0.2, 0, 1, "thresholds a tick")

    name: ClassVar[str] = "hot_pixels"
    stage: ClassVar[Stage] = Stage.SPIKES
    per: ClassVar[str] = "knot"
    source: ClassVar[str] = (
        "RSIR's dark map: median 7.7, most 382 lux equivalent, 0.19 spikes a tick; the share is ours"
    )
    vanishes: ClassVar[str] = "share = 0 or rate = 0"
    cost_ns: ClassVar[float] = 0.3

    def begin(self, site: Site) -> Hooks:
        """The sensor's hot pixels."""
        here = np.flatnonzero(site.draw_fixed(self.name).random((site.height, site.width)) < self.share)

        def light(block: Floats) -> None:
            block.reshape(len(block), site.height * site.width)[:, here] += np.float32(self.rate)

        return Hooks(light=light)

    def magnitude(self, facts: Facts) -> Bound:
        """A share of the pixels gains rate x ticks; no more than fit below one spike a tick."""
        spikes = facts.spikes(np.full_like(facts.light, self.rate), self.share)
        return Bound(spikes, 0.0, f"{self.rate:g} x {facts.ticks} in {100 * self.share:g} %")
