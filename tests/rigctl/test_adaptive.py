"""The adaptive step: pictures as close as motion and brightness ask for, and no closer."""

from typing import Any

import numpy as np
import pytest
from hard_sim import small

from spikerig.dataset.errors import UsageError
from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.adaptive import adaptive_phases, image_motion_px, log_change
from spikerig.rigctl.sim.capture import camera_of, view_path
from spikerig.rigctl.sim.events import EventCamera, simulate_events


def test_steps_are_as_long_as_they_may_be() -> None:
    phases = adaptive_phases([0.0, 0.5, 0.6, 1.0], [1.0, 0.0, 0.26], step_px=0.25)
    assert np.allclose(phases, [0, 0.125, 0.25, 0.375, 0.5, 0.6, 0.8, 1.0])


def test_the_larger_of_motion_and_brightness_decides() -> None:
    phases = adaptive_phases([0.0, 1.0, 2.0], [1.0, 0.1], [0.05, 0.3], step_px=0.5, step_change=0.1)
    assert np.allclose(phases, [0, 0.5, 1, 4 / 3, 5 / 3, 2])


def test_exact_multiples_are_not_rounded_up() -> None:
    assert len(adaptive_phases([0.0, 1.0], [0.3], step_px=0.1)) == 4, "0.3 / 0.1 is 2.9999999999999996"


def test_nothing_moves() -> None:
    assert adaptive_phases([0.25], []).tolist() == [0.25]
    assert adaptive_phases([0.0, 1.0], [0.0]).tolist() == [0.0, 1.0]


@pytest.mark.parametrize(
    "wrong",
    [
        {"phases": [1.0, 0.0]}, {"phases": []}, {"motion_px": [1.0, 2.0]}, {"motion_px": [-1.0]},
        {"motion_px": [np.nan]},
        {"change": [np.inf]}, {"step_px": 0.0}, {"step_change": -1.0}, {"motion_px": [1e9]},
    ],
)  # fmt: skip
def test_numbers_that_do_not_fit(wrong: dict[str, Any]) -> None:
    good: dict[str, Any] = {"phases": [0.0, 1.0], "motion_px": [1.0]}
    adaptive_phases(**good)
    with pytest.raises(UsageError):
        adaptive_phases(**good | wrong)


def test_image_motion_of_a_camera_that_moves_aside_and_turns() -> None:
    camera = Camera.pinhole(100, 80, 90.0)  # 50 px focal length
    poses = np.tile(np.eye(3, 4), (3, 1, 1))
    poses[1:, 0, 3] = 0.1
    assert np.allclose(image_motion_px(camera, poses, 2.0), [2.5, 0.0])
    assert np.allclose(image_motion_px(camera, poses, [2.0, 0.5, 8.0]), [10.0, 0.0]), "the nearest decides"
    angle = 0.01
    c, s = np.cos(angle), np.sin(angle)
    poses[1] = poses[2] = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0]])
    assert np.allclose(image_motion_px(camera, poses, 3.0)[0], np.hypot(50, 40) * 2 * np.sin(angle / 2)), "the corner"
    poses[2] = np.array([[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0]])
    assert image_motion_px(camera, poses, 3.0)[1] == np.hypot(100, 80), "all of it is behind"
    for depth in (0.0, -1.0, np.inf, [], np.nan):
        with pytest.raises(UsageError):
            image_motion_px(camera, poses, depth)


def test_log_change() -> None:
    light = np.array([[[0.0, 1.0]], [[0.0, 2.0]], [[1.0, 2.0]]], np.float32)
    assert np.allclose(log_change(light, 0.001), [np.log(2.001 / 1.001), np.log(1001)])
    assert np.allclose(log_change(light, 0.001, 50), [np.log(2.001 / 1.001) / 2, np.log(1001) / 2])


def test_the_step_bounds_what_was_asked_of_a_shaken_view() -> None:
    spec = small()
    path, camera = view_path(spec, 0), camera_of(spec)
    coarse = np.linspace(0, 1, 9)
    phases = adaptive_phases(coarse, image_motion_px(camera, path.poses(coarse), [1.0, 5.0]), step_px=0.25)
    motion = image_motion_px(camera, path.poses(phases), [1.0, 5.0])
    assert motion.max() < 0.26
    assert np.median(motion) > 0.15, "and not far below it"


def test_finer_steps_converge_to_the_true_events() -> None:
    """A bar that moves 4 px: knots a quarter of a pixel apart give the counts of far finer ones; one picture a pixel
    misses turns (the paper's point about asynchronous differences)."""

    def look(phases: np.ndarray) -> np.ndarray:
        x = np.arange(60)[None, None, :] + 0.5 - 4 * phases[:, None, None]
        return (0.5 + 0.4 * np.sin(2 * np.pi * x / 5)).astype(np.float32)

    def count(step_px: float) -> int:
        phases = adaptive_phases([0.0, 1.0], [4.0], step_px=step_px)
        return len(simulate_events(look(phases), np.rint(phases * 1_000_000).astype(int), 1e9, EventCamera()))

    true = count(0.005)
    assert abs(count(0.25) / true - 1) < 0.1
    assert abs(count(0.1) / true - 1) < 0.02
    assert count(2.0) < 0.75 * true
