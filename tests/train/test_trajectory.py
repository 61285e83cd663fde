"""Poses over time: SE(3) to the last digits, exact knots, and refusals."""

import numpy as np
import pytest

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.rigid import between, compose, exp_se3, inverse, log_se3, rotation_vector
from spikerig.dataset.scene import Frame, Pose, Trajectory, View
from spikerig.train.trajectory import phases, pose_at, sub_pose


def motion(seed: int, angle: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    return exp_se3(np.concatenate([axis / np.linalg.norm(axis) * angle, rng.normal(size=3)]))


@pytest.mark.parametrize(
    "angle", [0.0, 1e-12, 1e-9, 1e-5, 9.99e-3, 1.001e-2, 0.5, 2.0, 3.0, np.pi - 1e-6, np.pi - 1e-9]
)
def test_exp_and_log_are_inverse(angle):
    for seed in range(5):
        twist = log_se3(motion(seed, angle))
        rng = np.random.default_rng(seed)
        axis = rng.normal(size=3)
        assert np.allclose(twist[:3], axis / np.linalg.norm(axis) * angle, atol=1e-12)
        assert np.allclose(exp_se3(twist), motion(seed, angle), atol=1e-12)


def test_half_turns_round_trip_with_either_sign():
    for axis in np.vstack([np.eye(3), [[1, 1, 0], [0, -1, 1], [1, -2, 3]]]):
        unit = axis / np.linalg.norm(axis)
        R = exp_se3(np.concatenate([unit * np.pi, np.zeros(3)]))[:, :3]
        found = rotation_vector(R)
        assert min(np.abs(found - unit * np.pi).max(), np.abs(found + unit * np.pi).max()) < 1e-12


def test_exp_against_the_matrix_exponential():
    twist = np.array([0.3, -0.7, 0.2, 1.0, 2.0, -0.5])
    w = twist[:3]
    generator = np.zeros((4, 4))
    generator[:3, :3] = [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
    generator[:3, 3] = twist[3:]
    series, term = np.eye(4), np.eye(4)
    for k in range(1, 40):
        term = term @ generator / k
        series = series + term
    assert np.allclose(exp_se3(twist), series[:3], atol=1e-14)


def test_knots_are_exact_and_the_middle_of_a_turn_is_half_of_it():
    poses = np.stack([motion(1, 0.4), motion(2, 0.9), motion(3, 2.0)])
    path = Trajectory(np.array([10, 20, 1000]), poses)
    for at, pose in zip(path.at_ns, poses, strict=True):
        assert np.array_equal(pose_at(path, float(at)), pose)
    turn = exp_se3(np.array([0, 0.2, 0, 0.1, 0, 0]))
    middle = between(poses[0], compose(turn, poses[0]), 0.5)
    assert np.allclose(compose(middle, inverse(poses[0])), exp_se3(np.array([0, 0.1, 0, 0.05, 0, 0])), atol=1e-14)


def test_an_instant_far_outside_is_refused_and_half_a_spacing_is_not():
    path = Trajectory(np.array([100, 200, 300]), np.stack([motion(1, 0.0), motion(1, 0.1), motion(1, 0.2)]))
    assert np.allclose(log_se3(compose(pose_at(path, 50.0), inverse(pose_at(path, 100.0))))[:3],
                       -log_se3(compose(pose_at(path, 150.0), inverse(pose_at(path, 100.0))))[:3])  # fmt: skip
    with pytest.raises(DataError, match="outside the trajectory"):
        pose_at(path, 450.0)
    with pytest.raises(DataError, match="no other instants"):
        pose_at(Trajectory(np.array([5]), path.poses[:1]), 6.0)


def test_instants_of_an_exposure():
    assert phases(1, "midpoints", "mid") == (0.5,)
    assert phases(1, "midpoints", "first") == (0.0,)
    assert phases(5, "midpoints", "first") == pytest.approx((0.1, 0.3, 0.5, 0.7, 0.9))
    assert phases(3, "endpoints", "mid") == (0, 0.5, 1)
    with pytest.raises(UsageError):
        phases(0, "midpoints", "mid")


def test_without_a_trajectory_only_mid_exposure_is_known():
    frame = Frame(np.zeros((4, 5, 3), np.uint8), exposure_ns=100)
    view = View("v", frame, None, np.zeros((4, 5)), np.ones((4, 5), bool), Pose(motion(1, 0.3)), None)
    assert np.array_equal(sub_pose(view, 0.5), motion(1, 0.3))
    with pytest.raises(DataError, match="no trajectory"):
        sub_pose(view, 0.0)
