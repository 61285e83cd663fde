"""Volume rendering at its limits against float64: alpha, transmittance, density, and space out to infinity."""

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from spikerig.dataset.errors import UsageError
from spikerig.dataset.scene import Camera
from spikerig.train import ray_oracles
from spikerig.train.contraction import contract, distance_of
from spikerig.train.hashed import density_of, place, start_hashed, trace_hashed, unit
from spikerig.train.methods import configure
from spikerig.train.rays import rays_of
from spikerig.train.vanilla import network, start_vanilla
from spikerig.train.volume import THICKEST, weights_of

ULP = 2**-23
OPEN = configure("plain", "draft", "nerf-fast", contract=True, coarse=64, probes=16, fine=8, width=8, grid_levels=3,
                 finest=32, table_log2=9, occupancy=16)  # fmt: skip
CAMERA = Camera(np.array([[50.0, 0, 16.5], [0, 60.0, 10], [0, 0, 1]]), np.zeros(0), 32, 20)


def grad_of(leaf: torch.Tensor) -> torch.Tensor:
    assert leaf.grad is not None
    return leaf.grad


def test_alpha_and_its_gradient_from_thin_to_opaque():
    """Depths of 1e-12 to 1e3, each side of the clamp at 80: a few last places off, gradient e^-x times length."""
    length = 0.37
    depth = np.unique(np.concatenate([np.logspace(-12, 3, 400), [THICKEST * 0.999, THICKEST * 1.001]]))
    density = torch.tensor(depth / length, dtype=torch.float32, requires_grad=True)
    alpha, left = weights_of(density[:, None], torch.full((len(depth), 1), length))
    exact = density.detach().double().numpy() * np.float64(np.float32(length))
    truth = -np.expm1(-exact)
    assert np.max(np.abs(alpha[:, 0].detach().double().numpy() - truth) / truth) < 4 * ULP
    below = exact < 60
    rest = np.exp(-exact[below])
    assert np.max(np.abs(left.detach().double().numpy()[below] - rest) / rest) < 80 * ULP  # of e^-x, x rounded
    alpha.sum().backward()
    grad = grad_of(density).double().numpy()
    wanted = np.where(exact < THICKEST, np.exp(-exact) * length, 0.0)
    assert np.all(np.isfinite(grad))
    assert np.allclose(grad, wanted, rtol=1e-5, atol=1e-30)


@pytest.mark.parametrize("depth", [1e-6, 1.0, 30.0, 1e4])
def test_ten_thousand_samples_lose_no_light(depth):
    rng = np.random.default_rng(1)
    length = torch.from_numpy(rng.dirichlet(np.ones(10_000)).astype(np.float32))[None]
    density = torch.full((1, 10_000), depth)
    weights, left = weights_of(density, length)
    truth, rest = ray_oracles.weights_of(density.numpy(), length.numpy())
    assert abs((weights.double().sum() + left.double()).item() - 1) < 1e-6
    assert np.abs(weights.numpy() - truth).max() < 1e-6
    assert abs(left.item() - rest[0]) < 1e-6


@pytest.mark.parametrize("wall", [40.0, 79.0, 200.0])
def test_gradients_where_alpha_is_one_exactly(wall):
    """A sample behind which nothing is seen: e^-40 is no part of 1 in float64, and 200 is beyond the clamp."""
    density = torch.tensor([[0.7, wall, 0.9, 2.0], [wall, wall, wall, wall]], dtype=torch.float64, requires_grad=True)
    weights, left = weights_of(density, torch.ones(2, 4, dtype=torch.float64))
    assert weights[1].tolist() == [1, *[pytest.approx(0, abs=1e-17)] * 3]
    assert gradcheck(lambda d: weights_of(d, torch.ones(2, 4, dtype=torch.float64)), (density,))
    (weights.sum() + left.sum()).backward()
    assert torch.all(torch.isfinite(grad_of(density)))


@pytest.mark.parametrize("bias", [-1e4, -30.0, 30.0, 1e4, 3e38])
def test_the_papers_density_at_any_bias(bias):
    params, _ = start_vanilla(configure("plain", "draft", "nerf", width=8))
    params["fine/density/bias"] = torch.full((1,), bias, requires_grad=True)
    density, colour = network(params, "fine", torch.zeros(2, 3), torch.eye(3)[:2])
    assert torch.all(torch.isfinite(density) & (density >= 0))
    assert torch.all(torch.isfinite(colour))
    density.sum().backward()
    assert torch.all(torch.isfinite(grad_of(params["fine/density/bias"])))


@pytest.mark.parametrize("bias", [-1e4, -80.0, 10.999, 11.001, 80.0, 1e4])
def test_the_fast_fields_density_at_any_bias(bias):
    params, _ = start_hashed(OPEN)
    params["density/2/bias"] = torch.full((16,), bias, requires_grad=True)
    density, _ = density_of(params, OPEN, torch.zeros(2, 3))
    assert torch.all(torch.isfinite(density) & (density >= 0))
    assert density[0].item() == pytest.approx(np.exp(min(bias, 11.0)), rel=1e-2, abs=1e-30)
    density.sum().backward()
    grad = grad_of(params["density/2/bias"])
    assert torch.all(torch.isfinite(grad))
    assert (grad[0] > 0) == (density[0] > 0)  # beyond the flat part there is still a way back


def far_and_near():
    rng = np.random.default_rng(2)
    ways = rng.normal(size=(60, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    return ways * np.concatenate([np.logspace(-12, 12, 56), [1 - 1e-9, 1 + 1e-9, 1.5, 0.5]])[:, None]


def test_contraction_is_its_definition_inside_and_far_outside():
    points = far_and_near()
    found = contract(torch.from_numpy(points)).numpy()
    assert np.abs(found - ray_oracles.contract(points)).max() < 1e-15 * 4
    small = contract(torch.from_numpy(points.astype(np.float32))).double().numpy()
    assert np.abs(small - ray_oracles.contract(points.astype(np.float32))).max() < 8 * ULP
    assert np.linalg.norm(found, axis=1).max() < 2


def test_contractions_jacobian_is_the_closed_form():
    points = far_and_near()
    for point, truth in zip(points, ray_oracles.contract_jacobian(points), strict=True):
        found = torch.autograd.functional.jacobian(contract, torch.from_numpy(point))
        assert np.abs(found.numpy() - truth).max() < 1e-14
    near_kink = torch.tensor([[0.6, 0.8 - 1e-4, 0.0], [0.6, 0.8 + 1e-4, 0.0]], dtype=torch.float64, requires_grad=True)
    assert gradcheck(contract, (near_kink,), eps=1e-7)


def test_contraction_at_zero_and_infinity():
    inf = np.inf
    bad = torch.tensor([[0.0, 0, 0], [inf, 0, 0], [0, -inf, 5], [inf, inf, inf], [3e38, 0, 0], [1.0, 0, 0]],
                       requires_grad=True)  # fmt: skip
    found = contract(bad)
    third = 2 / 3**0.5
    expected = [[0, 0, 0], [2, 0, 0], [0, -2, 0], [third, third, third], [2, 0, 0], [1, 0, 0]]
    assert found.detach().numpy() == pytest.approx(np.array(expected), abs=1e-6)
    found.sum().backward()
    assert torch.all(torch.isfinite(grad_of(bad)))
    assert grad_of(bad)[0].tolist() == [1, 1, 1]
    assert torch.isnan(contract(torch.tensor([[np.nan, 0.0, 0.0]]))).any()


def test_contracted_distances_reach_far_and_never_turn_back():
    s = torch.linspace(0, 2, 2001)
    t = distance_of(s)
    assert torch.all(torch.isfinite(t))
    assert torch.all(torch.diff(t)[:-1] > 0)
    assert t[500].item() == pytest.approx(0.5)
    assert t[1500].item() == pytest.approx(2, rel=1e-5)
    assert t[-1] >= 1e6


def test_an_open_field_sees_beyond_every_box():
    """A shell of density at 30 units, painted by its grid: samples go there, and the light along rays is accounted."""
    params, grids = start_hashed(OPEN)
    grids["occupancy"].zero_()
    side = OPEN.occupancy
    cells = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1)[..., ::-1]  # x fastest
    radius = np.linalg.norm((cells + 0.5) / side * 4 - 2, axis=-1)
    grids["occupancy"][torch.from_numpy(radius > 1.7)] = 5.0
    rays = rays_of(CAMERA, torch.eye(4)[:3], torch.arange(40) * 16)
    pieces = place(grids["occupancy"], OPEN, rays, None, 16)
    middle = distance_of(pieces.distance[:, 8])
    assert torch.all(middle > 2)
    inside = unit(rays.origins + rays.directions * middle[:, None], OPEN)
    assert torch.all((inside >= 0) & (inside <= 1))
    leaves = {name: p.requires_grad_() for name, p in params.items()}
    (seen,) = trace_hashed(leaves, grids, OPEN, rays, torch.zeros(3), np.random.default_rng(0))
    seen.colour.sum().backward()
    assert torch.all(torch.isfinite(seen.colour) & torch.isfinite(seen.depth)[:, None])
    assert all(p.grad is None or torch.all(torch.isfinite(p.grad)) for p in leaves.values())
    assert grad_of(leaves["table"]).abs().sum() > 0


def test_contraction_is_for_the_fast_field():
    with pytest.raises(UsageError, match="contract"):
        configure("plain", "draft", "nerf", contract=True)
