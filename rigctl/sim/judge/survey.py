"""A survey of a few views: the facts that effects compute their bounds from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.judge.facts import Facts
from spikerig.rigctl.sim.rgb import window_weights
from spikerig.rigctl.sim.sensor import Floats, Light, spike_light
from spikerig.rigctl.sim.spec import Exposure, Sensor

PIXELS = 20_000  # of a view that are looked at


@dataclass(frozen=True, slots=True)
class Look:
    """One surveyed view: its light, and how far its picture moves over the exposure, pixels ([H,W] or one number)."""

    light: Light
    motion: NDArray[np.floating] | float


def survey(
    looks: Sequence[Look],
    sensor: Sensor,
    exposure: Exposure,
    *,
    focal_px: float,
    views: int,
    depth: tuple[float, float] = (np.inf, np.inf),
) -> Facts:
    """Facts of a scene from a few of its views.

    Args:
        looks: views, all of one size.
        sensor, exposure: of the scene.
        focal_px: of the camera.
        views: how many the scene has.
        depth: nearest and median distance, world units.

    Cost:
        A few passes over the pictures of each view.
    """
    parts = [_facts(look, sensor) for look in looks]
    pixels = {key: np.concatenate([rows[key] for rows, _ in parts]) for key in parts[0][0]}
    return Facts(
        **pixels,
        ticks=exposure.ticks,
        rate_hz=exposure.rate_hz,
        margin_ticks=exposure.margin_ticks,
        size=looks[0].light.rgb.shape[1:3],
        focal_px=focal_px,
        views=views,
        period_s=exposure.period_ms * 1e-3,
        depth=depth,
        looks=tuple(look.light for look in looks),
        means=tuple(mean for _, mean in parts),
        response=(sensor.gain * sensor.response[0], sensor.gain * sensor.response[1], sensor.gain * sensor.response[2]),
    )


def _facts(look: Look, sensor: Sensor) -> tuple[dict[str, Any], tuple[Floats, Floats]]:
    """Of one view: what is known of its sampled pixels, and the exposure's means."""
    light = look.light
    weights = window_weights(light, np.array([float(light.exposure[0])]))[0]
    inside = np.flatnonzero(weights)
    pictures = light.rgb[inside]
    seen = spike_light(pictures, sensor)
    share = weights[inside].astype(np.float32)
    mean, rgb = np.tensordot(share, seen, 1), np.tensordot(share, pictures, 1)
    height, width = mean.shape
    y, x = np.mgrid[:height, :width]
    half = np.hypot(height, width) / 2
    steep, bent = steepest(mean), bend(mean)
    if sensor.bayer is not None:  # neighbours differ in colour, which optics do not mix
        steep, bent = (spike_light(change(rgb)[None], sensor)[0] for change in (steepest, bend))
    rows = {
        "light": mean,
        "light_max": seen.max(0),
        "gradient": steep,
        "rgb": rgb,
        "rgb_gradient": steepest(rgb),
        "slope": np.abs(seen[-1] - seen[0]),
        "rgb_slope": np.abs(pictures[-1] - pictures[0]),
        "bend": bent,
        "rgb_bend": bend(rgb),
        "radius": np.hypot(y + 0.5 - height / 2, x + 0.5 - width / 2) / half,
        "motion": np.broadcast_to(np.asarray(look.motion, np.float64), (height, width)),
    }
    step = max(1, height * width // PIXELS)  # a stride that shares no factor with the width looks at every column
    while step > 1 and np.gcd(step, width) > 1:
        step += 1
    pixels = {key: np.asarray(a, np.float64).reshape(height * width, *a.shape[2:])[::step] for key, a in rows.items()}
    return pixels, (np.asarray(mean, np.float64), np.asarray(rgb, np.float64))


def steepest(picture: Floats) -> Floats:
    """Steepest change to a neighbour along both axes, [H,W] or [H,W,C], a pixel."""
    across, along = (np.abs(np.diff(picture, axis=axis)) for axis in (0, 1))
    pad = [(0, 0)] * (picture.ndim - 2)
    dy = np.maximum(np.pad(across, [(1, 0), (0, 0), *pad]), np.pad(across, [(0, 1), (0, 0), *pad]))
    dx = np.maximum(np.pad(along, [(0, 0), (1, 0), *pad]), np.pad(along, [(0, 0), (0, 1), *pad]))
    return np.hypot(dy, dx)


def bend(picture: Floats) -> Floats:
    """How far a pixel is from the mean of its eight neighbours, [H,W] or [H,W,C]."""
    wide = np.pad(picture, [(1, 1), (1, 1)] + [(0, 0)] * (picture.ndim - 2), mode="edge")
    height, width = picture.shape[:2]
    around = sum(wide[i : i + height, j : j + width] for i in range(3) for j in range(3) if (i, j) != (1, 1))
    return np.abs(picture - around / 8)
