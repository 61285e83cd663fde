"""A scene with other poses: the file is written anew beside, and takes the old one's place when it is whole."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.consensus import scaled
from spikerig.calib.gauge import Similarity, similarity
from spikerig.calib.poses import Estimate
from spikerig.dataset.errors import UsageError
from spikerig.dataset.outfile import refuse_existing, stand_in
from spikerig.dataset.scene import Points, Pose, Trajectory, View
from spikerig.dataset.store import SceneFile, open_scene

Floats = NDArray[np.float64]
MIN_TRACK_ERROR = 3.0  # times the median residual: points off by more are left out
MM_PER_METRE = 1000.0


@dataclass(frozen=True, slots=True)
class World:
    """Which world poses are written in.

    Args:
        to: from the estimate's world to it.
        rest: from the scene's earlier world to it; None: there was none, every view had the same pose (as a take has
            before poses are estimated), so that views that were not mapped have no place in it.
        told: JSON-ready, recorded.
    """

    to: Similarity
    rest: Similarity | None
    told: Mapping[str, Any]


def world_of(
    estimate: Estimate, earlier: Mapping[str, Floats], mm_per_unit: float | None = None, rescale: bool = False
) -> World:
    """The world to write in: the scene's own where it has one, else the map's, in metres where these are known.

    Args:
        estimate: whose poses are written.
        earlier: poses [3,4] of the scene, by view.
        mm_per_unit: millimetres a unit of the estimate's own world; None: not known.
        rescale: make the units of an earlier world metres too; all of it grows about its origin.

    Raises:
        UsageError: fewer than two views in common; metres asked for and not known.
    """
    if rescale and mm_per_unit is None:
        raise UsageError("metres are not known", cause="no board was named, or it gave no scale",
                         next="give --board and --square-mm, or leave --rescale out")  # fmt: skip
    metres = None if mm_per_unit is None else mm_per_unit / MM_PER_METRE
    if _all_alike(earlier):
        to = Similarity(metres or 1.0, np.eye(3), np.zeros(3))
        return World(to, None, {"of": "the map", "metres_per_unit": None if metres is None else 1.0})
    to = onto(estimate, earlier)
    now = None if metres is None else metres / to.scale
    if not rescale or now is None:
        return World(to, Similarity(1.0, np.eye(3), np.zeros(3)), {"of": "earlier poses", "metres_per_unit": now})
    rest = Similarity(now, np.eye(3), np.zeros(3))
    told = {"of": "earlier poses", "metres_per_unit": 1.0, "rescaled_by": now}
    return World(Similarity(now * to.scale, to.R, now * to.t), rest, told)


def _all_alike(earlier: Mapping[str, Floats]) -> bool:
    stack = np.stack(list(earlier.values()))
    return len(stack) > 1 and bool(np.all(stack == stack[0]))


def onto(estimate: Estimate, earlier: Mapping[str, Floats]) -> Similarity:
    """The similarity from the estimate's world to that of poses known before (of these same, mapped views only).

    Raises:
        UsageError: fewer than two views in common.
    """
    shared = sorted(estimate.poses.keys() & earlier.keys())
    if len(shared) < 2:
        raise UsageError("the estimate shares fewer than two views with the scene's poses", value=shared)
    return similarity(np.stack([estimate.poses[n] for n in shared]), np.stack([earlier[n] for n in shared]))


def write_poses(
    path: Path,
    estimate: Estimate,
    provenance: Mapping[str, Any],
    *,
    out: Path | None = None,
    force: bool = False,
    mm_per_unit: float | None = None,
    rescale: bool = False,
    done: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Put estimated poses, paths and points into a scene.

    The poses go into the world of those that the scene had, by the similarity of the mapped views alone: views that
    were not mapped (held-out pictures) keep their own pose, and stay where they belong. Where the scene had no poses
    (all are the same), the world is the map's, and views that were not mapped are left out. So are views with spikes
    that were not placed.

    Args:
        path: of the scene.
        estimate: accepted.
        provenance: recorded as info.poses, with the SHA-256 of what the poses are made of and of the poses.
        out: another file to write; None replaces `path`, which stays as it is until the new one is whole.
        force: replace `out`.
        mm_per_unit, rescale: as in `world_of`.
        done: called after each view.

    Returns:
        What was done, JSON-ready.
    """
    from spikerig.dataset.store import SceneWriter

    target = out or path
    if out is not None:
        refuse_existing(out, force)
    with open_scene(path) as scene, stand_in(target, "poses") as beside:
        provenance = dict(provenance) | {"sha256": _hashes(scene, estimate)}
        earlier = {n: scene.view(n, spikes=False).pose.cam_from_world for n in scene.names if n in estimate.images}
        world = world_of(estimate, earlier, mm_per_unit, rescale)
        provenance["world"] = dict(world.told)
        placed = dict(zip(estimate.poses, world.to.poses(np.stack(list(estimate.poses.values()))), strict=True))
        left_out = sorted((set(estimate.images) if world.rest else set(scene.names)) - placed.keys())
        with SceneWriter(
            beside,
            scene.name,
            scene.camera,
            light_gain=scene.light_gain,
            info={**scene.info, "poses": dict(provenance)},
            points=_points(estimate, world.to) or _grown(scene.points, world.rest),
            clock=scene.clock,
            calibration=scene.calibration,
            truth=scene.truth,
            keep=False,
        ) as writer:
            for name in scene.names:
                if name not in left_out:
                    _copy(scene, writer, name, placed, estimate, world)
                done()
    return {"written": str(target), "left_out": left_out, "scale": world.to.scale, "world": dict(world.told)}


def _hashes(scene: SceneFile, estimate: Estimate) -> dict[str, str]:
    """Of the spikes and times that the poses are made of, view by view, and of the poses and the map's points."""
    made_of, found = hashlib.sha256(), hashlib.sha256()
    for name in sorted(set(estimate.images) & set(scene.names)):
        view = scene.view(name)
        made_of.update(f"{name}:{view.frame.start_ns}:{view.frame.row_ns}:{view.frame.exposure_ns}\0".encode())
        if view.spikes is not None:
            made_of.update(f"{view.spikes.t0_ns}:{view.spikes.rate_hz}:{view.spikes.bits.shape}\0".encode())
            made_of.update(np.ascontiguousarray(view.spikes.bits).data)
    for name, pose in sorted(estimate.poses.items()):
        found.update(name.encode() + b"\0" + np.ascontiguousarray(pose, "<f8").tobytes())
    found.update(np.ascontiguousarray(estimate.best.xyz, "<f8").tobytes())
    return {"spikes": made_of.hexdigest(), "poses": found.hexdigest()}


def _copy(
    scene: SceneFile,
    writer: Any,
    name: str,
    placed: Mapping[str, Floats],
    estimate: Estimate,
    world: World,
) -> None:
    """One view, with its new pose and path where there are any, and its truth."""
    view, rest = scene.view(name), world.rest
    if name in placed:
        view = replace(view, pose=Pose(placed[name]), trajectory=trajectory_of(view, estimate, world.to))
    elif rest is not None:
        path = None if view.trajectory is None else _moved(view.trajectory, rest)
        view = replace(view, pose=Pose(rest.poses(view.pose.cam_from_world[None])[0]), trajectory=path)
    truth: dict[str, Any] = {}
    if scene.has_truth:
        for key, read in (
            ("light", scene.truth_light),
            ("at_ns", scene.truth_at_ns),
            ("trajectory", scene.truth_trajectory),
        ):
            if scene.has_true(name, key):
                truth[key] = read(name)
    if "trajectory" in truth and rest is not None:
        truth["trajectory"] = _moved(truth["trajectory"], rest)
    if scene.has_events(name):
        truth["events"] = scene.events(name)
    writer.add(view, **truth)


def _moved(path: Trajectory, to: Similarity) -> Trajectory:
    """A path in another world; the same bits where it is the same one."""
    if to.scale == 1.0:
        return path
    return Trajectory(path.at_ns, to.poses(path.poses), None if path.cov is None else scaled(path.cov, to.scale))


def _grown(points: Points | None, to: Similarity | None) -> Points | None:
    """A scene's own points in its new world; none where it had no world."""
    if points is None or to is None or to.scale == 1.0:
        return None if to is None else points
    return replace(points, xyz=to.points(points.xyz))


def trajectory_of(view: View, estimate: Estimate, to: Similarity) -> Trajectory | None:
    """The path as a trajectory of the view's frame; None where there is none (`--instants 1`, or none measured)."""
    path = estimate.paths.get(view.name)
    if path is None:
        return None
    start = view.mid_ns - view.frame.exposure_ns // 2
    at = start + np.rint(path.phases * view.frame.exposure_ns).astype(np.int64)
    return Trajectory(at, to.poses(path.poses), scaled(path.cov, to.scale))


def _points(estimate: Estimate, to: Similarity) -> Points | None:
    """The map's points but for the worst."""
    best = estimate.best
    if not len(best.xyz):
        return None
    good = best.error <= MIN_TRACK_ERROR * max(float(np.median(best.error)), 1e-6)
    return Points(to.points(best.xyz[good]), best.rgb[good], "sfm")
