"""Light samples an exposure: as many as the picture's motion asks for, and the error that they leave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.images import srgb_from_linear
from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.judge.facts import PART
from spikerig.rigctl.sim.sensor import Light, spike_light
from spikerig.rigctl.sim.spec import Exposure, Sensor

Floats = NDArray[np.floating]
STEP_PX = 0.25  # longest image motion between light samples
STILL_PX = 1e-3  # an exposure with less motion takes one
GRID = 4  # pixels between those whose motion is looked at


def motion_px(camera: Camera, depth: Floats, label: Floats, poses: Floats, grid: int = GRID) -> Floats:
    """How far points of the surface move in the picture, pixels along their path.

    Args:
        camera: a pinhole.
        depth: [H,W] along z at the label; infinite or 0 where nothing is, which is taken as very far.
        label: cam_from_world float64[3,4] of the depth.
        poses: cam_from_world float64[N,3,4] in the order of time.
        grid: look at every so many pixels of rows and columns.

    Returns:
        float64[ceil(H/grid),ceil(W/grid)].

    Edges:
        A point that passes behind the camera counts no further.
    """
    z = np.asarray(depth, np.float64)[::grid, ::grid]
    known = np.isfinite(z) & (z > 0)
    z = np.where(known, z, 1e4 * (z[known].max() if known.any() else 1.0))
    y, x = np.mgrid[0 : depth.shape[0] : grid, 0 : depth.shape[1] : grid] + 0.5
    K = camera.K
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(z)], -1) * z[..., None]
    world = (rays - label[:, 3]) @ label[:, :3]
    total = np.zeros(z.shape)
    before = None
    for pose in poses:
        p = world @ pose[:, :3].T + pose[:, 3]
        ahead = p[..., 2] > 1e-6 * z
        with np.errstate(divide="ignore", invalid="ignore"):
            spot = p[..., :2] / p[..., 2:] * K[[0, 1], [0, 1]]
        if before is not None:
            moved = np.hypot(*np.moveaxis(spot - before, -1, 0))
            total += np.where(ahead & np.isfinite(moved), moved, 0.0)
        before = np.where(ahead[..., None], spot, np.nan)
    return total


def parts_for(motion: float, step: float = STEP_PX) -> int:
    """Parts an exposure is cut into so that the picture moves no further than `step` in one; even, so that
    mid-exposure is a cut."""
    return 2 * max(1, int(np.ceil(motion / (2 * step) - 1e-9)))


def sampled(exposure: Exposure, motion: float) -> Exposure:
    """The exposure with light samples for that motion (its own number, where it has one).

    Args:
        exposure: with sub_poses 0 for "as the motion asks".
        motion: the longest path of a pixel over the exposure, pixels.

    Edges:
        Never more samples than ticks. Without motion one sample stands still.
    """
    if exposure.sub_poses:
        return exposure
    if motion <= STILL_PX:
        return replace(exposure, sub_poses=1)
    if exposure.light == "hold":  # an odd number of slots: mid-exposure is the middle of one
        return replace(exposure, sub_poses=min(parts_for(motion) + 1, exposure.ticks))
    return replace(exposure, sub_poses=min(parts_for(motion), exposure.ticks) + 1)


def error_left(lights: Sequence[Light], parts: Sequence[int], sensor: Sensor, ticks: int) -> tuple[float, float, float]:
    """Error that light samples leave in 95 % of pixels, from pictures of a few views.

    Args:
        lights: over the exposures, sampled well enough that most steps hold one change of light.
        parts: what each of these exposures will be cut into.
        sensor: of the scene.
        ticks: of an exposure.

    Returns:
        Spikes an exposure; digital numbers; and the root of the summed squared steps of light, thresholds a tick.

    Source:
        A change of light d falls anywhere within a part, 1/n of the exposure, and is taken as even over it: a standard
        deviation of d / (n sqrt 12) in the mean. Changes add as squares; two standard deviations are
        2 ticks sqrt(sum d^2 / 12) / n. (Rays through a pixel's centre see edges as jumps, so more samples help as 1/n.)
    """
    roots, off, moved = [], [], []
    for light, n in zip(lights, parts, strict=True):
        root = np.sqrt(_squares(np.minimum(spike_light(light.rgb, sensor), 1)))  # a spike a tick is all there is
        roots.append(root.ravel())
        off.append(root.ravel() * (2 * ticks / np.sqrt(12) / n))
        change = np.sqrt(_squares(light.rgb)) * (2 / np.sqrt(12) / n)
        mean = light.rgb.mean(0, dtype=np.float64)
        low, high = (srgb_from_linear(np.clip(mean + sign * change, 0, 1)) for sign in (-1, 1))
        moved.append(127.5 * (high - low).ravel())
    most = [float(np.percentile(np.concatenate(values), PART)) for values in (off, moved, roots)]
    return most[0], most[1], most[2]


def _squares(pictures: Floats) -> Floats:
    """Sum over time of the squared steps from picture to picture."""
    total = np.zeros(pictures.shape[1:])
    for one, next_ in pairwise(pictures):
        total += np.square(next_ - one, dtype=np.float64)
    return total
