"""Rigid motions: twists of SE(3), their exponential and logarithm, and the screw between two poses."""

from __future__ import annotations

import numpy as np

from spikerig.dataset.scene import Floats

SMALL = 1e-2  # below this angle the Taylor branches below are exact to float64 (next terms ~ angle^6/5000 = 2e-16)


def hat(w: Floats) -> Floats:
    """The skew matrix [w]x of w[3], so that hat(w) @ v = cross(w, v)."""
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def _coefficients(angle: float) -> tuple[float, float, float]:
    # sin(a)/a, (1-cos a)/a^2, (a - sin a)/a^3
    if angle < SMALL:
        s = angle * angle
        return 1 - s / 6 + s * s / 120, 0.5 - s / 24 + s * s / 720, 1 / 6 - s / 120 + s * s / 5040
    half = np.sin(angle / 2)
    return np.sin(angle) / angle, 2 * half * half / angle**2, (angle - np.sin(angle)) / angle**3


def exp_se3(twist: Floats) -> Floats:
    """Rigid motion [3,4] of a twist (rotation vector [3] in radians, then translation part [3])."""
    w, v = twist[:3], twist[3:]
    W = hat(w)
    a, b, c = _coefficients(float(np.linalg.norm(w)))
    R = np.eye(3) + a * W + b * W @ W
    V = np.eye(3) + b * W + c * W @ W
    return np.concatenate([R, (V @ v)[:, None]], axis=1)


def rotation_vector(R: Floats) -> Floats:
    """Axis times angle [3] of a rotation matrix, angle in [0, pi].

    Edges:
        At pi the axis is defined up to sign; the one with a positive largest component is returned.
    Cost: microseconds. Source: unit quaternion by the largest of the four squares (Shepperd), then atan2.
    """
    t = np.array([np.trace(R), R[0, 0], R[1, 1], R[2, 2]])
    k = int(np.argmax(t))
    if k == 0:
        q = np.array([1 + t[0], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    else:
        i, j, m = k - 1, k % 3, (k + 1) % 3
        q = np.empty(4)
        q[0] = R[m, j] - R[j, m]
        q[1 + i] = 1 + R[i, i] - R[j, j] - R[m, m]
        q[1 + j] = R[j, i] + R[i, j]
        q[1 + m] = R[m, i] + R[i, m]
    q /= np.linalg.norm(q)
    if q[0] < 0:
        q = -q
    s = float(np.linalg.norm(q[1:]))
    if s < 1e-8:  # angle = 2 atan2(s, q0) ~ 2 s / q0
        return 2 * q[1:] / q[0]
    return q[1:] * (2 * np.arctan2(s, q[0]) / s)


def log_se3(pose: Floats) -> Floats:
    """Twist [6] (rotation vector, translation part) whose `exp_se3` is the rigid motion [3,4]."""
    w = rotation_vector(pose[:, :3])
    angle = float(np.linalg.norm(w))
    W = hat(w)
    if angle < SMALL:
        d = 1 / 12 + angle**2 / 720 + angle**4 / 30240
    else:  # (1 - (a/2) cot(a/2)) / a^2
        d = (1 - (angle / 2) * np.cos(angle / 2) / np.sin(angle / 2)) / angle**2
    return np.concatenate([w, (np.eye(3) - W / 2 + d * W @ W) @ pose[:, 3]])


def compose(a: Floats, b: Floats) -> Floats:
    """The rigid motion `a` after `b`, both [3,4]."""
    return np.concatenate([a[:, :3] @ b[:, :3], (a[:, :3] @ b[:, 3] + a[:, 3])[:, None]], axis=1)


def inverse(pose: Floats) -> Floats:
    """The inverse rigid motion [3,4]."""
    R = pose[:, :3].T
    return np.concatenate([R, -(R @ pose[:, 3])[:, None]], axis=1)


def between(a: Floats, b: Floats, u: float) -> Floats:
    """The pose a fraction `u` along the screw motion from pose `a` [3,4] to `b`; exactly a at 0 and b at 1."""
    if u == 0.0:
        return a
    if u == 1.0:
        return b
    return compose(exp_se3(u * log_se3(compose(b, inverse(a)))), a)


def left_jacobian(twist: Floats) -> Floats:
    """[6,6] that turns a small change of a twist into the small motion that follows: exp(x + d) = exp(J d) exp(x).

    Edges: a series; exact to float64 for turns up to half a turn.
    Source: Barfoot, State Estimation for Robotics, section 7.1.5; twists are (rotation, translation) here.
    """
    w, v = hat(twist[:3]), hat(twist[3:])
    ad = np.block([[w, np.zeros((3, 3))], [v, w]])
    total, term = np.eye(6), np.eye(6)
    for n in range(1, 40):
        term = term @ ad / (n + 1)
        total += term
    return total
