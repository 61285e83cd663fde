"""A scene with other poses: the file is written anew beside, and takes the old one's place when it is whole."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.gauge import Similarity, similarity
from spikerig.calib.poses import Estimate
from spikerig.dataset.errors import UsageError
from spikerig.dataset.outfile import refuse_existing, stand_in
from spikerig.dataset.scene import Points, Pose, Trajectory, View
from spikerig.dataset.store import SceneFile, open_scene

MIN_TRACK_ERROR = 3.0  # times the median residual: points off by more are left out


def onto(estimate: Estimate, earlier: Mapping[str, NDArray[np.float64]]) -> Similarity:
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
    done: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Put estimated poses, paths and points into a scene.

    The poses go into the world of those that the scene had, by the similarity of the mapped views alone: views that
    were not mapped (held-out pictures) keep their own pose, and stay where they belong. Views with spikes that were not
    placed are left out.

    Args:
        path: of the scene.
        estimate: accepted.
        provenance: recorded as info.poses, with the SHA-256 of what the poses are made of and of the poses.
        out: another file to write; None replaces `path`, which stays as it is until the new one is whole.
        force: replace `out`.
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
        to = onto(estimate, earlier)
        placed = dict(zip(estimate.poses, to.poses(np.stack(list(estimate.poses.values()))), strict=True))
        left_out = sorted(set(estimate.images) - placed.keys())
        with SceneWriter(
            beside,
            scene.name,
            scene.camera,
            light_gain=scene.light_gain,
            info={**scene.info, "poses": dict(provenance)},
            points=_points(estimate, to) or scene.points,
            clock=scene.clock,
            calibration=scene.calibration,
            truth=scene.truth,
            keep=False,
        ) as writer:
            for name in scene.names:
                if name not in left_out:
                    _copy(scene, writer, name, placed, estimate, to)
                done()
    return {"written": str(target), "left_out": left_out, "scale": to.scale}


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
    placed: Mapping[str, NDArray[np.float64]],
    estimate: Estimate,
    to: Similarity,
) -> None:
    """One view, with its new pose and path where there are any, and its truth."""
    view = scene.view(name)
    if name in placed:
        view = replace(view, pose=Pose(placed[name]), trajectory=trajectory_of(view, estimate, to))
    truth: dict[str, Any] = {}
    if scene.has_truth:
        for key, read in (
            ("light", scene.truth_light),
            ("at_ns", scene.truth_at_ns),
            ("trajectory", scene.truth_trajectory),
        ):
            if scene.has_true(name, key):
                truth[key] = read(name)
    if scene.has_events(name):
        truth["events"] = scene.events(name)
    writer.add(view, **truth)


def trajectory_of(view: View, estimate: Estimate, to: Similarity) -> Trajectory | None:
    """The estimated path as a trajectory of the view's frame; None where only the middle is known."""
    path = estimate.paths.get(view.name)
    if path is None:
        return None
    start = view.mid_ns - view.frame.exposure_ns // 2
    at = start + np.rint(path.phases * view.frame.exposure_ns).astype(np.int64)
    cov = np.array(path.cov)
    cov[:, 3:, :] *= to.scale
    cov[:, :, 3:] *= to.scale
    return Trajectory(at, to.poses(path.poses), cov)


def _points(estimate: Estimate, to: Similarity) -> Points | None:
    """The map's points but for the worst."""
    best = estimate.best
    if not len(best.xyz):
        return None
    good = best.error <= MIN_TRACK_ERROR * max(float(np.median(best.error)), 1e-6)
    return Points(to.points(best.xyz[good]), best.rgb[good], "sfm")
