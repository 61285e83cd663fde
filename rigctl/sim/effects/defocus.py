"""Defocus: a point of light becomes a disk."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.arms import ARMS, looked_at, on_arm
from spikerig.rigctl.sim.effects import Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits
from spikerig.rigctl.sim.warp import blur_kernel, blurred


@dataclass(frozen=True, slots=True)
class Defocus:
    """The picture is averaged over a disk, the same everywhere; beyond the edge lies the edge's light.

    Args:
        arm: spike, rgb or both.
        radius_px: of the disk (the circle of confusion).
    """

    arm: str = limits("spike", unit="arm", choices=ARMS)
    radius_px: float = limits(0.7, 0, 100, "px")

    name: ClassVar[str] = "defocus"
    stage: ClassVar[Stage] = Stage.OPTICS
    per: ClassVar[str] = "knot"
    source: ClassVar[str] = "geometric optics: the aperture's image, a disk of variance radius^2 / 4 on each axis"
    vanishes: ClassVar[str] = "radius_px = 0"
    cost_ns: ClassVar[float] = 2.0

    @property
    def kernel(self) -> NDArray[np.float64]:
        """Of the disk: odd and square, sums to 1, of second moment radius^2 / 4."""
        n = max(256, int(4 * self.radius_px**2))  # a sunflower's points, four times: even, and the same on both axes
        r, turn = self.radius_px * np.sqrt((np.arange(n) + 0.5) / n), np.arange(n) * (np.pi * (3 - np.sqrt(5)))
        x, y = r * np.cos(turn), r * np.sin(turn)
        return blur_kernel(np.concatenate([np.stack(p, 1) for p in ((x, y), (-y, x), (-x, -y), (y, -x))]))

    def begin(self, site: Site) -> Hooks:
        """The same for every view."""
        if self.radius_px == 0:
            return Hooks()
        kernel = self.kernel
        return on_arm(self.arm, lambda pictures: blurred(pictures, kernel))

    def magnitude(self, facts: Facts) -> Bound:
        """What the blur takes away."""
        kernel = self.kernel
        return looked_at(facts, self.arm, lambda p: blurred(p, kernel), f"a disk of {self.radius_px:g} px")
