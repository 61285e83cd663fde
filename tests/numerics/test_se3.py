"""SE(3) in torch: round trips to 1e-12 at any angle, gradients exact and finite, splines against float64 NumPy."""

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from spikerig.dataset.errors import UsageError
from spikerig.dataset.rigid import between
from spikerig.dataset.rigid import exp_se3 as exp_by_numpy
from spikerig.train import se3
from spikerig.train.se3 import compose, cubic_spline, exp_se3, inverse, linear_spline, log_se3, rotation_vector

KINK = float(np.sqrt(se3.NEAR))  # angle where the series of exp and of log's second half end
ATAN_KINK = 2 * float(np.arctan(np.sqrt(se3.ATAN_NEAR)))
SHEPPERD_KINK = 2 * np.pi / 3  # about (1, 1, 1) all four squares are equal near there
SMALL = (0.0, 1e-300, 1e-20, 1e-12, 1e-9, 1e-5, 1e-2)
KINKS = tuple(k + d for k in (KINK, ATAN_KINK, SHEPPERD_KINK) for d in (-1e-5, -1e-9, 0.0, 1e-9, 1e-5))
LARGE = (1.0, np.pi / 2, 3.0, np.pi - 1e-5, np.pi - 1e-9, np.pi - 1e-12)
AXES = np.vstack([np.eye(3), -np.eye(3), [[1, 1, 1], [1, 1, 0], [0, -1, 1], [1, -2, 3], [-3, 1e-9, 1e-4]]])


def twists(angle: float, shift: float = 1.0) -> torch.Tensor:
    """One [6] about each axis, translations drawn."""
    unit = AXES / np.linalg.norm(AXES, axis=1, keepdims=True)
    moved = np.random.default_rng(5).normal(0, shift, unit.shape)
    return torch.from_numpy(np.concatenate([unit * angle, moved], 1))


def generator(twist: np.ndarray) -> np.ndarray:
    x, y, z, *v = twist
    return np.array([[0, -z, y, v[0]], [z, 0, -x, v[1]], [-y, x, 0, v[2]], [0, 0, 0, 0]])


@pytest.mark.parametrize("angle", [*SMALL, *KINKS, *LARGE, np.pi, 4.0, 2 * np.pi, 40.0])
def test_exp_is_the_matrix_exponential(angle):
    for twist, found in zip(twists(angle), exp_se3(twists(angle)), strict=True):
        assert np.abs(expm(generator(twist.numpy()))[:3] - found.numpy()).max() < 1e-12 * max(1, angle)


@pytest.mark.parametrize("angle", [*SMALL, *KINKS, *LARGE])
def test_log_undoes_exp_to_1e_12(angle):
    given = twists(angle)
    found = log_se3(exp_se3(given))
    assert (found - given).abs().max() < 1e-13
    assert (exp_se3(found) - exp_se3(given)).abs().max() < 1e-13
    by_scipy = Rotation.from_matrix(exp_se3(given)[:, :, :3].numpy()).as_rotvec()
    assert np.abs(found[:, :3].numpy() - by_scipy).max() < 1e-7  # scipy loses digits near half turns


def test_half_turns_round_trip_with_either_sign():
    given = twists(np.pi)
    motion = exp_se3(given)
    found = log_se3(motion)
    apart = torch.minimum((found - given)[:, :3].abs().amax(1), (found + given)[:, :3].abs().amax(1))
    assert apart.max() < 1e-12
    assert (exp_se3(found) - motion).abs().max() < 1e-12
    beyond = log_se3(exp_se3(twists(np.pi + 1e-6)))  # the short way round
    assert torch.allclose(beyond[:, :3].norm(dim=1), torch.tensor(np.pi - 1e-6, dtype=torch.float64), atol=1e-12)


@pytest.mark.parametrize("angle", [*SMALL, *KINKS, *LARGE])
def test_the_gradient_of_a_round_trip_is_the_identity(angle):
    for twist in twists(angle):
        found = torch.autograd.functional.jacobian(lambda x: log_se3(exp_se3(x)), twist)
        assert (found - torch.eye(6)).abs().max() < 1e-10


def test_gradients_at_the_identity_are_exact():
    """exp: the six generators. log, by the twelve numbers of the pose: (R - R^T)/2 and t."""
    zero = torch.zeros(6, dtype=torch.float64)
    found = torch.autograd.functional.jacobian(exp_se3, zero)
    for k, unit in enumerate(np.eye(6)):
        assert np.array_equal(found[..., k].numpy(), generator(unit)[:3])
    back = torch.autograd.functional.jacobian(log_se3, exp_se3(zero))
    wanted = np.zeros((6, 3, 4))
    for k, (i, j) in enumerate(((2, 1), (0, 2), (1, 0))):
        wanted[k, i, j], wanted[k, j, i] = 0.5, -0.5
        wanted[3 + k, k, 3] = 1
    assert np.array_equal(back.numpy(), wanted)


@pytest.mark.parametrize("angle", [0.0, *KINKS, 1e-3, 1.0, 3.0])
def test_gradients_agree_with_differences_on_both_sides_of_the_kinks(angle):
    for twist in twists(angle)[::3]:
        assert torch.autograd.gradcheck(exp_se3, twist.clone().requires_grad_(), atol=1e-7, rtol=1e-6)
        pose, still = exp_se3(twist), torch.zeros(6, dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(lambda x: log_se3(compose(exp_se3(x), pose)), still, atol=1e-7, rtol=1e-6)  # noqa: B023


def test_small_and_large_motions_in_one_batch_are_as_alone():
    """Where a batch holds both, each branch is shown the other's angles: no gradient may leak out of them."""
    angles = (0.0, 1e-300, 1e-9, 0.3, KINK, 2.0, np.pi)
    given = torch.cat([twists(angle) for angle in angles]).requires_grad_()
    log_se3(exp_se3(given)).square().sum().backward()
    for k, angle in enumerate(angles):
        alone = twists(angle).requires_grad_()
        log_se3(exp_se3(alone)).square().sum().backward()
        rows = slice(k * len(AXES), (k + 1) * len(AXES))
        assert (given.grad[rows] - alone.grad).abs().max() < 1e-12


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
@pytest.mark.parametrize("angle", [0.0, 1e-300, np.pi - 1e-12, np.pi, np.pi + 1e-12, 2 * np.pi, 100.0])
def test_gradients_are_finite_everywhere(angle, kind):
    given = twists(angle).to(kind).requires_grad_()
    motion = exp_se3(given)
    found = log_se3(motion)
    assert motion.dtype == found.dtype == kind
    (by_pose,) = torch.autograd.grad(found.square().sum(), motion, retain_graph=True)
    (by_twist,) = torch.autograd.grad(found.square().sum() + motion.sum(), given)
    assert torch.isfinite(by_pose).all()
    assert torch.isfinite(by_twist).all()


def test_rotations_with_a_zero_and_a_negative_zero_give_finite_vectors():
    half = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    for R in (half, -half.flip(0).flip(1) * torch.tensor([-1.0, 1, -1]), torch.eye(3, dtype=torch.float64)):
        assert torch.isfinite(rotation_vector(R)).all()


def test_compose_and_inverse_cancel():
    motions = exp_se3(twists(2.0))
    nothing = compose(motions, inverse(motions))
    assert (nothing - torch.eye(4, dtype=torch.float64)[:3]).abs().max() < 1e-14


def knots(count: int, seed: int = 1, size: float = 0.4) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).normal(0, size, (count, 6)))


def test_a_linear_spline_is_screws_between_its_knots():
    given = knots(4)
    motions = [exp_by_numpy(x) for x in given.numpy()]
    for at in (-0.5, 0.0, 0.3, 1.0, 1.5, 2.0, 2.9, 3.0, 3.4):
        piece = min(max(int(at), 0), 2)
        wanted = between(motions[piece], motions[piece + 1], at - piece)
        assert np.abs(linear_spline(given, at).numpy() - wanted).max() < 1e-13


def test_a_cubic_spline_is_the_blend_of_its_increments():
    """Against scipy's matrix exponential and logarithm, piece by piece."""
    from scipy.interpolate import BSpline
    from scipy.linalg import logm

    given = knots(6)
    motions = [expm(generator(x)) for x in given.numpy()]
    basis = [BSpline(np.arange(-3, 7), np.eye(6)[k], 3) for k in range(6)]  # piece 0 is [0, 1]
    for at in (0.0, 0.4, 1.0, 1.7, 2.999):
        wanted = motions[0]
        for k in range(1, 6):
            share = sum(float(basis[m](at)) for m in range(k, 6))
            wanted = expm(share * np.real(logm(motions[k] @ np.linalg.inv(motions[k - 1])))) @ wanted
        assert np.abs(cubic_spline(given, at).numpy() - wanted[:3]).max() < 1e-12


def test_a_cubic_spline_is_smooth_where_pieces_meet():
    given, step = knots(6), 1e-4
    for meet in (1.0, 2.0):
        left, right = ([cubic_spline(given, meet + side * k * step) for k in range(4)] for side in (-1, 1))
        speed = [(a[1] - a[0]) / step * side for a, side in ((left, -1), (right, 1))]
        assert (speed[0] - speed[1]).abs().max() < 10 * step
        bend = [(a[2] - 2 * a[1] + a[0]) / step**2 for a in (left, right)]
        assert (bend[0] - bend[1]).abs().max() < 100 * step


@pytest.mark.parametrize(("spline", "count"), [(linear_spline, 3), (cubic_spline, 5)])
def test_splines_of_equal_knots_stand_still_and_gradients_pass(spline, count):
    same = knots(1).expand(count, 6)
    assert (spline(same, 0.3) - exp_se3(same[0])).abs().max() < 1e-14
    for given in (torch.zeros(count, 6, dtype=torch.float64), knots(count)):
        assert torch.autograd.gradcheck(lambda x: spline(x, 1.25), given.clone().requires_grad_())
    many = torch.stack([knots(count, seed) for seed in range(3)])
    assert (spline(many, 0.7)[1] - spline(many[1], 0.7)).abs().max() < 1e-14


def test_too_few_knots_are_told():
    with pytest.raises(UsageError, match="more knots"):
        linear_spline(knots(1), 0.0)
    with pytest.raises(UsageError, match="more knots"):
        cubic_spline(knots(3), 0.0)
