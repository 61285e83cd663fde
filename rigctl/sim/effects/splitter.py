"""Beam splitter: how the light is shared between the arms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spikerig.rigctl.sim.effects import Floats, Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits


@dataclass(frozen=True, slots=True)
class Splitter:
    """The spike arm gets `share` of the light, the RGB arm the rest, less what the glass swallows.

    Relative to the lossless half and half that `sensor.gain` and RGB white stand for: the spike arm's light is
    multiplied by 2 share (1 - loss), the RGB arm's by 2 (1 - share) (1 - loss).

    Args:
        share: of the light that reaches the spike camera.
        loss: absorbed, or reflected elsewhere.
    """

    share: float = limits(0.45, 0, 1, "of the light")
    loss: float = limits(0.0, 0, 1, "of the light")

    name: ClassVar[str] = "splitter"
    stage: ClassVar[Stage] = Stage.OPTICS
    per: ClassVar[str] = "knot"
    source: ClassVar[str] = "conservation of energy; plate splitters are sold as 50:50 within 5 to 10 % of the light"
    vanishes: ClassVar[str] = "share = 1/2, loss = 0"
    cost_ns: ClassVar[float] = 0.3

    @property
    def gains(self) -> tuple[float, float]:
        """Of the spike arm and the RGB arm."""
        return 2 * self.share * (1 - self.loss), 2 * (1 - self.share) * (1 - self.loss)

    def begin(self, site: Site) -> Hooks:
        """The same for every view."""
        spike, rgb = (np.float32(gain) for gain in self.gains)

        def to_spike(pictures: Floats) -> Floats:
            return pictures * spike

        def to_rgb(pictures: Floats) -> Floats:
            return pictures * rgb

        return Hooks(spike_optics=to_spike if spike != 1 else None, rgb_optics=to_rgb if rgb != 1 else None)

    def magnitude(self, facts: Facts) -> Bound:
        """|2 share (1 - loss) - 1| light, and the other arm's in RGB values."""
        spike, rgb = self.gains
        spikes, dn = facts.spikes(lambda light: light * spike), facts.dn(lambda light: light * rgb)
        counts = facts.most(facts.counts)
        return Bound(spikes, dn, f"|{spike:.3g} - 1| x {counts:.3g} spikes; RGB light x {rgb:.3g}")
