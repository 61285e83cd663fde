"""Lens distortion: straight lines come out bent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spikerig.dataset.errors import UsageError
from spikerig.rigctl.sim.arms import ARMS, looked_at, on_arm
from spikerig.rigctl.sim.effects import Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits
from spikerig.rigctl.sim.warp import Map, Positions, resampler, straight


@dataclass(frozen=True, slots=True)
class Distortion:
    """The picture that a lens with OpenCV's radial and tangential coefficients would show of the pinhole's light.

    Each pixel of the distorted picture looks along the ray that the lens bends there (the model inverted by Newton's
    method); rays beyond the pinhole's picture see the light of its edge.

    Args:
        arm: spike, rgb or both.
        k1, k2: radial; k1 < 0 is a barrel, as wide lenses have.
        p1, p2: tangential.
    """

    arm: str = limits("rgb", unit="arm", choices=ARMS)
    k1: float = limits(-0.05, -10, 10, "at tan(angle) = 1")
    k2: float = limits(0.0, -10, 10, "at tan(angle) = 1")
    p1: float = limits(0.0, -1, 1, "at tan(angle) = 1")
    p2: float = limits(0.0, -1, 1, "at tan(angle) = 1")

    name: ClassVar[str] = "distortion"
    stage: ClassVar[Stage] = Stage.OPTICS
    per: ClassVar[str] = "frame"
    source: ClassVar[str] = "Brown-Conrady as in OpenCV's calib3d"
    vanishes: ClassVar[str] = "k1 = k2 = p1 = p2 = 0"
    cost_ns: ClassVar[float] = 600.0

    @property
    def coefficients(self) -> tuple[float, float, float, float]:
        """k1 k2 p1 p2, OpenCV's order."""
        return self.k1, self.k2, self.p1, self.p2

    def source_map(self, focal: tuple[float, float], centre: tuple[float, float]) -> Map:
        """Positions of the distorted picture to those of the pinhole's."""

        def source(x: np.ndarray, y: np.ndarray) -> Positions:
            u, v = straight((x - centre[0]) / focal[0], (y - centre[1]) / focal[1], self.coefficients)
            return u * focal[0] + centre[0], v * focal[1] + centre[1]

        return source

    def begin(self, site: Site) -> Hooks:
        """The same for every view.

        Raises:
            UsageError: no camera is known, or the model folds over within the picture.
        """
        if not any(self.coefficients):
            return Hooks()
        if site.camera is None:
            raise UsageError("distortion needs the camera: how wide its angles are")
        K = site.camera.K
        source = self.source_map((K[0, 0], K[1, 1]), (K[0, 2], K[1, 2]))
        return on_arm(self.arm, resampler(site.height, site.width, source))

    def magnitude(self, facts: Facts) -> Bound:
        """The picture's change, redrawn through the lens."""
        if not any(self.coefficients):
            return Bound(0.0, 0.0, "no distortion")
        (height, width), f = facts.size, facts.focal_px
        redraw = resampler(height, width, self.source_map((f, f), (width / 2, height / 2)))
        r = np.hypot(height, width) / 2 / f
        corner = f * r * abs(self.k1 * r**2 + self.k2 * r**4)
        return looked_at(facts, self.arm, redraw, f"up to {corner:.3g} px in the corner")
