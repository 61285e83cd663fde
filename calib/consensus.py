"""Several maps of the same views: do they agree, what is their mean, and the paths through it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.gauge import extent, pose_errors, similarity
from spikerig.calib.mapping import Map
from spikerig.calib.smooth import compose, mean_pose, smooth_path

Floats = NDArray[np.float64]
AGREE_DEG, AGREE_SHARE = 1.5, 0.03  # median rotation, and median distance over the extent, within which maps agree


@dataclass(frozen=True, slots=True)
class Path:
    """A view's poses over its exposure: phases float64[M], cam_from_world [M,3,4], covariances [M,6,6], chi-square."""

    phases: Floats
    poses: Floats
    cov: Floats
    chi2: float


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
        known = np.array([np.sqrt(np.maximum(np.diag(c), 0)) for _, _, c in rows[1:] if c is not None])
        sigmas = np.concatenate([np.median(known, 0)[None], known])
        scale = 1.0
        if to is not None:
            measured, scale = to.poses(measured), to.scale
        sigmas[:, 3:] *= scale
        smooth, cov, chi2 = smooth_path(at, measured, sigmas, np.append(phases, 0.5))
        inverse = np.concatenate([smooth[-1][:, :3].T, -(smooth[-1][:, :3].T @ smooth[-1][:, 3])[:, None]], 1)
        shift = compose(inverse, poses[name])  # world of the path -> world of the average, in the middle
        moved = np.stack([compose(p, shift) for p in smooth[:-1]])
        paths[name] = Path(phases, moved, cov[:-1], chi2)
    return paths
