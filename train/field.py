"""The seam between a fit and what it fits: a Field starts, draws and tends parameters; a Model draws finished ones."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from spikerig.dataset.scene import Camera, Floats
from spikerig.train.config import FitConfig
from spikerig.train.gauge import Gauge

if TYPE_CHECKING:
    from spikerig.dataset.scene import Points
    from spikerig.train.targets import Targets, TrainView

Tensors = dict[str, Tensor]


class Model(Protocol):
    """A scene that can be drawn, in a gauge, seen by one camera."""

    @property
    def gauge(self) -> Gauge:
        """Where it lives."""
        ...

    @property
    def camera(self) -> Camera:
        """Who sees it."""
        ...

    @property
    def config(self) -> FitConfig:
        """Of the fit."""
        ...

    def picture(self, cam_from_world: Floats) -> NDArray[np.float32]:
        """The picture float32[H,W,3] (sRGB codes, not clipped) for a pose of the world."""
        ...

    def depth(self, cam_from_world: Floats) -> NDArray[np.float32]:
        """Depth along z [H,W], world units; inf where alpha is below a half."""
        ...

    def middle(self) -> Floats:
        """The weighted middle [3] of what there is to see, world units."""
        ...

    def seen_by(self, camera: Camera) -> Model:
        """The same scene for another camera."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """What a field may need to know of a step: fraction of the run done, background, the step's random draws.

    Every draw appends what it cost to `drawn`: 1 a picture, or the number of rays.
    `notes`: what was seen on the way, by name: loss terms ("colour", "tfs", "parts") and what the field itself keeps.
    """

    number: int
    fraction: float
    background: tuple[float, float, float]
    rng: np.random.Generator
    drawn: list[int] = field(default_factory=list)
    notes: dict[str, list[Any]] = field(default_factory=dict)

    def note(self, name: str, what: Any) -> None:
        """Add to the notes."""
        self.notes.setdefault(name, []).append(what)


class Field(Protocol):
    """A way to hold a scene: `params` are trained by gradient, `grids` (also kept in checkpoints) are not."""

    def start(self, points: Points | None, gauge: Gauge, config: FitConfig) -> tuple[Tensors, Tensors]:
        """(params, grids) of step 0."""
        ...

    def model(self, params: Tensors, grids: Tensors, gauge: Gauge, camera: Camera, config: FitConfig) -> Model:
        """Something to draw pictures with."""
        ...

    def look(self, targets: Targets, camera: Camera, config: FitConfig, step: int, rng: np.random.Generator
    ) -> TrainView:  # fmt: skip
        """What a step compares with: a view, or pixels of some."""
        ...

    def draw(self, model: Any, view: TrainView, pose: Tensor, step: Step) -> list[Tensor]:
        """The view's renders from a pose (of each pixel, for a batch); each has a loss of its own, and they add up."""
        ...

    def rates(self, name: str, config: FitConfig) -> tuple[float, float | None]:
        """Learning rate of a parameter, and the share of it for all but the first three of a row (None: all)."""
        ...

    def regularise(self, params: Tensors, config: FitConfig) -> list[Tensor]:
        """Terms that are added to the loss."""
        ...

    def sense(self, config: FitConfig, step: Step) -> None:
        """Before the gradients of a step are taken: look at its terms apart."""
        ...

    def tend(self, state: Any, config: FitConfig, step: Step) -> None:
        """After a step: grow, move or prune parameters and moments, refresh grids."""
        ...

    def check(self, config: FitConfig) -> None:
        """Raise a HostError where the config's device cannot be used."""
        ...

    def torch_threads(self) -> int:
        """How many torch may use; with more than one, bits hold only at that number."""
        ...
