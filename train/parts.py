"""Optional pieces of the camera between a field and its losses, each with parameters of its own.

A part may move the camera of an instant, change the exposed picture before it is compared, ask for further instants,
read more of a view, and add loss terms. A finished model knows nothing of parts: held-out views are drawn without them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

from torch import Tensor

from spikerig.train.config import FitConfig
from spikerig.train.field import Step, Tensors

if TYPE_CHECKING:
    from spikerig.dataset.scene import View
    from spikerig.dataset.store import SceneFile
    from spikerig.train.targets import TrainView

T = TypeVar("T")


Draw = Callable[["TrainView", Tensor], list[Tensor]]  # (view, pose) -> renders


@dataclass(frozen=True, slots=True)
class Part:
    """One piece; every hook may be None, which means that it changes nothing.

    Args:
        name: its parameters are called `name:...` in State.params and checkpoints.
        remark: told with every fit and kept in run.json.
        instants: config -> fractions of the exposure that are rendered beside those of colour and textures.
        read: (scene, view, config) -> pictures [H,W,...] by name, kept as TrainView.beside (of a batch of pixels, the
            values there).
        start: fit.Task -> parameters by their short names; identity (a part at its start changes nothing).
        rate: (short name, config, fraction of the run done) -> learning rate of a step of Adam.
        descend: (params, moments by short name, config, fraction of the run done) instead of Adam: changes both in
            place, by the parameters' gradients.
        pose: (params, view, phase, pose, config) -> pose of that instant, [3,4] or [B,3,4].
        expose: (params, view, picture, config) -> the exposed picture as the camera would hand it out.
        draw: (params, draw, view, pose, step, fit.Task) -> the renders that stand for draw(view, pose), each [H,W,3].
        loss: (fit.State, fit.Task, view, pictures by phase, step) -> terms that are added to the loss.
    """

    name: str
    remark: str = ""
    instants: Callable[[FitConfig], tuple[float, ...]] | None = None
    read: Callable[[SceneFile, View, FitConfig], dict[str, Tensor]] | None = None
    start: Callable[[Any], Tensors] | None = None
    rate: Callable[[str, FitConfig, float], float] | None = None
    descend: Callable[[Tensors, dict[str, tuple[Tensor, Tensor]], FitConfig, float], None] | None = None
    pose: Callable[[Tensors, TrainView, float, Tensor, FitConfig], Tensor] | None = None
    expose: Callable[[Tensors, TrainView, Tensor, FitConfig], Tensor] | None = None
    draw: Callable[[Tensors, Draw, TrainView, Tensor, Step, Any], list[Tensor]] | None = None
    loss: Callable[[Any, Any, TrainView, dict[float, Tensor], Step], list[Tensor]] | None = None


def parts_of(config: FitConfig) -> tuple[Part, ...]:
    """The parts that a config asks for, in the order in which they act."""
    found: list[Any] = []  # Any: a module that is checked by its file name has a Part of its own
    if config.exposure != "off":
        from spikerig.train.exposure import AFFINE, BILATERAL

        found.append(AFFINE if config.exposure == "affine" else BILATERAL)
    if config.trajectory != "given":
        from spikerig.train.path import PART as PATH

        found.append(PATH)
    if config.event_weight > 0:
        from spikerig.train.eventloss import EVENTS

        found.append(EVENTS)
    if config.kernel_points > 0:
        from spikerig.train.blurkernel import KERNEL

        found.append(KERNEL)
    if config.restore_instants > 0:
        from spikerig.train import restore

        found.append(
            Part("restore", instants=restore.instants, read=restore.read, start=restore.start, loss=restore.loss)
        )
    return tuple(found)


def part_of(config: FitConfig, parameter: str) -> tuple[Part, str] | None:
    """The part that owns a parameter, and its short name; None for those of the field and the gray converter."""
    name, colon, short = parameter.partition(":")
    if not colon:
        return None
    return next((part, short) for part in parts_of(config) if part.name == name)


def start_parts(task: Any) -> Tensors:
    """The parameters of all parts at step 0."""
    return {
        f"{part.name}:{short}": tensor
        for part in parts_of(task.config)
        if part.start is not None
        for short, tensor in part.start(task).items()
    }


def own(part: Part, params: dict[str, T]) -> dict[str, T]:
    """A part's parameters (or what else is kept by their names) by their short names."""
    prefix = f"{part.name}:"
    return {name.removeprefix(prefix): p for name, p in params.items() if name.startswith(prefix)}


def pose_of(params: Tensors, view: TrainView, phase: float, config: FitConfig) -> Tensor:
    """The camera of an instant after all parts: [3,4], or [B,3,4] for a batch of pixels."""
    pose = view.instants[phase].pose
    for part in parts_of(config):
        if part.pose is not None:
            pose = part.pose(own(part, params), view, phase, pose, config)
    return pose


def drawn_by(params: Tensors, view: TrainView, phase: float, step: Step, task: Any, draw: Draw) -> list[Tensor]:
    """The field's renders of an instant after all parts; `draw` is the field's own."""
    for part in parts_of(task.config):
        if part.draw is not None:
            draw = partial(_drawn, part.draw, own(part, params), draw, step, task)
    return draw(view, pose_of(params, view, phase, task.config))


def _drawn(
    hook: Any, params: Tensors, draw: Draw, step: Step, task: Any, view: TrainView, pose: Tensor
) -> list[Tensor]:
    return hook(params, draw, view, pose, step, task)


def exposed_by(params: Tensors, view: TrainView, picture: Tensor, config: FitConfig) -> Tensor:
    """The exposed picture after all parts."""
    for part in parts_of(config):
        if part.expose is not None:
            picture = part.expose(own(part, params), view, picture, config)
    return picture
