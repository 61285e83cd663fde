"""The paper's NeRF: a coarse and a fine network of 8 layers, samples of the second where the first sees something."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from spikerig.train.config import FitConfig
from spikerig.train.layers import dense, new_layer, waves
from spikerig.train.rays import BOX, Rays, bounds
from spikerig.train.volume import Traced, composite, inverse_cdf, stratified, weights_of

if TYPE_CHECKING:
    from spikerig.train.field import Tensors

DEPTH, SKIP = 8, 5  # layers, and the one (from 1) beside whose output the coordinates are handed on again
PLACE_WAVES, VIEW_WAVES = 10, 4


def start_vanilla(config: FitConfig) -> tuple[Tensors, Tensors]:
    """Random parameters of both networks, no grids."""
    rng = np.random.default_rng((config.seed, 1))
    params: Tensors = {}
    place, view, wide = 3 * (1 + 2 * PLACE_WAVES), 3 * (1 + 2 * VIEW_WAVES), config.width
    for net in ("coarse", "fine"):
        for k in range(1, DEPTH + 1):
            inputs = place if k == 1 else wide + place if k == SKIP + 1 else wide
            params |= new_layer(f"{net}/{k}", inputs, wide, rng)
        params |= new_layer(f"{net}/density", wide, 1, rng, 1.0)
        params |= new_layer(f"{net}/feature", wide, wide, rng, 1.0)
        params |= new_layer(f"{net}/view", wide + view, max(wide // 2, 1), rng)
        params |= new_layer(f"{net}/colour", max(wide // 2, 1), 3, rng, 1.0)
    return params, {}


def network(params: Tensors, net: str, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Density [N] and colour [N,3] at points [N,3] of the gauge, seen along unit directions [N,3].

    Edges: density is softplus(x - 1) where the paper has ReLU, whose all-zero starts never recover; colour a sigmoid.
    Source: paper, Eq. 1.
    """
    place = waves(points / BOX, PLACE_WAVES)
    x = place
    for k in range(1, DEPTH + 1):
        if k == SKIP + 1:
            x = torch.cat([place, x], -1)
        x = torch.relu(dense(params, f"{net}/{k}", x))
    density = functional.softplus(dense(params, f"{net}/density", x)[:, 0] - 1)
    feature = torch.cat([dense(params, f"{net}/feature", x), waves(directions, VIEW_WAVES)], -1)
    return density, torch.sigmoid(dense(params, f"{net}/colour", torch.relu(dense(params, f"{net}/view", feature))))


def trace_vanilla(
    params: Tensors, config: FitConfig, rays: Rays, background: Tensor, rng: np.random.Generator | None
) -> list[Traced]:
    """What rays see, by the coarse and by the fine network.

    Args:
        params: of both.
        config: coarse, fine: numbers of samples.
        rays: B of the gauge.
        background: [3].
        rng: where in their pieces samples lie; None: in the middle.

    Source: Mildenhall et al. 2020, section 5.2; the last piece ends where the ray leaves the box.
    """
    near, far = bounds(rays)
    distance, edges = stratified(near, far, config.coarse, _draws(rng, len(rays), config.coarse, near))
    density, colour = _at(params, "coarse", rays, distance)
    length = edges[:, 1:] - edges[:, :-1]
    coarse = composite(density, length, distance, colour, background)
    weights, _ = weights_of(density.detach(), length)
    draws = _draws(rng, len(rays), config.fine, near)
    where = (torch.arange(config.fine, device=near.device) + (0.5 if draws is None else draws)) / config.fine
    more = inverse_cdf(edges, weights + 1e-5, where.expand(len(rays), -1))
    distance = torch.sort(torch.cat([distance, more], -1), -1).values
    density, colour = _at(params, "fine", rays, distance)
    length = torch.diff(torch.cat([distance, far[:, None]], -1)).clamp(min=0)
    return [coarse, composite(density, length, distance, colour, background)]


def _draws(rng: np.random.Generator | None, rays: int, count: int, like: Tensor) -> Tensor | None:
    return None if rng is None else torch.from_numpy(rng.random((rays, count), np.float32)).to(like)


def _at(params: Tensors, net: str, rays: Rays, distance: Tensor) -> tuple[Tensor, Tensor]:
    points = rays.origins[:, None] + rays.directions[:, None] * distance[..., None]
    directions = rays.directions[:, None].expand_as(points)
    density, colour = network(params, net, points.reshape(-1, 3), directions.reshape(-1, 3))
    return density.reshape(distance.shape), colour.reshape(*distance.shape, 3)
