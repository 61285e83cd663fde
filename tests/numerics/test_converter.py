"""The learned gray converter: held ones cannot raise contrast, curves stay monotone, gradients are those of float64."""

import numpy as np
import pytest
import torch

from spikerig.train.converter import LEARNED, SEGMENTS, converter, respond, start_converter
from spikerig.train.losses import gray_of, srgb_from_linear, tfs_oracle

FROZEN = torch.tensor([0.299, 0.587, 0.114, 0.01])


@pytest.mark.parametrize("kind", LEARNED)
def test_at_its_start_a_learned_converter_is_the_frozen_one(kind):
    gray, heights = converter(kind, start_converter(kind, FROZEN), FROZEN)
    assert torch.allclose(gray, FROZEN, atol=1e-6)
    if heights is not None:
        codes = torch.linspace(-0.5, 1.5, 41)
        assert torch.allclose(respond(codes, heights), codes, atol=1e-6)


def test_a_weight_of_nothing_can_still_grow():
    raw = start_converter("constrained", torch.tensor([0.0, 1.0, -0.1, 0.0])).requires_grad_()
    gray, _ = converter("constrained", raw, torch.tensor([0.0, 1.0, -0.1, 0.0]))
    gray[0].backward()
    assert torch.isfinite(raw).all()
    assert raw.grad is not None
    assert raw.grad[0] > 0


@pytest.mark.parametrize("scale", [1.0, 30.0, 1e4])
def test_held_converters_keep_their_sum_and_curves_their_order(scale):
    rng = np.random.default_rng(0)
    for _ in range(20):
        raw = torch.tensor(rng.normal(0, scale, 3 + SEGMENTS), dtype=torch.float32, requires_grad=True)
        gray, heights = converter("response", raw, FROZEN)
        assert heights is not None
        assert gray[:3].sum().item() == pytest.approx(1.0, abs=1e-6)
        assert gray[3] == FROZEN[3]
        assert (gray[:3] >= 0).all()
        assert (torch.diff(heights) >= 0).all()
        assert (heights[0].item(), heights[-1].item()) == pytest.approx((0.0, 1.0), abs=1e-6)
        (respond(torch.linspace(-1, 2, 50), heights).square().sum() + gray.square().sum()).backward()
        assert raw.grad is not None
        assert torch.isfinite(raw.grad).all()


def test_the_free_one_can_raise_contrast_and_the_held_ones_cannot():
    raw = torch.tensor([0.6, 1.2, 0.2, -0.3])
    assert converter("learned", raw, FROZEN)[0][:3].sum() == pytest.approx(2.0)
    held = torch.log(torch.tensor([60.0, 120.0, 20.0]))
    assert converter("constrained", held, FROZEN)[0][:3].sum() == pytest.approx(1.0)


def test_gradients_are_those_of_finite_differences_on_both_sides_of_a_knot():
    raw = torch.tensor(np.random.default_rng(1).normal(0, 0.7, 3 + SEGMENTS), requires_grad=True)
    frozen = FROZEN.double()

    def curve(gray, raw):
        heights = converter("response", raw, frozen)[1]
        assert heights is not None
        return respond(gray, heights)

    for knot in (0.0, 1 / SEGMENTS, 0.5, 1.0):
        gray = torch.tensor([knot - 1e-3, knot + 1e-3], dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(curve, (gray, raw), eps=1e-7)
    at = torch.tensor([0.5], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(curve(at, raw).sum(), at)
    heights = converter("response", raw, frozen)[1]
    assert heights is not None
    left, right = (SEGMENTS * (heights[k + 1] - heights[k]) for k in (3, 4))
    assert min(left, right) <= slope <= max(left, right)  # at the knot itself: one of its two sides


def test_a_bent_response_and_its_weights_are_found_again():
    """A camera with other weights that answers as light^1.25: what is learned is that curve, to 1 %."""
    rng = np.random.default_rng(2)
    image = torch.tensor(rng.uniform(0.02, 0.98, (60, 80, 3)), dtype=torch.float32)
    true = torch.tensor([0.2, 0.45, 0.35, 0.0])
    texture = gray_of(image, true, "encoded") ** 1.25
    weight = torch.full((60, 80), 1 / 4800)
    start = torch.tensor([0.299, 0.587, 0.114, 0.0])
    raw = start_converter("response", start).requires_grad_()
    optimiser = torch.optim.Adam([raw], lr=0.02)
    for _ in range(400):
        optimiser.zero_grad()
        gray, heights = converter("response", raw, start)
        tfs_oracle(image, texture, weight, gray, "encoded", heights).backward()
        optimiser.step()
    gray, heights = converter("response", raw.detach(), start)
    assert heights is not None
    assert torch.allclose(gray, true, atol=0.01)
    codes = torch.linspace(0.3, 0.95, 30)
    assert torch.allclose(respond(codes, heights), codes**1.25, atol=0.01)
    straight = tfs_oracle(image, texture, weight, true)
    assert tfs_oracle(image, texture, weight, gray, "encoded", heights) < 0.02 * straight
    assert srgb_from_linear(torch.tensor(1.0)) == pytest.approx(1.0)
