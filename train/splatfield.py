"""Splats as a field: whole views, densification, regularisers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from spikerig.dataset.scene import Camera
from spikerig.train.config import FitConfig
from spikerig.train.densify import jolt, relocate
from spikerig.train.field import Step, Tensors
from spikerig.train.gauge import Gauge
from spikerig.train.model import SplatModel, renderer, splats_of
from spikerig.train.start import start_splats

if TYPE_CHECKING:
    from spikerig.dataset.scene import Points
    from spikerig.train.targets import Targets, TrainView

RATES = {
    "means": "lr_means",
    "quats": "lr_quats",
    "log_scales": "lr_scales",
    "logit_opacities": "lr_opacities",
    "sh": "lr_colours",
}
HIGHER_SH = 1 / 20  # learning rate of the view-dependent coefficients, of the constant one's


class SplatField:
    """See `field.Field`."""

    def start(self, points: Points | None, gauge: Gauge, config: FitConfig) -> tuple[Tensors, Tensors]:
        """Splats on the scene's points."""
        return start_splats(points, gauge, config), {}

    def model(self, params: Tensors, grids: Tensors, gauge: Gauge, camera: Camera, config: FitConfig) -> SplatModel:
        """The splats, drawn by the config's device."""
        return SplatModel(splats_of(params), gauge, camera, config)

    def look(
        self, targets: Targets, camera: Camera, config: FitConfig, step: int, rng: np.random.Generator
    ) -> TrainView:
        """The step's view, whole."""
        from spikerig.train.targets import views_of_step

        return views_of_step(targets, config.seed, step)[0]

    def draw(self, model: SplatModel, view: TrainView, pose: Tensor, step: Step) -> list[Tensor]:
        """One picture."""
        config = model.config
        rows = config.sh_degree + 1
        degree = min(config.sh_degree, int(step.fraction / max(config.sh_warmup, 1e-9) * rows))
        return [model.draw(pose, step.background, degree).image]

    def rates(self, name: str, config: FitConfig) -> tuple[float, float | None]:
        """The config's rate of each tensor; a twentieth for view-dependent colour."""
        return getattr(config, RATES[name]), HIGHER_SH if name == "sh" else None

    def regularise(self, params: Tensors, config: FitConfig) -> list[Tensor]:
        """Opacity and size of the splats."""
        terms = []
        if config.opacity_reg > 0:
            terms.append(config.opacity_reg * torch.sigmoid(params["logit_opacities"]).mean())
        if config.scale_reg > 0:
            terms.append(config.scale_reg * torch.exp(params["log_scales"]).mean())
        return terms

    def tend(self, state: Any, config: FitConfig, step: Step) -> None:
        """MCMC: dead splats go to live ones, all are jolted."""
        if config.densify != "mcmc":
            return
        splats = {n: state.params[n] for n in RATES}
        if step.number > 0 and step.number % config.densify_every == 0 and step.fraction < config.densify_until:
            with torch.no_grad():
                splats, moments = relocate(splats, {n: state.moments[n] for n in splats}, config.splats, step.rng)
            state.params |= {n: p.detach().requires_grad_() for n, p in splats.items()}
            state.moments |= moments
            splats = {n: state.params[n] for n in splats}
        jolt(splats, config.noise * config.lr_means * config.lr_end**step.fraction, step.rng)

    def check(self, config: FitConfig) -> None:
        """The rasteriser of the device."""
        renderer(config.device)

    def torch_threads(self) -> int:
        """One."""
        return 1
