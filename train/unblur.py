"""A frame's colours brought to an instant of its exposure: Richardson and Lucy's deconvolution along the known path.

The blur of a frame is the mean of one sharp picture moved along the camera's path. Seen from one instant the others
are that picture under homographies: exact for what turns, and for what shifts at the depth of the scene's middle.
The gray of the picture is held to the spikes' in every iteration, so only colour is left to find.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from spikerig.dataset.scene import Camera, Floats

DIM = 1e-3  # linear light added to both sides of a ratio
MOST = 6.0  # a ratio is at most so large, or 1 / so small
STRIDE = 2.0  # exponent of a step: more than 1 goes ahead faster, beyond 2 it rings


@dataclass(frozen=True, slots=True)
class Path:
    """Where the pixels of an instant are at the n instants of an exposure: sampling grids [n,H,W,2] as torch has them.

    `there`: a picture of the instant, seen from the others; `back`: pictures of the others, seen from it.
    """

    there: Tensor
    back: Tensor


def path_of(camera: Camera, poses: list[Floats], at: Floats, depth: float) -> Path:
    """The path from an instant's pose [3,4] to `poses`, for a plane at a depth that faces the camera."""
    K = camera.K
    px = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), -1)
    px = np.concatenate([px, np.ones((*px.shape[:2], 1))], -1)
    grids: tuple[list[Tensor], list[Tensor]] = ([], [])
    for pose in poses:
        R = pose[:, :3] @ at[:, :3].T
        t = pose[:, 3] - R @ at[:, 3]
        onward = K @ (R + np.outer(t, [0.0, 0.0, 1.0]) / depth) @ np.linalg.inv(K)
        for grid, move in zip(grids, (np.linalg.inv(onward), onward), strict=True):
            to = px @ move.T
            to = to[..., :2] / to[..., 2:] / [camera.width, camera.height] * 2 - 1
            grid.append(torch.from_numpy(to.astype(np.float32)))
    return Path(torch.stack(grids[0]), torch.stack(grids[1]))


def warp(pictures: Tensor, grid: Tensor) -> Tensor:
    """Pictures [n or 1,C,H,W] sampled bilinearly on grids [n,H,W,2]; the border goes on outside."""
    return grid_sample(pictures.expand(len(grid), -1, -1, -1), grid, "bilinear", "border", align_corners=False)


def unblur(frame: Tensor, gray: Tensor, weights: Tensor, path: Path, rounds: int, clipped: Tensor | None = None) -> Tensor:
    """The frame at the path's instant.

    Args:
        frame: [H,W,3], linear light, blurred along the path.
        gray: [H,W], what weights . picture is at the instant (from spikes), same units.
        weights: [3].
        path: of the exposure.
        rounds: iterations; more bring back finer colour, and the noise of the frame with it.
        clipped: bool[H,W,3], where the frame only says "at least".

    Returns:
        [H,W,3] linear light.

    Cost: 2 n bilinear samples a pixel and round; 3 ms at 200x125 with n = 9.
    Source: Richardson 1972, Lucy 1974; the exponent: Adorf et al. 1992 (accelerated RL).
    """
    blurred, wanted = frame.permute(2, 0, 1)[None], gray[None, None]
    top = None if clipped is None else clipped.permute(2, 0, 1)[None]

    def held(picture: Tensor) -> Tensor:
        own = (picture[0] * weights[:, None, None]).sum(0)
        return picture * ((wanted + DIM) / (own + DIM)).clamp(1 / MOST, MOST)

    picture = held(blurred)
    for _ in range(rounds):
        mean = warp(picture, path.there).mean(0, keepdim=True)
        ratio = ((blurred + DIM) / (mean + DIM)).clamp(1 / MOST, MOST)
        if top is not None:
            ratio = torch.where(top, ratio.clamp(min=1.0), ratio)
        picture = held(picture * warp(ratio, path.back).mean(0, keepdim=True) ** STRIDE)
    return picture[0].permute(1, 2, 0)
