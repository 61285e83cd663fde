"""A scene file played from viewpoint to viewpoint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.outfile import refuse_existing
from spikerig.rigctl.sim.caster.light import Stage, stage_of
from spikerig.rigctl.sim.effects import parameters
from spikerig.rigctl.sim.judge.plan import Plan, plan, resolve
from spikerig.rigctl.sim.schedule import Track, schedule, track_phases
from spikerig.rigctl.sim.spec import SceneSpec
from spikerig.rigctl.sim.take import Rig, Taken, pack, share_of, surface, take_blurry, take_sharp, true_clock
from spikerig.rigctl.sim.viewpoint import camera_of, timed, view_path


def rig_of(spec: SceneSpec) -> Rig:
    """The sensors of a scene."""
    return Rig(spec.name, spec.seed, camera_of(spec), spec.exposure, spec.sensor, spec.effects, spec.events)


def take_view(spec: SceneSpec, number: int, stage: Stage | None = None) -> Taken:
    """Capture one view; the same bits whoever asks, in any order.

    Args:
        spec: the scene.
        number: of the view, from 0.
        stage: the world made ready, if at hand.
    """
    stage = stage or stage_of(spec.world)
    rig, times, path = rig_of(spec), schedule(timed(spec, number, stage)), view_path(spec, number)
    label = path.poses(times.label)[0]
    sharp = stage.picture(rig.camera, label, spec.lens.samples)
    phases, name = track_phases(times, _readout(spec)), f"{number:03d}"
    track = Track(phases, path.poses(phases))
    held_out = spec.orbit.held_out()
    if number in held_out:
        return take_sharp(rig, number, name, times, sharp, track, _first(rgb_arm(spec, stage, label[None])))
    poses = path.poses(times.phases)
    rgb = np.empty((len(poses), *sharp.shape), np.float32)
    for k, pose in enumerate(poses):
        rgb[k] = sharp if times.phases[k] == times.label else stage.picture(rig.camera, pose, spec.lens.samples)
    taken = take_blurry(rig, number, name, times, sharp, track, rgb, rgb_arm(spec, stage, poses))
    train = [k for k in range(spec.orbit.views) if k not in held_out]
    share = share_of(spec.cloud.count, train.index(number), len(train))
    depth = stage.depth(rig.camera, label)
    return replace(taken, points=surface(rig, number, spec.cloud, share, taken.view, depth))


def _readout(spec: SceneSpec) -> float:
    """Of a rolling shutter, in exposures; 0 without."""
    rolling: Any = next((e for e in spec.effects if e.name == "rolling_shutter"), None)
    return 0.0 if rolling is None else rolling.readout_ms / spec.exposure.exposure_ms


def _first(pictures: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
    return None if pictures is None else pictures[0]


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
        What was made, JSON-ready: counts, spikes an exposure, blur; and the plan, where effects were to be chosen.

    Raises:
        UsageError: the file exists, or views that were finished with other settings.
        HostError: the disk is full or a worker died.
    """
    from spikerig.rigctl.sim.farm import fill, finished
    from spikerig.rigctl.sim.shelf import Shelf, alone, fingerprint

    path = Path(path)
    refuse_existing(path, force)
    spec, judged = settled(spec)
    true_clock(rig_of(spec), spec.orbit.views)  # one that steps back is refused before any work
    info = provenance(spec, judged)
    made = {"name": spec.name, "seed": spec.seed, **info, "made_with": fingerprint()}
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
        told = pack(path, rig_of(spec), finished(spec, shelf), info=info, views=views, force=True)
        shelf.clear()
    return told | ({} if judged is None else {"plan": judged.as_json(), "plan_line": judged.summary()})


def settled(spec: SceneSpec) -> tuple[SceneSpec, Plan | None]:
    """The scene with its effects chosen, and the plan that chose them; None where the scene lists them."""
    if spec.tolerance is None:
        return spec, None
    made = plan(spec)
    return resolve(spec, made), made


def provenance(spec: SceneSpec, made: Plan | None = None) -> dict[str, Any]:
    """How a scene was made, JSON-ready: the whole scene file as it was understood, and the plan that was made of it."""
    parts = {f.name: getattr(spec, f.name) for f in fields(spec) if f.name not in ("effects", "name", "seed")}
    tables = {key: asdict(value) for key, value in parts.items() if value is not None}
    effects = {effect.name: parameters(effect) for effect in spec.effects}
    told = {"made_by": "spikerig sim capture", "scene_file": {**tables, "effects": effects}}
    return told if made is None else told | {"plan": made.as_json()}
