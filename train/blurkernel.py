"""Deblur-NeRF's deformable sparse kernel: a blurry pixel is a learned mix of a few displaced ones.

Each view has N canonical points; a small network moves them, by view, place in the picture and point, and weighs them.
On fields of rays the displaced pixels are traced, each from a displaced origin, as published. A field of splats draws a
whole picture, and it is looked up between its pixels: no origin moves, and the kernel is worked out on a lattice of
every LATTICE-th pixel, in between which it is blended. Finished models know no kernel.

Source: Ma et al., "Deblur-NeRF", CVPR 2022, Sec. 4, and its code (limacv/Deblur-NeRF: class DSKnet, configs tx_*_full).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from spikerig.dataset.scene import Camera
from spikerig.train.config import FitConfig
from spikerig.train.field import Step, Tensors
from spikerig.train.layers import chain, dense, new_layer, waves
from spikerig.train.losses import linear_from_srgb, srgb_from_linear
from spikerig.train.parts import Draw, Part

if TYPE_CHECKING:
    from spikerig.train.targets import TrainView

WIDE, EMBED, FREQUENCIES = 64, 32, 2  # of hidden layers, of a view's code, of the sines of a place
REACH = 10.0  # pixels: canonical points lie within
SPREAD = 0.1  # of the first canonical points, before tanh: a pixel
JITTER = 0.15  # pixels, of canonical points in training
ORIGIN = 0.01  # unit of origins, so that they move slowly
ALIGN_ORIGIN = 10.0  # of the alignment term, an origin against pixels
ALIGN_UNTIL = 0.9  # of the run
LATTICE = 8  # pixels
HIDDEN = tuple(f"hidden/{k}" for k in range(4))


def start(task: Any) -> Tensors:
    """Canonical points near the middle, views' codes 0, a network whose last layer is small: a slight blur."""
    config: FitConfig = task.config
    views = len(task.targets.views)
    rng = np.random.default_rng((config.seed, 11))
    inputs = 2 * (1 + 2 * FREQUENCIES) * 2 + EMBED
    points = rng.standard_normal((views, config.kernel_points, 2)).astype(np.float32) * SPREAD
    params = {"points": torch.from_numpy(points), "views": torch.zeros(views, EMBED)}
    for k, name in enumerate(HIDDEN):
        params |= new_layer(name, WIDE if k else inputs, WIDE, rng)
    params |= new_layer("join", WIDE + inputs, WIDE, rng)
    return params | new_layer("out", WIDE, 5, rng, gain=0.1)


def kernel_at(params: Tensors, which: Tensor, places: Tensor, jitter: Tensor | None = None) -> tuple[Tensor, ...]:
    """The kernel at some pixels.

    Args:
        params: of the part.
        which: int64[B] (or [1]), numbers of views.
        places: [B,2], column and row in -1..1.
        jitter: [B,N,2] pixels that are added to canonical points, or None.

    Returns:
        Displacements [B,N,2] in pixels (column, row), origins [B,N,2] in the camera's x and y, weights [B,N] of sum 1.
    """
    canonical = REACH * torch.tanh(params["points"])[which]
    if jitter is not None:
        canonical = canonical + jitter
    canonical = canonical.expand(len(places), -1, 2)
    count = canonical.shape[1]
    code = params["views"][which].expand(len(places), EMBED)[:, None].expand(-1, count, -1)
    place = waves(places, FREQUENCIES)[:, None].expand(-1, count, -1)
    x = torch.cat([waves(canonical / REACH, FREQUENCIES), code, place], -1)
    hidden = torch.relu(chain(params, HIDDEN, x))
    found = dense(params, "out", torch.relu(dense(params, "join", torch.cat([x, hidden], -1))))
    return canonical + found[..., 2:4], ORIGIN * found[..., :2], torch.softmax(found[..., 4], -1)


def displaced(camera: Camera, pose: Tensor, pixels: Tensor, moved: Tensor, origin: Tensor) -> Tensor:
    """Poses from which pixels see what displaced pixels from displaced origins would.

    Args:
        camera: a pinhole.
        pose: [B,3,4] cam_from_world.
        pixels: int64[B].
        moved: [B,N,2] pixels.
        origin: [B,N,2], x and y of the camera at pose, its plane z = 1 the pivot: a ray from there meets that plane
            where the displaced pixel's ray does.

    Returns:
        [B,N,3,4]: the camera turned (the least turn that does it) and moved.
    """
    K = camera.K
    column = (pixels % camera.width).to(pose.dtype) + 0.5
    row = torch.div(pixels, camera.width, rounding_mode="floor").to(pose.dtype) + 0.5
    at = torch.stack([(column - float(K[0, 2])) / float(K[0, 0]), (row - float(K[1, 2])) / float(K[1, 1])], -1)
    reach = torch.tensor([float(K[0, 0]), float(K[1, 1])], dtype=pose.dtype)
    to = at[:, None] + moved / reach - origin
    seen, wanted = (functional.normalize(functional.pad(v, (0, 1), value=1.0), dim=-1) for v in (at[:, None], to))
    axis = torch.linalg.cross(wanted, seen.expand_as(wanted))
    cosine = (wanted * seen).sum(-1)[..., None, None]
    zero = torch.zeros_like(axis[..., 0])
    x, y, z = axis.unbind(-1)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    turn = torch.eye(3, dtype=pose.dtype) + cross + cross @ cross / (1 + cosine)
    R, t = pose[:, None, :, :3], pose[:, None, :, 3:]
    from_origin = t - functional.pad(origin, (0, 1))[..., None]
    return torch.cat([turn @ R, turn @ from_origin], -1)


def mixed(pictures: Tensor, weights: Tensor, domain: str) -> Tensor:
    """Displaced codes [...,N,3] by weights [...,N] in linear light, or (domain `encoded`) as codes."""
    if domain == "encoded":
        return (pictures * weights[..., None]).sum(-2)
    return srgb_from_linear((linear_from_srgb(pictures) * weights[..., None]).sum(-2))


def _draw(params: Tensors, draw: Draw, view: TrainView, pose: Tensor, step: Step, task: Any) -> list[Tensor]:
    config: FitConfig = task.config
    if step.fraction < config.kernel_start:
        return draw(view, pose)
    if view.pixels is None:
        return [_looked_up(params, view, picture, step, config) for picture in draw(view, pose)]
    camera, count = task.camera, config.kernel_points
    jitter = torch.from_numpy(step.rng.standard_normal((len(view.pixels), count, 2), np.float32)) * JITTER
    moved, origin, weights = kernel_at(params, view.which, places_of(camera, view.pixels), jitter)
    poses = displaced(camera, pose.expand(len(view.pixels), 3, 4), view.pixels, moved, origin)
    many = replace(view, pixels=view.pixels.repeat_interleave(count), which=view.which.repeat_interleave(count))
    renders = draw(many, poses.flatten(0, 1))
    return [mixed(r[:, 0].unflatten(0, (-1, count)), weights, config.average_domain)[:, None] for r in renders]


def _looked_up(params: Tensors, view: TrainView, picture: Tensor, step: Step, config: FitConfig) -> Tensor:
    """A whole picture blurred by the view's kernel."""
    height, width = picture.shape[:2]
    rows, columns = (-(-n // LATTICE) + 1 for n in (height, width))
    places = lattice(rows, columns)
    jitter = torch.from_numpy(step.rng.standard_normal((len(places), config.kernel_points, 2), np.float32)) * JITTER
    moved, _, weights = kernel_at(params, view.which, places, jitter)
    kernel = torch.cat([moved, weights[..., None]], -1).flatten(1).T.unflatten(1, (rows, columns))
    kernel = functional.interpolate(kernel[None], (height, width), mode="bilinear", align_corners=True)
    kernel = kernel[0].unflatten(0, (config.kernel_points, 3))  # [N,3,H,W]
    return warped(picture, kernel[:, :2].permute(0, 2, 3, 1), kernel[:, 2], config.average_domain)


def warped(picture: Tensor, moved: Tensor, weights: Tensor, domain: str) -> Tensor:
    """A picture [H,W,3] mixed from its values, blended between pixels, at displacements [N,H,W,2] by weights [N,H,W].

    Edges: past the border the border's values go on.
    """
    height, width = picture.shape[:2]
    value = picture if domain == "encoded" else linear_from_srgb(picture)
    y, x = (torch.arange(n, dtype=picture.dtype) + 0.5 for n in (height, width))
    at = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1) + moved
    at = at * torch.tensor([2 / width, 2 / height]) - 1
    source = value.permute(2, 0, 1)[None].expand(len(moved), -1, -1, -1)
    found = functional.grid_sample(source, at, mode="bilinear", padding_mode="border", align_corners=False)
    total = (found * weights[:, None]).sum(0).permute(1, 2, 0)
    return total.contiguous() if domain == "encoded" else srgb_from_linear(total).contiguous()


def lattice(rows: int, columns: int) -> Tensor:
    """Places [rows * columns, 2] that cover a picture from border to border."""
    y, x = torch.linspace(-1, 1, rows), torch.linspace(-1, 1, columns)
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).flatten(0, 1)


def places_of(camera: Camera, pixels: Tensor) -> Tensor:
    """Centres of pixels [B] as places [B,2] in -1..1."""
    column, row = pixels % camera.width, torch.div(pixels, camera.width, rounding_mode="floor")
    return torch.stack([(column + 0.5) * (2 / camera.width) - 1, (row + 0.5) * (2 / camera.height) - 1], -1)


def _loss(state: Any, task: Any, view: TrainView, pictures: dict[float, Tensor], step: Step) -> list[Tensor]:
    """The first point stays at its pixel, and its origin at the camera: otherwise scene and kernels drift together."""
    config: FitConfig = task.config
    if not config.kernel_start <= step.fraction < ALIGN_UNTIL or config.kernel_align == 0:
        return []
    params = {n.removeprefix("kernel:"): p for n, p in state.params.items() if n.startswith("kernel:")}
    places = lattice(8, 8) if view.pixels is None else places_of(task.camera, view.pixels)
    which = view.which if len(view.which) in (1, len(places)) else view.which[:1]
    moved, origin, _ = kernel_at(params, which, places)
    first = moved[:, 0].abs().mean() + ALIGN_ORIGIN * origin[:, 0].abs().mean()
    networks = 2 if config.field == "nerf" else 1  # the loss is asked for by each
    return [config.kernel_align / networks * first]


def _rate(name: str, config: FitConfig, fraction: float) -> float:
    return config.lr_kernel * config.lr_end**fraction


KERNEL = Part("kernel", start=start, rate=_rate, draw=_draw, loss=_loss)
