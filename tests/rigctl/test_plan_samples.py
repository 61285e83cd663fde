"""Light samples of a plan: as many as the motion needs, and the error that they leave."""

from dataclasses import replace

import numpy as np
import pytest
from hard_plan import AUTO
from hard_sim import small

from spikerig.dataset.errors import UsageError
from spikerig.rigctl.sim.capture import take_view
from spikerig.rigctl.sim.caster.light import stage_of
from spikerig.rigctl.sim.judge.samples import STEP_PX, error_left, motion_px, sampled
from spikerig.rigctl.sim.schedule import schedule
from spikerig.rigctl.sim.sensor import Light
from spikerig.rigctl.sim.shake import rotation
from spikerig.rigctl.sim.spec import Exposure, Sensor
from spikerig.rigctl.sim.viewpoint import camera_of, timed, view_motion, view_path


def test_light_samples_follow_the_motion() -> None:
    spec = small(**AUTO, exposure={"exposure_ms": 8.0}, shake__path_px=[6, 6])
    stage = stage_of(spec.world)
    n = timed(spec, 0, stage).sub_poses
    motion, _ = view_motion(spec, 0, stage)
    assert motion.max() / (n - 1) <= STEP_PX < motion.max() / (n - 4)
    assert n % 2 == 1  # mid-exposure is one of them
    assert timed(spec, 1, stage).sub_poses != n
    assert take_view(spec, 0).view.trajectory.at_ns.size == n  # type: ignore[union-attr]
    still = replace(spec, shake=replace(spec.shake, path_px=(0.0, 0.0)))
    assert timed(still, 0, stage).sub_poses == 1
    given = replace(spec, exposure=replace(spec.exposure, sub_poses=9))
    assert timed(given, 0, stage).sub_poses == 9
    assert small(exposure={}).exposure.sub_poses == 17
    assert small(**AUTO, exposure={"protocol": "paper"}).exposure.sub_poses == 18


@pytest.mark.parametrize(
    ("motion", "light", "samples"),
    [(50.0, "linear", 201), (50.0, "hold", 201), (1e6, "linear", 321), (1e6, "hold", 320)],
)
def test_samples_of_fast_motion(motion: float, light: str, samples: int) -> None:
    found = sampled(Exposure(light=light, sub_poses=0), motion)
    assert found.sub_poses == samples
    assert found.ticks == 320
    with pytest.raises(UsageError):
        schedule(Exposure(sub_poses=0))  # only a view knows how many


def test_motion_of_known_moves() -> None:
    camera = camera_of(small(camera__width=200, camera__height=120))
    f, base = camera.K[0, 0], np.eye(3, 4)
    depth = np.full((120, 200), 2.0)
    depth[:60] = np.inf
    moves = [np.concatenate([np.eye(3), [[x], [0], [0]]], 1) for x in (-0.1, 0.0, 0.1)]
    moved = motion_px(camera, depth, base, np.stack(moves))
    assert moved[-1] == pytest.approx(f * 0.2 / 2)
    assert moved[0].max() < 0.01  # what is far does not move
    behind = [np.concatenate([np.eye(3), [[0], [0], [z]]], 1) for z in (0.0, -2.0, -4.0, 0.0)]
    assert np.all(np.isfinite(motion_px(camera, depth, base, np.stack(behind))))
    turns = [np.concatenate([rotation(np.array([[0, 0, a]]))[0], np.zeros((3, 1))], 1) for a in np.linspace(0, 0.1, 9)]
    around = motion_px(camera, depth, base, np.stack(turns))
    y, x = np.mgrid[0:120:4, 0:200:4] + 0.5
    assert np.allclose(around, 0.1 * np.hypot(x - 100, y - 60), atol=0.01)


def test_the_error_that_samples_leave() -> None:
    """The bound from nine pictures holds for 95 % of pixels at two numbers of samples, and is not far off."""
    spec = small(camera__width=80, camera__height=50, shake__path_px=[8, 8], exposure={"exposure_ms": 8.0})
    stage, path, camera, ticks = stage_of(spec.world), view_path(spec, 0), camera_of(spec), spec.exposure.ticks
    fine = np.stack([stage.picture(camera, pose, 2) for pose in path.poses(np.linspace(0, 1, 129))])

    def mean(pictures: np.ndarray) -> np.ndarray:
        weights = np.ones(len(pictures))
        weights[[0, -1]] = 0.5
        return np.tensordot(weights / weights.sum(), pictures, 1) @ np.array(Sensor().response) * Sensor().gain * ticks

    few = Light(fine[::16], np.linspace(0, ticks, 9).astype(int), (0, ticks), 40_000.0)
    for parts in (16, 32):
        bound = error_left([few], [parts], Sensor(), ticks)[0]
        error = np.abs(mean(fine[:: 128 // parts]) - mean(fine))
        assert np.mean(error > bound) < 0.05
        assert bound < 6 * np.percentile(error, 95)
