"""What casting the views of a scene file costs, measured on small pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.caster.light import Stage, stage_of
from spikerig.rigctl.sim.judge.calibrate import Work, least
from spikerig.rigctl.sim.judge.plan import Plan
from spikerig.rigctl.sim.schedule import schedule
from spikerig.rigctl.sim.spec import SceneSpec
from spikerig.rigctl.sim.take import Rig
from spikerig.rigctl.sim.viewpoint import camera_of, timed, view_path

RAYS = 32_768  # of the picture that is timed


def work_of(spec: SceneSpec, made: Plan) -> Work:
    """What the capture of a scene file does.

    Args:
        spec: the scene, resolved or not.
        made: its plan.
    """
    camera, lens, stage = camera_of(spec), spec.lens, stage_of(spec.world)
    held_out = spec.orbit.held_out()
    first = next(k for k in range(spec.orbit.views) if k not in held_out)
    exposure = spec.exposure
    if made.samples.chosen:
        exposure = replace(exposure, sub_poses=max(1, round(made.samples.mean)))
    times, path = schedule(exposure), view_path(spec, first)
    s = max(1, int(np.ceil(np.sqrt(camera.width * camera.height * lens.samples**2 / RAYS))))
    width, height = -(-camera.width // s), -(-camera.height // s)
    small = Camera(np.diag([1 / s, 1 / s, 1]) @ camera.K, np.zeros(0), width, height)
    scale = camera.width * camera.height / (width * height)
    pose = path.poses(times.label)[0]
    fresh = Stage(spec.world)  # light maps are made when first seen
    once = least(lambda: fresh.picture(small, pose, lens.samples), 1)
    picture = least(lambda: stage.picture(small, pose, lens.samples))
    depth = scale * least(lambda: stage.depth(small, pose), 2)
    path_s = least(lambda: view_path(spec, first), 2)
    look = max(least(lambda: timed(spec, first, stage), 2), path_s) if made.samples.chosen else 0.0
    # The label's picture is one of those of the exposure, or one more; standing still, it is the only one.
    pictures = 1 if exposure.sub_poses == 1 else len(times.phases) + (times.label not in times.phases)
    rig = Rig(spec.name, spec.seed, camera, spec.exposure, spec.sensor, ())
    test = path_s + look + picture * scale
    train = path_s + look + pictures * picture * scale + depth
    views = spec.orbit.views - len(held_out)
    arm = len(times.phases) * picture * scale
    return Work(rig, views, len(held_out), times, max(once - picture, 0.0), train, test, spec.cloud.count, arm)
