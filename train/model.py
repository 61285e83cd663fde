"""A trained (or training) scene: splats, the gauge they live in, and how to draw them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from spikerig.dataset.errors import DataError
from spikerig.dataset.scene import Camera, Floats
from spikerig.train.config import FitConfig
from spikerig.train.gauge import Gauge
from spikerig.train.splat import Rendered, Splats, render
from spikerig.train.start import SH0

NEAR = 0.02  # of the gauge's unit: nearer splats blow up under projection
BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "random": (0.0, 0.0, 0.0)}


@dataclass(frozen=True, slots=True, eq=False)
class SplatModel:
    """Splats in a gauge, seen by one camera."""

    splats: Splats
    gauge: Gauge
    camera: Camera
    config: FitConfig

    def draw(
        self,
        pose: torch.Tensor,
        background: tuple[float, float, float] | None = None,
        sh_degree: int | None = None,
    ) -> Rendered:
        """The picture for a pose float32[3,4] of the gauge; differentiable in the splats.

        `background` defaults to the config's (black for random); `sh_degree` to the stored one.
        """
        backend = renderer(self.config.device)
        return backend(
            self.splats,
            self.camera.K,
            self.camera.width,
            self.camera.height,
            pose,
            background=background or BACKGROUNDS[self.config.background],
            sh_degree=sh_degree,
            antialias=self.config.antialias,
            near=NEAR,
            **({"absgrad": True} if self.config.absgrad else {}),
        )

    def picture(self, cam_from_world: Floats) -> np.ndarray:
        """The picture float32[H,W,3] (sRGB codes, not clipped) for a pose of the world."""
        with torch.no_grad():
            pose = torch.from_numpy(self.gauge.pose(np.asarray(cam_from_world, np.float64)))
            return self.draw(pose).image.cpu().numpy()

    def depth(self, cam_from_world: Floats) -> np.ndarray:
        """Depth along z [H,W], world units: splats' depths blended like colours; inf where alpha is below a half."""
        pose = self.gauge.pose(cam_from_world)
        with torch.no_grad():
            z = self.splats.means @ torch.from_numpy(pose[2, :3]) + float(pose[2, 3])
            far = max(float(z.max()), 1e-6)
            sh = (z / far)[:, None, None].expand(-1, 1, 3).sub(0.5).div(SH0).contiguous()
            flat = replace(self, splats=replace(self.splats, sh=sh), config=replace(self.config, background="black"))
            drawn = flat.draw(torch.from_numpy(pose))
            alpha = drawn.alpha.cpu().numpy()
            depth = drawn.image[:, :, 0].cpu().numpy() / np.maximum(alpha, 0.5) * (far / self.gauge.scale)
        return np.where(alpha >= 0.5, depth, np.inf).astype(np.float32)

    def middle(self) -> Floats:
        """The splats' middle [3] by opacity, world units."""
        with torch.no_grad():
            weight = torch.sigmoid(self.splats.logit_opacities)[:, None]
            middle = ((self.splats.means * weight).sum(0) / weight.sum()).cpu().numpy()[None].astype(np.float64)
        return self.gauge.world(middle)[0]

    def seen_by(self, camera: Camera) -> SplatModel:
        """The same splats for another camera."""
        return replace(self, camera=camera)


def renderer(device: str) -> Callable[..., Rendered]:
    """The rasteriser of a device: the native one, or gsplat on CUDA (extra `cuda`)."""
    if device == "cpu":
        return render
    from spikerig.train.cuda import check_cuda, render_cuda

    check_cuda()
    return render_cuda


def check_pinhole(camera: Camera) -> None:
    """Refuse a camera with distortion: scenes are undistorted when the two arms are aligned."""
    if np.any(camera.distortion != 0):
        raise DataError(
            "training needs a pinhole camera",
            value=f"distortion {camera.distortion}",
            expected="no distortion",
            cause="pictures that were not undistorted",
            next="align the capture, or undistort the pictures before spikerig data build",
        )


def splats_of(tensors: dict[str, Any]) -> Splats:
    """Splats from their tensors by name."""
    return Splats(**{name: tensors[name] for name in ("means", "quats", "log_scales", "logit_opacities", "sh")})
