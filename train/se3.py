"""Rigid motions in torch: exponential and logarithm of SE(3) with gradients everywhere, and splines made of them.

Twists [...,6] are (rotation vector in radians, translation part), motions [...,3,4], as in `dataset.rigid`, which is
float64 NumPy and has no gradients. All functions take float32 or float64 and any leading axes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from math import factorial

import torch
from torch import Tensor

from spikerig.dataset.errors import UsageError

TERMS = 8
NEAR = 0.25  # squared angle below which the series are taken: their next terms are below 1e-17 there
# sin(a)/a, (1 - cos a)/a^2, (a - sin a)/a^3 in powers of a^2
EXP_SERIES = [[(-1.0) ** k / factorial(2 * k + n) for n in (1, 2, 3)] for k in range(TERMS)]
# (1 - (a/2) cot(a/2)) / a^2 in powers of a^2: |B_2k| / (2k)!
LOG_SERIES = [
    b / factorial(2 * k)
    for k, b in enumerate((1 / 6, 1 / 30, 1 / 42, 1 / 30, 5 / 66, 691 / 2730, 7 / 6, 3617 / 510, 43867 / 798), 1)
]
ATAN_NEAR = 0.0625  # squared tangent of half the angle below which atan's series is taken
ATAN_SERIES = [2 * (-1.0) ** k / (2 * k + 1) for k in range(13)]
# 4 q_i q_j of the unit quaternion (w, x, y, z) from a rotation matrix, row after row: constants and factors of R
QUAD_ONE = [1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0]
_R00, _R01, _R02, _R10, _R11, _R12, _R20, _R21, _R22 = range(9)
QUAD = [
    {_R00: 1, _R11: 1, _R22: 1}, {_R21: 1, _R12: -1}, {_R02: 1, _R20: -1}, {_R10: 1, _R01: -1},
    {_R21: 1, _R12: -1}, {_R00: 1, _R11: -1, _R22: -1}, {_R01: 1, _R10: 1}, {_R02: 1, _R20: 1},
    {_R02: 1, _R20: -1}, {_R01: 1, _R10: 1}, {_R11: 1, _R00: -1, _R22: -1}, {_R12: 1, _R21: 1},
    {_R10: 1, _R01: -1}, {_R02: 1, _R20: 1}, {_R12: 1, _R21: 1}, {_R22: 1, _R00: -1, _R11: -1},
]  # fmt: skip
QUAD_FROM = [[float(row.get(k, 0)) for row in QUAD] for k in range(9)]


@cache
def _constants(dtype: torch.dtype) -> tuple[Tensor, ...]:
    """Coefficients of the three series, factors and constants of the quaternion's matrix, the unit matrix, 0 1 2..."""
    tables = (EXP_SERIES, [[c] for c in LOG_SERIES], [[c] for c in ATAN_SERIES], QUAD_FROM, QUAD_ONE)
    counted = torch.arange(len(ATAN_SERIES), dtype=dtype)
    return *(torch.tensor(table, dtype=dtype) for table in tables), torch.eye(3, dtype=dtype), counted


def _series(s: Tensor, coefficients: Tensor) -> Tensor:
    """The polynomials sum_k c[k] s^k: [..., C] for c [K,C]."""
    return s[..., None] ** _constants(s.dtype)[-1][: len(coefficients)] @ coefficients


def _choose(near: Tensor, s: Tensor, series: Tensor, exact: Callable[[Tensor], Tensor]) -> Tensor:
    """A function [..., C] of s by its series where `near`, else by `exact` (which is only shown s that are not)."""
    if bool(near.all()):  # small motions, the rule in training, at half the cost
        return _series(s, series)
    return torch.where(near[..., None], _series(torch.where(near, s, 0.0), series), exact(torch.where(near, 1.0, s)))


def _exp_exact(s: Tensor) -> Tensor:
    a = torch.sqrt(s)
    sine, half = torch.sin(a), torch.sin(a / 2)
    return torch.stack([sine / a, 2 * half * half / s, (a - sine) / (s * a)], -1)


def _log_exact(s: Tensor) -> Tensor:
    half = torch.sqrt(s) / 2
    return ((1 - half * torch.cos(half) / torch.sin(half)) / s)[..., None]


def exp_se3(twist: Tensor) -> Tensor:
    """Rigid motions [...,3,4] of twists [...,6].

    Edges: any angle, exactly 0 too; gradients are finite everywhere and exact at 0 (the series' own).
    Source: Rodrigues; Barfoot, State Estimation for Robotics, 7.1.3.
    """
    w, v = twist[..., :3], twist[..., 3:]
    s = (w * w).sum(-1)
    exp_series, _, _, _, _, unit, _ = _constants(w.dtype)
    first, second, third = _choose(s < NEAR, s, exp_series, _exp_exact)[..., None].unbind(-2)
    wv = torch.linalg.cross(w, v)
    shift = v + second * wv + third * torch.linalg.cross(w, wv)
    x, y, z = (first * w).unbind(-1)
    nil = torch.zeros_like(x)
    skew = torch.stack([nil, -z, y, z, nil, -x, -y, x, nil], -1).unflatten(-1, (3, 3))
    square = w[..., :, None] * w[..., None, :] - s[..., None, None] * unit
    R = unit + skew + second[..., None] * square
    return torch.cat([R, shift[..., None]], -1)


def rotation_vector(R: Tensor) -> Tensor:
    """Axis times angle [...,3] of rotation matrices [...,3,3], angle in [0, pi].

    Edges:
        At pi the axis is defined up to sign and either may come; gradients are finite there, one-sided. At the
        identity the gradient is that of (R - R^T)/2, exactly.
    Source: unit quaternion by the largest of the four squares (Shepperd), then atan2.
    """
    _, _, series, factors, ones, _, _ = _constants(R.dtype)
    quad = (R.flatten(-2) @ factors + ones).unflatten(-1, (4, 4))
    best = quad.detach().diagonal(dim1=-2, dim2=-1).argmax(-1)
    q = torch.take_along_dim(quad, best[..., None, None], -2).squeeze(-2)
    q = torch.where(q.detach()[..., :1] < 0, -q, q)
    real, rest = q[..., :1], q[..., 1:]
    length = (rest * rest).sum(-1, keepdim=True)
    near = length < ATAN_NEAR * real * real
    if bool(near.all()):
        return rest * _series((length / (real * real))[..., 0], series) / real
    safe = torch.where(near, real, 1.0)
    small = _series(torch.where(near, length / (safe * safe), 0.0)[..., 0], series) / safe
    root = torch.sqrt(torch.where(near, 1.0, length))
    return rest * torch.where(near, small, 2 * torch.atan2(root, real) / root)


def log_se3(pose: Tensor) -> Tensor:
    """Twists [...,6] whose `exp_se3` are the rigid motions [...,3,4]; angles up to pi (see `rotation_vector`)."""
    w, t = rotation_vector(pose[..., :3]), pose[..., 3]
    s = (w * w).sum(-1)
    factor = _choose(s < NEAR, s, _constants(s.dtype)[1], _log_exact)
    wt = torch.linalg.cross(w, t)
    return torch.cat([w, t - wt / 2 + factor * torch.linalg.cross(w, wt)], -1)


def compose(a: Tensor, b: Tensor) -> Tensor:
    """The motions `a` after `b`, [...,3,4]."""
    turned = a[..., :3] @ b
    return torch.cat([turned[..., :3], turned[..., 3:] + a[..., 3:]], -1)


def inverse(pose: Tensor) -> Tensor:
    """The inverse motions [...,3,4]."""
    R = pose[..., :3].transpose(-1, -2)
    return torch.cat([R, -(R @ pose[..., 3:])], -1)


def linear_spline(knots: Tensor, at: float) -> Tensor:
    """The motion [...,3,4] at a place of screw motions from one knot to the next.

    Args:
        knots: twists [...,K,6] of K >= 2 motions, which the path meets at places 0, 1, ..., K - 1.
        at: the place; beyond the ends the outer pieces go on.
    """
    piece, u = _piece(at, knots.shape[-2] - 1)
    a, b = exp_se3(knots[..., piece : piece + 2, :]).unbind(-3)
    return compose(exp_se3(u * log_se3(compose(b, inverse(a)))), a)


def cubic_spline(knots: Tensor, at: float) -> Tensor:
    """The motion [...,3,4] at a place of a cumulative cubic B-spline; two derivatives are continuous.

    Args:
        knots: twists [...,K,6] of K >= 4 control motions.
        at: 0 to K - 3, a piece of the curve for each 1; beyond the ends the outer pieces go on.

    Source: Lovegrove et al. 2013 (Spline Fusion), in camera-from-world form, so factors stand in reverse.
    """
    piece, u = _piece(at, knots.shape[-2] - 3)
    controls = exp_se3(knots[..., piece : piece + 4, :])
    steps = log_se3(compose(controls[..., 1:, :, :], inverse(controls[..., :3, :, :])))
    share = knots.new_tensor([(5 + 3 * u - 3 * u**2 + u**3) / 6, (1 + 3 * u + 3 * u**2 - 2 * u**3) / 6, u**3 / 6])
    first, second, third = exp_se3(share[:, None] * steps).unbind(-3)
    return compose(third, compose(second, compose(first, controls[..., 0, :, :])))


def _piece(at: float, count: int) -> tuple[int, float]:
    if count < 1:
        raise UsageError("a spline needs more knots", expected="2 for a linear one, 4 for a cubic one")
    piece = min(max(int(at), 0), count - 1)
    return piece, at - piece
