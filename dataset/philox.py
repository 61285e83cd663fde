"""Random numbers that depend on a key, a tick and a pixel and on nothing else: what the native kernels draw, in NumPy.

Philox4x32-10 is a hash of a 128-bit counter under a 64-bit key: no state, so that any tick of any pixel can be drawn
first, by any thread, in blocks of any length. Words become normal and Poisson numbers through polynomials in float32
(and float64) that are evaluated in one fixed order without fused multiply-adds, so that every instruction set and
NumPy agree in every bit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Key = tuple[int, int]
Words = NDArray[np.uint32]
Floats = NDArray[np.floating]  # float32 unless said
F = np.float32

MULTIPLIERS = (np.uint64(0xD2511F53), np.uint64(0xCD9E8D57))
WEYL = (np.uint64(0x9E3779B9), np.uint64(0xBB67AE85))
LOW = np.uint64(0xFFFFFFFF)
FEW = F(8)  # electrons below which a Poisson count is found by inversion
RARE = F(2.0**-12)  # chance below which that is done in float64

# Of least maximal error (Lawson's iteration), rising powers: log2(1+t)/t for |t| <= 1/3; the normal quantile over
# 2u - 1, in L = -log2 4u(1-u) below 8, and in sqrt(L) - 4 for L from 8 to 31; (2^t - 1)/t for |t| <= 1/2.
LOG2 = (1.4426935911178589, -0.7214025855064392, 0.48106637597084045, -0.35773220658302307,
        0.283658891916275, -0.2842307388782501, 0.2570645809173584)  # fmt: skip
CENTRE = (1.2533117532730103, 0.2274535596370697, 0.00779822887852788, -0.0010466594249010086,
          -7.223698048619553e-05, 2.0450281226658262e-05, -1.48395349697239e-06, 3.8950791036995724e-08)  # fmt: skip
TAIL = (4.4753618240356445, 1.184531331062317, 0.004461626056581736, -0.002450686413794756,
        0.0012992979027330875, -0.0007985380943864584, 0.0003666246775537729, -7.405880751321092e-05)  # fmt: skip
EXP2 = (0.6931471824645996, 0.24022650718688965, 0.055503278970718384, 0.009618005715310574,
        0.0013400283642113209, 0.00015475897816941142)  # fmt: skip


def philox(counter: tuple[Words, Words, Words, Words], key: Key) -> tuple[Words, Words, Words, Words]:
    """Four random words of a counter of four words under a key of two: Philox4x32 with ten rounds.

    Source:
        Salmon, Moraes, Dror, Shaw: Parallel random numbers, as easy as 1, 2, 3 (SC 2011).
    """
    c0, c1, c2, c3 = (np.asarray(c, np.uint64) for c in counter)
    k0, k1 = np.uint64(key[0]), np.uint64(key[1])
    for _ in range(10):
        p0, p1 = MULTIPLIERS[0] * c0, MULTIPLIERS[1] * c2
        c0, c1, c2, c3 = (p1 >> np.uint64(32)) ^ c1 ^ k0, p1 & LOW, (p0 >> np.uint64(32)) ^ c3 ^ k1, p0 & LOW
        k0, k1 = (k0 + WEYL[0]) & LOW, (k1 + WEYL[1]) & LOW
    return tuple(c.astype(np.uint32) for c in (c0, c1, c2, c3))  # type: ignore[return-value]


def words(key: Key, tick: int, pixels: Words) -> Words:
    """The random word of each pixel at a tick.

    Args:
        key: two words, 0 .. 2^32 - 1.
        tick: any int64.
        pixels: uint32[...], number y * width + x of each pixel.

    Returns:
        uint32[...]: word tick % 4 of the counter (tick // 4 low, tick // 4 high, pixel, 0).
    """
    quad = tick // 4
    low, high = np.uint32(quad & 0xFFFFFFFF), np.uint32(quad >> 32 & 0xFFFFFFFF)
    return philox((low, high, np.asarray(pixels, np.uint32), np.uint32(0)), key)[tick % 4]  # type: ignore[arg-type]


def normal(word: Words) -> Floats:
    """The standard normal quantile of u = (word + 1/2) / 2^32, float32, within 2e-6; |z| < 6.34."""
    near = np.where(word >> np.uint32(31), ~word, word).astype(np.int32)  # how far from the nearer end
    p = (near.astype(F) + F(0.5)) * F(2.0**-32)
    y = p * F(4) * (F(1) - p)
    bits = y.view(np.int32)
    exponent = (bits - np.int32(0x3F2AAAAB)) >> 23  # so that the rest is in [2/3, 4/3)
    t = (bits - (exponent << 23)).view(F) - F(1)
    log = -(exponent.astype(F) + t * _polynomial(LOG2, t))
    ratio = np.where(log < F(8), _polynomial(CENTRE, log), _polynomial(TAIL, np.sqrt(np.maximum(log, F(0))) - F(4)))
    return ((word ^ np.uint32(0x80000000)).view(np.int32).astype(F) + F(0.5)) * F(2.0**-31) * ratio


def poisson(mean: Floats, word: Words) -> Floats:
    """A Poisson count of each mean, rising with the word.

    Args:
        mean: float32[...], >= 0.
        word: uint32[...].

    Returns:
        float32[...]: whole numbers (above 2^24 as far as float32 holds them).

    Edges:
        Below a mean of 8 the distribution function is inverted: within 1e-6 of the distribution (total variation), in
        float64 where the chance is below 2^-12, so that rare counts are right to 2^-32 of probability. From 8 on, the
        floor of the Cornish-Fisher expansion to the third order: within 2.5e-4 of the distribution, its mean within
        2.5e-6 and its variance within 4e-4.

    Source:
        M. Giles: Algorithm 955, approximation of the inverse Poisson cumulative distribution function (2016), eq. 2.
    """
    few = mean < FEW
    counts = _many(np.where(few, FEW, mean), word)
    if few.any():
        counts = np.where(few, _few(np.where(few, mean, F(0)), word), counts)
    return counts


def _many(mean: Floats, word: Words) -> Floats:
    z, s = normal(word), np.sqrt(mean)
    r = F(1) / s
    rr = r * r
    change = rr * F(1 / 270) * z + r * F(-1 / 72)
    change = change * z + (F(1 / 6) + rr * F(7 / 810))
    change = change * z + (s - r * F(1 / 36))
    change = change * z + (F(1 / 3) - rr * F(8 / 405))
    count = np.maximum(mean + change, F(0))
    return np.where(count < F(2.0**24), np.floor(count), count)


def _few(mean: Floats, word: Words) -> Floats:
    """The count k whose P(K >= k) is above the chance 1 - u, and P(K >= k + 1) is not."""
    chance = ((~word).astype(F) + F(0.5)) * F(2.0**-32)
    rare = chance < RARE
    scaled = mean * F(-1.4426950408889634)
    n = (scaled + F(12582912.0)) - F(12582912.0)  # 1.5 * 2^23: the nearest whole number
    t = scaled - n
    scale = ((n.astype(np.int32) + 127) << 23).view(F)
    change = scale * (t * _polynomial(EXP2, t))
    term = scale + change  # exp(-mean) = P(K = 0)
    above = (F(1) - scale) - change
    counts = _invert(np.where(rare, F(1), chance), mean, term, above)
    if rare.any():
        few64 = mean.astype(np.float64)
        chance64 = ((~word).astype(np.float64) + 0.5) * 2.0**-32
        term64 = exp_minus(few64)
        counts = np.where(rare, _invert(chance64, few64, term64, 1.0 - term64).astype(F), counts)
    return counts


def _invert(chance: Floats, mean: Floats, term: Floats, above: Floats) -> Floats:
    count = np.zeros_like(mean)
    for k in range(1, 64):
        more = chance < above
        if not more.any():
            break
        count += more
        term = term * (mean * mean.dtype.type(1.0 / k))
        above = above - term
    return count


def exp_minus(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """exp(-x) for 0 <= x <= 700, relative error a few 1e-16."""
    magic = 6755399441055744.0  # 1.5 * 2^52: adding it rounds to an integer kept in the low bits
    shifted = x * -1.4426950408889634 + magic
    n = shifted - magic
    r = (-x - n * 6.93147180369123816490e-01) - n * 1.90821492927058770002e-10
    p = np.full_like(x, 1.0 / 6227020800.0)
    for c in (479001600, 39916800, 3628800, 362880, 40320, 5040, 720, 120, 24, 6, 2, 1, 1):
        p = p * r + 1.0 / c
    return (p.view(np.int64) + (shifted.view(np.int64) << 52)).view(np.float64)


def _polynomial(rising: tuple[float, ...], x: Floats) -> Floats:
    p = np.full_like(x, F(rising[-1]))
    for c in rising[-2::-1]:
        p = p * x + F(c)
    return p
