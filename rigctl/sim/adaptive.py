"""How many pictures of moving light are needed: an adaptive step in image motion and in brightness."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikerig.dataset.errors import UsageError
from spikerig.dataset.scene import Camera

Floats = NDArray[np.floating]
GRID = 9  # points along each side of the picture whose motion is looked at


def adaptive_phases(
    phases: ArrayLike,
    motion_px: ArrayLike,
    change: ArrayLike | None = None,
    *,
    step_px: float = 0.25,
    step_change: float = np.inf,
    most: int = 100_000,
) -> NDArray[np.float64]:
    """Phases at which to cast pictures so that neither motion nor brightness steps too far between two of them.

    Args:
        phases: increasing, [N], where the light was looked at.
        motion_px: image motion between them, [N-1], e.g. of `image_motion_px`.
        change: change of log light between them, [N-1], e.g. of `log_change`.
        step_px: most motion a step.
        step_change: most change of log light a step; ESIM asks for a part of the threshold.
        most: more pictures than this are refused.

    Returns:
        float64[M]: the phases, and between two of them as many more as the larger of both asks for, evenly spread.

    Raises:
        UsageError: phases that do not increase, measures that are negative or not finite, or too many pictures.

    Edges:
        Within an interval motion is taken to be even: look closer where it is not. A change that no motion explains (a
        lamp switched on) is divided evenly like any other. One phase needs nothing.

    Source:
        ESIM (Rebecq et al., CoRL 2018), eq. 3 and 4: step by the larger of brightness change and optic flow.
    """
    at = np.asarray(phases, np.float64)
    motion = np.asarray(motion_px, np.float64)
    changed = np.zeros_like(motion) if change is None else np.asarray(change, np.float64)
    if at.ndim != 1 or len(at) < 1 or motion.shape != (len(at) - 1,) or changed.shape != motion.shape:
        raise UsageError(
            "one motion and change between every two phases", value=(at.shape, motion.shape, changed.shape)
        )
    both = np.concatenate([motion, changed])
    if not (np.isfinite(at).all() and np.all(np.diff(at) > 0) and np.all((both >= 0) & np.isfinite(both))):
        raise UsageError("phases must increase, motion and change be finite and not negative", value=at[:8])
    if not (step_px > 0 and step_change > 0):
        raise UsageError("a step must be more than nothing", value=(step_px, step_change))
    wanted = np.maximum(motion / step_px, changed / step_change)
    parts = np.maximum(np.ceil(wanted - 1e-9), 1)
    if parts.sum() + 1 > most:
        raise UsageError(
            "more pictures than allowed", value=f"{parts.sum() + 1:.0f}, over {most}", next="raise the step"
        )
    n = parts.astype(np.int64)
    k = np.repeat(np.arange(len(n)), n)
    share = (np.arange(len(k)) - np.repeat(np.cumsum(n) - n, n)) / n[k]
    return np.append(at[k] + share * (at[k + 1] - at[k]), at[-1])


def image_motion_px(camera: Camera, poses: Floats, depths: ArrayLike) -> NDArray[np.float64]:
    """How far the picture moves at most from pose to pose.

    Args:
        camera: a pinhole; its distortion is not applied.
        poses: cam_from_world float64[N,3,4].
        depths: at which the scene may lie, along the axis: nearest and farthest bound what lies between.

    Returns:
        float64[N-1], pixels: the longest way of a grid of points of the first picture of each pair.

    Raises:
        UsageError: a depth that is not positive and finite.

    Edges:
        A point that comes to lie behind the next camera counts as the picture's diagonal.
    """
    depth = np.atleast_1d(np.asarray(depths, np.float64))
    if not (depth.size and np.all((depth > 0) & np.isfinite(depth))):
        raise UsageError("depths are positive and finite", value=depth[:8])
    u, v = np.meshgrid(np.linspace(0, camera.width, GRID), np.linspace(0, camera.height, GRID))
    pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
    rays = np.linalg.solve(camera.K, pixels)
    seen = np.concatenate([rays * z for z in depth], axis=1)
    start = np.tile(pixels[:2], (1, seen.shape[1] // u.size))
    out = np.zeros(len(poses) - 1)
    for k, (before, after) in enumerate(pairwise(poses)):
        world = before[:, :3].T @ (seen - before[:, 3:])
        there = camera.K @ (after[:, :3] @ world + after[:, 3:])
        ahead = there[2] > 0
        way = np.linalg.norm(there[:2, ahead] / there[2, ahead] - start[:, ahead], axis=0)
        out[k] = way.max(initial=0.0) if ahead.all() else np.hypot(camera.width, camera.height)
    return out


def log_change(light: Floats, eps: float, part: float = 100.0) -> NDArray[np.float64]:
    """Change of log(light + eps) between successive pictures [N,H,W]: of the pixel at `part` percent, float64[N-1].

    Edges:
        The largest change of all (100 %) is that of the sharpest edge that moves: it hardly falls with the step before
        the motion is well below a pixel.
    """
    logs = np.log(np.asarray(light, np.float64) + eps)
    return np.percentile(np.abs(np.diff(logs, axis=0)).reshape(len(logs) - 1, -1), part, axis=1)
