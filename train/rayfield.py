"""NeRFs as a field: batches of pixels, and pictures made of rays."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from spikerig import _native
from spikerig.dataset.errors import HostError
from spikerig.dataset.scene import Camera, Floats
from spikerig.train.config import FitConfig
from spikerig.train.field import Step, Tensors
from spikerig.train.gauge import Gauge
from spikerig.train.losses import mean_weights
from spikerig.train.model import BACKGROUNDS
from spikerig.train.rays import Rays, rays_of
from spikerig.train.volume import Traced

if TYPE_CHECKING:
    from spikerig.dataset.scene import Points
    from spikerig.train.fit import State
    from spikerig.train.targets import Instant, Targets, TrainView

CHUNK = 4096  # rays of a picture traced at a time


@dataclass(frozen=True, slots=True, eq=False)
class RayModel:
    """Parameters and grids of a NeRF in a gauge, seen by one camera. See `field.Model`."""

    params: Tensors
    grids: Tensors
    gauge: Gauge
    camera: Camera
    config: FitConfig

    def trace(
        self, rays: Rays, background: tuple[float, float, float], rng: np.random.Generator | None
    ) -> list[Traced]:
        """What rays of the gauge see, by each network, the best last; on the config's device, from and to the CPU."""
        config, device = self.config, self.config.device
        behind = torch.tensor(background, dtype=rays.origins.dtype)
        params, grids = self.params, self.grids
        if device != "cpu":
            params, grids = ({n: t.to(device) for n, t in each.items()} for each in (params, grids))
            rays, behind = rays.to(device), behind.to(device)
        if config.field == "nerf":
            from spikerig.train.vanilla import trace_vanilla

            found = trace_vanilla(params, config, rays, behind, rng)
        else:
            from spikerig.train.hashed import trace_hashed

            found = trace_hashed(params, grids, config, rays, behind, rng)
        return found if device == "cpu" else [Traced(t.colour.cpu(), t.alpha.cpu(), t.depth.cpu()) for t in found]

    def _whole(self, cam_from_world: Floats) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Codes [H,W,3], alpha [H,W], depth along z [H,W] in the gauge, without alpha divided out."""
        from spikerig.train.fit import torch_threads

        height, width = self.camera.height, self.camera.width
        pose = torch.from_numpy(self.gauge.pose(np.asarray(cam_from_world, np.float64)))
        made = []
        with torch.no_grad(), torch_threads(threads_of(self.config)):
            rays = rays_of(self.camera, pose, torch.arange(height * width))
            for begin in range(0, len(rays), CHUNK):
                some = rays.part(begin, begin + CHUNK)
                seen = self.trace(some, BACKGROUNDS[self.config.background], None)[-1]
                made.append((seen.colour, seen.alpha, seen.depth * some.forward))
        colour, alpha, depth = (torch.cat(each).numpy() for each in zip(*made, strict=True))
        return colour.reshape(height, width, 3), alpha.reshape(height, width), depth.reshape(height, width)

    def picture(self, cam_from_world: Floats) -> np.ndarray:
        """The picture float32[H,W,3] (sRGB codes) for a pose of the world."""
        return self._whole(cam_from_world)[0]

    def depth(self, cam_from_world: Floats) -> np.ndarray:
        """Depth along z [H,W], world units, weighted as colours are; inf where alpha is below a half."""
        _, alpha, depth = self._whole(cam_from_world)
        return np.where(alpha >= 0.5, depth / np.maximum(alpha, 0.5) / self.gauge.scale, np.inf).astype(np.float32)

    def middle(self) -> Floats:
        """The middle of the gauge, world units: the box of points and cameras has it there."""
        return self.gauge.world(np.zeros((1, 3)))[0]

    def seen_by(self, camera: Camera) -> RayModel:
        """The same scene for another camera."""
        return replace(self, camera=camera)


@dataclass(frozen=True, slots=True)
class RayField:
    """Fields `nerf` and `nerf-fast`. See `field.Field`."""

    name: str

    def start(self, points: Points | None, gauge: Gauge, config: FitConfig) -> tuple[Tensors, Tensors]:
        """Random networks; those of nerf-fast are then taught the points, unless `init` is random or there are none."""
        if self.name == "nerf":
            from spikerig.train.vanilla import start_vanilla

            return start_vanilla(config)
        from spikerig.train.hashed import start_hashed

        params, grids = start_hashed(config)
        if config.init == "points" and points is not None and len(points.xyz):
            from spikerig.train.prime import prime

            prime(params, grids, gauge.inside(points.xyz), points.rgb / 255.0, config)
        return params, grids

    def model(self, params: Tensors, grids: Tensors, gauge: Gauge, camera: Camera, config: FitConfig) -> RayModel:
        """Something to trace rays with."""
        return RayModel(params, grids, gauge, camera, config)

    def look(
        self, targets: Targets, camera: Camera, config: FitConfig, step: int, rng: np.random.Generator
    ) -> TrainView:
        """Pixels of some views, drawn at random with repetition."""
        from spikerig.train.targets import TrainView, views_of_step

        views = views_of_step(targets, config.seed, step, config.views_per_step)
        size = camera.width * camera.height
        shares = np.diff(np.linspace(0, config.rays, len(views) + 1).astype(int))
        taken = [torch.from_numpy(rng.integers(size, size=n)) for n in shares]
        pairs = list(zip(views, taken, strict=True))
        valid = None
        if any(view.valid is not None for view in views):
            every = torch.ones(size, dtype=torch.bool)
            valid = torch.cat([(every if v.valid is None else v.valid.reshape(-1))[p] for v, p in pairs])[:, None]
        return TrainView(
            ", ".join(dict.fromkeys(view.name for view in views)),
            torch.cat([view.frame.reshape(-1, 3)[p] for view, p in pairs])[:, None],
            valid,
            {phase: _instant([(v, v.instants[phase], p) for v, p in pairs]) for phase in views[0].instants},
            torch.cat(taken),
            torch.cat([view.which.expand(len(p)) for view, p in pairs]),
            {name: torch.cat([v.beside[name].flatten(0, 1)[p] for v, p in pairs])[:, None] for name in views[0].beside},
            _lateness(pairs),
        )

    def draw(self, model: RayModel, view: TrainView, pose: Tensor, step: Step) -> list[Tensor]:
        """The pixels from their poses, by every network: pictures of B rows and one column."""
        if view.pixels is None:
            raise ValueError("a batch of pixels, as look() makes it")
        step.drawn.append(len(view.pixels))
        rays = rays_of(model.camera, pose, view.pixels)
        return [seen.colour[:, None].contiguous() for seen in model.trace(rays, step.background, step.rng)]

    def rates(self, name: str, config: FitConfig) -> tuple[float, float | None]:
        """lr_grid for features, lr_net for networks."""
        return config.lr_grid if name == "table" else config.lr_net, None

    def regularise(self, params: Tensors, config: FitConfig) -> list[Tensor]:
        """Nothing."""
        return []

    def sense(self, config: FitConfig, step: Step) -> None:
        """Nothing."""

    def tend(self, state: State, config: FitConfig, step: Step) -> None:
        """The occupancy grid follows the density."""
        if self.name == "nerf-fast":
            from spikerig.train.hashed import refresh

            refresh(state.params, state.grids, config, step)

    def check(self, config: FitConfig) -> None:
        """A CUDA device where one is asked for."""
        if config.device == "cuda" and not torch.cuda.is_available():
            raise HostError(
                "there is no CUDA device for --device cuda",
                value=f"torch {torch.__version__}",
                next="leave --device at cpu, or install the CUDA build of torch",
            )

    def torch_threads(self) -> int:
        """One for nerf-fast, the kernels' count for nerf: its bits hold at that number, which run.json records."""
        return _native.threads() if self.name == "nerf" else 1


def threads_of(config: FitConfig) -> int:
    """How many threads torch may use for a config's field."""
    return RayField(config.field).torch_threads()


def _lateness(pairs: list[tuple[TrainView, Tensor]]) -> Tensor | None:
    """[B,1] of some pixels of some views, None where no view has a rolling shutter."""
    if all(view.late is None for view, _ in pairs):
        return None
    return torch.cat([torch.zeros(len(p)) if v.late is None else v.late.reshape(-1)[p] for v, p in pairs])[:, None]


def _instant(parts: list[tuple[TrainView, Instant, Tensor]]) -> Instant:
    """Some pixels of some views at one instant: a pose each, textures and ratio targets of these pixels."""
    from spikerig.train.rolling import poses_at
    from spikerig.train.targets import Instant

    poses = torch.cat([poses_at(instant.pose, view.late, p) for view, instant, p in parts])
    textures = []
    for each in zip(*(instant.textures for _, instant, _ in parts), strict=True):
        taken = [
            (light.reshape(-1)[p], weight.reshape(-1)[p])
            for (light, weight), (_, _, p) in zip(each, parts, strict=True)
        ]
        light, weight = (torch.cat(column)[:, None].contiguous() for column in zip(*taken, strict=True))
        textures.append((light, mean_weights(weight > 0)))
    ratios = [instant.ratio.reshape(-1, 3)[p] for _, instant, p in parts if instant.ratio.numel()]
    return Instant(poses, tuple(textures), torch.cat(ratios)[:, None] if ratios else torch.zeros(0, dtype=torch.half))
