"""Both arms of a scene's view, side by side on the scene's camera: what checks and contact sheets look at."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.align import Aligned, Warp, linear_of, warp_of, warp_texture
from spikerig.calib.rig import calibration_of
from spikerig.calib.rolling import exposure_texture, tfp_rows
from spikerig.dataset.bayer import bayer_of, demosaic
from spikerig.dataset.check_look import SceneLook, Undecided, ViewLook
from spikerig.dataset.clocktime import NS
from spikerig.dataset.scene import Frame
from spikerig.dataset.spikes import SpikeStream
from spikerig.dataset.texture import Texture, tfi


@dataclass(frozen=True, slots=True)
class Arms:
    """Both arms of a view on the scene's camera: RGB light float32[H,W,3], where it may be compared, and its spikes.

    Args:
        light: linear RGB float32[H,W,3].
        good: bool[H,W], valid and not at full scale.
        stream: spikes around the exposure, `reach` ticks and a little more on each side.
        frame: the picture, with times on the spikes' clock.
        rows: float32[h,w] sensor row of each spike pixel.
        mid_ns: mid-exposure of the picture's middle row.
        window: ticks of the exposure.
        reach: ticks by which the exposure may be shifted.
        warp: how textures come onto the scene's camera; None where they lie on it.
        scene: that it is of.
    """

    light: NDArray[np.float32]
    good: NDArray[np.bool_]
    stream: SpikeStream
    frame: Frame
    rows: NDArray[np.float32]
    mid_ns: int
    window: float
    reach: int
    warp: Warp | None
    scene: SceneLook

    def texture(self, lag: int = 0) -> Texture:
        """The spikes' mean over each pixel's own exposure, as if that had been `lag` ticks later."""
        ns = round(lag * NS / (self.stream.rate_hz or 1.0))
        shifted = replace(self.frame, start_ns=self.frame.start_ns + ns)
        return self._seen(exposure_texture(self.stream, shifted, self.rows))

    def tfp(self, window: int) -> Texture:
        """TFP at mid-exposure of every pixel."""
        return self._seen(tfp_rows(self.stream, self.frame, self.rows, 0.5, window))

    def tfi(self) -> Texture:
        """TFI at mid-exposure of the middle row."""
        at = float(np.clip(self.stream.tick_at(self.mid_ns), 0, self.stream.ticks))
        return self._seen(tfi(self.stream, at))

    def aligned(self, valid: NDArray[np.bool_]) -> Aligned:
        """Both arms as `align.pair` gives them, for overlays."""
        camera = self.scene.camera
        return Aligned(camera, self.light, self.texture(), self.rows, valid, self.frame)

    def _seen(self, texture: Texture) -> Texture:
        """Gray, on the scene's camera."""
        bayer = bayer_of(self.scene.info)
        if bayer is not None:
            colours = demosaic(texture, bayer)
            texture = replace(texture, light=colours.light.mean(2), known=colours.known.all(2))
        return texture if self.warp is None else warp_texture(self.warp, texture)


def arms_of(look: ViewLook) -> Arms:
    """Both arms of a view; Undecided where they cannot be compared.

    Cost:
        Reads the spikes of the exposure, and as many again or 300 on each side; kept as long as the look is.
    """
    return look.once("arms", lambda: _arms(look))


def _arms(look: ViewLook) -> Arms:
    s, scene, view = look.survey, look.scene, look.view
    first, last = look.exposure_ticks
    if (s.width, s.height) != (scene.camera.width, scene.camera.height):
        raise Undecided("spikes and pictures are of different sizes: not aligned")
    reach = int(min(first, s.ticks - last))
    if reach < 0 or view.frame.exposure_ns <= 0:
        raise Undecided("the exposure lies outside the spikes, or has no length")
    window = view.frame.exposure_ns * (s.rate_hz or 0.0) / NS
    reach = min(reach, max(300, round(window)))
    stream = look.spikes(int(np.floor(first)) - reach - 1, int(np.ceil(last)) + reach + 2)
    frame = replace(view.frame, clock=stream.clock)
    if stream.clock != view.frame.clock and scene.clock is not None:
        frame = replace(frame, start_ns=int(scene.clock.device_from_rig(np.int64(frame.start_ns))))
    light = linear_of(view.frame)
    good = view.valid & (view.frame.pixels < 0.98 * view.frame.full).all(2)
    rows = np.where(view.valid, view.sensor_row, np.median(view.sensor_row[view.valid])).astype(np.float32)
    warp = scene.once("warp", lambda: _warp(scene))
    return Arms(light, good, stream, frame, rows, view.mid_ns, window, reach, warp, scene)


def _warp(scene: SceneLook) -> Warp | None:
    """How textures of raw spikes come onto the scene's camera; None where they lie on it already."""
    if scene.calibration is None or not isinstance(scene.info.get("align"), dict):
        return None
    warp = warp_of(calibration_of(scene.calibration))
    return None if warp.same else warp
