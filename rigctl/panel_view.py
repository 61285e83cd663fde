"""Where the clock box's LED panel stands in each camera's picture, as a plan tells it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.panel_read import Spot
from spikerig.dataset.panel import Panel
from spikerig.rigctl.sim.limits import limits

HALO_PX = 2.0  # around an LED's disk its light is not to be trusted


@dataclass(frozen=True, slots=True)
class PanelPlan:
    """`[panel]`: the LED panel, and the pixels of its four corner LEDs, x and y each: top left, top right, bottom
    left, bottom right.

    Args:
        spike: in the spike camera's picture, as stored (top row first).
        rgb: in the RGB camera's.
        step_us: time of one code word.
        bits, slow: of the code, and the first bit that the RGB camera reads (`dataset.panel.Panel`).
        spike_radius_px, rgb_radius_px: of an LED's disk.
    """

    spike: tuple[float, float, float, float, float, float, float, float] = limits(unit="px")
    rgb: tuple[float, float, float, float, float, float, float, float] = limits(unit="px")
    step_us: float = limits(100.0, 1, 1e6, "us")
    bits: int = limits(16, 1, 40)
    slow: int = limits(8, 0, 39)
    spike_radius_px: float = limits(3.0, 0.5, 1000, "px")
    rgb_radius_px: float = limits(3.0, 0.5, 1000, "px")

    @property
    def panel(self) -> Panel:
        """What it shows."""
        return Panel(round(self.step_us * 1e3), self.bits, self.slow)


def centres(panel: Panel, corners: Sequence[float]) -> NDArray[np.float64]:
    """Pixels of all LEDs, float64[L,2], by their place between the corner LEDs."""
    x = np.array([led.x_mm for led in panel.leds])
    y = np.array([led.y_mm for led in panel.leds])
    u = ((x - x.min()) / max(np.ptp(x), 1e-9))[:, None]
    v = ((y - y.min()) / max(np.ptp(y), 1e-9))[:, None]
    tl, tr, bl, br = np.asarray(corners, np.float64).reshape(4, 2)
    return (1 - v) * ((1 - u) * tl + u * tr) + v * ((1 - u) * bl + u * br)


def spots(panel: Panel, corners: Sequence[float], radius_px: float) -> list[Spot]:
    """The disks in which LEDs are read; those always on tell no time and are left out."""
    at = centres(panel, corners)
    return [Spot(n, float(at[n, 0]), float(at[n, 1]), radius_px) for n, led in enumerate(panel.leds) if led.bit >= 0]


def mask(panel: Panel, corners: Sequence[float], radius_px: float, height: int, width: int) -> NDArray[np.bool_]:
    """Pixels that the panel's light reaches, bool[H,W]."""
    y, x = np.mgrid[:height, :width] + 0.5
    lit = np.zeros((height, width), bool)
    for cx, cy in centres(panel, corners):
        lit |= np.hypot(x - cx, y - cy) <= radius_px + HALO_PX
    return lit
