"""The lens: from directions to pixels and back, with derivatives. OpenCV's model, pixel centres at +0.5.

A direction is (x, y) at z = 1. The lens bends it, K turns it into a pixel:

    radial = (1 + k1 r2 + k2 r4 + k3 r6) / (1 + k4 r2 + k5 r4 + k6 r6),   r2 = x^2 + y^2
    x' = x radial + 2 p1 x y + p2 (r2 + 2 x^2),   y' = y radial + p1 (r2 + 2 y^2) + 2 p2 x y

with the coefficients stored as k1 k2 p1 p2 k3 k4 k5 k6; OpenCV's centres-at-0 is met here and nowhere else.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikerig.dataset.errors import UsageError
from spikerig.dataset.scene import Camera

Floats = NDArray[np.float64]
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
LENSES = (0, 1, 4, 5, 8)  # how many coefficients a fit may free


def bend(xy: Floats, coefficients: Floats) -> tuple[Floats, Floats]:
    """What the lens does to directions, with the derivative.

    Args:
        xy: float64[...,2] at z = 1.
        coefficients: float64[n], n of `LENSES`.

    Returns:
        (bent float64[...,2], d bent / d xy float64[...,2,2]).

    Source:
        OpenCV's calib3d page, "camera calibration and 3D reconstruction".
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = _eight(coefficients)
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    bottom = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / bottom
    slope = (k1 + r2 * (2 * k2 + r2 * 3 * k3) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / bottom  # d radial / d r2
    across = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    down = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    by = np.empty((*xy.shape, 2))
    by[..., 0, 0] = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    by[..., 0, 1] = by[..., 1, 0] = 2 * x * y * slope + 2 * (p1 * x + p2 * y)
    by[..., 1, 1] = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return np.stack([across, down], -1), by


def by_coefficients(xy: Floats, coefficients: Floats) -> Floats:
    """d bent / d coefficients of `bend`, float64[...,2,n]."""
    _, _, _, _, _, k4, k5, k6 = _eight(coefficients)
    x, y = xy[..., 0, None], xy[..., 1, None]
    r2 = x * x + y * y
    bottom = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = _radial(r2, coefficients)
    powers = np.concatenate([r2, r2**2, r2**3], -1) / bottom
    across = [powers[..., :2] * x, 2 * x * y, r2 + 2 * x * x, powers[..., 2:] * x, -powers * radial * x]
    down = [powers[..., :2] * y, r2 + 2 * y * y, 2 * x * y, powers[..., 2:] * y, -powers * radial * y]
    rows = [np.concatenate(row, -1) for row in (across, down)]
    return np.stack(rows, -2)[..., : len(coefficients)]


def bent_only(xy: Floats, coefficients: Floats) -> Floats:
    """What `bend` does to directions, without the derivatives: a quarter of its cost."""
    if not len(coefficients):
        return xy
    _, _, p1, p2, *_ = _eight(coefficients)
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = _radial(r2, coefficients)
    across = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    return np.stack([across, y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1)


def _eight(coefficients: Floats) -> Floats:
    return np.concatenate([coefficients, np.zeros(8 - len(coefficients))])


def _radial(r2: Floats, coefficients: Floats) -> Floats:
    k1, k2, _, _, k3, k4, k5, k6 = _eight(coefficients)
    top = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return top / (1 + r2 * (k4 + r2 * (k5 + r2 * k6))) if len(coefficients) > 5 else top


def project(camera: Camera, points: ArrayLike) -> Floats:
    """Pixels of points in the camera's axes.

    Args:
        camera: with its distortion.
        points: float64[...,3], any unit.

    Returns:
        float64[...,2], centres at +0.5; NaN for points behind the camera or beyond what the lens can bend.
    """
    p = np.asarray(points, np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = p[..., :2] / p[..., 2:]
    ahead = (p[..., 2] > 0) & (np.hypot(xy[..., 0], xy[..., 1]) < reach(camera.distortion))
    bent = bent_only(np.where(ahead[..., None], xy, 0), camera.distortion)
    px = bent @ camera.K[:2, :2].T + camera.K[:2, 2]
    return np.where(ahead[..., None], px, np.nan)


def directions(camera: Camera, px: ArrayLike) -> Floats:
    """Directions (x, y, 1) of pixels, the inverse of `project`: Newton's method, to 1e-12.

    Args:
        camera: with its distortion.
        px: float64[...,2].

    Returns:
        float64[...,3]; NaN where no direction inside the lens's reach comes to that pixel.
    """
    K = camera.K
    p = np.asarray(px, np.float64) - K[:2, 2]
    y = p[..., 1] / K[1, 1]
    target = np.stack([(p[..., 0] - K[0, 1] * y) / K[0, 0], y], -1)
    xy, most = target.copy(), reach(camera.distortion)
    if camera.distortion.any():
        for _ in range(30):
            far = np.hypot(xy[..., 0], xy[..., 1])[..., None]
            xy = np.where(far > most * 0.999, xy * (most * 0.999 / np.maximum(far, 1e-300)), xy)
            bent, by_xy = bend(xy, camera.distortion)
            off = bent - target
            if np.nanmax(np.abs(off), initial=0) < 1e-13:
                break
            (a, b), (c, d) = np.moveaxis(by_xy, (-2, -1), (0, 1))
            det = a * d - b * c
            det = np.where(np.abs(det) < 1e-12, 1e-12, det)
            step = np.stack([d * off[..., 0] - b * off[..., 1], a * off[..., 1] - c * off[..., 0]], -1) / det[..., None]
            xy = xy - step
        off = bent_only(xy, camera.distortion) - target
        xy = np.where((np.abs(off).max(-1) < 1e-9)[..., None], xy, np.nan)
    return np.concatenate([xy, np.ones_like(xy[..., :1])], -1)


def reach(coefficients: Floats) -> float:
    """The radius at z = 1 up to which a lens bends directions one to one; beyond it a fitted polynomial folds back.

    Returns:
        A radius, at most 20 (87 degrees off the axis); infinite for a lens that does not bend.
    """
    if not np.any(coefficients):
        return float("inf")
    r = np.linspace(0, 20, 4001)[1:]
    _, by_xy = bend(
        np.stack([r, np.zeros_like(r)], -1), np.where(np.arange(len(coefficients)) // 2 == 1, 0, coefficients)
    )
    folded = np.flatnonzero(~(by_xy[:, 0, 0] > 0) | ~(by_xy[:, 1, 1] > 0))
    return float(r[folded[0]] - r[0]) if len(folded) else float(r[-1])


def cv_matrix(K: Floats) -> Floats:
    """OpenCV's camera matrix (pixel centres at 0) of ours (at +0.5)."""
    return K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


def our_matrix(K: Floats) -> Floats:
    """Ours (pixel centres at +0.5) of OpenCV's (at 0)."""
    return K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


def stored(coefficients: Floats) -> Floats:
    """Coefficients as `Camera` stores them: none where all are zero, else OpenCV's 4, 5 or 8."""
    n = len(coefficients)
    if n not in LENSES:
        raise UsageError("no such lens", value=f"{n} coefficients", expected=", ".join(map(str, LENSES)))
    return np.concatenate([coefficients, np.zeros(3)]) if n == 1 else np.asarray(coefficients, np.float64)
