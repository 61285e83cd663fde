"""E2NeRF's event loss: renders at the ends of event bins must differ in log light as the events between them say."""

from __future__ import annotations

import math
from itertools import combinations
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from spikerig.dataset.errors import DataError
from spikerig.train.config import FitConfig
from spikerig.train.eventview import event_sums, require_events, thresholds_of
from spikerig.train.field import Step
from spikerig.train.losses import REC601, linear_from_srgb, mean_weights
from spikerig.train.parts import Part

if TYPE_CHECKING:
    from spikerig.dataset.scene import View
    from spikerig.dataset.store import SceneFile
    from spikerig.train.targets import TrainView

KNEE = 20.0  # of 0..255: below it, the log of codes is a line


def lin_log(code: Tensor) -> Tensor:
    """Log of codes in 0..255, a line through 0 below 20.

    Source: E2NeRF's event_loss_helpers.py, as in v2e.
    """
    return torch.where(code <= KNEE, code * (math.log(KNEE) / KNEE), torch.log(code.clamp(min=KNEE)))


def log_light(picture: Tensor, eps: Tensor, kind: str) -> Tensor:
    """What an event camera sees of sRGB codes [H,W,3]: [H,W].

    Args:
        picture: of a render.
        eps: [H,W] or scalar, added to light.
        kind: linear = log of the gray of linear light, + eps; encoded = `lin_log` of the gray of codes, as published.
    """
    weights = torch.tensor(REC601, dtype=picture.dtype, device=picture.device)
    if kind == "encoded":
        return lin_log(255 * (picture * weights).sum(-1))
    return torch.log((linear_from_srgb(picture) * weights).sum(-1).clamp(min=0) + eps.clamp(min=1e-6))


def pair_loss(
    change: Tensor, events: Tensor, up: Tensor, down: Tensor, weight: Tensor, *, shift: float, hinge: float
) -> Tensor:
    """One pair's loss: a weighted mean of squared differences in events.

    Args:
        change: [H,W] of log light between the two instants.
        events: [H,W] up less down between them.
        up, down: [H,W] or scalar thresholds.
        weight: [H,W], 1/pixels on those that count.
        shift: added to the number of events away from 0: a count rounds down (0.5 as published).
        hinge: weight of pixels without events, where a change of more than one threshold costs; 0 as published.
    """
    rise, fall = change / up, change / down
    residual = torch.where(events > 0, rise - (events + shift), torch.where(events < 0, fall - (events - shift), 0.0))
    loss = (weight * residual * residual).sum()
    if hinge > 0:
        over = torch.where(events == 0, torch.maximum(rise, -fall) - 1, 0.0).clamp(min=0)
        loss = loss + hinge * (weight * over * over).sum()
    return loss


def _read(scene: SceneFile, view: View, config: FitConfig) -> dict[str, Tensor]:
    require_events(scene)
    found = thresholds_of(scene, config)
    if found is None:
        raise DataError(
            "nobody says at which thresholds the events of this scene were made",
            value=scene.name,
            expected="thresholds recorded by the simulator",
            next="--set event_pos=0.2 --set event_neg=0.2; `--method edi` searches one and writes it to run.json",
        )
    sums = torch.from_numpy(event_sums(scene, view, config.poses_per_view - 1)).float()
    three = torch.tensor([found.up, found.down, found.eps], dtype=torch.float32)
    return {"events": sums.permute(1, 2, 0).contiguous(), "thresholds": three.expand(*sums.shape[1:], 3)}


def _loss(state: Any, task: Any, view: TrainView, pictures: dict[float, Tensor], step: Step) -> list[Tensor]:
    config: FitConfig = task.config
    numbers = [k for k, phase in enumerate(task.targets.colour) if phase in pictures]
    pairs = list(combinations(numbers, 2))
    if not pairs:  # a step that renders another instant
        return []
    up, down, eps = view.beside["thresholds"].unbind(-1)
    logs = {k: log_light(pictures[task.targets.colour[k]], eps, config.event_light) for k in numbers}
    events = view.beside["events"]
    weight = mean_weights(torch.ones(events.shape[:2], dtype=torch.bool) if view.valid is None else view.valid)
    losses = [
        pair_loss(
            logs[e] - logs[s], events[..., s:e].sum(-1), up, down, weight,
            shift=config.event_shift, hinge=config.event_hinge,
        )
        for s, e in pairs
    ]  # fmt: skip
    return [config.event_weight * torch.stack(losses).mean()]


EVENTS = Part("events", read=_read, loss=_loss)
