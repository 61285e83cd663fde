"""A spline on SE(3): exact on curves of its kind, whatever the turn; covariances that are covariances, and right."""

import numpy as np
import pytest

from spikerig.calib.consensus import Path, still_paths
from spikerig.calib.gauge import degrees_apart
from spikerig.calib.smooth import smooth_path, twist_covariance
from spikerig.dataset.rigid import compose, exp_se3, inverse, left_jacobian, log_se3

BASE = exp_se3(np.array([0.4, 0.2, -1.0, 0.3, -0.1, 3.0]))


def curve(at: np.ndarray, turn: float) -> np.ndarray:
    """exp(x(t)) BASE with cubics x, 0 in the middle; `turn` scales the twist at the ends, in radians."""
    s = 2 * np.asarray(at) - 1
    x = turn * np.stack([0.8 * s, 0.5 * s**2, -0.3 * s**3, 0.6 * s, -0.2 * s**3, 0.4 * s**2], 1)
    return np.array([compose(exp_se3(row), BASE) for row in x])


def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Twists [N,6] by which poses a are off b, on their left."""
    return np.array([log_se3(compose(p, inverse(q))) for p, q in zip(a, b, strict=True)])


def noise(seed: int = 0) -> np.ndarray:
    """A covariance [6,6] of twists with strong correlations, sds about 1e-3."""
    mix = np.random.default_rng(seed).normal(size=(6, 6))
    return 1e-6 * (mix @ mix.T / 6 + 0.05 * np.eye(6))


@pytest.mark.parametrize("turn", [1e-9, 0.02, 0.5, 2.0, 3.0])
def test_a_known_curve_is_met_between_its_instants(turn: float) -> None:
    """Exact however far the camera turns within the exposure; a rotation vector beside a translation would not be."""
    at, wanted = np.linspace(0, 1, 7), np.linspace(0, 1, 23)
    found, cov, chi2 = smooth_path(at, curve(at, turn), np.array([noise()] * 7), wanted)
    assert np.abs(apart(found, curve(wanted, turn))).max() < 1e-8
    assert chi2 < 1e-6
    for c in cov:
        assert np.array_equal(c, c.T)
        assert np.linalg.eigvalsh(c)[0] > 0


def test_the_covariance_is_that_of_the_errors() -> None:
    """Noise of a known covariance, 300 times, on a path that turns by 80 degrees to each side: Mahalanobis distance."""
    rng, at, wanted = np.random.default_rng(4), np.linspace(0, 1, 9), np.array([0.0, 0.3, 0.5, 1.0])
    truth, mix, far = curve(at, 1.4), np.linalg.cholesky(noise()), []
    there = curve(wanted, 1.4)
    for _ in range(300):
        noisy = np.array([compose(exp_se3(mix @ rng.normal(size=6)), p) for p in truth])
        found, cov, _ = smooth_path(at, noisy, np.array([noise()] * 9), wanted)
        far.append([e @ np.linalg.solve(c, e) / 6 for e, c in zip(apart(found, there), cov, strict=True)])
    assert np.mean(far, 0) == pytest.approx(np.ones(4), abs=0.25)


def test_whole_covariances_weigh_directions() -> None:
    """One instant is sure of its turn alone, another of its shift alone: the mean takes the best of both."""
    sure, unsure = 1e-10, 1e-2
    turn_only, shift_only = (np.diag(np.repeat(v, 3)) for v in ((sure, unsure), (unsure, sure)))
    first = compose(exp_se3(np.array([0, 0, 0, 0.05, 0.05, 0.05])), BASE)
    second = compose(exp_se3(np.array([0.05, 0.05, 0.05, 0, 0, 0])), BASE)
    at, poses = np.array([0.4, 0.6]), np.stack([first, second])
    found, _, _ = smooth_path(at, poses, np.array([turn_only, shift_only]), np.array([0.5]), degree=0)
    assert degrees_apart(found, BASE[None])[0] < 0.1


def test_a_small_change_of_a_twist_is_a_small_motion() -> None:
    for x in (np.zeros(6), np.array([0.3, -0.2, 0.1, 1.0, 2.0, -1.0]), np.array([2.0, 1.5, -1.0, 0.3, 0.4, 5.0])):
        d = 1e-6 * np.array([1.0, -2.0, 0.5, 0.3, 0.7, -1.0])
        small = log_se3(compose(exp_se3(x + d), inverse(exp_se3(x))))
        assert left_jacobian(x) @ d == pytest.approx(small, abs=2e-11)


def test_colmaps_covariance_is_of_half_the_rotation_vector() -> None:
    """Motions drawn as Ceres' quaternion tangent and translation have the covariance that is said."""
    rng, given, pose = np.random.default_rng(2), noise(3), BASE
    twists = []
    for d in rng.multivariate_normal(np.zeros(6), given, 4000):
        turned = exp_se3(np.concatenate([2 * d[:3], np.zeros(3)]))[:, :3] @ pose[:, :3]
        moved = np.concatenate([turned, (pose[:, 3] + d[3:])[:, None]], 1)
        twists.append(log_se3(compose(moved, inverse(pose))))
    told = twist_covariance(given, pose)
    assert np.cov(np.transpose(twists)) == pytest.approx(told, abs=0.08 * np.abs(told).max())


def test_a_view_without_a_path_stands_still_and_unsure() -> None:
    phases = np.linspace(0, 1, 5)
    measured = {"a": Path(phases, curve(phases, 0.01), np.array([1e-8 * np.eye(6)] * 5), 1.0)}
    poses = {"a": BASE, "b": exp_se3(np.array([0, 1.0, 0, 0, 0, 2.0]))}
    still = still_paths(measured, poses, phases)
    assert list(still) == ["b"]
    assert still["b"].chi2 is None
    assert np.array_equal(still["b"].poses, np.stack([poses["b"]] * 5))
    sds = np.sqrt(still["b"].cov[:, 0, 0])
    assert sds[[0, 4]] == pytest.approx(0.008, rel=0.01)
    assert sds[2] == pytest.approx(1e-4)
    assert all(np.linalg.eigvalsh(c)[0] > 0 for c in still["b"].cov)
    assert still_paths({}, poses, phases) == {}
