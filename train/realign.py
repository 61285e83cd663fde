"""Test-time alignment: a held-out camera moved until the model's picture fits best. Its score is never the raw one.

Estimated held-out poses are off by a pixel or so, which costs dB that no reconstruction can win back. Aligning each
camera on the very picture it is scored on shows how much; it also forgives what it should not, so both are told.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from spikerig.calib.gauge import degrees_apart
from spikerig.dataset.errors import NumericsError
from spikerig.dataset.rigid import compose, exp_se3
from spikerig.dataset.scene import Floats
from spikerig.train.model import SplatModel

STEPS = 60
FIRST_PX, LAST_PX = 0.5, 0.02  # what a step moves the picture's middle by, at the start and at the end
BETAS = (0.8, 0.95)


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """A camera [3,4] of the model's world after alignment, how far it moved, and the mean squared errors."""

    pose: Floats
    deg: float
    px: float
    before: float
    after: float


def twist_gradient(pose: Floats, gradient: Floats) -> Floats:
    """d loss / d twist [6] (rotation, translation) of exp(twist) after `pose`, at 0, from d loss / d pose [3,4]."""
    return np.concatenate([np.cross(pose.T, gradient.T).sum(0), gradient[:, 3]])


def realign(model: SplatModel, pose: Floats, picture: NDArray[np.uint8], steps: int = STEPS) -> Aligned:
    """Move a camera to where the model's picture has the least squared error; it never ends worse than it began.

    Args:
        model: of splats; not changed.
        pose: [3,4] of the model's world (not of its gauge).
        picture: uint8[H,W,3] to fit.
        steps: renders, each with its gradient.

    Raises:
        NumericsError: the picture or its gradient is not finite.

    Cost: `steps` renders with gradients.
    Source: the pose gradient of the rasteriser; Adam on the twist, in pixels, step sizes falling to 0.02 px.
    """
    K = model.camera.K
    target = torch.from_numpy(picture.astype(np.float32) / 255)
    start = model.gauge.pose(np.asarray(pose, np.float64)).astype(np.float64)
    depth = max(float(np.linalg.norm(start[:, 3])), 0.1)  # the gauge's middle is its origin
    unit = np.array([1, 1, 1, depth, depth, depth]) / K[0, 0]  # a pixel, as radians or as a shift at that depth
    here, best, lowest, first = start, start, np.inf, np.inf
    m, v = np.zeros(6), np.zeros(6)
    for k in range(steps + 1):
        loss, gradient = _look(model, here, target)
        first = loss if k == 0 else first
        if loss < lowest:
            best, lowest = here, loss
        if k == steps:
            break
        g = twist_gradient(here, gradient) * unit
        m, v = BETAS[0] * m + (1 - BETAS[0]) * g, BETAS[1] * v + (1 - BETAS[1]) * g * g
        length = np.sqrt(np.max(v) / (1 - BETAS[1] ** (k + 1)))  # one length for all six: steep ones go first
        if length == 0:
            break
        px = FIRST_PX * (LAST_PX / FIRST_PX) ** (k / max(steps - 1, 1))
        step = px * (m / (1 - BETAS[0] ** (k + 1))) / length
        here = compose(exp_se3(-step * unit), here)
    world = _to_world(model, best)
    deg = float(degrees_apart(best[None], start[None])[0])
    return Aligned(world, deg, _moved_px(K, start, best), first, lowest)


def _look(model: SplatModel, pose: Floats, target: torch.Tensor) -> tuple[float, Floats]:
    camera = torch.tensor(pose, dtype=torch.float32, requires_grad=True)
    loss = (model.draw(camera).image.cpu() - target).square().mean()
    loss.backward()
    value, gradient = float(loss.detach()), camera.grad
    if gradient is None or not np.isfinite(value) or not bool(torch.isfinite(gradient).all()):
        raise NumericsError("a camera cannot be aligned: the picture or its gradient is not finite", value=value)
    return value, gradient.numpy().astype(np.float64)


def _to_world(model: SplatModel, pose: Floats) -> Floats:
    R, t = pose[:, :3], pose[:, 3]
    return np.concatenate([R, (t / model.gauge.scale - R @ np.array(model.gauge.centre))[:, None]], axis=1)


def _moved_px(K: Floats, a: Floats, b: Floats) -> float:
    """How far the gauge's middle moved in the picture, pixels."""
    seen = [K @ p[:, 3] for p in (a, b)]
    if min(s[2] for s in seen) <= 0:
        return float("nan")
    return float(np.linalg.norm(seen[0][:2] / seen[0][2] - seen[1][:2] / seen[1][2]))
