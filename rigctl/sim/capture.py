"""A scene file played from viewpoint to viewpoint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.outfile import refuse_existing
from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.draws import stream
from spikerig.rigctl.sim.effects import parameters
from spikerig.rigctl.sim.light import Stage, stage_of
from spikerig.rigctl.sim.orbit import orbit_pose, target_depth
from spikerig.rigctl.sim.schedule import Track, schedule, track_phases
from spikerig.rigctl.sim.shake import ShakePath, shake_path
from spikerig.rigctl.sim.spec import SceneSpec
from spikerig.rigctl.sim.take import Rig, Taken, pack, share_of, surface, take_blurry, take_sharp


def camera_of(spec: SceneSpec) -> Camera:
    """The scene's pinhole camera."""
    return Camera.pinhole(spec.lens.width, spec.lens.height, spec.lens.fov_deg)


def rig_of(spec: SceneSpec) -> Rig:
    """The sensors of a scene."""
    return Rig(spec.name, spec.seed, camera_of(spec), spec.exposure, spec.sensor, spec.effects, spec.events)


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
    poses = path.poses(plan.phases)
    rgb = np.empty((len(poses), *sharp.shape), np.float32)
    for k, pose in enumerate(poses):
        rgb[k] = sharp if plan.phases[k] == plan.label else stage.picture(rig.camera, pose, spec.lens.samples)
    taken = take_blurry(rig, number, name, plan, sharp, track, rgb, rgb_arm(spec, stage, poses))
    train = [k for k in range(spec.orbit.views) if k not in held_out]
    share = share_of(spec.cloud.count, train.index(number), len(train))
    depth = stage.depth(rig.camera, label)
    return replace(taken, points=surface(rig, number, spec.cloud, share, taken.view, depth))


def rgb_arm(spec: SceneSpec, stage: Stage, poses: NDArray[np.float64]) -> NDArray[np.float32] | None:
    """What the RGB camera sees where it is misaligned: float32[K,H,W,3] while the spike camera is at `poses`."""
    apart: Any = next((e for e in spec.effects if e.name == "misalignment"), None)
    if apart is None or apart.absent:
        return None
    return np.stack([stage.picture(camera_of(spec), pose, spec.lens.samples) for pose in apart.rgb_poses(poses)])


def capture(
    spec: SceneSpec,
    path: str | Path,
    *,
    workers: int = 1,
    force: bool = False,
    done: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Play a scene and write it: views as they are finished to PATH.views/, then the scene, and the folder goes.

    A run that was killed or interrupted goes on where it was when it is started again; the bytes are the same.

    Args:
        spec: the scene.
        path: of the scene file; it appears there complete or not at all.
        workers: processes that cast and simulate; the bits do not depend on it.
        force: replace an existing file, and throw away views that were finished with other settings.
        done: called after each view, also after those that were finished before.

    Returns:
        What was made, JSON-ready: counts, spikes an exposure, blur.

    Raises:
        UsageError: the file exists, or views that were finished with other settings.
        HostError: the disk is full or a worker died.
    """
    from spikerig.rigctl.sim.farm import fill, finished
    from spikerig.rigctl.sim.shelf import Shelf, alone, fingerprint

    path = Path(path)
    refuse_existing(path, force)
    made = {"name": spec.name, "seed": spec.seed, **provenance(spec), "made_with": fingerprint()}
    folder, views = path.with_name(path.name + ".views"), spec.orbit.views
    with alone(folder):
        shelf = Shelf(folder, made, force)
        for _ in range(views - len(shelf.missing(views))):
            done()
        try:
            fill(spec, shelf, workers, done)
        except BaseException:
            if len(shelf.missing(views)) == views:
                shelf.clear()
            raise
        # What lies in the way of the writer is what a kill left of this same scene.
        told = pack(path, rig_of(spec), finished(spec, shelf), info=provenance(spec), views=views, force=True)
        shelf.clear()
    return told


def provenance(spec: SceneSpec) -> dict[str, Any]:
    """How a scene was made, JSON-ready: the whole scene file as it was understood."""
    parts = {f.name: getattr(spec, f.name) for f in fields(spec) if f.name not in ("effects", "name", "seed")}
    tables = {key: asdict(value) for key, value in parts.items() if value is not None}
    effects = {effect.name: parameters(effect) for effect in spec.effects}
    return {"made_by": "spikerig sim capture", "scene_file": {**tables, "effects": effects}}
