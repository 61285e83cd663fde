"""Tests of significance without SciPy: the F distribution, and Hotelling's test of a mean."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def f_above(value: float, d1: float, d2: float) -> float:
    """The chance that an F(d1, d2) variable exceeds `value`; 1 for values of 0 and below, 0 for infinity.

    Source: Abramowitz and Stegun 26.6.2, by the incomplete beta function.
    """
    if not value > 0:
        return 1.0
    if math.isinf(value):
        return 0.0
    return beta_below(d2 / (d2 + d1 * value), d2 / 2, d1 / 2)


def beta_below(x: float, a: float, b: float) -> float:
    """The regularised incomplete beta function I_x(a, b), 0 <= x <= 1: a continued fraction, to 1e-12."""
    if x <= 0 or x >= 1:
        return float(x >= 1)
    if x > (a + 1) / (a + b + 2):
        return 1 - beta_below(1 - x, b, a)
    front = math.exp(
        math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) + b * math.log1p(-x)
    ) / a  # fmt: skip
    tiny, c, d = 1e-300, 1.0, 1 - (a + b) * x / (a + 1)
    d = 1 / (d or tiny)
    total = d
    for m in range(1, 500):
        for numerator in (
            m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m)),
            -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1)),
        ):
            d = 1 / ((1 + numerator * d) or tiny)
            c = (1 + numerator / c) or tiny
            total *= c * d
        if abs(c * d - 1) < 1e-14:
            break
    return min(max(front * total, 0.0), 1.0)


def jackknife_cov(left_out: Floats) -> Floats:
    """Covariance float64[P,P] of estimates from what they become as each view is left out, float64[V,P], V >= 2."""
    n = len(left_out)
    off = left_out - left_out.mean(0)
    return off.T @ off * ((n - 1) / n)


def hotelling(mean: Floats, cov: Floats, samples: int) -> float:
    """The chance of a mean as far from 0 as this one, its covariance estimated from `samples` independent groups.

    Args:
        mean: float64[p].
        cov: float64[p,p] of the mean.
        samples: groups, more than p.

    Source: Hotelling 1931: T2 (n - p) / (p (n - 1)) is F(p, n - p).
    """
    p = len(mean)
    if samples <= p:
        return 1.0
    t2 = float(mean @ np.linalg.lstsq(cov, mean, rcond=1e-12)[0])
    return f_above(t2 * (samples - p) / (p * (samples - 1)), p, samples - p)
