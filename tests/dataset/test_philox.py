"""Random numbers of a key, a tick and a pixel: the published hash, and the distributions against SciPy's."""

import numpy as np
import pytest
from scipy import stats
from scipy.special import ndtr, ndtri

from spikerig.dataset import philox

F = np.float32
EVENLY = np.arange(0, 2**32, 1021, dtype=np.uint64).astype(np.uint32)  # 4.2 million words, stratified


@pytest.mark.parametrize(
    ("counter", "key", "expected"),
    [
        ((0, 0, 0, 0), (0, 0), "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
        ((2**32 - 1,) * 4, (2**32 - 1,) * 2, "408f276d 41c83b0e a20bc7c6 6d5451fd"),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xA4093822, 0x299F31D0),
            "d16cfe09 94fdcceb 5001e420 24126ea1",
        ),
    ],
)
def test_published_answers(counter, key, expected):
    """The known answers that come with Random123."""
    assert " ".join(f"{int(w):08x}" for w in philox.philox(counter, key)) == expected


def test_words_of_ticks_and_pixels_are_those_of_their_counters():
    pixels = np.array([0, 7, 2**32 - 1], np.uint32)
    for tick, quad, at in ((0, 0, 0), (7, 1, 3), (-1, -1, 3), (-5, -2, 3), (2**40 + 2, 2**38, 2)):
        got = philox.words((3, 4), tick, pixels)
        counter = (quad & 0xFFFFFFFF, quad >> 32 & 0xFFFFFFFF)
        for pixel, word in zip(pixels.tolist(), got.tolist(), strict=True):
            assert word == int(philox.philox((*counter, pixel, 0), (3, 4))[at])


def test_words_look_uniform_and_unrelated():
    pixels = np.arange(4000, dtype=np.uint32)
    drawn = np.array([philox.words((11, 12), t, pixels) for t in range(64)]) / 2.0**32
    assert stats.kstest(drawn.ravel(), "uniform").pvalue > 1e-3
    for a, b in ((drawn[1:], drawn[:-1]), (drawn[4:], drawn[:-4]), (drawn[:, 1:], drawn[:, :-1])):
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 4 / np.sqrt(a.size)


def test_normal_is_the_quantile():
    ends = np.arange(100_000, dtype=np.uint32)
    word = np.concatenate([EVENLY, ends, ~ends, ends + np.uint32(2**31 - 50_000)])
    u = np.where(word < 2**31, word, ~word).astype(np.float64)
    expected = ndtri((u + 0.5) / 2**32) * np.where(word < 2**31, 1, -1)
    assert np.abs(philox.normal(word) - expected).max() < 2e-6


def test_exp_minus():
    x = np.linspace(0, 700, 100_001)
    assert np.abs(philox.exp_minus(x) / np.exp(-x) - 1).max() < 1e-15


def steps_of(mean):
    """P(count = k) of `poisson` at one mean: the word at which each count starts, found by bisection."""

    def count(words):
        return philox.poisson(np.full(len(words), mean, F), np.array(words, np.uint64).astype(np.uint32))

    low, high = (int(c) for c in count([0, 2**32 - 1]))
    k = np.arange(low, high + 1)
    below, at = np.full(len(k), -1, np.int64), np.full(len(k), 2**32 - 1, np.int64)
    while np.any(at - below > 1):
        middle = (below + at) // 2
        reached = count(middle.tolist()) >= k
        at, below = np.where(reached, middle, at), np.where(reached, below, middle)
    starts = at / 2.0**32
    starts[0] = 0
    return k, np.diff(np.append(starts, 1.0))


@pytest.mark.parametrize("mean", [0.01, 0.1, 1.0, 4.0, 7.999, 8.0, 10.0, 30.0, 100.0, 1e3, 1e4])
def test_poisson_has_the_moments_of_its_distribution(mean):
    k, p = steps_of(mean)
    mean = float(F(mean))
    got = (k * p).sum()
    variance = ((k - got) ** 2 * p).sum()
    skew = ((k - got) ** 3 * p).sum() / variance**1.5
    assert got == pytest.approx(mean, rel=2.5e-6)
    assert variance == pytest.approx(mean, rel=4e-4)
    assert skew == pytest.approx(mean**-0.5, rel=1e-3)
    assert 0.5 * np.abs(p - stats.poisson.pmf(k, mean)).sum() < (2.5e-4 if mean >= 8 else 1e-6)


def test_poisson_of_hardly_any_light_and_of_very_much():
    assert not philox.poisson(np.zeros(len(EVENLY), F), EVENLY).any()
    for mean in (1e-3, 1e-5):
        share = (philox.poisson(np.full(len(EVENLY), mean, F), EVENLY) > 0).mean()
        assert share == pytest.approx(-np.expm1(-mean), rel=0.05)
    many = philox.poisson(np.full(len(EVENLY), 1e12, F), EVENLY).astype(np.float64)
    assert many.mean() == pytest.approx(float(F(1e12)), rel=1e-9)
    assert many.std() == pytest.approx(1e6, rel=1e-2)


def test_poisson_against_its_definition_word_by_word():
    """Below eight, the count is the quantile, but for words within rounding of a step."""
    word = EVENLY[::97]
    u = (word + 0.5) / 2.0**32
    for mean in (1e-4, 0.5, 3.3, 7.9):
        got = philox.poisson(np.full(len(word), mean, F), word)
        expected = stats.poisson.ppf(u, float(F(mean)))
        assert (got != expected).mean() < 1e-6


def test_ndtr_of_normal_is_uniform():
    z = philox.normal(EVENLY)
    assert np.abs(ndtr(z.astype(np.float64)) - (EVENLY + 0.5) / 2**32).max() < 2e-7
