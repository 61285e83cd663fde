"""The part `path`: how each training camera moved during its exposure, optimised with the scene.

A view's pose at a fraction u of its exposure is S(u) P(u): P is what was given (the scene's trajectory, or the one
mid-exposure pose where there is none), S a spline on SE(3) in the camera's frame whose knots are trained. Held-out
cameras have no knots. The gauge freedom (a common motion of all cameras, and a common scale) is projected out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from spikerig.dataset.rigid import compose as after
from spikerig.dataset.rigid import hat
from spikerig.dataset.scene import Floats
from spikerig.train.config import FitConfig
from spikerig.train.field import Tensors
from spikerig.train.parts import Part, own
from spikerig.train.se3 import compose, cubic_spline, inverse, linear_spline
from spikerig.train.trajectory import PATH_PHASES, phases

if TYPE_CHECKING:
    from spikerig.train.fit import State, Task
    from spikerig.train.targets import TrainView

NAME = "path"
MIDDLE = PATH_PHASES.index(0.5)
BETAS = (0.9, 0.95)
WARM = 0.15  # of the run, over which the rate grows from 0: before there is a scene, cameras fit nothing
START_PX = 3.0  # path length given to cameras that stand still: see `start`


def span_of(config: FitConfig) -> tuple[float, float, int]:
    """Where the knots are: the fractions of the exposure of the first and the last piece's ends, and knots a view.

    Even: over the exposure. Spikes: every piece of the spline ends at an instant with a texture (of a ratio target, of
    the colour average where there are no textures). A cubic spline has 2 more knots than ends.
    """
    more = 2 if config.trajectory == "cubic" else 0
    if config.knots_at == "even":
        return 0.0, 1.0, config.knots or 2 + more
    counts = [config.textures_per_view if config.tfs_weight > 0 else 0, config.poses_per_view]
    counts.append(config.ratio_instants if config.ratio_until > 0 else 0)
    count = counts[2] if config.ratio_until >= 1 else counts[0] or counts[2] or counts[1]
    found = phases(max(count, 2), config.instants_rule, config.pose_label)
    return found[0], found[-1], len(found) + more


def correction(knots: Tensor, phase: float, config: FitConfig) -> Tensor:
    """The motions S [...,3,4] of knots [...,K,6] at a fraction of the exposure."""
    first, last, _ = span_of(config)
    cubic = config.trajectory == "cubic"
    pieces = knots.shape[-2] - (3 if cubic else 1)
    spline = cubic_spline if cubic else linear_spline
    return spline(knots, (phase - first) / (last - first) * pieces)


def moves(params: Tensors, which: Tensor | slice, phase: float, config: FitConfig) -> Tensor:
    """The motions S [V,3,4] of some views at a fraction of the exposure; anchor `mid`: S(u) S(1/2)^-1."""
    knots = params["knots"][which]
    found = correction(knots, phase, config)
    return compose(found, inverse(correction(knots, 0.5, config))) if config.anchor == "mid" else found


def pose(params: Tensors, view: TrainView, phase: float, given: Tensor, config: FitConfig) -> Tensor:
    """The camera of an instant: [3,4] of a view, [B,3,4] of a batch of pixels."""
    if view.pixels is None:
        return compose(moves(params, view.which, phase, config)[0], given)
    shown, of_pixel = torch.unique(view.which, return_inverse=True)
    return compose(moves(params, shown, phase, config)[of_pixel], given)


@torch.no_grad()
def descend(params: Tensors, moments: dict[str, tuple[Tensor, Tensor]], config: FitConfig, fraction: float) -> None:
    """One step of the views that were looked at: Adam with two lengths a view (moving its path, bending it).

    A view is looked at once an epoch; plain Adam would go on moving it in between. One length for many numbers lets the
    directions go first that the pictures tell apart; a length each would shake the others at the same rate. The rate is
    lr_poses, grown over the first WARM of the run, falling to lr_poses_end times that.
    """
    knots, looks, freedom = params["knots"], params["looks"], params["freedom"]
    if knots.grad is None:
        return
    mean, square = moments["knots"]
    seen = torch.nonzero(knots.grad.abs().amax((1, 2)))[:, 0]
    looks[seen] += 1
    gradient, count = knots.grad[seen], looks[seen][:, None, None]
    mean[seen] = BETAS[0] * mean[seen] + (1 - BETAS[0]) * gradient
    rate = config.lr_poses * config.lr_poses_end**fraction * min(1.0, fraction / WARM)
    for k, (of_mean, of_gradient) in enumerate(
        zip(_shared_and_own(mean[seen]), _shared_and_own(gradient), strict=True)
    ):
        size = of_gradient.square().mean((1, 2))[:, None]
        square[seen, k] = BETAS[1] * square[seen, k] + (1 - BETAS[1]) * size
        length = torch.sqrt(square[seen, k][:, None] / (1 - BETAS[1] ** count))
        knots[seen] -= rate * of_mean / (1 - BETAS[0] ** count) / length.clamp(min=1e-20)
    if config.anchor == "mean":
        common = (freedom * knots.mean(1)[..., None]).sum((0, 1))
        knots -= (freedom @ common)[:, None]


def _shared_and_own(gradient: Tensor) -> tuple[Tensor, Tensor]:
    """What all knots of a view [V,K,6] have in common, which moves the path, and the rest, which bends it."""
    shared = gradient.mean(1, keepdim=True).expand_as(gradient)
    return shared, gradient - shared


def start(task: Task) -> Tensors:
    """Knots [N,K,6]; beside them the directions [N,6,7] of the gauge freedom, and how often each view was seen [N].

    Where the given poses move, S starts as the identity. Where a camera is given one pose for all instants, a path of
    length 0 is a saddle of the blur (any path and its reverse explain it alike), so it gets a turn of START_PX pixels
    in a direction drawn by seed and view: enough to be told apart from none by the pictures, too little to blur them.
    """
    config, targets = task.config, task.targets
    _, _, count = span_of(config)
    knots = np.zeros((len(targets.views), count, 6), np.float32)
    where = np.linspace(-0.5, 0.5, count)[:, None]
    for number, view in enumerate(targets.views):
        poses = [instant.pose for instant in view.instants.values()]
        if len(poses) > 1 and all(torch.equal(each, poses[0]) for each in poses):
            angle = np.random.default_rng((config.seed, 7, number)).uniform(0, 2 * np.pi)
            turn = START_PX / float(task.camera.K[0, 0])
            knots[number, :, :2] = where * turn * [np.cos(angle), np.sin(angle)]
    mids = np.stack([task.gauge.pose(each[MIDDLE]) for each in targets.given]).astype(np.float64)
    return {
        "knots": torch.from_numpy(knots),
        "freedom": torch.from_numpy(gauge_directions(mids)).float(),
        "looks": torch.zeros(len(knots)),
    }


def gauge_directions(poses: Floats) -> Floats:
    """Orthonormal directions [N,6,7] of the twists by which a common motion or scale moves N cameras [N,3,4].

    Edges: fewer freedoms than 7 (one camera, cameras at one place) leave columns of 0.
    Source: P exp(g) = exp(Ad(P) g) P; scaling the world by 1 + s shifts a camera by s t.
    """
    columns = np.zeros((len(poses), 6, 7))
    for k, each in enumerate(poses):
        R, t = each[:, :3], each[:, 3]
        columns[k, :3, :3], columns[k, 3:, :3], columns[k, 3:, 3:6] = R, hat(t) @ R, R
        columns[k, 3:, 6] = t
    u, s, _ = torch.linalg.svd(torch.from_numpy(columns.reshape(-1, 7)), full_matrices=False)
    found = np.zeros((6 * len(poses), 7))
    found[:, : len(s)] = np.where(s > 1e-9 * max(float(s[0]), 1e-300), u.numpy(), 0.0)
    return found.reshape(-1, 6, 7)


PART = Part(NAME, start=start, pose=pose, descend=descend)


def paths(state: State, task: Task) -> dict[str, Floats]:
    """The poses [5,3,4] of the world at PATH_PHASES of every training view, as they are now."""
    given, config = task.targets.given, task.config
    names = [view.name for view in task.targets.views]
    if config.trajectory == "given":
        return dict(zip(names, given, strict=True))
    params = {n: p.detach().double() for n, p in own(PART, state.params).items()}
    turned = [moves(params, slice(None), phase, config).numpy() for phase in PATH_PHASES]
    found = np.empty_like(given)
    for k, j in np.ndindex(given.shape[:2]):
        move = turned[j][k].copy()
        move[:, 3] /= task.gauge.scale
        found[k, j] = after(move, given[k, j])
    return dict(zip(names, found, strict=True))
