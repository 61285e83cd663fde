"""Putting splats where they are needed: MCMC (Kheradmand et al. 2024), relocation, growth and noise (Kerbl's: grow.py).

Off by default for short runs, where it hardly matters. All draws come from (seed, step), so a resumed run repeats them.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

DEAD = 0.005  # opacity below which a splat is moved elsewhere
GROWTH = 1.05
MOST_COPIES = 51


def copies_scale(opacity: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """New opacity and scale factor of a splat that is replaced by `copies` equal ones at its place.

    Args:
        opacity: [N] in (0, 1).
        copies: int[N], 1..51, the original included.

    Returns:
        (opacity [N], factor [N]) such that the picture stays nearly the same; copies = 1 changes nothing.

    Source: 3DGS as MCMC, Eq. 9.
    """
    o = opacity.double()
    n = copies.double()
    new = 1 - (1 - o) ** (1 / n)
    below = torch.zeros_like(o)
    for i in range(1, int(copies.max()) + 1):
        for k in range(i):
            term = math.comb(i - 1, k) * (-1.0) ** k / math.sqrt(k + 1) * new ** (k + 1)
            below += torch.where(n >= i, term, 0.0)
    return new.float(), (o / below).float()


def relocate(
    params: dict[str, Tensor], moments: dict[str, tuple[Tensor, Tensor]], cap: int, rng: np.random.Generator
) -> tuple[dict[str, Tensor], dict[str, tuple[Tensor, Tensor]]]:
    """Move dead splats onto living ones (drawn by opacity) and grow by 5 % up to `cap`.

    Args:
        params: the five tensors of Splats by name.
        moments: Adam's two moments a tensor; zero for moved and new splats.
        cap: largest number of splats.
        rng: draws.

    Returns:
        New params and moments (may be longer); the inputs are left as they are.

    Edges: with nothing alive, nothing changes.
    """
    opacity = torch.sigmoid(params["logit_opacities"])
    alive = torch.nonzero(opacity > DEAD).flatten()
    dead = torch.nonzero(opacity <= DEAD).flatten()
    n = len(opacity)
    new = max(0, min(cap, int(n * GROWTH)) - n)
    if len(alive) == 0 or len(dead) + new == 0:
        return params, moments
    weight = opacity[alive].double().numpy()
    source = alive[torch.from_numpy(rng.choice(len(alive), len(dead) + new, p=weight / weight.sum()))]
    copies = (torch.bincount(source, minlength=n) + 1).clamp(max=MOST_COPIES)
    made_opacity, factor = copies_scale(opacity, copies)
    shared = {name: p.detach().clone() for name, p in params.items()}
    hit = copies > 1
    bounded = made_opacity.clamp(DEAD, 1 - 1e-6)
    shared["logit_opacities"][hit] = torch.logit(bounded)[hit]
    shared["log_scales"][hit] += torch.log(factor)[hit, None]
    to = torch.cat([dead, torch.arange(n, n + new)])
    out, out_moments = {}, {}
    for name, p in shared.items():
        longer = torch.cat([p, p.new_zeros((new, *p.shape[1:]))])
        longer[to] = p[source]
        out[name] = longer
        out_moments[name] = tuple(
            torch.cat([m.detach().clone(), m.new_zeros((new, *m.shape[1:]))]) for m in moments[name]
        )
        for m in out_moments[name]:
            m[to] = 0
            m[source] = 0
    return out, out_moments  # type: ignore[return-value]


def jolt(params: dict[str, Tensor], rate: float, rng: np.random.Generator) -> None:
    """Shake the centres of faint splats along their own shape, in place, so that they explore.

    Args:
        params: the five tensors.
        rate: noise strength times the position learning rate.
        rng: draws.

    Source: 3DGS as MCMC, Eq. 8 (sigmoid gate at opacity 0.005, steepness 100).
    """
    with torch.no_grad():
        opacity = torch.sigmoid(params["logit_opacities"])
        gate = torch.sigmoid(-100 * (opacity - DEAD)) * rate
        noise = torch.from_numpy(rng.standard_normal((len(opacity), 3)).astype(np.float32))
        R = rotations(params["quats"])
        variance = torch.exp(2 * params["log_scales"])
        inside = (R * noise[:, :, None]).sum(1) * variance  # R^T noise, scaled
        params["means"] += (R * inside[:, None, :]).sum(2) * gate[:, None]


def rotations(quats: Tensor) -> Tensor:
    """[N,3,3] of quaternions [N,4] wxyz, any length; zero gives no rotation."""
    length = quats.norm(dim=1, keepdim=True)
    identity = torch.tensor([1.0, 0, 0, 0], dtype=quats.dtype)
    w, x, y, z = torch.where(length > 0, quats / length.clamp(min=1e-20), identity).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, 1).reshape(-1, 3, 3)
