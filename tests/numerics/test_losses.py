"""Loss terms against float64 definitions, and on hostile inputs."""

import numpy as np
import pytest
import torch

from spikerig import _native
from spikerig.dataset.errors import UsageError
from spikerig.train.losses import (
    DOMAINS,
    average_exposure,
    average_oracle,
    l2_loss,
    light_of,
    linear_from_srgb,
    mean_weights,
    ratio_target,
    srgb_from_linear,
    tfs_loss,
    tfs_oracle,
)

GRAY = (0.31, 0.55, 0.12, 0.01)


def picture(seed: int, h: int = 37, w: int = 53) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    image = rng.uniform(0, 1.2, (h, w, 3))
    image.reshape(-1)[:9] = [0, 1e-8, 0.04045, 0.0404501, 1, 1.5, 0.003, 0.5, 4.0]  # the kink, black, beyond white
    return torch.tensor(image, dtype=torch.float32)


def relative(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a.double() - b.double()).norm() / b.double().norm().clamp(min=1e-300))


@pytest.mark.parametrize("domain", DOMAINS)
def test_tfs_matches_its_definition(isa, domain):
    image, texture = picture(1), picture(2)[..., 0].contiguous()
    mask = torch.rand(texture.shape, generator=torch.Generator().manual_seed(3)) > 0.2
    weight = mean_weights(mask)
    got_image, got_gray = image.clone().requires_grad_(), torch.tensor(GRAY).requires_grad_()
    got = tfs_loss(got_image, texture, weight, got_gray, domain)
    (3 * got).backward()
    exact_image = image.double().requires_grad_()
    exact_gray = torch.tensor(GRAY).double().requires_grad_()
    exact = tfs_oracle(exact_image, texture.double(), weight.double(), exact_gray, domain)
    (3 * exact).backward()
    assert abs(got.item() / exact.item() - 1) < 2e-6
    assert relative(got_image.grad, exact_image.grad) < 3e-6
    assert relative(got_gray.grad, exact_gray.grad) < 3e-6


def test_tfs_oracle_gradient_is_that_of_finite_differences():
    image = torch.tensor(np.random.default_rng(0).uniform(0.06, 0.9, (3, 4, 3)), requires_grad=True)
    texture = torch.rand(3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    weight = torch.full((3, 4), 1 / 12, dtype=torch.float64)
    gray = torch.tensor(GRAY, dtype=torch.float64, requires_grad=True)
    for domain in DOMAINS:
        assert torch.autograd.gradcheck(lambda i, g, d=domain: tfs_oracle(i, texture, weight, g, d), (image, gray))


def test_average_matches_its_definition(isa):
    images = [picture(seed) for seed in range(5)]
    got_in = [i.clone().requires_grad_() for i in images]
    exact_in = [i.double().requires_grad_() for i in images]
    pull = picture(9) - 0.5
    got, exact = average_exposure(got_in), average_oracle(exact_in)
    (got * pull).sum().backward()
    (exact * pull.double()).sum().backward()
    assert relative(got.detach(), exact.detach()) < 5e-7
    for g, e in zip(got_in, exact_in, strict=True):
        assert relative(g.grad, e.grad) < 3e-6


def test_average_with_remembered_light_is_the_average_of_all(isa):
    images = [picture(seed) for seed in range(4)]
    everything = average_exposure(images)
    first = images[0].clone().requires_grad_()
    others = sum(light_of(i) for i in images[1:])
    some = average_exposure([first], others, 4)
    assert relative(some.detach(), everything) < 5e-7
    some.sum().backward()
    leaf = images[0].clone().requires_grad_()
    average_exposure([leaf, *images[1:]]).sum().backward()
    assert relative(first.grad, leaf.grad) < 1e-5


def test_light_of_is_the_curve(isa):
    assert relative(light_of(picture(1)), linear_from_srgb(picture(1).double())) < 1e-6


def test_same_bits_for_any_thread_count():
    image, texture = picture(1, 250, 400), picture(2, 250, 400)[..., 0].contiguous()
    weight, gray = mean_weights(torch.ones_like(texture, dtype=torch.bool)), torch.tensor(GRAY)
    before, found = _native.threads(), set()
    for threads in (1, 2, 3):
        _native.set_threads(threads)
        leaf, k = image.clone().requires_grad_(), gray.clone().requires_grad_()
        loss = tfs_loss(average_exposure([leaf, leaf * 0.5]), texture, weight, k)
        loss.backward()
        found.add((loss.item(), leaf.grad.numpy().tobytes(), k.grad.numpy().tobytes()))
    _native.set_threads(before)
    assert len(found) == 1


def test_masked_pixels_may_hold_anything():
    image, texture = picture(1), picture(2)[..., 0].contiguous()
    mask = torch.ones_like(texture, dtype=torch.bool)
    mask[:5] = False
    spoiled = texture.clone()
    spoiled[:5] = float("nan")
    gray = torch.tensor(GRAY)
    a, b = image.clone().requires_grad_(), image.clone().requires_grad_()
    clean = tfs_loss(a, texture, mean_weights(mask), gray)
    dirty = tfs_loss(b, spoiled, mean_weights(mask), gray)
    clean.backward()
    dirty.backward()
    assert clean.item() == dirty.item()
    assert torch.equal(a.grad, b.grad)
    assert torch.all(b.grad[:5] == 0)


def test_nothing_known_is_a_zero_loss():
    image = picture(1).requires_grad_()
    none = mean_weights(torch.zeros(37, 53, dtype=torch.bool))
    loss = tfs_loss(image, torch.zeros(37, 53), none, torch.tensor(GRAY))
    loss.backward()
    assert loss.item() == 0
    assert torch.all(image.grad == 0)


def test_curves_are_inverse_and_their_gradients_finite_at_black():
    light = torch.cat([torch.zeros(1), torch.logspace(-9, 1, 400)]).double().requires_grad_()
    back = linear_from_srgb(srgb_from_linear(light))
    assert torch.allclose(back, light, rtol=2e-4, atol=0)  # the standard's two branches meet to 1e-7 only
    back.sum().backward()
    assert torch.isfinite(light.grad).all()


def test_a_mean_is_a_mean():
    ones = torch.ones(4, 5, 3)
    assert float(l2_loss(ones, torch.zeros(4, 5, 3))) == pytest.approx(1)
    mask = torch.zeros(4, 5, dtype=torch.bool)
    mask[0, :3] = True
    assert float(l2_loss(ones, torch.zeros(4, 5, 3), mean_weights(mask))) == pytest.approx(1)
    gray = torch.tensor([0.0, 0.0, 0.0, 0.5])
    assert float(tfs_loss(ones, torch.zeros(4, 5), mean_weights(mask), gray, "linear")) == pytest.approx(0.25)


def test_ratio_of_equal_textures_returns_the_frame_and_extremes_are_bounded():
    code = picture(4).clamp(0, 1)
    light = linear_from_srgb(code)
    texture = torch.rand(37, 53, generator=torch.Generator().manual_seed(1))
    known = torch.ones_like(texture, dtype=torch.bool)
    same = ratio_target(light, texture, texture, known, eps=0.01, low=0.15, high=6)
    assert torch.allclose(same, code, atol=2e-5)
    dark = ratio_target(light, torch.zeros_like(texture), texture * 1e6, known, eps=0.01, low=0.15, high=6)
    assert torch.allclose(dark, srgb_from_linear(light * 0.15), atol=1e-6)
    bright = ratio_target(light, texture * 1e6, torch.zeros_like(texture), known, eps=0.01, low=0.15, high=6)
    assert torch.isfinite(bright).all()
    assert float(bright.max()) <= 1
    unknown = ratio_target(light, texture * 1e6, texture, ~known, eps=0.01, low=0.15, high=6)
    assert torch.allclose(unknown, code, atol=2e-5)


def test_wrong_shapes_are_told():
    with pytest.raises(UsageError, match="TfS term needs"):
        tfs_loss(torch.zeros(4, 5, 3), torch.zeros(4, 6), torch.zeros(4, 5), torch.zeros(4))
    with pytest.raises(UsageError, match="one size"):
        average_exposure([torch.zeros(4, 5, 3), torch.zeros(4, 6, 3)])
