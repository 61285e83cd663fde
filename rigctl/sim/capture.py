"""A scene file played from viewpoint to viewpoint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.draws import stream
from spikerig.rigctl.sim.effects import parameters
from spikerig.rigctl.sim.light import Stage, stage_of
from spikerig.rigctl.sim.orbit import orbit_pose, target_depth
from spikerig.rigctl.sim.schedule import Track, schedule, track_phases
from spikerig.rigctl.sim.shake import ShakePath, shake_path
from spikerig.rigctl.sim.spec import SceneSpec
from spikerig.rigctl.sim.take import Rig, Taken, in_parallel, pack, share_of, surface, take_blurry, take_sharp


def camera_of(spec: SceneSpec) -> Camera:
    """The scene's pinhole camera."""
    return Camera.pinhole(spec.lens.width, spec.lens.height, spec.lens.fov_deg)


def rig_of(spec: SceneSpec) -> Rig:
    """The sensors of a scene."""
    return Rig(spec.name, spec.seed, camera_of(spec), spec.exposure, spec.sensor, spec.effects)


def view_path(spec: SceneSpec, number: int) -> ShakePath:
    """How the camera moves over the exposure of a view; held-out views are labelled at the same phase of theirs."""
    rng = stream(spec.seed, "shake", number)
    base = orbit_pose(spec.orbit, number)
    return shake_path(spec.shake, spec.exposure, camera_of(spec), base, target_depth(spec.orbit), rng)


def take_view(spec: SceneSpec, number: int, stage: Stage | None = None) -> Taken:
    """Capture one view; the same bits whoever asks, in any order.

    Args:
        spec: the scene.
        number: of the view, from 0.
        stage: the world made ready, if at hand.
    """
    stage = stage or stage_of(spec.world)
    rig, plan, path = rig_of(spec), schedule(spec.exposure), view_path(spec, number)
    label = path.poses(plan.label)[0]
    sharp = stage.picture(rig.camera, label, spec.lens.samples)
    phases, name = track_phases(plan), f"{number:03d}"
    track = Track(phases, path.poses(phases))
    held_out = spec.orbit.held_out()
    if number in held_out:
        return take_sharp(rig, number, name, plan, sharp, track)
    rgb = np.empty((len(plan.phases), *sharp.shape), np.float32)
    for k, pose in enumerate(path.poses(plan.phases)):
        rgb[k] = sharp if plan.phases[k] == plan.label else stage.picture(rig.camera, pose, spec.lens.samples)
    taken = take_blurry(rig, number, name, plan, sharp, track, rgb)
    train = [k for k in range(spec.orbit.views) if k not in held_out]
    share = share_of(spec.cloud.count, train.index(number), len(train))
    depth = stage.depth(rig.camera, label)
    return replace(taken, points=surface(rig, number, spec.cloud, share, taken.view, depth))


def capture(
    spec: SceneSpec,
    path: str | Path,
    *,
    workers: int = 1,
    force: bool = False,
    done: Callable[[Taken], None] = lambda taken: None,
) -> dict[str, Any]:
    """Play a scene and write it, a view at a time.

    Args:
        spec: the scene.
        path: of the scene file; it appears there complete or not at all.
        workers: processes that cast and simulate; the bits do not depend on it.
        force: replace an existing file.
        done: called after each view is written.

    Returns:
        What was made, JSON-ready: counts, spikes an exposure, blur.

    Raises:
        UsageError: the file exists. HostError: the disk is full or a worker died.
    """
    takes = in_parallel(take_view, spec, spec.orbit.views, workers)
    return pack(path, rig_of(spec), takes, info=provenance(spec), views=spec.orbit.views, force=force, done=done)


def provenance(spec: SceneSpec) -> dict[str, Any]:
    """How a scene was made, JSON-ready: the whole scene file as it was understood."""
    parts = {f.name: getattr(spec, f.name) for f in fields(spec) if f.name not in ("effects", "name", "seed")}
    tables = {key: asdict(value) for key, value in parts.items() if value is not None}
    effects = {effect.name: parameters(effect) for effect in spec.effects}
    return {"made_by": "spikerig sim capture", "scene_file": {**tables, "effects": effects}}
