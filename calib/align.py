"""Both arms of a view on one pinhole camera: undistorted, cropped to the spike field of view, filtered to its pixels.

The pinhole camera has the spike camera's own matrix, so that a spike lens that does not distort is not resampled.
Spikes stay as they were recorded; only pictures made of them are warped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.crop import rgb_px_from_ray, unmirrored
from spikerig.calib.lens import directions, project
from spikerig.calib.rig import Arm, RigCalibration
from spikerig.calib.rolling import exposure_texture
from spikerig.dataset.clocktime import frozen_array
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.images import linear_from_srgb, srgb_from_linear
from spikerig.dataset.scene import Camera, Frame, View
from spikerig.dataset.texture import Texture

Floats = NDArray[np.float64]
KNOWN = 0.999  # share of known light under an output pixel from which on it is known


@dataclass(frozen=True, slots=True)
class Region:
    """A polygon in the raw picture of an arm that is not scene, such as the clock's LED panel: float64[K,2] px."""

    arm: Arm
    polygon_px: Floats


@dataclass(frozen=True, slots=True)
class Warp:
    """Where the pixels of one pinhole camera come from; the same for all views of a rig.

    Args:
        camera: the pinhole camera.
        spike_px, rgb_px: float64[H,W,2] raw pixels of each output pixel's centre; NaN where an arm does not see.
        fine_px: float32[H*s,W*s,2] raw RGB pixels of s x s points in each output pixel, for the prefilter.
        samples: s.
        valid: bool[H,W], both arms see the pixel, wholly, outside all regions.
        same: whether textures need no resampling at all.
    """

    camera: Camera
    spike_px: Floats
    rgb_px: Floats
    fine_px: NDArray[np.float32]
    samples: int
    valid: NDArray[np.bool_]
    same: bool

    def __post_init__(self) -> None:
        for name in ("spike_px", "rgb_px", "fine_px", "valid"):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))

    @property
    def sensor_row(self) -> NDArray[np.float32]:
        """float32[H,W]: the row of the raw RGB picture that each pixel was read at; 0 where there is none."""
        return np.nan_to_num(self.rgb_px[..., 1] - 0.5).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Aligned:
    """A view with both arms on one pinhole camera.

    Args:
        camera: the pinhole camera.
        light: float32[H,W,3] linear RGB, averaged over each pixel's footprint; 0 where not valid.
        texture: of the spikes, known only where the spike arm sees.
        sensor_row: float32[H,W] row of the raw RGB picture: a pixel was exposed from start_ns + row_ns * sensor_row.
        valid: bool[H,W], both arms see it.
        frame: `light` encoded, with the times of the raw frame: its rows are the raw picture's (`sensor_row`).
    """

    camera: Camera
    light: NDArray[np.float32]
    texture: Texture
    sensor_row: NDArray[np.float32]
    valid: NDArray[np.bool_]
    frame: Frame

    def __post_init__(self) -> None:
        for name in ("light", "sensor_row", "valid"):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))


def warp_of(
    calibration: RigCalibration,
    *,
    full: bool = False,
    depth_mm: float | None = None,
    regions: Sequence[Region] = (),
    refinement: Floats | None = None,
) -> Warp:
    """Plan the alignment of all views of a rig.

    Args:
        calibration: of the rig.
        full: at the RGB arm's resolution instead of the spike arm's.
        depth_mm: of the scene, for a stereo rig; None: the working depth of the calibration.
        regions: raw parts that are not scene.
        refinement: float64[3,3], where in the crop (at spike resolution) the RGB picture of a pixel really lies.

    Cost:
        0.5 s at 400x250 from 1920x1080; remember it, it is the same for every view.
    """
    spike, rgb = calibration.spike, calibration.rgb
    ratio = (rgb.K[0, 0] * rgb.K[1, 1] / (spike.K[0, 0] * spike.K[1, 1])) ** 0.5 if full else 1.0
    width, height = max(1, round(spike.width * ratio)), max(1, round(spike.height * ratio))
    scale = np.array([width / spike.width, height / spike.height])
    camera = Camera(spike.K * [[scale[0]], [scale[1]], [1]], np.zeros(0), width, height)
    shrink = (rgb.K[0, 0] * rgb.K[1, 1] / (camera.K[0, 0] * camera.K[1, 1])) ** 0.5
    samples = 1 if full else int(np.clip(np.ceil(1.5 * shrink), 1, 16))

    def rays(steps: int) -> Floats:
        x, y = ((np.arange(n * steps) + 0.5) / steps for n in (width, height))
        return directions(camera, np.stack(np.meshgrid(x, y), -1))

    def rgb_of(ray: Floats) -> Floats:
        if refinement is not None:
            px = ray[..., :2] * np.diag(spike.K)[:2] + spike.K[:2, 2]
            moved = np.concatenate([px, np.ones_like(px[..., :1])], -1) @ refinement.T
            ray = directions(Camera(spike.K, np.zeros(0), spike.width, spike.height), moved[..., :2] / moved[..., 2:])
        return rgb_px_from_ray(calibration, ray, depth_mm)

    centre, fine = rays(1), rgb_of(rays(samples))
    spike_px = unmirrored(calibration, "spike", project(spike, centre))
    cells = _within(fine, rgb).reshape(height, samples, width, samples).all((1, 3))
    valid = cells & _within(spike_px, spike, rim=0.5)
    same = not full and not spike.distortion.any() and calibration.mirrored != "spike"
    return without(Warp(camera, spike_px, rgb_of(centre), fine.astype(np.float32), samples, valid, same), regions)


def without(warp: Warp, regions: Sequence[Region]) -> Warp:
    """A warp whose pixels in some regions are not valid."""
    if not regions:
        return warp
    inside = [within_polygon(warp.rgb_px if r.arm == "rgb" else warp.spike_px, r.polygon_px) for r in regions]
    return replace(warp, valid=warp.valid & ~np.any(inside, axis=0))


def pair(
    view: View,
    calibration: RigCalibration,
    *,
    warp: Warp | None = None,
    texture: Texture | None = None,
) -> Aligned:
    """Align a raw view: RGB and texture on one pinhole camera, cropped to the spike field of view.

    Args:
        view: as recorded: `frame` and `spikes` raw, of the sizes of the calibration.
        calibration: of the rig.
        warp: what `warp_of` planned (options go there); None plans it anew.
        texture: of the raw spikes, at their size; None: their mean over each pixel's own exposure, row by row,
            which shows the same blur as the RGB picture.

    Returns:
        An Aligned.

    Raises:
        UsageError: the view has no spikes and no texture is given.
        DataError: the view's sizes are not the calibration's.

    Cost:
        40 ms at 400x250 from 1920x1080, with a warp at hand.
    """
    warp = warp_of(calibration) if warp is None else warp
    _check_size("the RGB picture", view.frame.pixels.shape[:2], calibration.rgb)
    if texture is None:
        if view.spikes is None:
            raise UsageError("the view has no spikes to align", value=view.name)
        texture = exposure_texture(view.spikes, view.frame, rows_of_spike_px(calibration))
    _check_size("the texture", texture.light.shape, calibration.spike)
    light = np.where(warp.valid[..., None], warp_light(warp, linear_of(view.frame)), 0)
    frame = replace(view.frame, pixels=coded_like(view.frame, light))
    return Aligned(warp.camera, light, warp_texture(warp, texture), warp.sensor_row, warp.valid, frame)


def linear_of(frame: Frame) -> NDArray[np.float32]:
    """A frame's linear light, float32[H,W,3]."""
    return np.asarray(
        linear_from_srgb(frame.pixels) if frame.transfer == "srgb" else frame.pixels / np.float32(frame.full),
        np.float32,
    )


def coded_like(frame: Frame, light: NDArray[np.float32]) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Linear light in a frame's own code and depth."""
    clipped = np.clip(light, 0, 1)
    coded = np.rint((srgb_from_linear(clipped) if frame.transfer == "srgb" else clipped) * frame.full)
    return coded.astype(np.uint16) if frame.full > 255 else coded.astype(np.uint8)


def warp_light(warp: Warp, linear: NDArray[np.float32]) -> NDArray[np.float32]:
    """RGB light float32[h,w,C] brought to the pinhole camera, each output pixel the mean over its footprint.

    The footprint is sampled finer than the picture's own pixels and averaged: a box as wide as a spike pixel, which is
    also what a spike pixel does to light. At full resolution (one sample) it is a cubic interpolation.
    """
    import cv2

    at = np.nan_to_num(warp.fine_px - np.float32(0.5), nan=-10)
    how = cv2.INTER_CUBIC if warp.samples == 1 else cv2.INTER_LINEAR
    fine = cv2.remap(linear, at[..., 0], at[..., 1], how, borderMode=cv2.BORDER_REPLICATE)
    fine = fine.reshape(*at.shape[:2], -1)
    s, (height, width) = warp.samples, warp.valid.shape
    return np.maximum(fine.reshape(height, s, width, s, -1).mean((1, 3), dtype=np.float32), 0)


def warp_texture(warp: Warp, texture: Texture) -> Texture:
    """A texture of the raw spikes on the pinhole camera; known where KNOWN of what a pixel shows is known."""
    return texture if warp.same else texture_at(texture, warp.spike_px)


def texture_at(texture: Texture, px: Floats) -> Texture:
    """A texture of the raw spikes at pixels float64[H,W,2] between its own; known where KNOWN of what one shows is."""
    import cv2

    at = np.nan_to_num(px - 0.5, nan=-10).astype(np.float32)
    known = texture.known.astype(np.float32)
    both = np.stack([np.where(texture.known, texture.light, 0), known], -1)
    both = cv2.copyMakeBorder(both, 1, 1, 1, 1, cv2.BORDER_REPLICATE)  # a pixel's own rim is part of it
    moved = cv2.remap(both, at[..., 0] + 1, at[..., 1] + 1, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    share = moved[..., 1]
    inside = (share > KNOWN) & _within(px, (texture.light.shape[1], texture.light.shape[0]))
    light = np.divide(moved[..., 0], share, out=np.zeros_like(share), where=inside)
    return Texture(light, inside, texture.at, texture.method)


def rows_of_spike_px(calibration: RigCalibration) -> NDArray[np.float32]:
    """Which raw RGB row sees what each raw spike pixel sees: float32[h,w]; the nearest known where none does."""
    spike = calibration.spike
    x, y = np.meshgrid(np.arange(spike.width) + 0.5, np.arange(spike.height) + 0.5)
    rays = directions(spike, unmirrored(calibration, "spike", np.stack([x, y], -1)))
    row = rgb_px_from_ray(calibration, rays)[..., 1] - 0.5
    row = np.where(np.isfinite(row), row, np.nanmean(row) if np.isfinite(row).any() else 0)
    return np.clip(row, 0, calibration.rgb.height - 1).astype(np.float32)


def within_polygon(px: Floats, polygon: Floats) -> NDArray[np.bool_]:
    """Which points float64[...,2] lie in a polygon float64[K,2], by the even-odd rule; NaN lies nowhere."""
    corners = np.asarray(polygon, np.float64)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.isfinite(corners).all():
        raise UsageError("a region is a polygon of at least three corners", value=np.shape(polygon))
    inside = np.zeros(px.shape[:-1], bool)
    x, y = px[..., 0], px[..., 1]
    for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        crosses = (ay > y) != (by > y)
        if ay != by:
            inside ^= crosses & (x < ax + (y - ay) * ((bx - ax) / (by - ay)))
    return inside


def _within(px: Floats, size: Camera | tuple[int, int], rim: float = 0.0) -> NDArray[np.bool_]:
    width, height = (size.width, size.height) if isinstance(size, Camera) else size
    x, y = px[..., 0], px[..., 1]
    return (x >= rim) & (x <= width - rim) & (y >= rim) & (y <= height - rim)


def _check_size(what: str, shape: tuple[int, ...], camera: Camera) -> None:
    if tuple(shape[:2]) != (camera.height, camera.width):
        raise DataError(f"{what} is not of the calibrated size", value=f"{shape[1]}x{shape[0]}",
                        expected=f"{camera.width}x{camera.height}", cause="another camera mode, or a picture that was "
                        "resized or cropped", next="calibrate in the mode that scenes are shot in")  # fmt: skip
