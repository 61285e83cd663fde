"""By how many ticks are blurry pictures and spikes out of step? Answered from the pictures themselves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.check import Undecided

Floats = NDArray[np.float64]
LAGS = 13
SOFT = 1.5  # px
MIN_VIEWS = 3
DEPTH = 0.02  # by which the misfit must rise towards both ends, relative to the least


@dataclass(frozen=True, slots=True)
class Lagged:
    """How well a view's spikes, shifted by each of some lags, fit its picture.

    Args:
        lags: int64[L], ticks.
        misfit: float64[L], squared residual after the picture's colours and an offset are fitted.
        cross: float64[L,2], residual times slopes of the fitted picture across and down.
        slopes: float64[L,2,2], the slopes' own products.
        power: squared deviation of the unshifted texture from its mean.
        window: ticks of the exposure.
    """

    lags: NDArray[np.int64]
    misfit: Floats
    cross: Floats
    slopes: Floats
    power: float
    window: float


@dataclass(frozen=True, slots=True)
class Lag:
    """The best lag of all views in ticks (positive: the light was seen later than the picture says), its standard
    deviation, whether it lies at the end of those tried, and the exposure in ticks."""

    ticks: float
    sd: float
    at_end: bool
    window: float


def lagged(
    lags: NDArray[np.int64], textures: Sequence[NDArray[np.float32]], light: NDArray[np.float32],
    good: NDArray[np.bool_], window: float,
) -> Lagged:  # fmt: skip
    """Fit each shifted texture by the picture's three colours and an offset, and keep what a small shift would explain.

    Args:
        lags: ticks.
        textures: [H,W] light of the spikes over the exposure, later by each lag.
        light: [H,W,3] linear RGB.
        good: bool[H,W], where all of them may be compared.
        window: ticks of the exposure.

    Cost:
        A projection on four columns a lag.
    """
    colours = [_soft(light[..., c], good) for c in range(3)]
    some = np.zeros_like(good)
    some[::2, ::2] = good[::2, ::2]  # of smooth pictures every other pixel says all
    columns = np.stack([*(c[some] for c in colours), np.ones(int(some.sum()))], 1)
    down, across = (np.stack([np.gradient(c, axis=a)[some] for c in colours], 1) for a in (0, 1))
    q, r = np.linalg.qr(columns)
    usable = np.abs(np.diag(r)) > 1e-6 * np.abs(np.diag(r)).max()
    q = q if usable.all() else np.linalg.svd(columns, full_matrices=False)[0][:, : int(usable.sum())]
    misfit, cross, slopes = np.zeros(len(lags)), np.zeros((len(lags), 2)), np.zeros((len(lags), 2, 2))
    for k, texture in enumerate(textures):
        seen = _soft(texture, good)[some]
        weights = np.linalg.lstsq(columns, seen, rcond=None)[0][:3]
        left = seen - q @ (q.T @ seen)
        slope = np.stack([across @ weights, down @ weights], 1)
        slope -= q @ (q.T @ slope)
        misfit[k], cross[k], slopes[k] = left @ left, slope.T @ left, slope.T @ slope
    middle = _soft(textures[len(textures) // 2], good)[some]
    power = float(((middle - middle.mean()) ** 2).sum())
    return Lagged(np.asarray(lags, np.int64), misfit, cross, slopes, power, window)


def _soft(light: NDArray[np.float32], good: NDArray[np.bool_]) -> Floats:
    """A picture smoothed over SOFT px within `good`: less noise, and slopes that hold over some pixels of shift."""
    import cv2

    weight = cv2.GaussianBlur(good.astype(np.float64), (0, 0), SOFT)
    return cv2.GaussianBlur(np.where(good, light, 0).astype(np.float64), (0, 0), SOFT) / np.maximum(weight, 1e-6)


def lag_of(views: Sequence[Lagged]) -> Lag:
    """The lag at which all views together fit best, whatever small shift all of them share.

    A misaligned picture looks like a lagging one where the camera moves one way only. So one shift for all views is
    fitted beside the lag; views that move in different ways tell the two apart.

    Args:
        views: at least MIN_VIEWS; those tried over other lags than most are left out.

    Raises:
        Undecided: too few views, or the misfit hardly depends on the lag.
    """
    usual = max({tuple(v.lags) for v in views}, key=lambda lags: sum(tuple(v.lags) == lags for v in views), default=())
    same = [v for v in views if tuple(v.lags) == usual]
    if len(same) < MIN_VIEWS:
        raise Undecided(f"it takes {MIN_VIEWS} views with spikes around a blurry picture")
    lags, total = same[0].lags.astype(np.float64), _misfit(same)
    best = _lowest(lags, total)
    ends = max(total[0], total[-1]) if best in (lags[0], lags[-1]) else min(total[0], total[-1])
    if ends < (1 + DEPTH) * total.min():
        raise Undecided(f"the pictures hardly change within {lags[-1]:.0f} ticks")
    left_out = np.array([_lowest(lags, _misfit(same[:k] + same[k + 1 :])) for k in range(len(same))])
    n = len(same)
    sd = float(np.sqrt((n - 1) / n * ((left_out - left_out.mean()) ** 2).sum()))
    return Lag(best, sd, best in (lags[0], lags[-1]), float(np.median([v.window for v in same])))


def _misfit(views: Sequence[Lagged]) -> Floats:
    """float64[L] of all views, each as a share of its power, a shared shift taken out."""
    weights = [1 / max(v.power, 1e-300) for v in views]
    misfit, cross, slopes = (
        np.sum([w * getattr(v, key) for w, v in zip(weights, views, strict=True)], axis=0)
        for key in ("misfit", "cross", "slopes")
    )
    taken = [c @ np.linalg.lstsq(s, c, rcond=None)[0] for c, s in zip(cross, slopes, strict=True)]
    return misfit - np.array(taken)


def _lowest(at: Floats, values: Floats) -> float:
    """Where values are lowest, by the parabola through the lowest and its neighbours."""
    k = int(values.argmin())
    if k in (0, len(at) - 1):
        return float(at[k])
    a, b, _ = np.polyfit(at[k - 1 : k + 2] - at[k], values[k - 1 : k + 2], 2)
    return float(at[k] - b / (2 * a)) if a > 0 else float(at[k])
