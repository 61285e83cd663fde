"""L1 + SSIM on hard inputs, against float64."""

import numpy as np
import pytest
import torch

from spikerig.train import oracles
from spikerig.train.ssim import l1_ssim, ssim


def pair(height: int, width: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    target = rng.random((height, width, 3))
    image = np.clip(target + 0.1 * rng.standard_normal(target.shape), 0, 1)
    return torch.tensor(image, dtype=torch.float32).requires_grad_(), torch.tensor(target, dtype=torch.float32)


def agree(
    image: torch.Tensor,
    target: torch.Tensor,
    weight: float = 0.2,
    valid: torch.Tensor | None = None,
    relative: float = 1e-5,
) -> None:
    """Value and gradient (L2) within `relative` of float64."""
    double = image.detach().double().requires_grad_()
    true = oracles.l1_ssim(double, target.double(), weight, valid)
    found = l1_ssim(image, target, weight, valid)
    assert float(found.detach()) == pytest.approx(float(true.detach()), rel=relative, abs=1e-6)
    mine, theirs = torch.autograd.grad(found, image)[0], torch.autograd.grad(true, double)[0]
    assert torch.isfinite(mine).all()
    assert float((mine - theirs).norm()) <= relative * float(theirs.norm()) + 1e-12


@pytest.mark.parametrize("masked", [False, True], ids=["all", "masked"])
@pytest.mark.parametrize(
    ("height", "width"), [(1, 1), (1, 40), (40, 1), (5, 3), (11, 11), (32, 16), (33, 17), (70, 65)]
)
def test_agrees_with_float64(height: int, width: int, masked: bool, isa: str) -> None:
    image, target = pair(height, width)
    valid = torch.from_numpy(np.random.default_rng(1).random((height, width)) < 0.7) if masked else None
    for weight in (0.0, 0.2, 1.0):
        agree(image, target, weight, valid)


def test_the_oracle_is_the_formula_at_a_pixel() -> None:
    image, target = (t.detach().double().numpy() for t in pair(16, 18))
    taps = np.exp(-((np.arange(11) - 5) ** 2) / (2 * 1.5**2))
    window = np.outer(taps, taps) / taps.sum() ** 2
    y, x, c = 4, 9, 1  # rows -1..9: one row of the window is outside
    cut = (slice(0, 10), slice(4, 15), c)
    a, b, w = image[cut], target[cut], window[1:]
    ma, mb = (w * a).sum(), (w * b).sum()
    saa, sbb, sab = (w * a * a).sum() - ma**2, (w * b * b).sum() - mb**2, (w * a * b).sum() - ma * mb
    expected = (2 * ma * mb + 1e-4) * (2 * sab + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (saa + sbb + 9e-4))
    found = oracles.ssim_map(torch.from_numpy(image), torch.from_numpy(target))[y, x, c]
    assert float(found) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_constant_pictures(level: float, isa: str) -> None:
    flat = torch.full((40, 30, 3), level, requires_grad=True)
    assert ssim(flat, flat.detach()) == pytest.approx(1, abs=1e-6)
    loss = l1_ssim(flat, flat.detach())
    loss.backward()
    assert float(loss.detach()) == pytest.approx(0, abs=1e-6)
    assert flat.grad is not None
    assert float(flat.grad.abs().max()) < 1e-6
    # E[x^2] - E[x]^2 is off by some roundings of E[x]^2, which stand beside C2 = 9e-4
    lost = 2.0**-24 * (level + 0.1) ** 2 / 9e-4
    agree(torch.full((40, 30, 3), level + 0.1).requires_grad_(), flat.detach(), relative=1e-5 + 4 * lost)


def test_values_outside_the_range(isa: str) -> None:
    image, target = pair(30, 30)
    agree((image.detach() * 50 - 20).requires_grad_(), target)


def test_no_valid_pixel_is_no_loss(isa: str) -> None:
    image, target = pair(20, 20)
    loss = l1_ssim(image, target, valid=torch.zeros(20, 20, dtype=torch.bool))
    loss.backward()
    assert float(loss.detach()) == 0
    assert image.grad is not None
    assert not image.grad.any()


def test_what_is_not_valid_does_not_matter(isa: str) -> None:
    image, target = pair(25, 25)
    valid = torch.from_numpy(np.random.default_rng(2).random((25, 25)) < 0.6)
    noise = torch.from_numpy(np.random.default_rng(3).random((25, 25, 3), dtype=np.float32))
    other = torch.where(valid[..., None], image.detach(), noise * 9).requires_grad_()
    one, two = l1_ssim(image, target, valid=valid), l1_ssim(other, target, valid=valid)
    assert torch.equal(one, two)
    first, second = torch.autograd.grad(one, image)[0], torch.autograd.grad(two, other)[0]
    assert torch.equal(first, second)
    assert not first[~valid].any()


def test_equal_pictures_are_similar_and_opposite_ones_are_not() -> None:
    image, _ = pair(40, 40)
    assert ssim(image.detach(), image.detach()) == pytest.approx(1, abs=1e-6)
    assert ssim(1 - image.detach(), image.detach()) < 0
