"""Pictures resampled and blurred: the one place where optics move light from pixel to pixel.

Cubic interpolation (Keys, a = -1/2): exact for quadratics, and a copy, bit for bit, where a shift is a whole pixel.
Beyond the edge lies the edge's light.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import UsageError

Floats = NDArray[np.floating]
Positions = tuple[NDArray[np.float64], NDArray[np.float64]]
Map = Callable[[NDArray[np.float64], NDArray[np.float64]], Positions]  # x, y of the output -> x, y of the input
FINEST = 6  # samples along a pixel's side where a map shrinks


def resampler(height: int, width: int, source: Map) -> Callable[[Floats], Floats]:
    """A function that redraws pictures float32[n,H,W,C] through a map.

    Args:
        height, width: of the pictures.
        source: output positions to input positions, pixels, centres at +0.5.

    Returns:
        Takes pictures and returns new ones. Where the map shrinks, a pixel is the mean of several samples.

    Cost:
        16 reads a pixel; times the square of the shrinkage. Positions and weights are computed once.
    """
    parts = _samples(height, width, source)
    taps: list[tuple[NDArray[np.intp], Floats]] = []
    for j in range(parts):
        for i in range(parts):
            y, x = np.mgrid[:height, :width].reshape(2, -1)
            taps += _taps(*source(x + (i + 0.5) / parts, y + (j + 0.5) / parts), height, width, parts**2)

    def redraw(pictures: Floats) -> Floats:
        out = np.empty_like(pictures)
        for k, picture in enumerate(pictures):
            flat = picture.reshape(height * width, -1)
            total = np.zeros_like(flat)
            for at, weight in taps:
                total += flat.take(at, axis=0) * weight[:, None]
            out[k] = total.reshape(picture.shape)
        return out

    return redraw


def _samples(height: int, width: int, source: Map) -> int:
    """Samples along a pixel's side that a map needs: how far apart neighbours come to lie, rounded up."""
    y, x = np.mgrid[: height + 1, : width + 1].astype(np.float64)
    u, v = source(x.ravel(), y.ravel())
    u, v = u.reshape(x.shape), v.reshape(x.shape)
    apart = max(np.hypot(np.diff(u, axis=a), np.diff(v, axis=a)).max() for a in (0, 1))
    return int(np.clip(np.ceil(apart - 0.1), 1, FINEST))


def cubic(t: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Keys' weights (a = -1/2) of the pixels at -1, 0, 1 and 2 for a position t between 0 and 1."""
    return (
        ((-0.5 * t + 1) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1,
        ((-1.5 * t + 2) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )


def _taps(
    x: NDArray[np.float64], y: NDArray[np.float64], height: int, width: int, share: int
) -> list[tuple[NDArray[np.intp], Floats]]:
    """Where to read (index into the flat picture) and how much of it, for input positions."""
    x, y = np.clip(x, -1, width + 1) - 0.5, np.clip(y, -1, height + 1) - 0.5
    i, j = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
    found = []
    for dy, wy in enumerate(cubic(y - j)):
        row = np.clip(j + dy - 1, 0, height - 1) * width
        for dx, wx in enumerate(cubic(x - i)):
            weight = wy * wx / share
            if weight.any():
                found.append((row + np.clip(i + dx - 1, 0, width - 1), weight.astype(np.float32)))
    return found


def shift_map(dx: float, dy: float) -> Map:
    """The map that moves a picture right by dx and down by dy pixels."""
    return lambda x, y: (x - dx, y - dy)


def plane_map(matrix: NDArray[np.float64]) -> Map:
    """The map of a homography float64[3,3] from output to input positions.

    Raises:
        UsageError: on use, where a position has no finite source in front of the camera.
    """

    def source(x: NDArray[np.float64], y: NDArray[np.float64]) -> Positions:
        u, v, w = (matrix[k, 0] * x + matrix[k, 1] * y + matrix[k, 2] for k in range(3))
        if not np.min(w, initial=1.0) > 1e-3:
            raise UsageError("the arms are turned so far apart that one sees what lies behind the other")
        return u / w, v / w

    return source


def bent(x: NDArray, y: NDArray, k: tuple[float, float, float, float]) -> Positions:
    """Where a lens puts the ray (x, y, 1): OpenCV's model of k1 k2 p1 p2, normalised coordinates."""
    k1, k2, p1, p2 = k
    r2 = x * x + y * y
    radial = 1 + (k1 + k2 * r2) * r2
    return x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


def straight(x: NDArray, y: NDArray, k: tuple[float, float, float, float]) -> Positions:
    """The ray that a lens puts at (x, y): the inverse of `bent`, by Newton's method to 1e-12.

    Raises:
        UsageError: the model folds over within the picture: no ray reaches a position, or two do.
    """
    k1, k2, p1, p2 = k
    u, v = np.array(x, np.float64), np.array(y, np.float64)
    good = np.ones(u.shape, bool)
    for _ in range(60):
        bx, by = bent(u, v, k)
        ex, ey = bx - x, by - y
        r2 = u * u + v * v
        radial, slope = 1 + (k1 + k2 * r2) * r2, 2 * (k1 + 2 * k2 * r2)
        a = radial + slope * u * u + 2 * p1 * v + 6 * p2 * u
        b = slope * u * v + 2 * p1 * u + 2 * p2 * v
        d = radial + slope * v * v + 6 * p1 * v + 2 * p2 * u
        det = a * d - b * b
        good = det > 1e-3
        det = np.where(good, det, 1)
        u -= np.where(good, (d * ex - b * ey) / det, 0)
        v -= np.where(good, (a * ey - b * ex) / det, 0)
        if np.max(np.hypot(ex, ey), initial=0) < 1e-12:
            break
    bx, by = bent(u, v, k)
    bad = ~good | ~(np.hypot(bx - x, by - y) < 1e-9)
    if bad.any():
        raise UsageError(
            "the distortion folds over within the picture",
            value=f"{int(bad.sum())} of {bad.size} positions see no ray of their own, k1 k2 p1 p2 = {list(k)}",
            cause="coefficients of a lens with a smaller field of view",
            next="lower them, or the field of view",
        )
    return u, v


def blur_kernel(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The kernel that averages a picture's shifted copies; odd and square, float64, sums to 1.

    Args:
        points: shifts (x, y), pixels, float64[n,2]. Second moments are kept exactly (the interpolation reproduces
            quadratics).
    """
    reach = int(np.ceil(np.abs(points).max(initial=0))) + 2
    size = 2 * reach + 1
    whole = np.floor(points).astype(np.intp)
    across, down = (cubic(points[:, axis] - whole[:, axis]) for axis in (0, 1))
    corner = (whole[:, 1] + reach - 1) * size + whole[:, 0] + reach - 1
    kernel = np.zeros(size * size)
    for j in range(4):
        for i in range(4):
            kernel += np.bincount(corner + j * size + i, down[j] * across[i], size * size)
    return kernel.reshape(size, size) / len(points)


def blurred(pictures: Floats, kernel: NDArray[np.float64]) -> Floats:
    """Pictures float32[n,H,W,C] averaged by a symmetric kernel; beyond the edge lies the edge's light."""
    import cv2

    out = np.empty_like(pictures)
    for k, picture in enumerate(pictures):
        out[k] = cv2.filter2D(picture, -1, kernel, borderType=cv2.BORDER_REPLICATE).reshape(picture.shape)
    return out
