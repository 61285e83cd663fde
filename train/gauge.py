"""The gauge a fit works in: the world moved and scaled so that points and cameras lie in [-1, 1]."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError
from spikerig.dataset.scene import Floats

INNER = (1.0, 99.0)  # percentiles of the points that must fit: a few stray points do not shrink the scene


@dataclass(frozen=True, slots=True)
class Gauge:
    """x_inside = (x_world - centre) * scale; no rotation, so that spherical harmonics carry over as they are."""

    centre: tuple[float, float, float]
    scale: float

    def inside(self, xyz: Floats) -> Floats:
        """Points [N,3] of the world in the gauge."""
        return (np.asarray(xyz, np.float64) - np.array(self.centre)) * self.scale

    def world(self, xyz: Floats) -> Floats:
        """Points [N,3] of the gauge in the world."""
        return np.asarray(xyz, np.float64) / self.scale + np.array(self.centre)

    def pose(self, cam_from_world: Floats) -> NDArray[np.float32]:
        """The camera [3,4] for points of the gauge; the picture stays the same, depths scale. float32, C order."""
        R, t = cam_from_world[:, :3], cam_from_world[:, 3]
        moved = self.scale * (R @ np.array(self.centre) + t)
        return np.ascontiguousarray(np.concatenate([R, moved[:, None]], axis=1), np.float32)

    def as_json(self) -> dict[str, Any]:
        """A JSON-ready record."""
        return {"centre": list(self.centre), "scale": self.scale}


def gauge_of(xyz: Floats, cam_from_world: Floats) -> Gauge:
    """The gauge of a scene: the box of its points (1st to 99th percentile) and camera centres becomes [-1, 1].

    Args:
        xyz: [N,3] points of the world, N may be 0.
        cam_from_world: [K,3,4] poses.

    Raises:
        DataError: no extent at all (one camera and no points), or values that are not finite.
    """
    centres = -np.einsum("kji,kj->ki", cam_from_world[:, :, :3], cam_from_world[:, :, 3])
    low, high = centres.min(0), centres.max(0)
    if len(xyz):
        box = np.percentile(xyz, INNER, axis=0)
        low, high = np.minimum(low, box[0]), np.maximum(high, box[1])
    size = float(np.max(high - low)) / 2
    if not np.isfinite(size) or size <= 0:
        raise DataError(
            "the scene has no extent to work in",
            value=f"{len(xyz)} points, {len(centres)} cameras, half size {size}",
            expected="finite points or at least two different camera positions",
            cause="missing sparse points, or all cameras at one place",
        )
    centre = (low + high) / 2
    return Gauge((float(centre[0]), float(centre[1]), float(centre[2])), 1.0 / size)
