"""A scene's camera: what it is, how it moves over the exposure of a view, and when pictures of it are cast."""

from __future__ import annotations

import numpy as np

from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.caster.light import Stage
from spikerig.rigctl.sim.draws import stream
from spikerig.rigctl.sim.judge.samples import motion_px, sampled
from spikerig.rigctl.sim.orbit import orbit_pose, target_depth
from spikerig.rigctl.sim.shake import ShakePath, shake_path
from spikerig.rigctl.sim.spec import Exposure, SceneSpec

LOOKS = 33  # instants of an exposure at which its motion is measured


def camera_of(spec: SceneSpec) -> Camera:
    """The scene's pinhole camera."""
    return Camera.pinhole(spec.lens.width, spec.lens.height, spec.lens.fov_deg)


def view_path(spec: SceneSpec, number: int) -> ShakePath:
    """How the camera moves over the exposure of a view; held-out views are labelled at the same phase of theirs."""
    rng = stream(spec.seed, "shake", number)
    base = orbit_pose(spec.orbit, number)
    return shake_path(spec.shake, spec.exposure, camera_of(spec), base, target_depth(spec.orbit), rng)


def view_motion(spec: SceneSpec, number: int, stage: Stage) -> tuple[np.ndarray, np.ndarray]:
    """Image motion over the exposure of a view, pixels, on a coarse grid; and the depth at mid-exposure, [H,W]."""
    camera, path = camera_of(spec), view_path(spec, number)
    label = path.poses(0.5)[0]
    depth = stage.depth(camera, label)
    return motion_px(camera, depth, label, path.poses(np.linspace(0, 1, LOOKS))), depth


def timed(spec: SceneSpec, number: int, stage: Stage) -> Exposure:
    """The exposure of a view with its light samples: as many as its motion asks for, where the scene leaves it open."""
    if spec.exposure.sub_poses:
        return spec.exposure
    return sampled(spec.exposure, float(view_motion(spec, number, stage)[0].max()))
