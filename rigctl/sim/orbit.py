"""Where the camera stands: poses on an arc."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.caster.world import Vec3
from spikerig.rigctl.sim.limits import limits

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Orbit:
    """`[orbit]`: viewpoints on an arc around the vertical through `target`, all looking at it.

    `views` are spread evenly from `start_deg` over `arc_deg`, ends included. Every `test_every`-th (the third of five)
    is for testing, unless `test` lists them by number from 0.
    """

    views: int = limits(30, 1, 100_000)
    start_deg: float = limits(0.0, -3600, 3600, "degrees")
    arc_deg: float = limits(174.0, -3600, 3600, "degrees")
    radius: float = limits(2.0, 1e-3, 1e6, "world units")
    height: float = limits(1.0, -1e6, 1e6, "world units")
    target: Vec3 = limits((0.0, 0.0, 0.0), -1e6, 1e6, "world units")
    test_every: int = limits(5, 0, 100_000, "views; 0 for no test views")
    test: tuple[float, ...] = limits((), 0, 100_000, "view numbers")

    def held_out(self) -> frozenset[int]:
        """Numbers of the views for testing."""
        if self.test:
            return frozenset(int(k) for k in self.test)
        return frozenset(range(self.test_every // 2, self.views, self.test_every) if self.test_every else ())


def orbit_pose(orbit: Orbit, number: int) -> Floats:
    """The pose of a viewpoint: on the arc, looking at the target, the world's z up in the picture.

    Args:
        orbit: the arc.
        number: of the view, from 0.

    Returns:
        cam_from_world, float64[3,4].
    """
    step = orbit.arc_deg / max(orbit.views - 1, 1)
    angle = np.radians(orbit.start_deg + step * number)
    target = np.array(orbit.target)
    centre = np.array(
        [target[0] + orbit.radius * np.cos(angle), target[1] + orbit.radius * np.sin(angle), orbit.height]
    )
    ahead = (target - centre) / np.linalg.norm(target - centre)
    right = np.array([-np.sin(angle), np.cos(angle), 0.0])  # horizontal, for one who looks inward
    R = np.stack([right, np.cross(ahead, right), ahead])
    return np.concatenate([R, -(R @ centre)[:, None]], 1)


def target_depth(orbit: Orbit) -> float:
    """Distance from the camera to the target, in world units."""
    return float(np.hypot(orbit.radius, orbit.height - orbit.target[2]))
