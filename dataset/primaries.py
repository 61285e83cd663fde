"""Colours that are not linear Rec.709 when they come: other primaries, luminance with subsampled chroma."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikerig.dataset.errors import DataError

Floats = NDArray[np.float64]
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)  # red, green, blue, white: x, y each
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
# OpenEXR's windowed sinc: the weights of seven samples on each side of a missing one, nearest last
HALF_SINC = np.array([0.002128, -0.007540, 0.019597, -0.043159, 0.087929, -0.186077, 0.627123], np.float32)


def xyz_from_rgb(primaries: Sequence[float]) -> Floats:
    """The matrix float64[3,3] from linear RGB to CIE XYZ, RGB white at Y = 1.

    Args:
        primaries: chromaticities x, y of red, green, blue and white.

    Raises:
        DataError: not eight finite numbers, or primaries that span no colours.
    """
    x, y = np.array(primaries, np.float64).reshape(-1, 2).T if np.size(primaries) == 8 else (np.zeros(4), np.zeros(4))
    columns = np.stack([x, y, 1 - x - y])
    if np.all(np.isfinite(columns)) and y[3] != 0 and abs(np.linalg.det(columns[:, :3])) > 1e-9:
        matrix = columns[:, :3] * np.linalg.solve(columns[:, :3], columns[:, 3] / y[3])
        if abs(np.linalg.det(matrix)) > 1e-9:
            return matrix
    raise DataError("primaries that span no colours", value=tuple(np.ravel(primaries)))


def rec709_from(primaries: Sequence[float], neutral: Sequence[float] | None = None) -> Floats:
    """The matrix float64[3,3] from linear RGB of other primaries to linear Rec.709.

    Args:
        primaries: as in `xyz_from_rgb`.
        neutral: chromaticity x, y that shall become white (Bradford); None keeps colours as they are.

    Source:
        OpenEXR technical introduction, "RGB Color" (`chromaticities`, `adoptedNeutral`); Lindbloom for Bradford.
    """
    matrix = xyz_from_rgb(primaries)
    if neutral is not None:
        x, y = (float(v) for v in np.ravel(neutral)[:2])
        if not (np.isfinite([x, y]).all() and y > 0):
            raise DataError("a neutral that is no colour", value=(x, y))
        seen = BRADFORD @ np.array([x / y, 1, (1 - x - y) / y])
        white = BRADFORD @ np.array([REC709[6] / REC709[7], 1, (1 - REC709[6] - REC709[7]) / REC709[7]])
        matrix = np.linalg.inv(BRADFORD) @ np.diag(white / seen) @ BRADFORD @ matrix
    return np.linalg.inv(xyz_from_rgb(REC709)) @ matrix


def rgb_from_luma_chroma(y: ArrayLike, ry: ArrayLike, by: ArrayLike, primaries: Sequence[float]) -> NDArray[np.float32]:
    """Linear RGB of a luminance-chroma picture.

    Args:
        y: [H,W] luminance.
        ry, by: (R - Y) / Y and (B - Y) / Y at even pixels of even rows, [ceil(H/2), ceil(W/2)].
        primaries: that made the luminance.

    Returns:
        float32[H,W,3], of the same primaries.

    Source:
        OpenEXR, ImfRgbaYca.cpp: reconstructChroma, YCAtoRGBA, fixSaturation. Its rounding to half is left out.
    """
    luma = np.asarray(y, np.float32)
    red, blue = (_upsampled(_upsampled(np.asarray(c, np.float32), luma.shape[0]).T, luma.shape[1]).T for c in (ry, by))
    weights = xyz_from_rgb(primaries)[1]
    weights = weights / weights.sum()
    r, b = (red + 1) * luma, (blue + 1) * luma
    g = (luma - r * weights[0] - b * weights[2]) / weights[1]
    rgb = np.stack([r, g, b], 2).astype(np.float32)
    gray = (red == 0) & (blue == 0)
    rgb[gray] = luma[gray][:, None]
    return _less_saturated(rgb, weights)


def _upsampled(values: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """Rows at even places filled up to `size` rows; beyond the edges the outermost row goes on."""
    n, out = len(values), np.empty((size, values.shape[1]), np.float32)
    out[::2] = values
    padded = np.concatenate([np.repeat(values[:1], 6, 0), values, np.repeat(values[-1:], 7, 0)])
    between = sum(w * (padded[k : k + n] + padded[13 - k : 13 - k + n]) for k, w in enumerate(HALF_SINC))
    out[1::2] = between[: size // 2]  # type: ignore[index]
    return out


def _less_saturated(rgb: NDArray[np.float32], weights: Floats) -> NDArray[np.float32]:
    """Pixels far more saturated than their diagonal neighbours lose colour and keep luminance (chroma filters ring)."""
    top = rgb.max(2)
    saturation = np.where(top > 0, 1 - rgb.min(2) / np.where(top > 0, top, 1), 0)
    around = np.pad(saturation, 1, "edge")
    mean = np.minimum(1, 0.25 * (around[:-2, :-2] + around[:-2, 2:] + around[2:, :-2] + around[2:, 2:]))
    most = np.minimum(1, 1 - (1 - mean) * 0.25)
    wild = saturation > np.maximum(mean, most)
    if not wild.any():
        return rgb
    bad, peak = rgb[wild], top[wild][:, None]
    less = np.maximum(peak - (peak - bad) * (most[wild] / saturation[wild])[:, None], 0)
    before, after = bad @ weights, less @ weights
    rgb[wild] = less * np.where(after > 0, before / np.where(after > 0, after, 1), 1)[:, None]
    return rgb
