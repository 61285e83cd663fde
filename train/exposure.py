"""Frames of different exposure or white balance: a colour correction a view, as a part of the camera.

A correction acts on the exposed picture in linear light, before it is compared with the frame. The views' corrections
are held to a mean of identity (a brighter scene under darker corrections would fit as well), so the scene comes out in
the mean exposure of the training views; a finished model knows nothing of them, and held-out views are drawn without.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from spikerig.train.config import FitConfig
from spikerig.train.field import Step, Tensors
from spikerig.train.losses import linear_from_srgb, srgb_from_linear
from spikerig.train.parts import Part, own

if TYPE_CHECKING:
    from spikerig.train.targets import TrainView

GRID = (8, 16, 16)  # of a bilateral grid: brightness, rows, columns
IDENTITY = torch.eye(3, 4)
LUMA = (0.2126, 0.7152, 0.0722)
REMARK = "each training frame has a colour correction of its own (mean: none); held-out views are scored without one"


def start(task: Any) -> Tensors:
    """Differences from identity, all 0: affine [V,3,4], or a bilateral grid [V,12,8,16,16]."""
    views = len(task.targets.views)
    if task.config.exposure == "affine":
        return {"affine": torch.zeros(views, 3, 4)}
    return {"grid": torch.zeros(views, 12, *GRID)}


def correction(params: Tensors, which: Tensor) -> Tensor:
    """Corrections [B,3,4] or [B,12,8,16,16] of some views; their mean over all views is the identity.

    Args:
        params: of this part.
        which: int64[B] numbers of training views.
    """
    (raw,) = params.values()
    identity = IDENTITY if raw.ndim == 3 else IDENTITY.reshape(12, 1, 1, 1)
    return raw[which] - raw.mean(0) + identity


def affine(light: Tensor, matrix: Tensor) -> Tensor:
    """Colours [...,3] through [...,3,4]: a 3x3 matrix and an offset."""
    return (matrix[..., :3] * light[..., None, :]).sum(-1) + matrix[..., 3]


def sliced(grid: Tensor, picture: Tensor) -> Tensor:
    """The colour matrices [H,W,3,4] that a bilateral grid [12,8,16,16] holds for the pixels of a picture.

    Args:
        grid: cells' centres are spread over the whole picture and over luma 0..1, ends included.
        picture: [H,W,3] sRGB codes; their luma (without gradient) looks up the first axis.

    Source: Chen et al. 2007; Wang et al. 2024 (bilateral guided radiance field processing).
    """
    height, width = picture.shape[:2]
    luma = sum((picture.detach()[..., c] * k for c, k in enumerate(LUMA)), torch.zeros(())).clamp(0, 1)
    y, x = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
    where = torch.stack([x, y, 2 * luma - 1], -1)[None, None]
    found = torch.nn.functional.grid_sample(grid[None], where, padding_mode="border", align_corners=True)
    return found[0, :, 0].permute(1, 2, 0).reshape(height, width, 3, 4)


def expose(params: Tensors, view: TrainView, picture: Tensor, config: FitConfig) -> Tensor:
    """The exposed picture [H,W,3] (sRGB codes) as the view's frame shows it; [B,1,3] for a batch of pixels."""
    found = correction(params, view.which)
    if config.exposure == "affine":
        matrix = found[:, None]  # of all pixels of a view; of a batch of pixels, one each
    else:
        matrix = sliced(found[0], picture)
    return srgb_from_linear(affine(linear_from_srgb(picture), matrix))


def roughness(grid: Tensor) -> Tensor:
    """Mean squared differences of neighbouring cells of a grid [12,8,16,16], summed over its three axes."""
    terms = [(grid.narrow(k, 1, n - 1) - grid.narrow(k, 0, n - 1)).square().mean() for k, n in enumerate(GRID, 1)]
    return terms[0] + terms[1] + terms[2]


def smooth(state: Any, task: Any, view: TrainView, pictures: dict[float, Tensor], step: Step) -> list[Tensor]:
    """The grid of the view at hand should change slowly."""
    grid = correction(own(BILATERAL, state.params), view.which)[0]
    return [task.config.exposure_tv * roughness(grid)]


def rate(name: str, config: FitConfig, fraction: float) -> float:
    """`lr_exposure`, falling as all rates do."""
    return config.lr_exposure * config.lr_end**fraction


AFFINE = Part("exposure", REMARK, start=start, rate=rate, expose=expose)
BILATERAL = Part("exposure", REMARK, start=start, rate=rate, expose=expose, loss=smooth)
