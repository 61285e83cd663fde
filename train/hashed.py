"""The fast field: hash grid and two small networks, samples put where a grid of densities says there is something."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from spikerig.train.config import FitConfig
from spikerig.train.contraction import contract, distance_of
from spikerig.train.hashgrid import FEATURES, Layout, hash_encode, layout_of
from spikerig.train.layers import chain, harmonics, new_layer
from spikerig.train.rays import BOX, NEAREST, Rays, bounds
from spikerig.train.volume import Traced, composite, locate, stratified, weights_of

if TYPE_CHECKING:
    from spikerig.train.field import Step, Tensors

GEOMETRY = 15  # numbers handed from the density's network to the colour's
DENSEST = 11.0  # of the logarithm of density; e^11 is opaque within a thousandth of the gauge's unit
EMPTY = 0.05  # density below which a cell is skipped: the whole box of it lets a third of the light through
THICK = 5.0
LATER_SPREAD = 0.1
REFRESH, REVISIT, FADE = 16, 8, 0.6  # steps between refreshes, 1 / share of cells looked at, what stays of a cell's
SPREAD = 0.25  # of the samples, evenly over what is not empty; the others where the grid's light goes


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """Rays cut up: a sample's distance [B,N], the cuts [B,N+1], and how much of each piece is not empty [B,N]."""

    distance: Tensor
    edges: Tensor
    length: Tensor


def grid_layout(config: FitConfig) -> Layout:
    """Of the config's hash grid."""
    return layout_of(config.grid_levels, config.coarsest, config.finest, config.table_log2)


def start_hashed(config: FitConfig) -> tuple[Tensors, Tensors]:
    """Random parameters (features +-1e-4), and an occupancy grid in which nothing is empty."""
    rng = np.random.default_rng((config.seed, 1))
    layout = grid_layout(config)
    table = rng.uniform(-1e-4, 1e-4, (layout.rows, FEATURES)).astype(np.float32)
    params = {"table": torch.from_numpy(table)}
    params |= new_layer("density/1", layout.width, config.width, rng)
    params |= new_layer("density/2", config.width, 1 + GEOMETRY, rng, 1.0)
    params |= new_layer("colour/1", GEOMETRY + (config.sh_degree + 1) ** 2, config.width, rng)
    params |= new_layer("colour/2", config.width, 3, rng, 1.0)
    return params, {"occupancy": torch.ones(config.occupancy, config.occupancy, config.occupancy)}


class _Exp(torch.autograd.Function):
    """e^x for x up to DENSEST and flat above, with a gradient that still leads back down from there."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        out = torch.exp(x.clamp(max=DENSEST))
        ctx.save_for_backward(out)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        (out,) = ctx.saved_tensors
        return grads[0] * out


def density_of(params: Tensors, config: FitConfig, points: Tensor) -> tuple[Tensor, Tensor]:
    """Density [N] and geometry [N,15] at points [N,3] of the gauge; with `contract`, density a contracted length."""
    return density_in(params, config, unit(points, config))


def unit(points: Tensor, config: FitConfig) -> Tensor:
    """Points [...,3] of the gauge in the cube [0, 1]^3 that the grids fill; without `contract` some lie beyond."""
    return contract(points) * 0.25 + 0.5 if config.contract else points * (0.5 / BOX) + 0.5


def density_in(params: Tensors, config: FitConfig, places: Tensor) -> tuple[Tensor, Tensor]:
    """Density [N] and geometry [N,15] at places [N,3] of the unit cube."""
    features = hash_encode(places, params["table"], grid_layout(config))
    found = chain(params, ("density/1", "density/2"), features)
    return _Exp.apply(found[:, 0]), found[:, 1:]  # type: ignore[return-value]


def colour_of(params: Tensors, config: FitConfig, geometry: Tensor, directions: Tensor) -> Tensor:
    """Colour [N,3] (sRGB codes) from geometry [N,15] and unit directions [N,3]."""
    seen = harmonics(directions, config.sh_degree)
    return torch.sigmoid(chain(params, ("colour/1", "colour/2"), torch.cat([geometry, seen], -1)))


def trace_hashed(
    params: Tensors,
    grids: Tensors,
    config: FitConfig,
    rays: Rays,
    background: Tensor,
    rng: np.random.Generator | None,
) -> list[Traced]:
    """What rays see: cells of the occupancy grid are looked up, then densities, then the networks are asked.

    Args:
        params, grids: of the field.
        config: coarse, probes, fine: how many cells, densities without a gradient (0: none), samples of a ray.
        rays: B of the gauge.
        background: [3].
        rng: where in their pieces samples lie; None: in the middle.

    Edges: a ray that meets only empty cells sees the background and has no gradient; empty gaps have no length.
    """
    with torch.no_grad():
        pieces = place(grids["occupancy"], config, rays, rng, config.probes or config.fine)
        if config.probes:
            density, _ = density_of(params, config, _points(rays, along(pieces.distance, config)).reshape(-1, 3))
            weights, _ = weights_of(density.reshape(pieces.distance.shape), pieces.length)
            pieces = sample(pieces, weights, LATER_SPREAD, config.fine, rng)
        distance, length = along(pieces.distance, config), pieces.length
    points = _points(rays, distance)  # with the gradient of rays that have one: of poses and kernels that are learned
    density, geometry = density_of(params, config, points.reshape(-1, 3))
    ways = rays.directions[:, None].expand(-1, config.fine, -1).flatten(0, 1)
    colour = colour_of(params, config, geometry, ways)
    shape = distance.shape
    return [composite(density.reshape(shape), length, distance, colour.reshape(*shape, 3), background)]


def _points(rays: Rays, distance: Tensor) -> Tensor:
    return rays.origins[:, None] + rays.directions[:, None] * distance[..., None]


def place(occupancy: Tensor, config: FitConfig, rays: Rays, rng: np.random.Generator | None, count: int) -> Pieces:
    """`count` samples a ray where the occupancy grid has something, empty stretches left out."""
    near, far = _ends(rays, config)
    shift = None if rng is None else torch.from_numpy(rng.random((len(rays), 1), np.float32)).to(near)
    looked, edges = stratified(near, far, config.coarse, shift)
    cells = cells_of(unit(_points(rays, along(looked, config)), config), len(occupancy))
    density = occupancy.reshape(-1)[cells]
    length = torch.where(density > EMPTY, edges[:, 1:] - edges[:, :-1], 0.0)
    weights, _ = weights_of(density.clamp(max=THICK), length)
    return sample(Pieces(looked, edges, length), weights, SPREAD, count, rng)


def sample(pieces: Pieces, weights: Tensor, spread: float, count: int, rng: np.random.Generator | None) -> Pieces:
    """Cut rays anew into `count` pieces of equal weight, a share of it spread evenly over what is not empty."""
    length = pieces.length
    share = (1 - spread) * weights / weights.sum(-1, keepdim=True).clamp(min=1e-9)
    share = share + spread * length / length.sum(-1, keepdim=True).clamp(min=1e-9)
    rays, like = len(weights), weights
    cuts = torch.arange(count + 1, dtype=like.dtype, device=like.device) / count
    inside = 0.5 if rng is None else torch.from_numpy(rng.random((rays, count), np.float32)).to(like)
    middle = (torch.arange(count, dtype=like.dtype, device=like.device) + inside) / count
    piece, part = locate(share, torch.cat([cuts.expand(rays, -1), middle.expand(rays, -1)], -1))
    low, high = pieces.edges.gather(-1, piece), pieces.edges.gather(-1, piece + 1)
    found = low + (high - low) * part
    cut, partly = piece[:, : count + 1], part[:, : count + 1]
    before = (torch.cumsum(length, -1) - length).gather(-1, cut) + partly * length.gather(-1, cut)
    return Pieces(found[:, count + 1 :], found[:, : count + 1], torch.diff(before).clamp(min=0))


def _ends(rays: Rays, config: FitConfig) -> tuple[Tensor, Tensor]:
    if not config.contract:
        return bounds(rays)
    near = torch.full_like(rays.forward, NEAREST)
    return near, torch.full_like(near, 2.0)


def along(distance: Tensor, config: FitConfig) -> Tensor:
    """Distances along rays of where pieces are cut: themselves, or with `contract` those of contracted distances."""
    return distance_of(distance) if config.contract else distance


def cells_of(places: Tensor, side: int) -> Tensor:
    """Numbers of the occupancy cells of places [...,3] of the unit cube; beyond it, those at its border."""
    at = (places * side).long().clamp(0, side - 1)
    return (at[..., 2] * side + at[..., 1]) * side + at[..., 0]


@torch.no_grad()
def refresh(params: Tensors, grids: Tensors, config: FitConfig, step: Step) -> None:
    """Look at a share of the cells: each fades, and holds at least the density at a random place inside."""
    if step.number % REFRESH:
        return
    side = config.occupancy
    total = side**3
    # every REVISIT-th cell, another comb each time: all are visited in turn, at no cost of drawing
    cells = np.arange((step.number // REFRESH * 5) % REVISIT, total, REVISIT)
    corner = np.stack([cells % side, cells // side % side, cells // side**2], -1)
    places = (corner + step.rng.random((len(cells), 3))) / side
    density, _ = density_in(params, config, torch.from_numpy(places.astype(np.float32)))
    flat, where = grids["occupancy"].reshape(-1), torch.from_numpy(cells)
    flat[where] = torch.maximum(FADE * flat[where], density)
