"""Rays, samples, weights and the hash grid against float64, and at their limits."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from spikerig import _native
from spikerig.dataset.errors import UsageError
from spikerig.dataset.scene import Camera
from spikerig.train import ray_oracles
from spikerig.train.hashed import EMPTY, density_of, place, refresh, start_hashed, trace_hashed
from spikerig.train.hashgrid import hash_encode, hash_encode_torch, layout_of
from spikerig.train.layers import harmonics, waves
from spikerig.train.methods import configure
from spikerig.train.rays import BOX, Rays, bounds, rays_of
from spikerig.train.volume import composite, inverse_cdf, stratified, weights_of

CAMERA = Camera(np.array([[50.0, 0, 16.5], [0, 60.0, 10], [0, 0, 1]]), np.zeros(0), 32, 20)
LAYOUT = layout_of(5, 4, 64, 9)  # two dense levels, three hashed


def table_of(layout, rng):
    return rng.normal(size=(layout.rows, 2)).astype(np.float32)


def awkward_points(rng):
    """Inside, on vertices and faces of cells, at the ends, beyond them."""
    corners = np.array([[0, 0, 0], [1, 1, 1], [0.5, 0.25, 1], [-0.2, 0.3, 1.7], [1 - 6e-8, 0, 0.5]])
    return np.concatenate([rng.random((40, 3)), corners]).astype(np.float32)


def test_hash_encode_matches_its_definition(isa):
    rng = np.random.default_rng(1)
    table, points = table_of(LAYOUT, rng), awkward_points(rng)
    found = hash_encode(torch.from_numpy(points), torch.from_numpy(table), LAYOUT).numpy()
    truth = ray_oracles.hash_encode(points, table, LAYOUT.table)
    assert np.abs(found - truth).max() < 64 * 3e-7 * np.abs(table).max() * 2  # 64 cells of float32's places


def test_hash_encode_in_torch_is_the_same_function():
    rng = np.random.default_rng(2)
    table, points = table_of(LAYOUT, rng).astype(np.float64), awkward_points(rng).astype(np.float64)
    found = hash_encode_torch(torch.from_numpy(points), torch.from_numpy(table), LAYOUT).numpy()
    assert np.abs(found - ray_oracles.hash_encode(points, table, LAYOUT.table)).max() < 1e-12


def test_the_grids_gradient_matches_torch_in_float64(isa):
    rng = np.random.default_rng(3)
    points, table = torch.from_numpy(awkward_points(rng)), torch.from_numpy(table_of(LAYOUT, rng))
    by = torch.from_numpy(rng.normal(size=(len(points), LAYOUT.width)).astype(np.float32))
    table.requires_grad_()
    hash_encode(points, table, LAYOUT).backward(by)
    wide = table.detach().double().requires_grad_()
    hash_encode_torch(points.double(), wide, LAYOUT).backward(by.double())
    assert table.grad is not None
    assert wide.grad is not None
    assert (table.grad.double() - wide.grad).abs().max() < 2e-4
    untouched = wide.grad == 0
    assert untouched.any()
    assert torch.all(table.grad[untouched] == 0)


def test_the_gradient_of_places_matches_torch_in_float64():
    rng = np.random.default_rng(6)
    points = torch.from_numpy(
        np.concatenate([awkward_points(rng), rng.uniform(-0.2, 1.2, (500, 3))]).astype(np.float32)
    )
    table = torch.from_numpy(table_of(LAYOUT, rng))
    by = torch.from_numpy(rng.normal(size=(len(points), LAYOUT.width)).astype(np.float32))
    points.requires_grad_()
    hash_encode(points, table.clone().requires_grad_(), LAYOUT).backward(by)
    wide = points.detach().double().requires_grad_()
    hash_encode_torch(wide, table.double(), LAYOUT).backward(by.double())
    assert points.grad is not None
    assert wide.grad is not None
    off_faces = torch.ones(len(points), dtype=torch.bool)  # float32 and float64 may put a point into other cells
    for cells in LAYOUT.table[:, 0].tolist():
        at = points.detach().double().clamp(0, 1) * cells
        off_faces &= ((at - at.round()).abs() > 1e-4).all(-1)
    assert off_faces.sum() > 200
    error = (points.grad.double() - wide.grad)[off_faces].abs().max()
    assert error < 1e-5 * wide.grad[off_faces].abs().max()
    outside = (points.detach() < 0) | (points.detach() > 1)
    assert torch.all(points.grad[outside] == 0)
    assert torch.isfinite(points.grad).all()


def test_the_grid_has_the_same_bits_for_any_thread_count():
    rng = np.random.default_rng(4)
    points = torch.from_numpy(rng.random((5000, 3)).astype(np.float32))
    by = torch.from_numpy(rng.normal(size=(5000, LAYOUT.width)).astype(np.float32))
    start, before, seen = table_of(LAYOUT, rng), _native.threads(), set()
    try:
        for count in (1, 2, 3, 5):
            _native.set_threads(count)
            table = torch.from_numpy(start.copy()).requires_grad_()
            out = hash_encode(points, table, LAYOUT)
            out.backward(by)
            assert table.grad is not None
            seen.add((out.detach().numpy().tobytes(), table.grad.numpy().tobytes()))
    finally:
        _native.set_threads(before)
    assert len(seen) == 1


def test_points_that_are_no_numbers_are_the_corner_and_none_are_none():
    table = torch.from_numpy(table_of(LAYOUT, np.random.default_rng(5)))
    bad = torch.tensor([[np.nan, np.nan, np.nan], [np.inf, -np.inf, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    found = hash_encode(bad, table, LAYOUT)
    assert torch.equal(found[0], found[2])
    assert torch.equal(found[1], found[3])
    assert hash_encode(torch.zeros(0, 3), table, LAYOUT).shape == (0, LAYOUT.width)


def test_grids_that_do_not_fit_are_refused():
    table = torch.zeros(LAYOUT.rows + 1, 2)
    with pytest.raises(UsageError, match="its table"):
        hash_encode(torch.zeros(3, 3), table, LAYOUT)
    for wrong in ((0, 4, 8, 9), (30, 4, 8, 9), (4, 8, 4, 9), (4, 4, 8, 40)):
        with pytest.raises(UsageError, match="no such hash grid"):
            layout_of(*wrong)
    levels = LAYOUT.table.copy()
    levels[3, 2] += 1
    with pytest.raises(ValueError, match="level"):
        _native.hash_encode(levels, np.zeros((1, 3), np.float32), table.numpy()[:-1], np.zeros((1, 10), np.float32))


def test_weights_match_eq_3_sample_by_sample():
    rng = np.random.default_rng(6)
    density, length = rng.gamma(0.3, 30, (50, 40)), rng.random((50, 40)) * 0.1
    truth, rest = ray_oracles.weights_of(density, length)
    for kind, most in ((torch.float64, 1e-14), (torch.float32, 2e-6)):
        weights, left = weights_of(torch.tensor(density, dtype=kind), torch.tensor(length, dtype=kind))
        assert np.abs(weights.numpy() - truth).max() < most
        assert np.abs(left.numpy() - rest).max() < most


@pytest.mark.parametrize("count", [1, 10_000])
@pytest.mark.parametrize("density", [0.0, 1e-30, 1e-7, 1.0, 1e6, 3e38])
def test_weights_at_their_limits_sum_to_one_with_finite_gradients(count, density):
    density = torch.full((1, count), density, requires_grad=True)
    weights, left = weights_of(density, torch.full((1, count), 2.0 / count))
    assert abs((weights.double().sum() + left).item() - 1) < 1e-6
    (weights * torch.linspace(-1, 1, count)).sum().backward()
    assert torch.isfinite(weights).all()
    assert density.grad is not None
    assert torch.isfinite(density.grad).all()


def test_a_thin_samples_weight_is_exact_to_float32():
    thin = torch.logspace(-12, 1, 50, dtype=torch.float64)
    weights, _ = weights_of(thin.float()[:, None], torch.ones(50, 1))
    exact = -torch.expm1(-thin.float().double())
    assert ((weights[:, 0].double() - exact) / exact).abs().max() < 2e-7


@pytest.mark.parametrize("scale", [0.0, 1.0, 60.0])
def test_gradients_of_composite(scale):
    rng = np.random.default_rng(7)
    density = torch.tensor(rng.random((2, 5)) * scale + 1e-3, requires_grad=True)
    length = torch.tensor(rng.random((2, 5)) * 0.3)
    colour = torch.tensor(rng.random((2, 5, 3)), requires_grad=True)
    behind = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)

    def seen(d, c):
        out = composite(d, length, torch.cumsum(length, -1), c, behind)
        return out.colour, out.alpha, out.depth

    assert gradcheck(seen, (density, colour))


def test_composite_of_nothing_is_the_background_and_of_a_wall_its_colour():
    colour, behind = torch.full((1, 3, 3), 0.25), torch.tensor([0.1, 0.2, 0.3])
    distance, length = torch.tensor([[1.0, 2.0, 3.0]]), torch.ones(1, 3)
    nothing = composite(torch.zeros(1, 3), length, distance, colour, behind)
    assert torch.equal(nothing.colour[0], behind)
    assert nothing.alpha.item() == 0
    wall = composite(torch.tensor([[0.0, 1e9, 1e9]]), length, distance, colour, behind)
    assert torch.allclose(wall.colour, torch.full((1, 3), 0.25))
    assert (wall.alpha.item(), wall.depth.item()) == (1, 2)


def test_samples_follow_the_weight_and_avoid_the_empty():
    edges = torch.linspace(0, 1, 5)[None]
    at = ((torch.arange(1000) + 0.5) / 1000)[None]
    found = inverse_cdf(edges, torch.tensor([[0.0, 3.0, 0.0, 1.0]]), at)[0]
    assert torch.all(torch.diff(found) >= 0)
    inside = [((found >= a) & (found <= a + 0.25)).sum().item() for a in (0.25, 0.75)]
    assert inside == [750, 250]
    ends = inverse_cdf(edges, torch.tensor([[0.0, 3.0, 0.0, 0.0]]), torch.tensor([[0.0, 1.0]]))
    assert ends.tolist() == [[0.25, 0.5]]


@pytest.mark.parametrize("weights", [[0.0, 0.0, 0.0], [1e-38, 1e-38, 1e-38], [1e38, 1e38, 1e38]])
def test_samples_of_weights_without_shape_are_even(weights):
    found = inverse_cdf(torch.linspace(0, 3, 4)[None], torch.tensor([weights]), torch.tensor([[0.0, 0.25, 0.5, 1.0]]))
    assert torch.allclose(found, torch.tensor([[0.0, 0.75, 1.5, 3.0]]), atol=1e-5)


def test_strata_hold_one_sample_each():
    near, far = torch.tensor([0.5, 2.0]), torch.tensor([1.5, 2.0])
    draws = torch.rand(2, 16, generator=torch.Generator().manual_seed(0))
    distance, edges = stratified(near, far, 16, draws)
    assert torch.all((distance >= edges[:, :-1]) & (distance <= edges[:, 1:]))
    assert torch.all(distance[1] == 2.0)
    assert stratified(near, far, 1, None)[0].tolist() == [[1.0], [2.0]]


def test_a_ray_goes_through_the_centre_of_its_pixel():
    rng = np.random.default_rng(8)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    pose = torch.tensor(np.concatenate([turn, rng.normal(size=(3, 1))], 1))
    pixels = torch.tensor([0, 31, 33, 19 * 32 + 31])
    for poses in (pose, pose.expand(4, 3, 4)):
        rays = rays_of(CAMERA, poses, pixels)
        points = rays.origins + 3 * rays.directions
        seen = points @ pose[:, :3].T + pose[:, 3]
        x, y = (seen[:, k] / seen[:, 2] * CAMERA.K[k, k] + CAMERA.K[k, 2] for k in (0, 1))
        assert torch.allclose(x, (pixels % 32).double() + 0.5)
        assert torch.allclose(y, (pixels // 32).double() + 0.5)
        assert torch.allclose(seen[:, 2], 3 * rays.forward)
    with pytest.raises(UsageError, match="a pose"):
        rays_of(CAMERA, pose.expand(3, 3, 4), pixels)


def test_a_ray_that_misses_the_box_or_runs_along_an_axis():
    origins = torch.tensor([[0.0, 0, -3], [0, 0, 0], [0, 5, 0], [0, 0, 9]])
    directions = torch.tensor([[0.0, 0, 1], [1, 0, 0], [1, 0, 0], [0, 0, 1]])
    near, far = bounds(Rays(origins, directions, torch.ones(4)), 1.0, 0.25)
    assert near[:2].tolist() == [2, 0.25]
    assert far[:2].tolist() == [4, 1]
    assert torch.equal(near[2:], far[2:])
    assert torch.isfinite(far).all()


def test_waves_and_harmonics():
    x = torch.tensor([[0.25, -0.5, 1.0]], dtype=torch.float64)
    found = waves(x, 2)
    assert found.shape == (1, 15)
    assert torch.allclose(found[:, 3:6], torch.sin(torch.pi * x))
    assert torch.allclose(found[:, 12:], torch.cos(2 * torch.pi * x))
    way = torch.nn.functional.normalize(torch.randn(20_000, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    for degree in range(4):
        rows = harmonics(way, degree)
        assert rows.shape[1] == (degree + 1) ** 2
        mixed = rows.T @ rows / len(way)
        off = mixed - torch.diag(torch.diag(mixed))
        assert off.abs().max() < 0.06  # orthogonal on the sphere, to the noise of 20,000 draws


FAST = configure("plain", "draft", "nerf-fast", coarse=32, fine=16, width=8, grid_levels=3, finest=32, table_log2=9,
                 occupancy=16)  # fmt: skip
BEHIND = torch.tensor([0.1, 0.2, 0.3])


def measured(grids, rays, draws):
    """(distance, length) of samples placed by the occupancy grid."""
    pieces = place(grids["occupancy"], FAST, rays, draws, FAST.fine)
    return pieces.distance, pieces.length


def some_rays(count=64):
    pose = torch.tensor([[1.0, 0, 0, 0.1], [0, 1, 0, -0.1], [0, 0, 1, 0.9]])
    return rays_of(CAMERA, pose, torch.arange(count) * 9)


@pytest.mark.parametrize("rng", [None, 0])
def test_an_empty_grid_shows_the_background_with_no_gradient(rng):
    params, grids = start_hashed(FAST)
    grids["occupancy"].zero_()
    leaves = {name: p.requires_grad_() for name, p in params.items()}
    draws = None if rng is None else np.random.default_rng(rng)
    (seen,) = trace_hashed(leaves, grids, FAST, some_rays(), BEHIND, draws)
    assert torch.equal(seen.colour, BEHIND.expand(64, 3))
    seen.colour.sum().backward()
    assert all(torch.all(p.grad == 0) for p in leaves.values() if p.grad is not None)


def test_samples_stay_in_the_one_full_cell_and_stand_for_its_length():
    rays, (_, grids) = some_rays(), start_hashed(FAST)
    grids["occupancy"].zero_()
    grids["occupancy"][8, 8, 8] = 5.0
    low = 8 * (2 * BOX / 16) - BOX
    for draws in (None, np.random.default_rng(3)):
        distance, length = measured(grids, rays, draws)
        hit = length.sum(-1) > 0
        assert 0 < hit.sum() < len(rays)
        near, far = bounds(rays)
        step = ((far - near) / FAST.coarse)[hit]
        points = (rays.origins[:, None] + rays.directions[:, None] * distance[..., None])[hit]
        slack = step[:, None, None] + 1e-4  # a looked-up place speaks for its whole piece of the ray
        assert torch.all((points > low - slack) & (points < low + 2 * BOX / 16 + slack))
        assert torch.all(length[hit].sum(-1) <= far[hit] - near[hit] + 1e-4)


def test_a_full_grid_leaves_no_length_out():
    rays, (_, grids) = some_rays(), start_hashed(FAST)
    near, far = bounds(rays)
    for draws in (None, np.random.default_rng(4)):
        distance, length = measured(grids, rays, draws)
        assert torch.allclose(length.sum(-1), far - near, atol=1e-5)
        assert torch.all(torch.diff(distance) >= 0)


def test_the_grid_forgets_what_has_gone_and_finds_what_has_come():
    from spikerig.train.field import Step

    params, grids = start_hashed(FAST)
    gone = {**params, "density/2/bias": params["density/2/bias"] - 5}
    for number in range(8 * 16 * 8):  # each cell is visited eight times, and fades by 0.6 at each
        refresh(gone, grids, FAST, Step(number, 0.0, (0.0, 0.0, 0.0), np.random.default_rng(number)))
    assert grids["occupancy"].max() < EMPTY
    for number in range(8 * 16):
        refresh(params, grids, FAST, Step(number, 0.0, (0.0, 0.0, 0.0), np.random.default_rng(number)))
    assert grids["occupancy"].min() > EMPTY


def test_a_density_beyond_all_bounds_is_finite_and_can_come_back():
    params, _ = start_hashed(FAST)
    params["density/2/bias"] = torch.full((16,), 500.0, requires_grad=True)
    density, _ = density_of(params, FAST, torch.zeros(1, 3))
    assert torch.isfinite(density).all()
    density.sum().backward()
    grad = params["density/2/bias"].grad
    assert grad is not None
    assert grad[0] > 0
    assert torch.isfinite(grad).all()


def test_gradients_of_the_fast_field():
    """Without probes: where samples lie follows the densities too, and that has no gradient by design."""
    rng = np.random.default_rng(9)
    params, grids = start_hashed(FAST)
    wide = {name: p.double() + torch.from_numpy(rng.normal(0, 0.1, p.shape)) for name, p in params.items()}
    thin = rays_of(CAMERA, torch.tensor([[1.0, 0, 0, 0.1], [0, 1, 0, -0.1], [0, 0, 1, 0.9]]).double(),
                   torch.tensor([100, 330]))  # fmt: skip
    names = [name for name in params if name != "table"]

    def seen(*values):
        given = {"table": wide["table"], **dict(zip(names, values, strict=True))}
        (out,) = trace_hashed(given, grids, replace(FAST, probes=0), thin, BEHIND.double(), None)
        return out.colour, out.alpha, out.depth

    assert gradcheck(seen, tuple(wide[name].requires_grad_() for name in names), atol=1e-6, fast_mode=True)
