"""A camera's path over one exposure from poses at a few instants: a smoothing spline of one span on SE(3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError
from spikerig.dataset.rigid import compose, exp_se3, hat, inverse, left_jacobian, log_se3

Floats = NDArray[np.float64]
HUBER = 2.0  # standard deviations beyond which an instant counts less


def smooth_path(
    at: Floats, poses: Floats, cov: Floats, wanted: Floats, degree: int = 3
) -> tuple[Floats, Floats, float]:
    """Poses at any instants of an exposure, from noisy ones at some.

    The path is exp(x(t)) B, where B is the measured pose nearest to the middle, exp that of SE(3), and x(t) a twist
    whose six components are cubics in time: a spline of one span in the tangent space at B. It is fitted to the
    logarithms log(P B^-1) of the measured poses P by robust least squares, weighted by their whole covariances. All of
    it is well-defined, and the fit of a path that lies on such a curve exact, for less than half a turn away from B.

    Args:
        at: phases of the measured poses, float64[N], 0 to 1.
        poses: cam_from_world float64[N,3,4].
        cov: covariances float64[N,6,6] of the twists (rotation, translation) by which poses are off, on their left
            (in the camera's frame); or standard deviations [N,6].
        wanted: phases asked for, float64[M].
        degree: of the polynomial; lowered to what N instants can carry.

    Returns:
        poses float64[M,3,4], the covariances float64[M,6,6] of their twists, and the chi-square a degree of freedom of
        the fit before robust weights (about 1 where the covariances are right).

    Raises:
        DataError: no instant at all.

    Source: a polynomial in the tangent space, as in Barfoot, State Estimation for Robotics, chapter 7.
    """
    if len(at) == 0:
        raise DataError("a path needs a pose at one instant at least")
    cov = np.array([np.diag(row**2) for row in cov]) if cov.ndim == 2 else cov
    base = poses[int(np.argmin(np.abs(at - 0.5)))]
    local = np.array([log_se3(compose(pose, inverse(base))) for pose in poses])
    degree = max(0, min(degree, len(at) - 2 if len(at) > 2 else len(at) - 1))
    basis, ask = (np.polynomial.legendre.legvander(2 * np.asarray(p) - 1, degree) for p in (at, wanted))
    back = [np.linalg.inv(left_jacobian(x)) for x in local]  # from motions on a pose's left to changes of its twist
    white = np.array([_whitening(J @ c @ J.T) for J, c in zip(back, cov, strict=True)])
    system = np.einsum("nij,nd->nidj", white, basis).reshape(6 * len(at), -1)
    sides = np.einsum("nij,nj->ni", white, local).ravel()
    weight, off, solved = np.ones(6 * len(at)), np.zeros(6 * len(at)), np.zeros(system.shape[1])
    for _ in range(5):
        solved = np.linalg.lstsq(system * weight[:, None], sides * weight, rcond=None)[0]
        off = system @ solved - sides
        far = np.sqrt(np.mean(off.reshape(-1, 6) ** 2, 1))
        weight = np.repeat(np.sqrt(np.minimum(1, HUBER / np.maximum(far, 1e-12))), 6)
    free = 6 * max(len(at) - degree - 1, 1)
    grown = max(1.0, float(np.sum((off * weight) ** 2)) / free)  # never surer than the scatter says
    inside = grown * np.linalg.pinv((system * weight[:, None]).T @ (system * weight[:, None]))
    rows = [np.kron(row, np.eye(6)) for row in ask]
    twists = [row @ solved for row in rows]
    turned = [left_jacobian(x) @ row for x, row in zip(twists, rows, strict=True)]
    found = np.array([J @ inside @ J.T for J in turned])
    smooth = np.array([compose(exp_se3(x), base) for x in twists])
    return smooth, (found + found.transpose(0, 2, 1)) / 2, float(np.sum(off**2)) / free


def _whitening(cov: Floats) -> Floats:
    """The matrix that turns errors of this covariance into independent ones of 1; no error is taken as 1e-9."""
    values, axes = np.linalg.eigh((cov + cov.T) / 2)
    return (axes / np.sqrt(np.maximum(values, 1e-18))).T


def twist_covariance(solved: Floats, pose: Floats) -> Floats:
    """The covariance [6,6] of a pose's twist error, from that of COLMAP's parameters.

    Args:
        solved: [6,6] of Ceres' tangent to the quaternion, which is half the rotation vector, and of the translation.
        pose: cam_from_world [3,4].

    Source: exp(twist) P moves the translation t by v + w x t; so v = dt + t x w, and w is twice the tangent.
    """
    to = np.block([[2 * np.eye(3), np.zeros((3, 3))], [2 * hat(pose[:, 3]), np.eye(3)]])
    return to @ solved @ to.T


def mean_pose(poses: Sequence[Floats]) -> Floats:
    """Mean of poses [3,4] of one camera in one world: chordal mean of rotations, mean of centres."""
    u, _, vt = np.linalg.svd(sum(p[:, :3] for p in poses))
    R = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    centre = np.mean([-p[:, :3].T @ p[:, 3] for p in poses], 0)
    return np.concatenate([R, -(R @ centre)[:, None]], 1)
