"""The fixed pattern of a sensor from a scene's own views: found where it is, none invented, the scene left alone."""

import numpy as np
import pytest

from spikerig.calib.pattern import fixed_pattern
from spikerig.dataset.spikes import SpikeStream

SIZE, TICKS = (40, 56), 320


def stream(light: np.ndarray, rng: np.random.Generator) -> SpikeStream:
    """Spikes of a steady light, the phase of each pixel its own."""
    phase = rng.uniform(size=light.shape)
    steps = np.floor(phase + light * np.arange(TICKS + 1)[:, None, None])
    return SpikeStream(np.packbits(np.diff(steps, axis=0) > 0, axis=2, bitorder="little"), light.shape[1], 4e4)


def views(gain: np.ndarray, count: int, seed: int = 0) -> list[SpikeStream]:
    """Smooth waves and sharp edges that lie elsewhere in every view, seen through a gain."""
    rng, found = np.random.default_rng(seed), []
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    for _ in range(count):
        a, b, c = rng.uniform(0, 2 * np.pi, 3)
        waves = 0.2 + 0.08 * np.sin(x / 5 + a) * np.cos(y / 6 + b)
        edges = 1 + 0.4 * (np.sin(x * np.cos(c) / 2 + y * np.sin(c) / 2 + a) > 0)
        found.append(stream(waves * edges * gain, rng))
    return found


def test_a_pattern_is_found() -> None:
    gain = np.exp(0.04 * np.random.default_rng(9).normal(size=SIZE))
    found = fixed_pattern(views(gain, 24))
    assert found is not None
    left = np.log(gain / found)
    assert np.std(np.log(found)) == pytest.approx(0.036, abs=0.008)
    assert np.std(left) < 0.6 * 0.04


def test_none_is_invented() -> None:
    found = fixed_pattern(views(np.ones(SIZE), 24))
    assert found is not None
    assert np.std(np.log(found)) < 0.002


def test_a_wild_pixel_is_bounded_and_the_dark_is_finite() -> None:
    gain = np.ones(SIZE)
    gain[10, 10], gain[20, 20] = 0.0, 1.9
    found = fixed_pattern(views(gain * np.exp(0.04 * np.random.default_rng(9).normal(size=SIZE)), 12))
    assert found is not None
    assert np.isfinite(found).all()
    assert np.exp(-0.25) <= found.min() < 0.85
    assert 1.15 < found.max() <= np.exp(0.25)


def test_few_views_tell_nothing() -> None:
    assert fixed_pattern(views(np.ones(SIZE), 7)) is None
    assert fixed_pattern([]) is None
    some = views(np.ones(SIZE), 8)
    assert fixed_pattern(some) is not None
    odd = SpikeStream(some[0].bits[:100], SIZE[1], 4e4)
    assert fixed_pattern([*some[1:], odd]) is None
