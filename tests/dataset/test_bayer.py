"""A colour spike sensor: mosaic, split and demosaic, with holes and at odd sizes."""

from typing import Any

import numpy as np
import pytest

from spikerig.dataset.bayer import PATTERNS, Bayer, bayer_info, bayer_of, demosaic, mosaic, split
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.texture import Texture


def texture(light: np.ndarray, known: np.ndarray | None = None) -> Texture:
    known = np.ones(light.shape, bool) if known is None else known
    return Texture(np.where(known, light, 0).astype(np.float32), known, 5.0, "tfp")


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("size", [(1, 1), (2, 2), (5, 7), (4, 6)])
def test_each_pixel_sees_its_own_colour(pattern: str, size: tuple[int, int]) -> None:
    pictures = np.random.default_rng(0).random((3, *size, 3)).astype(np.float32)
    seen = mosaic(pictures, Bayer(pattern, (2.0, 1.0, 0.5)))
    for y in range(size[0]):
        for x in range(size[1]):
            c = "rgb".index(pattern[2 * (y % 2) + x % 2])
            assert Bayer(pattern).channels(*size)[y, x] == c
            assert np.array_equal(seen[:, y, x], pictures[:, y, x, c] * np.float32([2, 1, 0.5][c]))


def test_split_and_mosaic_are_inverse() -> None:
    bayer = Bayer("gbrg", (2.0, 1.0, 4.0))
    raw = np.random.default_rng(1).random((7, 5)).astype(np.float32)
    known = np.random.default_rng(2).random((7, 5)) < 0.7
    apart = split(texture(raw, known), bayer)
    assert np.array_equal(apart.known.sum(2), known)
    assert np.array_equal(mosaic(apart.light, bayer), np.where(known, raw, 0))
    assert (apart.at, apart.method) == (5.0, "tfp")


@pytest.mark.parametrize("pattern", PATTERNS)
def test_light_that_is_linear_across_the_picture_comes_back(pattern: str) -> None:
    """Bilinear is exact for a plane of light, but at the border; own colours are exact everywhere."""
    y, x = np.mgrid[:9, :11].astype(np.float32)
    light = np.stack([0.2 + 0.01 * x, 0.5 - 0.02 * y, 0.1 + 0.005 * (x + y)], 2)
    bayer = Bayer(pattern, (1.5, 1.0, 0.7))
    found = demosaic(texture(mosaic(light, bayer)), bayer)
    assert found.known.all()
    assert np.abs(found.light - light)[1:-1, 1:-1].max() < 1e-6
    own = bayer.channels(9, 11)[:, :, None] == np.arange(3)
    assert np.abs(found.light - light)[own].max() < 1e-6
    assert np.abs(found.light - light).max() < 0.021, "one pixel off at the border"
    assert found.method == "tfp, bilinear"


def test_a_hole_is_filled_from_the_neighbours_that_are_known() -> None:
    raw = np.arange(25, dtype=np.float32).reshape(5, 5)
    known = np.ones((5, 5), bool)
    known[2, 2] = False  # red in rggb
    found = demosaic(texture(raw, known), Bayer("rggb"))
    assert not found.known[2, 2, 0], "no red within one pixel"
    assert found.known[2, 2, 1]
    assert found.light[2, 2, 1] == (raw[1, 2] + raw[3, 2] + raw[2, 1] + raw[2, 3]) / 4
    assert found.light[2, 2, 0] == 0
    assert found.light[2, 1, 0] == raw[2, 0], "the one red neighbour that is left"
    assert found.light[1, 1, 0] == (raw[0, 0] + raw[0, 2] + raw[2, 0]) / 3
    nothing = demosaic(texture(raw, np.zeros((5, 5), bool)), Bayer("rggb"))
    assert not nothing.known.any()
    assert not nothing.light.any()


def test_one_pixel_knows_one_colour() -> None:
    found = demosaic(texture(np.full((1, 1), 0.5)), Bayer("bggr", (1.0, 1.0, 2.0)))
    assert found.known.tolist() == [[[False, False, True]]]
    assert found.light.tolist() == [[[0.0, 0.0, 0.25]]]


def test_what_a_scene_says_of_its_colours() -> None:
    bayer = Bayer("grbg", (1.25, 1.0, 2.0))
    assert bayer_of(bayer_info(bayer)) == bayer
    assert bayer_of({"sensor": {"bayer": "rggb"}}) == Bayer("rggb")
    for info in ({}, {"sensor": {}}, {"sensor": "vidar"}, {"sensor": None}):
        assert bayer_of(info) is None


@pytest.mark.parametrize(
    "sensor",
    [
        {"bayer": "rgbg"}, {"bayer": 5}, {"bayer": None}, {"bayer": "rggb", "channel_gain": [1, 1]},
        {"bayer": "rggb", "channel_gain": [1, 1, 0]}, {"bayer": "rggb", "channel_gain": [1, 1, float("inf")]},
        {"bayer": "rggb", "channel_gain": ["1", 1, 1]}, {"bayer": "rggb", "channel_gain": 3},
    ],
)  # fmt: skip
def test_info_from_others_that_is_wrong_is_one_error(sensor: dict[str, Any]) -> None:
    with pytest.raises(DataError):
        bayer_of({"sensor": sensor})


def test_pictures_have_three_colours() -> None:
    with pytest.raises(UsageError):
        mosaic(np.zeros((4, 4)), Bayer("rggb"))
