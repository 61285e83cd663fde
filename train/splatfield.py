"""Splats as a field: whole views, densification, regularisers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from spikerig.dataset.scene import Camera
from spikerig.train.config import FitConfig
from spikerig.train.densify import jolt, relocate
from spikerig.train.field import Step, Tensors
from spikerig.train.gauge import Gauge
from spikerig.train.grow import Rule, blank, fade, grow, watch
from spikerig.train.model import SplatModel, renderer, splats_of
from spikerig.train.splat import Rendered
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


def _probe(drawn: Rendered, config: FitConfig) -> Tensor:
    """Where a picture's screen gradient arrives."""
    probe = drawn.absgrad_probe if config.absgrad else drawn.means2d_probe
    if probe is None:
        raise ValueError("a picture drawn with gradients")
    return probe


def _put(state: Any, splats: Tensors, moments: Any) -> None:
    state.params |= {n: p.detach().requires_grad_() for n, p in splats.items()}
    state.moments |= moments


class SplatField:
    """See `field.Field`."""

    def start(self, points: Points | None, gauge: Gauge, config: FitConfig) -> tuple[Tensors, Tensors]:
        """Splats on the scene's points."""
        params = start_splats(points, gauge, config)
        return params, blank(len(params["means"])) if config.densify == "default" else {}

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
        step.drawn.append(1)
        rows = config.sh_degree + 1
        degree = min(config.sh_degree, int(step.fraction / max(config.sh_warmup, 1e-9) * rows))
        drawn = model.draw(pose, step.background, degree)
        if config.densify == "default":
            step.note("drawn", drawn)
        return [drawn.image]

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

    def sense(self, config: FitConfig, step: Step) -> None:
        """Screen gradients of one term alone, where densification asks for it: one more way back."""
        wanted = config.densify_by
        if config.densify != "default" or wanted == "all" or set(step.notes) <= {"drawn", wanted}:
            return
        term: Any = sum(step.notes.get(wanted, []))
        step.notes["apart"] = []
        if isinstance(term, Tensor) and term.requires_grad:
            probes = [_probe(picture, config) for picture in step.notes["drawn"]]
            step.notes["apart"] += torch.autograd.grad(term, probes, retain_graph=True, materialize_grads=True)

    def tend(self, state: Any, config: FitConfig, step: Step) -> None:
        """Densification."""
        if config.densify == "mcmc":
            self._mcmc(state, config, step)
        if config.densify == "default":
            self._default(state, config, step)

    def _mcmc(self, state: Any, config: FitConfig, step: Step) -> None:
        """Dead splats go to live ones, all are jolted."""
        splats = {n: state.params[n] for n in RATES}
        if step.number > 0 and step.number % config.densify_every == 0 and step.fraction < config.densify_until:
            cap = config.splats_most or config.splats
            with torch.no_grad():
                splats, moments = relocate(splats, {n: state.moments[n] for n in splats}, cap, step.rng)
            _put(state, splats, moments)
            splats = {n: state.params[n] for n in RATES}
        jolt(splats, config.noise * config.lr_means * config.lr_end**step.fraction, step.rng)

    def _default(self, state: Any, config: FitConfig, step: Step) -> None:
        """Watch every step; a round every `densify_every` steps; opacities reset now and then."""
        if step.fraction >= config.densify_until:
            return
        drawn = step.notes.get("drawn", [])
        found = step.notes.get("apart", [_probe(picture, config).grad for picture in drawn])
        if found and all(g is not None for g in found):
            watch(state.grids, drawn, found)
        done, reset = step.number + 1, config.opacity_reset
        splats, moments = {n: state.params[n] for n in RATES}, {n: state.moments[n] for n in RATES}
        if done % config.densify_every == 0 and step.fraction >= config.densify_from:
            huge = config.huge if 0 < reset < done else math.inf
            threshold = config.densify_grad or (8e-4 if config.absgrad else 2e-4)
            cap = config.splats_most or 4 * config.splats
            rule = Rule(threshold, config.densify_size, cap, config.densify_share, huge)
            splats, moments = grow(splats, moments, state.grids, rule, step.rng)
            _put(state, splats, moments)
            state.grids |= blank(len(splats["means"]))
        if reset and done % reset == 0:
            fade({n: state.params[n] for n in RATES}, state.moments)

    def check(self, config: FitConfig) -> None:
        """The rasteriser of the device."""
        renderer(config.device)

    def torch_threads(self) -> int:
        """One."""
        return 1
