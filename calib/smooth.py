"""A camera's path over one exposure from poses at a few instants: a smoothing spline on SE(3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError

Floats = NDArray[np.float64]
HUBER = 2.0  # standard deviations beyond which an instant counts less


def smooth_path(
    at: Floats, poses: Floats, sigmas: Floats, wanted: Floats, degree: int = 3
) -> tuple[Floats, Floats, float]:
    """Poses at any instants of an exposure, from noisy ones at some.

    A path of one exposure is short: in the frame of its middle pose, rotation vector and translation are small, and a
    polynomial of low degree in time is fitted to each by weighted, robust least squares.

    Args:
        at: phases of the measured poses, float64[N], 0 to 1.
        poses: cam_from_world float64[N,3,4].
        sigmas: standard deviations float64[N,6] of rotation (rad) and translation in the camera's frame.
        wanted: phases asked for, float64[M].
        degree: of the polynomial; lowered to what N instants can carry.

    Returns:
        poses float64[M,3,4], their covariances float64[M,6,6] (diagonal), and the chi-square a degree of freedom of the
        fit before robust weights (about 1 where the sigmas are right).

    Raises:
        DataError: no instant at all.
    """
    if len(at) == 0:
        raise DataError("a path needs a pose at one instant at least")
    base = poses[int(np.argmin(np.abs(at - 0.5)))]
    inverse = np.concatenate([base[:, :3].T, -(base[:, :3].T @ base[:, 3])[:, None]], 1)
    local = np.array([_log(compose(pose, inverse)) for pose in poses])
    degree = max(0, min(degree, len(at) - 2 if len(at) > 2 else len(at) - 1))
    basis, ask = (np.polynomial.legendre.legvander(2 * np.asarray(p) - 1, degree) for p in (at, wanted))
    fitted, cov, chi = np.empty((len(wanted), 6)), np.zeros((len(wanted), 6, 6)), 0.0
    for axis in range(6):
        sigma = np.maximum(sigmas[:, axis], 1e-9)
        weight = 1 / sigma
        solved, off = np.zeros(degree + 1), np.zeros(len(at))
        for _ in range(5):
            solved = np.linalg.lstsq(basis * weight[:, None], local[:, axis] * weight, rcond=None)[0]
            off = np.abs(basis @ solved - local[:, axis]) / sigma
            weight = np.sqrt(np.minimum(1, HUBER / np.maximum(off, 1e-12))) / sigma
        free = max(len(at) - degree - 1, 1)
        chi += float(np.sum(off**2)) / free / 6
        fitted[:, axis] = ask @ solved
        inside = np.linalg.pinv((basis * weight[:, None]).T @ (basis * weight[:, None]))
        grown = max(1.0, float(np.sum((off * sigma * weight) ** 2)) / free)  # never surer than the scatter says
        cov[:, axis, axis] = grown * np.einsum("mi,ij,mj->m", ask, inside, ask)
    return np.array([compose(_exp(v), base) for v in fitted]), cov, chi


def compose(a: Floats, b: Floats) -> Floats:
    """a after b, both [3,4]."""
    return np.concatenate([a[:, :3] @ b[:, :3], (a[:, :3] @ b[:, 3] + a[:, 3])[:, None]], 1)


def mean_pose(poses: Sequence[Floats]) -> Floats:
    """Mean of poses [3,4] of one camera in one world: chordal mean of rotations, mean of centres."""
    u, _, vt = np.linalg.svd(sum(p[:, :3] for p in poses))
    R = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    centre = np.mean([-p[:, :3].T @ p[:, 3] for p in poses], 0)
    return np.concatenate([R, -(R @ centre)[:, None]], 1)


def _log(pose: Floats) -> Floats:
    """Rotation vector and translation of a small motion [3,4]."""
    R = pose[:, :3]
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    sine, cosine = float(np.linalg.norm(axis)), (float(np.trace(R)) - 1) / 2
    angle = np.arctan2(sine, cosine)
    return np.concatenate([axis * (angle / sine if sine > 1e-12 else 1.0), pose[:, 3]])


def _exp(v: Floats) -> Floats:
    x, y, z = v[:3]
    angle = float(np.linalg.norm(v[:3]))
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    half = np.sinc(angle / (2 * np.pi))
    R = np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * half**2 * (cross @ cross)
    return np.concatenate([R, v[3:, None]], 1)
