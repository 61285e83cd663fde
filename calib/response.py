"""How the two arms' light compares: the spike arm's response to colour, spikes a tick at RGB white, the RGB curve."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.images import linear_from_srgb

Floats = NDArray[np.float64]
LUMA = np.array([0.299, 0.587, 0.114])
COLOURS = 0.02  # the third singular value of the levels' colours, relative, below which colours were too alike
DIM, CLIPPED = 2, 253  # 8-bit codes outside which a level says nothing of the RGB arm


@dataclass(frozen=True, slots=True)
class Response:
    """Light of the spike arm from that of the RGB arm: light = split_ratio * (response . linear rgb).

    Args:
        split_ratio: spikes a tick at RGB white, at the exposure and gain of the RGB pictures. What the splitter, the
            lenses and both sensors do together; the splitter's own share cannot be told from outside.
        response: to linear red, green and blue, sum 1; None where the levels' colours were too alike to tell.
        residual: relative, rms over the levels.
        curve: slope of log spike light against log RGB light; 1 where the RGB picture really is sRGB.
        curve_sd: its standard deviation; NaN for fewer than three levels.
        used: which levels counted.
    """

    split_ratio: float
    response: tuple[float, float, float] | None
    residual: float
    curve: float
    curve_sd: float
    used: tuple[bool, ...]


def rgb_mean(pixels: NDArray[np.uint8]) -> tuple[Floats, bool]:
    """Mean linear (r, g, b) of the middle quarter of a picture, and whether it is neither black nor clipped."""
    h, w = pixels.shape[:2]
    middle = pixels[h // 4 : h - h // 4, w // 4 : w - w // 4, :3]
    codes = middle.astype(np.float64) / (257.0 if middle.dtype == np.uint16 else 1.0)
    fits = bool(np.percentile(codes, 1) >= DIM and np.percentile(codes, 99) <= CLIPPED)
    return linear_from_srgb(middle).reshape(-1, middle.shape[2]).mean(0, dtype=np.float64), fits


def fit_response(rgb: Floats, light: Floats, fits: Sequence[bool]) -> Response:
    """Fit the comparison of the arms to levels of even light.

    Args:
        rgb: float64[K,3] linear means of the RGB pictures.
        light: float64[K] of the spike arm, its dark rate taken off.
        fits: levels whose RGB picture is neither black nor clipped.

    Raises:
        UsageError: shapes that do not fit.
        DataError: no level can be used.
    """
    if rgb.shape != (len(light), 3) or len(fits) != len(light):
        raise UsageError("levels are rgb[K,3] with light[K]", value=(rgb.shape, light.shape, len(fits)))
    use = np.array(fits) & (light > 0) & (rgb.max(1, initial=0) > 0)
    if not use.any():
        raise DataError("no level shows light in both arms", value=f"{len(light)} levels",
                        expected="RGB codes between 2 and 253, and spikes",
                        cause="pictures black or clipped")  # fmt: skip
    x, y = rgb[use], light[use]
    relative = x / y[:, None]  # least squares of relative errors: levels count alike
    values = np.linalg.svd(x / np.linalg.norm(x, axis=1, keepdims=True), compute_uv=False)
    if len(values) == 3 and values[2] > COLOURS * values[0]:
        k = _not_negative(relative)
    else:
        gray = relative @ LUMA
        k = LUMA * float(gray.sum() / (gray @ gray))
    told = x @ k
    curve, sd = _slope(np.log(np.maximum(told, 1e-12)), np.log(y))
    total = float(k.sum())
    response = tuple((k / total).tolist()) if len(values) == 3 and values[2] > COLOURS * values[0] else None
    residual = float(np.sqrt(np.mean((told / y - 1) ** 2)))
    return Response(total, response, residual, curve, sd, tuple(use.tolist()))  # type: ignore[arg-type]


def _not_negative(relative: Floats) -> Floats:
    """Least squares of relative @ k = 1 with k >= 0: the best of the seven choices of which are positive."""
    best, found = np.inf, LUMA
    for count in (1, 2, 3):
        for chosen in itertools.combinations(range(3), count):
            part = np.linalg.lstsq(relative[:, chosen], np.ones(len(relative)), rcond=None)[0]
            off = float(((relative[:, chosen] @ part - 1) ** 2).sum())
            if (part >= 0).all() and off < best:
                best, found = off, np.zeros(3)
                found[list(chosen)] = part
    return found


def _slope(x: Floats, y: Floats) -> tuple[float, float]:
    spread = float(((x - x.mean()) ** 2).sum())
    if len(x) < 2 or spread < 1e-6:
        return 1.0, float("nan")
    slope = float(((x - x.mean()) * (y - y.mean())).sum() / spread)
    if len(x) < 3:
        return slope, float("nan")
    off = y - y.mean() - slope * (x - x.mean())
    return slope, float(np.sqrt((off**2).sum() / (len(x) - 2) / spread))
