"""Unbounded space in a ball of radius 2: what is near stays as it is, what is far is drawn in, infinity is the rim."""

from __future__ import annotations

import torch
from torch import Tensor

HUGE = 1e18  # coordinates beyond are taken to be there: their squares are finite in float32


def contract(x: Tensor) -> Tensor:
    """x inside the unit ball, (2 - 1/|x|) x/|x| outside.

    Args:
        x: [...,3], any finite or infinite numbers.

    Returns:
        [...,3] of length below 2 (2 at infinity); continuous with its first derivative.

    Edges: 0 is 0 with gradient 1: nothing is divided by the length there. Infinite coordinates are the direction they
        point in, with gradient 0; NaN stays NaN.
    Source: Barron et al. 2022 (mip-NeRF 360), Eq. 10. Oracle: `ray_oracles.contract`, `contract_jacobian`.
    """
    x = x.clamp(-HUGE, HUGE)
    square = (x * x).sum(-1, keepdim=True)
    outside = square > 1
    length = torch.where(outside, square, 1.0).sqrt()
    return torch.where(outside, (2 - 1 / length) / length * x, x)


def distance_of(s: Tensor) -> Tensor:
    """Distance along a ray of its contracted distance s in [0, 2): s up to 1, 1 / (2 - s) beyond."""
    return torch.where(s <= 1, s, 1 / (2 - s.clamp(min=1)).clamp(min=1e-6))
