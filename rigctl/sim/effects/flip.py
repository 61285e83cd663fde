"""Mirror flip: an arm that sees the scene by reflection sees it mirrored."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spikerig.rigctl.sim.arms import ARMS, looked_at, on_arm
from spikerig.rigctl.sim.effects import Floats, Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits


@dataclass(frozen=True, slots=True)
class MirrorFlip:
    """The picture on an arm is mirrored. Poses and labels stay those of the camera that would see it unmirrored.

    Args:
        arm: spike, rgb or both.
        axis: x swaps left and right, y top and bottom.
    """

    arm: str = limits("rgb", unit="arm", choices=ARMS)
    axis: str = limits("x", unit="axis", choices=("x", "y"))

    name: ClassVar[str] = "mirror_flip"
    stage: ClassVar[Stage] = Stage.OPTICS
    per: ClassVar[str] = "knot"
    source: ClassVar[str] = "reflection; an even number of mirrors cancels"
    vanishes: ClassVar[str] = "left out; twice is not at all"
    cost_ns: ClassVar[float] = 2.0

    def begin(self, site: Site) -> Hooks:
        """The same for every view."""
        return on_arm(self.arm, self.flipped)

    def flipped(self, pictures: Floats) -> Floats:
        """Pictures [n,H,W,C], mirrored."""
        return np.ascontiguousarray(pictures[:, :, ::-1] if self.axis == "x" else pictures[:, ::-1])

    def magnitude(self, facts: Facts) -> Bound:
        """The difference of the picture and its mirror image."""
        return looked_at(facts, self.arm, self.flipped, "picture against its mirror image")
