"""MCMC densification: splitting keeps the picture, dead splats move, growth stops at the cap."""

import numpy as np
import pytest
import torch
from splat_params import moments, params, picture

from spikerig.train.densify import copies_scale, jolt, relocate, rotations


def test_one_copy_changes_nothing():
    opacity = torch.tensor([0.01, 0.5, 0.99])
    new, factor = copies_scale(opacity, torch.ones(3, dtype=torch.long))
    assert torch.allclose(new, opacity)
    assert torch.allclose(factor, torch.ones(3))


@pytest.mark.parametrize("copies", [2, 3, 7])
def test_copies_together_are_as_opaque_at_the_centre_and_as_heavy(copies):
    opacity = torch.linspace(0.05, 0.95, 10)
    new, factor = copies_scale(opacity, torch.full((10,), copies))
    assert torch.allclose(1 - (1 - new) ** copies, opacity, atol=1e-6)
    x = torch.linspace(-8, 8, 20001, dtype=torch.float64)
    for o, n, f in zip(opacity.double(), new.double(), factor.double(), strict=True):
        one = (o * torch.exp(-x * x / 2)).sum()
        many = (1 - (1 - n * torch.exp(-x * x / (2 * f * f))) ** copies).sum()
        assert float(many / one) == pytest.approx(1, abs=2e-3)


def test_dead_splats_move_onto_living_ones_and_the_picture_stays():
    p = params(40)
    p["logit_opacities"][30:] = -9.0
    before = picture(p)
    moved, m = relocate(p, moments(p), 40, np.random.default_rng(1))
    assert (torch.sigmoid(moved["logit_opacities"]) > 0.005).all()
    living = p["means"][:30]
    assert all((living == mean).all(1).any() for mean in moved["means"][30:])
    assert (m["means"][0][30:] == 0).all()
    assert (m["means"][0] == 1).any()
    assert float((picture(moved) - before).abs().mean()) < 0.02
    assert torch.equal(p["logit_opacities"][30:], torch.full((10,), -9.0))  # the input is left alone


def test_growth_is_five_per_cent_up_to_the_cap_and_nothing_alive_changes_nothing():
    p = params(100)
    assert len(relocate(p, moments(p), 1000, np.random.default_rng(1))[0]["means"]) == 105
    assert len(relocate(p, moments(p), 103, np.random.default_rng(1))[0]["means"]) == 103
    dead = params(20, opacity=0.001)
    same, _ = relocate(dead, moments(dead), 100, np.random.default_rng(1))
    assert same is dead


def test_noise_moves_faint_splats_and_leaves_opaque_ones():
    p = params(50)
    p["logit_opacities"][:25] = -6.0
    before = p["means"].clone()
    jolt(p, 1.0, np.random.default_rng(1))
    moved = (p["means"] - before).norm(dim=1)
    assert float(moved[:25].min()) > 0
    assert float(moved[25:].max()) < 1e-6


def test_rotations_of_any_quaternion_are_rotations():
    q = torch.cat([params(30)["quats"], torch.zeros(1, 4), torch.full((1, 4), 1e-25)])
    R = rotations(q)
    assert torch.allclose(R @ R.transpose(1, 2), torch.eye(3).expand(32, 3, 3), atol=1e-5)
    assert torch.equal(R[-2], torch.eye(3))
