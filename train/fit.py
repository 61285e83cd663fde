"""The loop: views -> loss -> field. Same seed and steps give the same bits for any thread count, resumed or not.

How that is kept: the kernels' sums have a fixed order; torch is held to one thread (its own reductions and chunked
elementwise ops are not independent of the count; field nerf, all torch, has the kernels' count and keeps its bits at
that count); every draw comes from (seed, step), so there is no generator whose state could be lost; the checkpoint
holds parameters, Adam's moments, the field's grids, step, and history.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from spikerig.dataset.errors import NumericsError
from spikerig.dataset.scene import Camera
from spikerig.train import checkpoint
from spikerig.train.adam import update
from spikerig.train.config import FitConfig, effective_weight
from spikerig.train.converter import LEARNED, converter, start_converter
from spikerig.train.field import Field, Model, Step, Tensors
from spikerig.train.fields import field_of
from spikerig.train.filters import tfs_through
from spikerig.train.gauge import Gauge
from spikerig.train.losses import average_exposure, l2_loss, light_of, mean_weights, tfs_loss
from spikerig.train.model import BACKGROUNDS
from spikerig.train.parts import drawn_by, exposed_by, own, part_of, parts_of, start_parts
from spikerig.train.ssim import l1_ssim
from spikerig.train.targets import Targets, TrainView

if TYPE_CHECKING:
    from spikerig.dataset.scene import Points

CHECK_EVERY = 50  # steps between looks for values that are not finite


@dataclass(slots=True, eq=False)
class State:
    """What a fit changes: parameters and Adam's moments by name, the next step, seconds trained, held-out dB over time.

    `grids`: what the field keeps beside its parameters.
    `cpu`: seconds of CPU, all threads; `renders`: pictures of splats, or rays, drawn for training so far.
    `memory`: linear light (float16[H,W,3]) of the last renders of sub-poses by (view, phase), where fresh_poses asks.
    """

    params: dict[str, Tensor]
    moments: dict[str, tuple[Tensor, Tensor]]
    step: int = 0
    seconds: float = 0.0
    history: list[dict[str, Any]] = field(default_factory=list)
    memory: dict[tuple[str, float], Tensor] = field(default_factory=dict)
    grids: Tensors = field(default_factory=dict)
    cpu: float = 0.0
    renders: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """What a fit works with and does not change; `gray` [4]: the frozen converter, or where the learned one starts."""

    config: FitConfig
    camera: Camera
    gauge: Gauge
    targets: Targets
    gray: Tensor

    @property
    def field(self) -> Field:
        """What is fitted."""
        return field_of(self.config)

    @property
    def weight(self) -> float:
        """Mean-equivalent weight of the TfS term."""
        pixels = self.camera.width * self.camera.height
        return effective_weight(self.config.tfs_weight, self.config.weight_reading, pixels)

    def model(self, state: State) -> Model:
        """The model of the current parameters."""
        return self.field.model(state.params, state.grids, self.gauge, self.camera, self.config)


def new_state(points: Points | None, task: Task) -> State:
    """Step 0: the field's start, and the gray converter where it is learned."""
    params, grids = task.field.start(points, task.gauge, task.config)
    if task.config.gray in LEARNED and task.targets.gray is not None:
        params = {**params, "gray": start_converter(task.config.gray, task.gray)}
    params = {**params, **start_parts(task)}
    leaves = {name: p.detach().clone().requires_grad_() for name, p in params.items()}
    moments = {name: (torch.zeros_like(p), torch.zeros_like(p)) for name, p in params.items()}
    return State(leaves, moments, grids=grids)


@contextmanager
def torch_threads(count: int = 1) -> Iterator[None]:
    """Hold torch to some threads inside: its elementwise ops and sums depend on the count in the last bits."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def train(
    state: State,
    task: Task,
    *,
    after: Callable[[State, float, float], None] = lambda state, fraction, loss: None,
) -> State:
    """Run a fit to its end.

    Args:
        state: where to begin; changed in place.
        task: of the fit; the length of the run is config.steps, or config.seconds of training where positive.
        after: called after every step with (state, fraction of the run done, loss); its time does not count.

    Returns:
        The same state.

    Raises:
        NumericsError: a loss or parameter stopped being finite; names step, tensor and index.
    """
    with torch_threads(task.field.torch_threads()):
        while (fraction := fraction_done(state, task.config)) < 1:
            begin, worked = time.perf_counter(), time.process_time()
            loss = one_step(state, task, fraction)
            state.seconds += time.perf_counter() - begin
            state.cpu += time.process_time() - worked
            after(state, fraction_done(state, task.config), loss)
    return state


def fraction_done(state: State, config: FitConfig) -> float:
    """How much of the run is done, by seconds where the config gives them, by steps else."""
    return state.seconds / config.seconds if config.seconds > 0 else state.step / config.steps


def step_of(state: State, task: Task, fraction: float) -> tuple[TrainView, Step]:
    """What the next step looks at, and its draws: view order by epoch, the rest by step."""
    config = task.config
    rng = np.random.default_rng((config.seed, 2, state.step))
    view = task.field.look(task.targets, task.camera, config, state.step, rng)
    background = BACKGROUNDS[config.background]
    if config.background == "random":
        r, g, b = rng.uniform(0, 1, 3)
        background = (r, g, b)
    return view, Step(state.step, fraction, background, rng)


def one_step(state: State, task: Task, fraction: float) -> float:
    """One look, one update; returns the loss."""
    for p in state.params.values():
        p.grad = None
    view, step = step_of(state, task, fraction)
    loss = view_loss(state, task, view, step)
    value = loss.item()
    if not np.isfinite(value):
        raise _not_finite(state, f"the loss of view '{view.name}' is {value}")
    if loss.requires_grad:
        task.field.sense(task.config, step)
        loss.backward()
    _descend(state, task, fraction)
    if state.step % CHECK_EVERY == 0:
        check_finite(state)
    task.field.tend(state, task.config, step)
    state.step += 1
    state.renders += sum(step.drawn)
    return value


def view_loss(state: State, task: Task, view: TrainView, step: Step) -> Tensor:
    """The whole loss of one view: colour term and TfS term of each of the field's renders, regularisers."""
    config, targets = task.config, task.targets
    model = task.model(state)

    def draw(phase: float) -> list[Tensor]:
        images = drawn_by(state.params, view, phase, step, task, lambda v, pose: task.field.draw(model, v, pose, step))
        if config.fresh_poses > 0:
            state.memory[view.name, phase] = light_of(images[0]).half()
        return images

    ratio = None
    if step.fraction < config.ratio_until:
        ratio = targets.ratio[step.rng.integers(len(targets.ratio))]
        drawn = {ratio: draw(ratio)}
    else:
        drawn = {phase: draw(phase) for phase in _fresh(state, task, view, step.rng)}
    losses = [
        _pictures_loss(state, task, view, {phase: images[k] for phase, images in drawn.items()}, ratio, step)
        for k in range(len(next(iter(drawn.values()))))
    ]
    losses += task.field.regularise(state.params, config)
    return sum(losses[1:], losses[0])


def _pictures_loss(
    state: State, task: Task, view: TrainView, pictures: dict[float, Tensor], ratio: float | None, step: Step
) -> Tensor:
    """All terms of one render at each instant; `ratio` is the instant of a ratio target."""
    config, targets = task.config, task.targets
    drawn = [pictures[p] for p in targets.colour if p in pictures]
    if ratio is not None:
        exposed = exposed_by(state.params, view, pictures[ratio], config)
        loss = colour_loss(exposed, view.instants[ratio].ratio.float(), view.valid, config)
    elif drawn:
        kept = [state.memory[view.name, p] for p in targets.colour if p not in pictures]
        others = sum((light.float() for light in kept[1:]), kept[0].float()) if kept else None
        exposed = exposed_by(state.params, view, _average(drawn, others, task), config)
        loss = len(targets.colour) / len(drawn) * colour_loss(exposed, view.frame, view.valid, config)
    else:  # only an instant with textures and no part in the average
        loss = torch.zeros(())
    if config.colour_weight != 1:
        loss = config.colour_weight * loss
    step.note("colour", loss)
    if task.weight > 0 and step.fraction >= config.tfs_from:
        step.note("tfs", task.weight * _tfs_term(state, task, view, pictures))
        loss = loss + step.notes["tfs"][-1]
    for part in parts_of(config):
        if part.loss is not None:
            step.note("parts", sum(part.loss(state, task, view, pictures, step), torch.zeros(())))
            loss = loss + step.notes["parts"][-1]
    return loss


def _average(drawn: list[Tensor], others: Tensor | None, task: Task) -> Tensor:
    """The exposed picture of sub-poses, in the config's domain."""
    if task.config.average_domain == "encoded":
        return torch.stack(drawn).mean(0)
    return average_exposure(drawn, others, len(task.targets.colour))


def _fresh(state: State, task: Task, view: TrainView, rng: np.random.Generator) -> list[float]:
    """The instants to render in a step: all, or `fresh_poses` random ones and those never rendered before."""
    wanted = list(dict.fromkeys((*task.targets.colour, *task.targets.tfs, *task.targets.also)))
    k = task.config.fresh_poses
    if k == 0 or k >= len(wanted):
        return wanted
    chosen = {wanted[i] for i in rng.choice(len(wanted), k, replace=False)}
    return [p for p in wanted if p in chosen or (view.name, p) not in state.memory]


def _tfs_term(state: State, task: Task, view: TrainView, pictures: dict[float, Tensor]) -> Tensor:
    gray, heights = task.gray, None
    if "gray" in state.params:
        gray, heights = converter(task.config.gray, state.params["gray"], task.gray)
    supervised = [phase for phase in pictures if view.instants[phase].textures]
    total = torch.zeros(())
    for phase in supervised:
        for texture, weight in view.instants[phase].textures:
            if task.targets.filters is not None:
                seen = (view.beside["site"], task.targets.filters.weights)
                total = total + tfs_through(pictures[phase], texture, weight, *seen, task.config.tfs_domain)
                continue
            total = total + tfs_loss(pictures[phase], texture, weight, gray, task.config.tfs_domain, heights)
    return total / len(supervised) if len(supervised) > 1 else total


def colour_loss(image: Tensor, target: Tensor, valid: Tensor | None, config: FitConfig) -> Tensor:
    """L2, or L1 with structural dissimilarity, as a mean over valid pixels."""
    if config.colour_loss == "l2":
        return l2_loss(image, target, None if valid is None else mean_weights(valid))
    return l1_ssim(image, target, ssim_weight=config.ssim_weight, valid=valid)


def _descend(state: State, task: Task, fraction: float) -> None:
    config = task.config
    decay = config.lr_end ** min(fraction, 1.0)
    for name, p in state.params.items():
        if (owner := part_of(config, name)) is not None:
            part, short = owner
            if part.descend is not None:
                continue
            rate = 0.0 if part.rate is None else part.rate(short, config, min(fraction, 1.0))
            update(p, state.moments[name], state.step + 1, rate, head=3, rest=None)
            continue
        base, share = (config.lr_gray, None) if name == "gray" else task.field.rates(name, config)
        rate = base * decay
        update(p, state.moments[name], state.step + 1, rate, head=3, rest=None if share is None else rate * share)
    for part in parts_of(config):
        if part.descend is not None:
            part.descend(own(part, state.params), own(part, state.moments), config, min(fraction, 1.0))


def check_finite(state: State) -> None:
    """Raise a NumericsError naming step, tensor and index of the first value that is not finite."""
    for name, p in state.params.items():
        if not torch.isfinite(p).all():
            raise _not_finite(state, f"'{name}' holds values that are not finite")


def _not_finite(state: State, what: str) -> NumericsError:
    where = "no parameter; look at the targets"
    for name, p in state.params.items():
        for kind, values in ((name, p), (f"gradient of {name}", p.grad)):
            bad = None if values is None else torch.nonzero(~torch.isfinite(values))
            if bad is not None and len(bad):
                where = f"{kind}, index {bad[0].tolist()} ({len(bad)} in all)"
                break
    return NumericsError(
        f"training diverged at step {state.step}: {what}",
        value=where,
        expected="finite numbers",
        cause="too large a learning rate or weight, or a target that is not finite",
        next="lower the learning rates (--set lr_means=...) or the TfS weight; resume from the last checkpoint",
    )


def save_state(path: Path, state: State, config: FitConfig) -> None:
    """Checkpoint: everything that the rest of the run depends on."""
    tensors: dict[str, Tensor] = {f"param/{n}": p for n, p in state.params.items()}
    for name, (mean, square) in state.moments.items():
        tensors |= {f"adam/{name}/mean": mean, f"adam/{name}/square": square}
    tensors |= {f"grid/{n}": g for n, g in state.grids.items()}
    tensors |= {f"memory/{view}/{phase!r}": image for (view, phase), image in state.memory.items()}
    record = {"step": state.step, "seconds": state.seconds, "history": state.history, "config": config.as_json()}
    record |= {"cpu": state.cpu, "renders": state.renders}
    checkpoint.save(path, tensors, record)


def load_state(path: Path) -> tuple[State, dict[str, Any]]:
    """The state of a checkpoint, and the config it was made with."""
    tensors, record = checkpoint.load(path)
    leaves = {n.removeprefix("param/"): p.requires_grad_() for n, p in tensors.items() if n.startswith("param/")}
    moments = {name: (tensors[f"adam/{name}/mean"], tensors[f"adam/{name}/square"]) for name in leaves}
    state = State(leaves, moments, int(record["step"]), float(record["seconds"]), list(record["history"]))
    state.cpu, state.renders = float(record.get("cpu", 0.0)), int(record.get("renders", 0))
    state.grids = {n.removeprefix("grid/"): g for n, g in tensors.items() if n.startswith("grid/")}
    for name, image in tensors.items():
        if name.startswith("memory/"):
            _, view, phase = name.split("/")
            state.memory[view, float(phase)] = image
    return state, record["config"]
