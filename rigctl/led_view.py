"""The blinking LED of a rig without a clock box, as a plan tells it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.panel_read import Spot
from spikerig.dataset.errors import DataError
from spikerig.rigctl.panel_view import HALO_PX
from spikerig.rigctl.sim.limits import limits


@dataclass(frozen=True, slots=True)
class LedPlan:
    """`[led]`: a plain square-wave LED (or several that blink together) in both cameras' view.

    Args:
        period_ms: from one time it goes on to the next, to a few per cent; 0: found in the spikes.
        spike: its pixel in the spike camera's picture, as stored (top row first): x and y, of each such LED; empty:
            found by its blinking at each viewpoint.
        rgb: in the RGB camera's.
        spike_radius_px, rgb_radius_px: of its disk, where the pixels are given.
    """

    period_ms: float = limits(0.0, 0, 60_000, "ms")
    spike: tuple[float, ...] = limits((), unit="px")
    rgb: tuple[float, ...] = limits((), unit="px")
    spike_radius_px: float = limits(3.0, 0.5, 1000, "px")
    rgb_radius_px: float = limits(3.0, 0.5, 1000, "px")

    def spots(self, arm: str) -> list[Spot]:
        """The disks in which it is read in an arm's picture; empty where they are to be found."""
        places, radius = (self.spike, self.spike_radius_px) if arm == "spike" else (self.rgb, self.rgb_radius_px)
        return [Spot(0, x, y, radius) for x, y in zip(places[::2], places[1::2], strict=True)]


def led_plan(plan: Mapping[str, Any]) -> LedPlan | None:
    """The LED of a take's plan; None where it is not synchronised by one.

    Raises:
        DataError: it is no LED.
    """
    sync = plan.get("sync")
    if not isinstance(sync, Mapping) or sync.get("mode") != "optical":
        return None
    try:
        names = {f.name for f in fields(LedPlan)}
        told: dict[str, Any] = {
            k: tuple(map(float, v)) if isinstance(v, list | tuple) else float(v)
            for k, v in dict(plan.get("led") or {}).items()
            if k in names
        }
        led = LedPlan(**told)
        if len(led.spike) % 2 or len(led.rgb) % 2 or not led.period_ms >= 0:
            raise ValueError("places are pairs of x and y, a period is not negative")
    except (TypeError, ValueError) as error:
        raise DataError("the take's plan has an LED that is none", value=str(error)) from error
    return led


def led_mask(spots: list[Spot], height: int, width: int) -> NDArray[np.bool_]:
    """Pixels that the LED's light reaches, bool[H,W]."""
    y, x = np.mgrid[:height, :width] + 0.5
    lit = np.zeros((height, width), bool)
    for s in spots:
        lit |= np.hypot(x - s.x_px, y - s.y_px) <= s.radius_px + HALO_PX
    return lit
