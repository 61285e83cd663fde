"""Several maps of the same views: do they agree, what is their mean, and the paths through it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.gauge import extent, pose_errors, similarity
from spikerig.calib.mapping import Map
from spikerig.calib.smooth import mean_pose, smooth_path
from spikerig.dataset.rigid import compose, inverse, log_se3

Floats = NDArray[np.float64]
AGREE_DEG, AGREE_SHARE = 1.5, 0.03  # median rotation, and median distance over the extent, within which maps agree


@dataclass(frozen=True, slots=True)
class Path:
    """A view's poses over its exposure: phases float64[M], cam_from_world [M,3,4], covariances [M,6,6] of their twists,
    and chi-square; None where nothing was measured and the camera is taken to stand still."""

    phases: Floats
    poses: Floats
    cov: Floats
    chi2: float | None


def apart_by(a: Map, b: Map) -> tuple[float, float]:
    """Median rotation (degrees) and distance (share of the extent) between two maps' poses of the same views."""
    shared = sorted(a.poses.keys() & b.poses.keys())
    if len(shared) < 3:
        return np.inf, np.inf
    stacks = [np.stack([m.poses[n].pose for n in shared]) for m in (a, b)]
    if extent(stacks[0]) <= 0 or extent(stacks[1]) <= 0:
        return np.inf, np.inf
    turned, moved = pose_errors(*stacks)
    return float(np.median(turned)), float(np.median(moved))


def agree(apart: tuple[float, float]) -> bool:
    """Whether two maps that far apart (as `apart_by` says) are one."""
    return apart[0] <= AGREE_DEG and apart[1] <= AGREE_SHARE


def averaged(maps: Sequence[Map]) -> dict[str, Floats]:
    """Poses in the first map's world, averaged over all maps that have them: their errors differ."""
    stacks = [{n: p.pose for n, p in maps[0].poses.items()}]
    for other in maps[1:]:
        shared = sorted(maps[0].poses.keys() & other.poses.keys())
        to = similarity(*(np.stack([m.poses[n].pose for n in shared]) for m in (other, maps[0])))
        moved = to.poses(np.stack([p.pose for p in other.poses.values()]))
        stacks.append(dict(zip(other.poses, moved, strict=True)))
    return {name: mean_pose([s[name] for s in stacks if name in s]) for name in stacks[0]}


def paths_through(first: Map, best: Map, poses: Mapping[str, Floats], phases: Floats) -> dict[str, Path]:
    """Paths over the exposures, moved so that each goes through its view's averaged pose at the middle."""
    to = None
    if first is not best:
        shared = sorted(first.poses.keys() & best.poses.keys())
        to = similarity(*(np.stack([m.poses[n].pose for n in shared]) for m in (first, best)))
    paths: dict[str, Path] = {}
    for name in poses.keys() & first.poses.keys():
        rows: list[tuple[float, Floats, Floats | None]] = [(0.5, first.poses[name].pose, None)]
        rows += [
            (float(phases[k]), first.placed[key].pose, first.placed[key].cov)
            for k in range(len(phases))
            if (key := f"{name}.at{k:03d}") in first.placed
        ]
        if len(rows) < 3:
            continue
        at, measured = np.array([r[0] for r in rows]), np.stack([r[1] for r in rows])
        known = np.array([c for _, _, c in rows[1:] if c is not None])
        cov = np.concatenate([np.mean(known, 0)[None], known])
        if to is not None:
            measured = to.poses(measured)
            cov = scaled(cov, to.scale)
        smooth, cov, chi2 = smooth_path(at, measured, cov, np.append(phases, 0.5))
        shift = compose(inverse(smooth[-1]), poses[name])  # world of the path -> world of the average, in the middle
        moved = np.stack([compose(p, shift) for p in smooth[:-1]])
        paths[name] = Path(phases, moved, cov[:-1], chi2)
    return paths


def still_paths(paths: Mapping[str, Path], poses: Mapping[str, Floats], phases: Floats) -> dict[str, Path]:
    """A path that stands still for each view that has none, as unsure as the other views' cameras move.

    Training needs a path of every view. Nothing was measured of this one's motion; the best guess of a motion that is
    as likely to go one way as the other is none. Its covariance says how wrong that may be: at each phase, the mean
    square of the twists from the middle to there of the views that were measured, and their own covariance.

    Args:
        paths: measured.
        poses: of all placed views, at mid-exposure.
        phases: of the exposure, as of the paths.

    Returns:
        By view; empty where no view was measured, for then nothing says how far cameras move.
    """
    if not paths:
        return {}
    moves = [
        np.array([log_se3(compose(pose, inverse(poses[name]))) for pose in path.poses]) for name, path in paths.items()
    ]
    spread = np.mean([np.einsum("pi,pj->pij", m, m) for m in moves], 0) + np.mean([p.cov for p in paths.values()], 0)
    left = sorted(poses.keys() - paths.keys())
    return {name: Path(phases, np.stack([poses[name]] * len(phases)), spread, None) for name in left}


def scaled(cov: Floats, scale: float) -> Floats:
    """Covariances [N,6,6] of twists in a world that is `scale` times as large."""
    by = np.repeat([1.0, scale], 3)
    return cov * by[:, None] * by
