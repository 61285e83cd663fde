"""Light along rays: samples, weights and their sums. Any dtype and device; float64 is the oracle's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

THICKEST = 80.0  # optical depth of a sample is clamped to it: e^-80 is nothing, and gradients stay finite


@dataclass(frozen=True, slots=True, eq=False)
class Traced:
    """What B rays see: colour [B,3] (sRGB codes), alpha [B], depth [B] = weighted distance (not divided by alpha)."""

    colour: Tensor
    alpha: Tensor
    depth: Tensor


class _Alpha(torch.autograd.Function):
    """1 - e^-x with the gradient e^-x itself: torch's of expm1 is 1 + (e^-x - 1), which is 0 from x = 17 on."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return -torch.expm1(-x)

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        (x,) = ctx.saved_tensors
        return grads[0] * torch.exp(-x)


def weights_of(density: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
    """How much of each sample a ray sees, and how much of what lies behind all of them.

    Args:
        density: [B,N], not negative.
        length: [B,N] of each sample's piece of the ray, not negative.

    Returns:
        (weights [B,N], left [B]); their sum over a ray is 1.

    Edges: density or length 0 gives weight 0 and a finite gradient; a piece of optical depth above 80 is opaque, with
        gradient 0. No division, and no product of (1 - alpha): nothing cancels or underflows into 0 * infinity.
    Source: paper, Eq. 3. Oracle: `ray_oracles.weights_of`.
    """
    thick = (density * length).clamp(max=THICKEST)
    behind = torch.cumsum(thick, -1, dtype=torch.float64)  # 10,000 float32 sums would be off by 1e-4
    before = torch.cat([torch.zeros_like(behind[..., :1]), behind[..., :-1]], -1).to(thick.dtype)
    return torch.exp(-before) * _Alpha.apply(thick), torch.exp(-behind[..., -1]).to(thick.dtype)


def composite(density: Tensor, length: Tensor, distance: Tensor, colour: Tensor, background: Tensor) -> Traced:
    """Colour, alpha and depth of rays from their samples.

    Args:
        density, length, distance: [B,N]: density, length of the piece, distance from the origin.
        colour: [B,N,3].
        background: [3], seen by what light is left.

    Source: paper, Eq. 3.
    """
    weights, left = weights_of(density, length)
    seen = (weights[..., None] * colour).sum(-2) + left[..., None] * background
    return Traced(seen, 1 - left, (weights * distance).sum(-1))


def stratified(near: Tensor, far: Tensor, count: int, draws: Tensor | None) -> tuple[Tensor, Tensor]:
    """One sample in each of `count` equal pieces of every ray.

    Args:
        near, far: [B].
        count: pieces.
        draws: [B,count] in [0, 1): where in its piece; None: the middle.

    Returns:
        (distances [B,count], edges [B,count+1] of the pieces).
    """
    step = torch.arange(count + 1, dtype=near.dtype, device=near.device) / count
    edges = near[:, None] + (far - near)[:, None] * step
    inside = 0.5 if draws is None else draws
    return edges[:, :-1] + (edges[:, 1:] - edges[:, :-1]) * inside, edges


def locate(weights: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """Which piece of a ray the share `at` of its weight ends in, and how far into that piece.

    Args:
        weights: [B,N], not negative; a ray without any weight is treated as if all were equal.
        at: [B,S] in [0, 1].

    Returns:
        (int64[B,S] pieces, [B,S] parts of them in [0, 1]); never inside a piece of weight 0 (save at its ends).

    Edges: no gradient; shares of 0 and 1 give the ends of the pieces that have weight.
    """
    weights, at = weights.detach(), at.contiguous()
    tiny = torch.finfo(weights.dtype).tiny
    total = weights.sum(-1, keepdim=True)
    share = torch.where(total > 0, weights / total.clamp(min=tiny), 1 / weights.shape[-1])
    below = torch.cat([torch.zeros_like(total), torch.cumsum(share, -1)], -1)
    found = torch.searchsorted(below, (at * below[:, -1:]).contiguous(), right=True) - 1
    last = weights.shape[-1] - 1 - torch.argmax((share > 0).flip(-1).to(torch.int8), -1, keepdim=True)
    piece = torch.minimum(found.clamp(min=0), last)
    part = (at * below[:, -1:] - below.gather(-1, piece)) / share.gather(-1, piece).clamp(min=tiny)
    return piece, part.clamp(0, 1)


def inverse_cdf(edges: Tensor, weights: Tensor, at: Tensor) -> Tensor:
    """Where the share `at` of the weight of a ray's pieces lies before.

    Args:
        edges: [B,N+1] of the pieces, ascending.
        weights, at: of `locate`.

    Returns:
        [B,S] distances, ascending in `at`; never inside a piece of weight 0 (save at its ends).
    """
    piece, part = locate(weights, at)
    low, high = edges.gather(-1, piece), edges.gather(-1, piece + 1)
    return low + (high - low) * part
