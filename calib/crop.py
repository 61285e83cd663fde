"""Where a pixel of one arm lies in the other: through lenses, mirror and the step between the arms."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikerig.calib.lens import directions, project
from spikerig.calib.rig import Arm, RigCalibration
from spikerig.dataset.errors import UsageError

Floats = NDArray[np.float64]


def unmirrored(calibration: RigCalibration, arm: Arm, px: ArrayLike) -> Floats:
    """Pixels float64[...,2] of an arm's raw picture as its camera counts them, and back: the same function."""
    p = np.asarray(px, np.float64)
    if calibration.mirrored != arm:
        return p
    return np.stack([calibration.camera(arm).width - p[..., 0], p[..., 1]], -1)


def working_depth_mm(calibration: RigCalibration) -> float:
    """The depth at which one homography is best over the depths seen: the harmonic middle."""
    near, far = calibration.depth_mm
    inverse = (1 / near if near > 0 else 0.0) / 2 + (1 / far if far > 0 else 0.0) / 2
    return 1 / inverse if inverse > 0 else float("inf")


def rgb_px_from_spike_px(calibration: RigCalibration, px: ArrayLike, depth_mm: float | None = None) -> Floats:
    """Raw RGB pixels of raw spike pixels.

    Args:
        calibration: of the rig.
        px: float64[...,2], centres at +0.5.
        depth_mm: along the spike camera's axis; None: the working depth. Of no account for a common centre.

    Returns:
        float64[...,2]; NaN where the RGB arm's lens does not reach.
    """
    rays = directions(calibration.spike, unmirrored(calibration, "spike", px))
    return rgb_px_from_ray(calibration, rays, depth_mm)


def rgb_px_from_ray(calibration: RigCalibration, rays: Floats, depth_mm: float | None = None) -> Floats:
    """Raw RGB pixels of directions (x, y, 1) in the spike camera's axes; see `rgb_px_from_spike_px`."""
    M = calibration.spike_from_rgb.cam_from_world
    points = (rays - M[:, 3] * _per_depth(calibration, depth_mm)) @ M[:, :3]
    return unmirrored(calibration, "rgb", project(calibration.rgb, points))


def spike_px_from_rgb_px(calibration: RigCalibration, px: ArrayLike, depth_mm: float | None = None) -> Floats:
    """Raw spike pixels of raw RGB pixels; `depth_mm` as in `rgb_px_from_spike_px`, still along the spike axis."""
    M = calibration.spike_from_rgb.cam_from_world
    rays = directions(calibration.rgb, unmirrored(calibration, "rgb", px)) @ M[:, :3].T
    # a point at 1/depth = q on the ray: s rays + shift, with z = 1/q; in units of the depth: (1 - q shift_z) / rays_z
    q = _per_depth(calibration, depth_mm)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = rays * ((1 - q * M[2, 3]) / rays[..., 2:]) + q * M[:, 3]
    points = np.where(rays[..., 2:] > 0, points, np.nan)
    return unmirrored(calibration, "spike", project(calibration.spike, points))


def crop_homography(calibration: RigCalibration, depth_mm: float | None = None) -> Floats:
    """spike_px from rgb_px, float64[3,3], for undistorted pictures that are no longer mirrored.

    Edges:
        Of a stereo rig it holds for the plane at that depth alone.
    """
    M = calibration.spike_from_rgb.cam_from_world
    R, t, q = M[:, :3], M[:, 3], _per_depth(calibration, depth_mm)
    normal = R[2] * (q / (1 - q * t[2]))  # the plane z_spike = depth, seen from the RGB camera: normal . x = 1
    H = calibration.spike.K @ (R + np.outer(t, normal)) @ np.linalg.inv(calibration.rgb.K)
    return H / H[2, 2]


def parallax_px(calibration: RigCalibration) -> float:
    """How far off, in spike pixels, the crop for the working depth is at the nearest and farthest board seen."""
    if calibration.model == "common":
        return 0.0
    here = grid(calibration.spike.width, calibration.spike.height, 5, 4)
    rgb = rgb_px_from_spike_px(calibration, here)
    off = [spike_px_from_rgb_px(calibration, rgb, depth) - here for depth in calibration.depth_mm]
    worst = np.linalg.norm(np.stack(off), axis=-1)
    return float(np.nanmax(worst)) if np.isfinite(worst).any() else float("nan")


def grid(width: int, height: int, across: int, down: int) -> Floats:
    """Pixels float64[down,across,2] spread evenly over a picture, its corners included."""
    return np.stack(np.meshgrid(np.linspace(0, width, across), np.linspace(0, height, down)), -1)


def _per_depth(calibration: RigCalibration, depth_mm: float | None) -> float:
    depth = working_depth_mm(calibration) if depth_mm is None else depth_mm
    if not depth > 0:
        raise UsageError("a depth is positive", value=depth)
    return 0.0 if np.isinf(depth) else 1 / depth
