"""Boards in pictures: to a hundredth of a pixel, with centres at +0.5, whatever OpenCV returns."""

import dataclasses

import board_pictures as bp
import cv2
import numpy as np
import pytest
from calib_rigs import BOARD, rig

from spikerig.calib.boards import Board, board_of, find, gray8, ours, seen_size
from spikerig.calib.saddle import refine
from spikerig.dataset.errors import UsageError
from spikerig.dataset.images import linear_from_srgb, srgb8_from_linear
from spikerig.dataset.texture import tfp

POSE = bp.poses(2, 3)[1]
ALL = np.ones(54, bool)


def off_px(px: np.ndarray, true: np.ndarray) -> float:
    """RMS distance, either way round."""
    return min(float(np.sqrt(((px - t) ** 2).sum(1).mean())) for t in (true, true[::-1]))


@pytest.fixture(scope="module")
def lens() -> bp.Lens:
    return bp.lens("spike", 4)


@pytest.fixture(scope="module")
def light(lens: bp.Lens) -> np.ndarray:
    return lens.picture(POSE)


def test_corners_of_clean_light_are_exact(lens: bp.Lens, light: np.ndarray) -> None:
    found = find(light, BOARD)
    assert found is not None
    assert found.seen.all()
    assert found.mirrored is None
    assert off_px(found.px, lens.corners(POSE)) < 0.015


def test_corners_of_an_encoded_picture_are_those_of_its_light(lens: bp.Lens, light: np.ndarray) -> None:
    found = find(linear_from_srgb(srgb8_from_linear(light)), BOARD)
    assert found is not None
    assert off_px(found.px, lens.corners(POSE)) < 0.015


def test_corners_of_noisy_spikes_are_good_to_a_thirtieth(lens: bp.Lens, light: np.ndarray) -> None:
    stream = bp.spikes(0.4 * light, 256, 1)
    found = find(tfp(stream, 128, 256).light, BOARD)
    assert found is not None
    assert off_px(found.px, lens.corners(POSE)) < 0.03


def test_a_picture_of_twice_the_size_has_corners_at_twice_the_place(light: np.ndarray) -> None:
    """Were centres at 0 anywhere, half a pixel would come out as a quarter of one."""
    camera = rig().spike
    twice = dataclasses.replace(camera, K=camera.K * [[2, 1, 2], [1, 2, 2], [1, 1, 1]], width=800, height=500)
    large = bp.Lens(twice, 2)
    picture = large.picture(POSE)
    shrunk = cv2.resize(picture, (400, 250), interpolation=cv2.INTER_AREA)
    a, b, c = (find(p, BOARD) for p in (picture, shrunk, light))
    assert a is not None
    assert b is not None
    assert c is not None
    assert off_px(a.px / 2, b.px) < 0.02
    assert off_px(b.px, c.px) < 0.02


def test_refinement_survives_a_start_that_is_off_and_leaves_what_it_cannot_fit(
    lens: bp.Lens, light: np.ndarray
) -> None:
    true = lens.corners(POSE)
    start = true + np.random.default_rng(0).uniform(-0.7, 0.7, true.shape)
    assert off_px(refine(light, start, ALL, 9, 6), true) < 0.015
    noise = np.random.default_rng(1).random(light.shape)
    told = refine(noise, start, ALL, 9, 6)
    assert np.abs(told - start).max() <= 1.5
    assert np.isfinite(told).all()
    np.testing.assert_array_equal(refine(np.zeros((250, 400)), start, ALL, 9, 6), start)
    hidden = np.where(np.arange(54)[:, None] == 7, np.nan, start)
    told = refine(light, hidden, np.isfinite(hidden[:, 0]), 9, 6)
    assert np.isnan(told[7]).all()
    assert off_px(np.delete(told, 7, 0), np.delete(true, 7, 0)) < 0.02


def test_the_shapes_of_both_opencvs_are_one() -> None:
    flat = np.arange(6, dtype=np.float32).reshape(3, 2)
    np.testing.assert_array_equal(ours(flat), ours(flat[:, None]))
    assert ours(flat).dtype == np.float64
    np.testing.assert_array_equal(ours(flat)[0], [0.5, 1.5])


def test_another_board_is_not_found_but_named(light: np.ndarray) -> None:
    assert find(light, Board(10, 7, 16.0)) is None
    assert seen_size(light) in ((9, 6), (6, 9))
    blank = np.full((250, 400), 0.5, np.float32)
    assert find(blank, BOARD) is None
    assert seen_size(blank) is None
    assert gray8(blank).max() == 0


@pytest.mark.parametrize("old", [False, True])
def test_charuco_boards_of_both_patterns_are_found(old: bool) -> None:
    board = board_of("6x5", 24, "DICT_4X4_50")
    made = cv2.aruco.CharucoBoard((7, 6), 24, 18, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    made.setLegacyPattern(old)
    flat = np.full((420, 480), 255, np.uint8)
    flat[30:390, 30:450] = made.generateImage((420, 360))
    found = find(linear_from_srgb(flat), board)
    assert found is not None
    assert found.seen.all()
    true = np.stack(np.meshgrid(np.arange(1, 7), np.arange(1, 6)), -1).reshape(-1, 2) * 60.0 + 30
    assert off_px(found.px, true) < 0.05


@pytest.mark.parametrize("mirrored", [False, True])
def test_charuco_boards_say_whether_they_are_seen_in_a_mirror(mirrored: bool) -> None:
    board = board_of("9x6", 24, "DICT_5X5_100", 18)
    made = cv2.aruco.CharucoBoard((10, 7), 24, 18, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100))
    flat = np.full((480, 660), 255, np.uint8)
    flat[30:450, 30:630] = made.generateImage((600, 420))
    flat[200:260, 300:330] = 255  # some of it hidden
    seen = np.ascontiguousarray(flat[:, ::-1]) if mirrored else flat
    found = find(linear_from_srgb(seen), board)
    assert found is not None
    assert found.mirrored is mirrored
    assert 40 < found.seen.sum() < 54
    true = np.stack(np.meshgrid(np.arange(1, 10), np.arange(1, 7)), -1).reshape(-1, 2) * 60.0 + 30
    true[:, 0] = 660 - true[:, 0] if mirrored else true[:, 0]
    where = true if np.nanmean(abs(found.px - true)) < 5 else true[::-1]  # the library's corner 0 is top or bottom
    off = np.linalg.norm(found.px - where, axis=1)[found.seen]
    assert np.median(off) < 0.05


@pytest.mark.parametrize(
    ("pattern", "square", "charuco", "marker"),
    [("9", 24, "", 0), ("9x", 24, "", 0), ("2x9", 24, "", 0), ("99x6", 24, "", 0), ("9x6", 0, "", 0),
     ("9x6", float("nan"), "", 0), ("9x6", 24, "DICT_NONE", 0), ("9x6", 24, "__class__", 0),
     ("9x6", 24, "DICT_5X5_100", 30), ("9x6", 24, "", 10)],
)  # fmt: skip
def test_boards_that_are_none(pattern: str, square: float, charuco: str, marker: float) -> None:
    with pytest.raises(UsageError):
        board_of(pattern, square, charuco, marker)


def test_labels_turn_with_the_board() -> None:
    board = Board(4, 3, 1.0)
    corners = np.arange(12)
    assert board.turns == (0, 2)
    np.testing.assert_array_equal(board.relabelled(corners, 2), corners[::-1])
    np.testing.assert_array_equal(board.relabelled(corners, 0, mirrored=True)[:4], [3, 2, 1, 0])
    assert board_of("4x3", 1, "DICT_4X4_50").turns == (0,)
    assert "4x3" in str(board)
