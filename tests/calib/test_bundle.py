"""The solver: right derivatives, right answers, honest uncertainties."""

import numpy as np
import pytest
from calib_rigs import bundle_of, corners_seen, rig

from spikerig.calib.bundle import Guess, _Problem, solve, turn
from spikerig.calib.evidence import beta_below, f_above, hotelling, jackknife_cov


def test_exact_corners_give_the_exact_rig() -> None:
    true = rig(shift=(15.0, -2.0, 3.0))
    points, sights, guess = bundle_of(true, corners_seen(true, 8, noise_px=(0, 0)), off=True)
    fit = solve(points, sights, guess)
    assert fit.rms_px() < 1e-8
    for (K, c), camera in zip(fit.lenses, (true.spike, true.rgb), strict=True):
        np.testing.assert_allclose(K, camera.K, rtol=1e-7)
        np.testing.assert_allclose(c, camera.distortion, atol=1e-7)
    back = np.concatenate([fit.step, [[0, 0, 0, 1]]]) @ np.concatenate(
        [true.spike_from_rgb.cam_from_world, [[0, 0, 0, 1]]]
    )
    np.testing.assert_allclose(back, np.eye(4), atol=1e-6)


def test_the_gradient_is_that_of_small_steps() -> None:
    true = rig(shift=(15.0, -2.0, 3.0))
    points, sights, guess = bundle_of(true, corners_seen(true, 3))
    step = np.concatenate([turn(np.array([0.4, -0.5, 0.9])) @ guess.step[:, :3], guess.step[:, 3:]], 1)
    state = Guess(guess.lenses, guess.poses, step)
    problem = _Problem(points, sights, np.ones(3, bool), True, True, True)
    _, _, _, shared, poses, _ = problem.normal(state)
    slope = np.concatenate([shared, poses.ravel()])

    def cost(change: np.ndarray) -> float:
        moved = problem.moved(state, change[: len(shared)], change[len(shared) :].reshape(poses.shape))
        return float(sum((off**2).sum() for off in problem.residuals(moved)[0]))

    told = [(cost(1e-6 * e) - cost(-1e-6 * e)) / 2e-6 for e in np.eye(len(slope))]
    np.testing.assert_allclose(told, -2 * slope, rtol=1e-4, atol=1e-4 * np.abs(slope).max())


def test_uncertainties_are_those_of_many_trials() -> None:
    true = rig(shift=(15.0, -2.0, 3.0))
    found, told = [], []
    for seed in range(40):
        points, sights, guess = bundle_of(true, corners_seen(true, 6, seed=3, noise_seed=seed))
        fit = solve(points, sights, guess, rest=1e-6)
        found.append([fit.lenses[0][0][0, 0], fit.lenses[1][0][0, 2], fit.lenses[0][1][0], fit.step[2, 3]])
        told.append([fit.sd(n) for n in ("fx0", "cx1", "k1_0", "shift_z")])
    ratio = np.std(found, axis=0) / np.mean(told, axis=0)
    assert np.all((ratio > 0.7) & (ratio < 1.35)), ratio  # 3 sd of a standard deviation from 40 trials


def test_what_is_held_stays_and_what_is_unseen_does_not_matter() -> None:
    true = rig()
    points, sights, guess = bundle_of(true, corners_seen(true, 5))
    fit = solve(points, sights, guess, free_lens=False, free_turn=False, free_shift=False)
    assert fit.names == ()
    np.testing.assert_array_equal(fit.step, guess.step)
    np.testing.assert_array_equal(fit.lenses[0][0], guess.lenses[0][0])
    use = np.array([True, True, True, False, True])
    less = solve(points, sights, guess, use=use)
    np.testing.assert_array_equal(less.poses[3], guess.poses[3])
    assert less.off_px[0][3].sum() == 0


def test_boards_that_say_nothing_give_a_huge_variance_and_no_exception() -> None:
    true = rig()
    points, sights, guess = bundle_of(true, corners_seen(true, 6, tilt_deg=0.0))
    fit = solve(points, sights[:1], Guess(guess.lenses[:1], guess.poses))
    assert fit.sd("fx0") > 0.2 * fit.lenses[0][0][0, 0]
    assert np.isfinite(fit.cov).all()


def test_turns_are_rotations_also_when_tiny() -> None:
    for w in ([0.0, 0, 0], [1e-12, 0, 0], [1e-8, -1e-8, 0], [1.0, 2, 3], [np.pi, 0, 0]):
        R = turn(np.array(w))
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
        assert np.linalg.det(R) == pytest.approx(1)


@pytest.mark.parametrize(("value", "d1", "d2"), [(3, 3, 17), (0.2, 3, 5), (50, 3, 12), (1, 3, 1e5), (1e-5, 2, 3)])
def test_f_distribution_is_scipys(value: float, d1: float, d2: float) -> None:
    from scipy.stats import f

    assert f_above(value, d1, d2) == pytest.approx(f.sf(value, d1, d2), abs=1e-9)
    assert f_above(0, d1, d2) == 1
    assert f_above(float("inf"), d1, d2) == 0
    assert beta_below(1, 2, 3) == 1


def test_hotelling_rejects_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    chances = []
    for _ in range(400):
        x = rng.normal(size=(9, 3)) * [1, 5, 0.1]
        left_out = np.stack([np.delete(x, k, 0).mean(0) for k in range(9)])
        chances.append(hotelling(x.mean(0), jackknife_cov(left_out), 9))
    assert abs(np.mean(np.array(chances) < 0.1) - 0.1) < 0.045  # 3 sd
    assert hotelling(np.ones(3), np.eye(3), 3) == 1
