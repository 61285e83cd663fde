"""From the world of a scene's poses to the world a run was trained in, by the TRAINING cameras alone.

Estimated poses are right up to a rotation, a shift and a scale, so held-out poses are brought over by the similarity
that fits the training cameras; held-out cameras take no part in it, nor do pictures.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from spikerig.calib.gauge import Similarity, centres, degrees_apart, extent, similarity
from spikerig.dataset.errors import DataError
from spikerig.dataset.scene import Floats
from spikerig.train.trajectory import pose_at

if TYPE_CHECKING:
    from spikerig.dataset.store import SceneFile

SAME_DEG, SAME_SHARE = 1e-6, 1e-8  # cameras nearer than that (of the extent) are the same to the last digits
FAR_DEG, FAR_SHARE = 1.0, 0.02  # farther apart, they are in another world, whatever the files say
Cameras = Mapping[str, Floats]


@dataclass(frozen=True, slots=True)
class Bridge:
    """The similarity to the run's world (None: the same world), and how far apart the training cameras are then."""

    to_run: Similarity | None
    cameras: int
    deg: float | None
    share: float | None

    def pose(self, cam_from_world: Floats) -> Floats:
        """A camera [3,4] of the scene in the run's world."""
        return cam_from_world if self.to_run is None else self.to_run.poses(cam_from_world[None])[0]

    def as_json(self) -> dict[str, Any]:
        """A JSON-ready record."""
        return {
            "same_world": self.to_run is None,
            "fitted_on": None if self.to_run is None else "training cameras only",
            "training_cameras": self.cameras,
            "scale": None if self.to_run is None else self.to_run.scale,
            "apart_deg_median": self.deg,
            "apart_share_of_extent_median": self.share,
        }


def estimated_poses(scene: SceneFile) -> bool:
    """Whether a scene's poses are estimates (of `calib poses` or COLMAP); those of a transforms.json are given."""
    record = scene.info.get("poses")
    return record is not None and not (isinstance(record, str) and record.endswith(".json"))


def stored_cameras(scene: SceneFile) -> dict[str, Floats]:
    """Mid-exposure poses [3,4] of a scene's training views, as stored: what a fit of it is given."""
    return {name: scene.view(name, spikes=False).pose.cam_from_world for name in scene.train}


def true_pose(scene: SceneFile, name: str) -> Floats:
    """A view's mid-exposure pose [3,4] by the simulator's truth where the scene has it, else as stored."""
    view = scene.view(name, spikes=False)
    if not scene.has_true(name, "trajectory"):
        return view.pose.cam_from_world
    return pose_at(scene.truth_trajectory(name), float(view.mid_ns))


def bridge(scored: Cameras, trained: Cameras, *, estimated: bool) -> Bridge:
    """The way from the world of `scored` to that of `trained`, by the cameras both name.

    Args:
        scored, trained: training cameras by name, [3,4] at mid-exposure.
        estimated: one side's poses are estimates, so that the worlds differ however near they look.

    Returns:
        A similarity where poses are estimated or the cameras lie far apart (median over 1 degree or 2 % of the
        extent); else the world is taken for the same, and the record says how far apart the cameras are.

    Raises:
        DataError: different worlds, and fewer than three cameras in common or all at one place.
    """
    shared = sorted(scored.keys() & trained.keys())
    if not shared:
        if estimated:
            raise DataError(
                "the run's poses are estimates, and it shares no training view with the scene to score on",
                value=f"{len(trained)} and {len(scored)} training views",
                expected="the same names, so that one world can be brought to the other",
            )
        return Bridge(None, 0, None, None)
    a, b = (np.stack([cameras[name] for name in shared]) for cameras in (scored, trained))
    deg, share = _apart(a, b)
    if max(deg / SAME_DEG, share / SAME_SHARE) <= 1 or not (estimated or deg > FAR_DEG or share > FAR_SHARE):
        return Bridge(None, len(shared), deg, share)
    if len(shared) < 3:
        raise DataError("too few training cameras to bring one world to the other", value=len(shared), expected="3")
    to = similarity(a, b)
    return Bridge(to, len(shared), *_apart(to.poses(a), b))


def _apart(a: Floats, b: Floats) -> tuple[float, float]:
    """Median degrees, and median distance of the centres as a share of b's extent."""
    far = np.linalg.norm(centres(a) - centres(b), axis=1)
    return float(np.median(degrees_apart(a, b))), float(np.median(far)) / (extent(b) or 1.0)
