"""Adam on CPU tensors, in place: one native kernel, one rate for the leading columns and one for the others."""

from __future__ import annotations

import torch
from torch import Tensor

from spikerig import _native
from spikerig.dataset.errors import UsageError

BETA1, BETA2, EPS = 0.9, 0.999, 1e-15  # eps as the 3DGS code has it: gradients of means over pixels are tiny


def update(
    param: Tensor, moments: tuple[Tensor, Tensor], count: int, rate: float, *, head: int = 0, rest: float | None = None
) -> None:
    """One step of Adam on a leaf tensor by its `.grad`, in place.

    Args:
        param: float32 on the CPU, contiguous; no gradient means no step.
        moments: running means of the gradient and its square, the tensor's shape, changed in place.
        count: number of this step, from 1.
        rate: learning rate.
        head: with `rest`, only so many leading numbers of each row (first axis) get `rate`.
        rest: learning rate of the other numbers of a row.

    Raises:
        UsageError: a shape, type or count that does not fit.

    Source: Kingma and Ba 2015, with bias correction. Oracle: torch.optim.Adam (tests).
    """
    if param.grad is None:
        return
    fits = all(t.shape == param.shape and t.dtype == torch.float32 and t.is_contiguous() for t in (param, *moments))
    if not fits or count < 1:
        raise UsageError("Adam needs float32 tensors of one shape and steps from 1", value=(tuple(param.shape), count))
    columns = max(1, param[0].numel()) if param.ndim > 1 and len(param) else 1
    _native.adam(
        param=param.detach().numpy(),
        grad=param.grad.contiguous().numpy(),
        mean=moments[0].numpy(),
        square=moments[1].numpy(),
        columns=columns,
        head=columns if rest is None else min(head, columns),
        count=count,
        rate_head=rate,
        rate_rest=rate if rest is None else rest,
        beta1=BETA1,
        beta2=BETA2,
        eps=EPS,
    )
