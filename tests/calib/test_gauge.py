"""Similarities between worlds, and errors of poses after the best one."""

import numpy as np
import pytest
from calib_worlds import moved, path, ring, turn

from spikerig.calib.gauge import centres, degrees_apart, extent, pose_errors, similarity, umeyama
from spikerig.calib.smooth import mean_pose, smooth_path
from spikerig.dataset.errors import DataError


def test_a_similarity_is_found_exactly_and_carries_points_and_poses() -> None:
    here, R, t = ring(7), turn(0.3, -1.2, 2.0), np.array([5.0, -2, 1])
    there = moved(here, 3.5, R, t)
    found = similarity(here, there)
    assert found.scale == pytest.approx(3.5, rel=1e-9)
    assert np.allclose(found.R, R)
    assert np.allclose(found.t, t)
    assert np.allclose(found.poses(here), there)
    assert np.allclose(found.points(centres(here)), centres(there))
    turned, away = pose_errors(here, there)
    assert turned.max() < 1e-6
    assert away.max() < 1e-9


def test_cameras_on_a_line_still_give_a_rotation() -> None:
    """Centres alone would leave the turn about the line open; the axes settle it."""
    here = np.array([np.column_stack([np.eye(3), [-x, 0, 0]]) for x in (0.0, 1.0, 2.0)])
    R = turn(1.0, 0.5, -0.4)
    found = similarity(here, moved(here, 0.2, R, np.array([1.0, 2, 3])))
    assert np.allclose(found.R, R)


def test_known_errors_are_measured() -> None:
    truth = ring(9)
    off = truth.copy()
    off[4] = np.column_stack([turn(0, 0, np.radians(3)) @ truth[4][:, :3], turn(0, 0, np.radians(3)) @ truth[4][:, 3]])
    turned, away = pose_errors(off, truth)
    assert turned[4] == pytest.approx(3, abs=0.4)
    assert np.median(turned) < 0.4
    assert away.max() < 0.02
    assert extent(truth) == pytest.approx(4.0)
    assert degrees_apart(truth, truth).max() == 0
    opposite = truth.copy()
    opposite[:, :3, :3] = np.array([turn(np.pi, 0, 0) @ p[:, :3] for p in truth])
    assert np.allclose(degrees_apart(opposite, truth), 180)


@pytest.mark.parametrize("poses", [ring(1), np.repeat(ring(1), 4, 0)], ids=["one", "one place"])
def test_no_scale_from_one_place(poses: np.ndarray) -> None:
    with pytest.raises(DataError, match="two places"):
        similarity(poses, ring(len(poses)))


def test_a_mirrored_world_is_not_taken_for_a_turned_one() -> None:
    a = np.random.default_rng(0).normal(size=(20, 3))
    found = umeyama(a, a * [1, 1, -1])
    assert np.linalg.det(found.R) == pytest.approx(1)
    assert np.abs(found.points(a) - a * [1, 1, -1]).max() > 0.5


def test_mean_of_poses_lies_between() -> None:
    a = np.column_stack([turn(0, 0, 0.1), [1.0, 0, 0]])
    b = np.column_stack([turn(0, 0, -0.1), [1.0, 0, 0]])
    mean = mean_pose([a, b])
    assert np.allclose(mean[:, :3], np.eye(3))
    assert np.allclose(-mean[:, :3].T @ mean[:, 3], -(a[:, :3].T @ a[:, 3] + b[:, :3].T @ b[:, 3]) / 2)


def test_a_smooth_path_is_kept_and_noise_is_less_after() -> None:
    at, wanted = np.linspace(0, 1, 9), np.linspace(0, 1, 5)
    clean, cov, chi2 = smooth_path(at, path(at), np.full((9, 6), 1e-3), wanted)
    assert degrees_apart(clean, path(wanted)).max() < 0.01
    assert chi2 < 0.01
    assert cov.shape == (5, 6, 6)
    rng = np.random.default_rng(1)
    before, after = [], []
    for _ in range(30):
        noisy = path(at)
        for k in range(9):
            noisy[k, :, :3] = turn(*(2e-3 * rng.normal(size=3))) @ noisy[k, :, :3]
        smooth, cov, chi2 = smooth_path(at, noisy, np.full((9, 6), 2e-3), at)
        before.append(degrees_apart(noisy, path(at)))
        after.append(degrees_apart(smooth, path(at)))
        sigma = np.degrees(np.sqrt(cov[4, 0, 0]))
        assert 0.01 < sigma < 0.15
    assert np.mean(after) < 0.8 * np.mean(before)


def test_one_wild_instant_does_not_bend_the_path() -> None:
    at = np.linspace(0, 1, 9)
    noisy = path(at)
    noisy[6, :, :3] = turn(0.2, 0, 0) @ noisy[6, :, :3]
    smooth, _, chi2 = smooth_path(at, noisy, np.full((9, 6), 1e-3), at)
    assert degrees_apart(smooth, path(at)).max() < 1.5
    assert chi2 > 10


@pytest.mark.parametrize("n", [1, 2, 3])
def test_few_instants_lower_the_degree(n: int) -> None:
    at = np.linspace(0.2, 0.5, n)
    smooth, cov, _ = smooth_path(at, path(at), np.full((n, 6), 1e-3), np.array([0.5]))
    assert np.all(np.isfinite(smooth))
    assert np.all(np.isfinite(cov))
    assert degrees_apart(smooth, path(np.array([0.5])))[0] < 0.6
    with pytest.raises(DataError):
        smooth_path(at[:0], path(at[:0]).reshape(0, 3, 4), np.zeros((0, 6)), np.array([0.5]))
