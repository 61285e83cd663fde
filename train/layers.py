"""Small dense networks as plain tensors by name, and the encodings in front of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

if TYPE_CHECKING:
    from spikerig.train.field import Tensors


def new_layer(name: str, inputs: int, outputs: int, rng: np.random.Generator, gain: float = math.sqrt(2)) -> Tensors:
    """Weights [outputs, inputs] uniform with variance gain^2 / inputs (He et al. 2015), biases 0; float32."""
    reach = gain * math.sqrt(3 / inputs)
    weight = torch.from_numpy(rng.uniform(-reach, reach, (outputs, inputs)).astype(np.float32))
    return {f"{name}/weight": weight, f"{name}/bias": torch.zeros(outputs)}


def dense(params: Tensors, name: str, x: Tensor) -> Tensor:
    """One layer, without its activation."""
    return functional.linear(x, params[f"{name}/weight"], params[f"{name}/bias"])


def chain(params: Tensors, names: Sequence[str], x: Tensor) -> Tensor:
    """Layers in turn with ReLU between them (none after the last)."""
    for name in names[:-1]:
        x = torch.relu(dense(params, name, x))
    return dense(params, names[-1], x)


def waves(x: Tensor, count: int) -> Tensor:
    """[..., D] as [..., D (1 + 2 count)]: itself, then sines and cosines of 2^k pi x, k < count.

    Source: Mildenhall et al. 2020, Eq. 4, with the coordinates themselves beside them as all code has it.
    """
    turns = torch.pi * 2.0 ** torch.arange(count, dtype=x.dtype, device=x.device)
    angle = (x[..., None, :] * turns[:, None]).flatten(-2)
    return torch.cat([x, torch.sin(angle), torch.cos(angle)], -1)


def harmonics(d: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics [..., (degree+1)^2] of unit directions [...,3], without their constants; degree <= 3."""
    x, y, z = d[..., 0], d[..., 1], d[..., 2]
    rows = [torch.ones_like(x)]
    if degree > 0:
        rows += [y, z, x]
    if degree > 1:
        rows += [x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y]
    if degree > 2:
        rows += [
            y * (3 * x * x - y * y), x * y * z, y * (5 * z * z - 1), z * (5 * z * z - 3), x * (5 * z * z - 1),
            z * (x * x - y * y), x * (x * x - 3 * y * y),
        ]  # fmt: skip
    return torch.stack(rows, -1)
