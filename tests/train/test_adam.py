"""Adam against torch's, with one rate and with two."""

import pytest
import torch

from spikerig import _native
from spikerig.dataset.errors import UsageError
from spikerig.train.adam import BETA1, BETA2, EPS, update


@pytest.mark.parametrize("isa", _native.isas())
@pytest.mark.parametrize("shape", [(7,), (1000, 3), (333, 16, 3), (0, 3)])
def test_it_is_torchs_adam(isa, shape):
    before = _native.isa()
    _native.set_isa(isa)
    g = torch.Generator().manual_seed(1)
    mine = torch.randn(shape, generator=g).requires_grad_()
    theirs = mine.detach().double().requires_grad_()
    adam = torch.optim.Adam([theirs], lr=0.01, betas=(BETA1, BETA2), eps=EPS)
    moments = torch.zeros(shape), torch.zeros(shape)
    for count in range(1, 30):
        mine.grad = torch.randn(shape, generator=g) * 1e-6
        theirs.grad = mine.grad.double()
        update(mine, moments, count, 0.01)
        adam.step()
    _native.set_isa(before)
    assert torch.allclose(mine.double(), theirs, rtol=1e-5, atol=1e-6)


def test_rows_may_have_two_rates():
    found = {}
    for rest in (0.0, 0.01, None):
        p = torch.ones(50, 4, 3).requires_grad_()
        p.grad = torch.full_like(p, 0.3)
        update(p, (torch.zeros(50, 4, 3), torch.zeros(50, 4, 3)), 1, 0.1, head=3, rest=rest)
        found[rest] = p.detach()
    assert torch.allclose(found[None], torch.tensor(0.9))
    assert torch.allclose(found[0.01][:, 0], torch.tensor(0.9))
    assert torch.allclose(found[0.01][:, 1:], torch.tensor(0.99))
    assert torch.equal(found[0.0][:, 1:], torch.ones(50, 3, 3))


def test_no_gradient_no_step_and_wrong_shapes_are_told():
    p = torch.ones(3).requires_grad_()
    update(p, (torch.zeros(3), torch.zeros(3)), 1, 0.1)
    assert torch.equal(p.detach(), torch.ones(3))
    p.grad = torch.ones(3)
    with pytest.raises(UsageError):
        update(p, (torch.zeros(4), torch.zeros(3)), 1, 0.1)
    with pytest.raises(UsageError):
        update(p, (torch.zeros(3), torch.zeros(3)), 0, 0.1)
