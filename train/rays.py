"""Rays of pixels: where they start and point, and where they enter and leave the box a field fills."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from spikerig.dataset.errors import UsageError
from spikerig.dataset.scene import Camera

BOX = 1.1  # half size of the box that fields fill; the gauge puts points and cameras into [-1, 1]
NEAREST = 0.05  # of the gauge's unit: nothing is looked for closer to a camera


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """B rays: origins [B,3], unit directions [B,3], `forward` [B] = depth along the optical axis of distance 1."""

    origins: Tensor
    directions: Tensor
    forward: Tensor

    def __len__(self) -> int:
        return len(self.origins)

    def part(self, begin: int, end: int) -> Rays:
        """Rays begin..end-1."""
        return Rays(self.origins[begin:end], self.directions[begin:end], self.forward[begin:end])

    def to(self, device: str) -> Rays:
        """The same rays on a device."""
        return Rays(self.origins.to(device), self.directions.to(device), self.forward.to(device))


def rays_of(camera: Camera, cam_from_world: Tensor, pixels: Tensor) -> Rays:
    """Rays through pixel centres.

    Args:
        camera: a pinhole.
        cam_from_world: [3,4], or [B,3,4] with a pose a pixel (views that differ, rows of a rolling shutter).
        pixels: int64[B], row * width + column.

    Returns:
        Rays in the coordinates of the poses' world, in the poses' type; pixel (column, row) is seen at
        (column + 1/2, row + 1/2).

    Raises:
        UsageError: shapes that do not fit.
    """
    many = cam_from_world.ndim == 3
    if cam_from_world.shape[-2:] != (3, 4) or (many and len(cam_from_world) != len(pixels)) or pixels.ndim != 1:
        raise UsageError(
            "rays need a pose [3,4], or one a pixel, and pixels [B]",
            value=(tuple(cam_from_world.shape), tuple(pixels.shape)),
        )
    K, kind = camera.K, cam_from_world
    x = (pixels % camera.width).to(kind.dtype) + 0.5
    y = torch.div(pixels, camera.width, rounding_mode="floor").to(kind.dtype) + 0.5
    seen = torch.stack([(x - float(K[0, 2])) / float(K[0, 0]), (y - float(K[1, 2])) / float(K[1, 1])], -1)
    forward = 1 / torch.sqrt((seen * seen).sum(-1) + 1)
    local = torch.cat([seen, torch.ones_like(seen[:, :1])], -1) * forward[:, None]
    R, t = kind[..., :3], kind[..., 3]
    directions = (R * local[:, :, None]).sum(-2) if many else local @ R  # R^T times each
    origins = -(R * t[..., None]).sum(-2)
    return Rays(origins.expand(len(pixels), 3), directions, forward)


def bounds(rays: Rays, half: float = BOX, nearest: float = NEAREST) -> tuple[Tensor, Tensor]:
    """Distances [B] at which rays enter (at least `nearest`) and leave the box [-half, half]^3.

    Edges: a ray that misses the box gets near = far, a span of length 0.
    """
    tiny = torch.finfo(rays.directions.dtype).tiny
    slope = torch.where(rays.directions.abs() < tiny, tiny, rays.directions)
    one, other = (-half - rays.origins) / slope, (half - rays.origins) / slope
    near = torch.minimum(one, other).amax(-1).clamp(min=nearest, max=1e6)
    far = torch.maximum(one, other).amin(-1).clamp(max=1e6)
    return near, torch.maximum(near, far)
