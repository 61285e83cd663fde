"""Where the camera stands: poses on an arc."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.spec import Orbit

Floats = NDArray[np.float64]


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
