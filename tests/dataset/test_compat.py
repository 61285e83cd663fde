"""Other codes' textures, transcribed here from their descriptions as plain loops, pixel by pixel."""

import numpy as np
import pytest

from spikerig.dataset import compat
from spikerig.dataset.errors import UsageError
from spikerig.dataset.spikes import SpikeStream

F = np.float32


def case(ticks, seed=0):
    """Pixels from dark to saturated; one that spikes at tick 0 only, one at the last tick only."""
    rng = np.random.default_rng(seed)
    pixels = (rng.random((ticks, 3, 9)) < rng.random((3, 9)) ** 2).astype(np.uint8)
    pixels[:, 0, :4] = 0
    pixels[:, 0, 1] = 1
    pixels[0, 0, 2] = pixels[-1, 0, 3] = 1
    return SpikeStream.from_pixels(pixels), pixels


def each_pixel(pixels, rule):
    """rule(list of 0/1) at every pixel."""
    return np.array([[rule(pixels[:, y, x].tolist()) for x in range(pixels.shape[2])] for y in range(pixels.shape[1])])


def mean255(values):
    """The mean in float32, times 255, cut off to a byte."""
    return int(F(sum(values)) / F(len(values)) * F(255))


@pytest.mark.parametrize("half", [0, 1, 2, 7, 20])
def test_spikecv_tfp_images(half):
    s, pixels = case(45)
    made = compat.spikecv_tfp(s, half)
    assert made.shape == (45 - 2 * half, 3, 9)
    assert made.dtype == np.uint8
    for i, key in enumerate(range(half, 45 - half)):
        assert np.array_equal(made[i], each_pixel(pixels, lambda p, k=key: mean255(p[k - half : k + half + 1])))


def test_spikecv_tfp_frame_averages_one_tick_less_at_the_very_end():
    s, pixels = case(30)
    for key, half in ((10, 3), (27, 3), (4, 4), (25, 5)):
        made = compat.spikecv_tfp_frame(s, key, half)
        assert np.array_equal(made, each_pixel(pixels, lambda p, k=key, h=half: mean255(p[k - h : k + h + 1])))


def images_interval(train, t):
    """SpikeCV spikes2images: (a, b] around t without limit; 257 where a side is missing."""
    before, after = [i for i in range(t) if train[i]], [i for i in range(t, len(train)) if train[i]]
    return F(after[0] - before[-1]) if before and after else F(257)


@pytest.mark.parametrize("m", [1, 5, 20])
def test_spikecv_tfi_images(m):
    s, pixels = case(60)
    made = compat.spikecv_tfi(s, m)
    assert made.shape == (60 - 2 * m, 3, 9)
    for i, t in enumerate(range(m, 60 - m)):
        assert np.array_equal(made[i], each_pixel(pixels, lambda p, t=t: int(F(255) / images_interval(p, t))))


def frame_interval(train, key, m):
    """SpikeCV spikes2frame and Spike-Zoo: [a, b) around key within m ticks, tick 0 unseen; 2m where one is missing."""
    former = latter = 0
    for i in range(key, max(key - m + 1, 1) - 1, -1):
        former += i * train[i] * (former == 0)
    for i in range(key + 1, min(key + m, len(train)) + 1):
        latter += i * train[i] * (latter == 0)
    return F(2 * m) if former == 0 or latter == 0 else F(latter - former)


@pytest.mark.parametrize(("key", "m"), [(0, 1), (1, 2), (5, 10), (20, 20), (30, 20), (39, 20), (58, 1)])
def test_spikecv_tfi_frame(key, m):
    s, pixels = case(60)
    made = compat.spikecv_tfi_frame(s, key, m)
    assert np.array_equal(made, each_pixel(pixels, lambda p: int(F(255) / frame_interval(p, key, m))))


@pytest.mark.parametrize(("ticks", "window"), [(41, 41), (60, 41), (60, 40), (9, 1), (40, 41)])
def test_spikezoo_tfp(ticks, window):
    s, pixels = case(ticks)
    middle, side = ticks // 2, window // 2
    made = compat.spikezoo_tfp(s, window)
    part = pixels[middle - side : middle + side + 1]
    assert np.array_equal(made, each_pixel(part, lambda p: F(sum(p)) / F(len(p))))


@pytest.mark.parametrize(("ticks", "window"), [(41, 41), (101, 41), (60, 11)])
def test_spikezoo_tfi(ticks, window):
    s, pixels = case(ticks)
    made = compat.spikezoo_tfi(s, window)
    assert made.dtype == np.float32
    assert np.array_equal(
        made, each_pixel(pixels, lambda p: F(1) / frame_interval(p, ticks // 2, window // 2)).astype(F)
    )


def test_where_the_others_crash_we_say_why():
    s, _ = case(40)
    for call in (
        lambda: compat.spikezoo_tfi(s, 41),  # T = 40: their IndexError
        lambda: compat.spikezoo_tfp(s, 43),
        lambda: compat.spikecv_tfi_frame(s, 20, 20),
        lambda: compat.spikecv_tfi_frame(s, 5, 12),
        lambda: compat.spikecv_tfp(s, 21),
        lambda: compat.spikecv_tfp_frame(s, 38, 3),
        lambda: compat.spikecv_tfi(s, 0),
    ):
        with pytest.raises(UsageError):
            call()
