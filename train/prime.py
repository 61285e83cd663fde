"""The fast field before its first step: taught the scene's sparse points, as splats are put on them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from spikerig.train.adam import update
from spikerig.train.config import FitConfig
from spikerig.train.hashed import cells_of, colour_of, density_in, unit
from spikerig.train.rays import BOX

if TYPE_CHECKING:
    from spikerig.train.field import Tensors

STEPS, BATCH = 100, 4096  # half of a batch are points, half places anywhere
SOLID, THIN = 4.5, -4.0  # log density at points, and away from them
THERE, UNKNOWN = 90.0, 0.6  # density that the occupancy grid holds near points, and elsewhere: not empty at first
COLOUR = 10.0  # weight of a squared colour error beside one of log density


def prime(params: Tensors, grids: Tensors, xyz: NDArray, rgb: NDArray, config: FitConfig) -> None:
    """Fit the networks to points: dense and coloured where they are, thin elsewhere; mark their cells. In place.

    Args:
        params, grids: of `start_hashed`.
        xyz: [N,3] in the gauge; those outside the box are left out (with `contract` there are none).
        rgb: [N,3] sRGB codes in [0, 1].
        config: of the fit.

    Edges: no point in the box changes nothing. Away from points rays look too, until a visit (within 128 steps) finds
        nothing dense there.
    Cost: 0.7 CPU-s at draft. Draws come from the seed: the same bits for any thread count.
    """
    inside = np.isfinite(xyz).all(1) if config.contract else (np.abs(xyz) <= BOX).all(1)
    points, colours = (torch.from_numpy(np.ascontiguousarray(a[inside], np.float32)) for a in (xyz, rgb))
    if len(points) == 0:
        return
    points = unit(points, config)
    near = _near(points, config.occupancy)
    grids["occupancy"].reshape(-1)[:] = torch.where(near, THERE, UNKNOWN)
    rng = np.random.default_rng((config.seed, 4))
    leaves = {name: p.detach().requires_grad_() for name, p in params.items()}  # the same memory
    moments = {name: (torch.zeros_like(p), torch.zeros_like(p)) for name, p in params.items()}
    for count in range(1, STEPS + 1):
        loss = _loss(leaves, config, points, colours, near, rng)
        for p in leaves.values():
            p.grad = None
        loss.backward()
        for name, p in leaves.items():
            update(p, moments[name], count, config.lr_grid if name == "table" else config.lr_net)


def _near(points: Tensor, side: int) -> Tensor:
    """Which cells [side^3] hold a point of the unit cube or touch one that does."""
    there = torch.zeros(side**3)
    there[cells_of(points, side)] = 1
    return functional.max_pool3d(there.reshape(1, 1, side, side, side), 3, 1, 1).reshape(-1) > 0


def _loss(
    params: Tensors, config: FitConfig, points: Tensor, colours: Tensor, near: Tensor, rng: np.random.Generator
) -> Tensor:
    half = BATCH // 2
    chosen = torch.from_numpy(rng.integers(len(points), size=half))
    anywhere = torch.from_numpy(rng.random((half, 3), np.float32))
    ways = functional.normalize(torch.from_numpy(rng.normal(size=(half, 3)).astype(np.float32)), dim=-1)
    counts = torch.cat([torch.ones(half, dtype=torch.bool), ~near[cells_of(anywhere, config.occupancy)]])
    density, geometry = density_in(params, config, torch.cat([points[chosen], anywhere]))
    wanted = torch.cat([torch.full((half,), SOLID), torch.full((half,), THIN)])
    off = torch.where(counts, torch.log(density.clamp(min=1e-9)) - wanted, 0.0)
    colour = colour_of(params, config, geometry[:half], ways)
    return (off * off).mean() + COLOUR * ((colour - colours[chosen]) ** 2).mean()
