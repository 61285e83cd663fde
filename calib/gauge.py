"""The similarity between two worlds: what COLMAP finds is right up to a rotation, a shift and a scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Similarity:
    """x_to = scale * R @ x_from + t."""

    scale: float
    R: Floats
    t: Floats

    def points(self, xyz: Floats) -> Floats:
        """Points [N,3] in the other world."""
        return self.scale * np.asarray(xyz) @ self.R.T + self.t

    def poses(self, cam_from_world: Floats) -> Floats:
        """cam_from_world [N,3,4] of the same cameras in the other world: the pictures stay the same."""
        R = cam_from_world[:, :, :3] @ self.R.T
        t = self.scale * cam_from_world[:, :, 3] - R @ self.t
        return np.concatenate([R, t[:, :, None]], 2)


def centres(cam_from_world: Floats) -> Floats:
    """Camera centres [N,3] of poses [N,3,4]."""
    return -np.einsum("kji,kj->ki", cam_from_world[:, :, :3], cam_from_world[:, :, 3])


def similarity(source: Floats, target: Floats) -> Similarity:
    """The similarity that brings cameras to cameras, least squares over their centres and axes.

    Args:
        source, target: cam_from_world float64[N,3,4] of the same cameras in two worlds, N >= 2.

    Returns:
        x_target = similarity(x_source).

    Raises:
        DataError: fewer than two cameras, or all at one place: a scale cannot be found.

    Edges:
        Axes count as points at the cameras' own spread, so that centres on one line still give a rotation.

    Source: Umeyama 1991, on four points a camera: its centre, and one along each axis.
    """
    here, there = centres(source), centres(target)
    spread = [float(np.sqrt(np.mean(np.sum((c - c.mean(0)) ** 2, 1)))) if len(c) else 0.0 for c in (here, there)]
    if len(here) < 2 or min(spread) <= 1e-12:
        raise DataError("a scale needs cameras at two places at least", value=f"{len(here)} cameras, spread {spread}")
    found, ratio = Similarity(1.0, np.eye(3), np.zeros(3)), spread[1] / spread[0]
    for _ in range(4):  # the axes' length in the source is the target's over the scale: converges at once
        a = np.concatenate([here, *(here + spread[1] / ratio * source[:, k, :3] for k in range(3))])
        b = np.concatenate([there, *(there + spread[1] * target[:, k, :3] for k in range(3))])
        found = umeyama(a, b)
        ratio = found.scale
    return found


def umeyama(a: Floats, b: Floats) -> Similarity:
    """Least-squares similarity of points a [N,3] to b [N,3]."""
    ma, mb = a.mean(0), b.mean(0)
    u, s, vt = np.linalg.svd((b - mb).T @ (a - ma))
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    R = (u * flip) @ vt
    scale = float((s * flip).sum() / ((a - ma) ** 2).sum())
    return Similarity(scale, R, mb - scale * R @ ma)


def degrees_apart(a: Floats, b: Floats) -> Floats:
    """Angle between the rotations of poses [N,3,4], degrees [N]; exact near zero."""
    R = a[:, :, :3] @ b[:, :, :3].transpose(0, 2, 1)
    off = np.linalg.norm(R - R.transpose(0, 2, 1), axis=(1, 2)) / (2 * np.sqrt(2))
    return np.degrees(np.arctan2(off, (np.trace(R, axis1=1, axis2=2) - 1) / 2))


def extent(cam_from_world: Floats) -> float:
    """Largest distance between two camera centres."""
    c = centres(cam_from_world)
    return float(np.max(np.linalg.norm(c[:, None] - c[None], axis=2)))


def pose_errors(estimate: Floats, truth: Floats) -> tuple[Floats, Floats]:
    """(degrees [N], share of the extent of truth [N]) after the best similarity of these same cameras."""
    moved = similarity(estimate, truth).poses(estimate)
    away = np.linalg.norm(centres(moved) - centres(truth), axis=1)
    return degrees_apart(moved, truth), away / extent(truth)
