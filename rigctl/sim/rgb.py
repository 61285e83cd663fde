"""The RGB camera under the light: an average over the exposure, row by row where it rolls, then a file's pixels."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import UsageError
from spikerig.dataset.images import srgb_from_linear
from spikerig.rigctl.sim.effects import Hooks
from spikerig.rigctl.sim.sensor import Floats, Light


def window_weights(light: Light, begin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of each picture in the mean over windows as long as the exposure.

    Args:
        light: for its knots and the exposure's length.
        begin: first tick of each window, float64[R]; fractions are fine.

    Returns:
        float64[R,K], rows sum to 1: exact for light that is linear between knots (or held).

    Raises:
        UsageError: a window leaves the light.
    """
    knots, length = light.knots.astype(np.float64), float(light.exposure[1] - light.exposure[0])
    if begin.min() < knots[0] - 1e-6 or begin.max() + length > knots[-1] + 1e-6:
        raise UsageError(
            "the RGB camera reads out for longer than there is light",
            value=f"rows need ticks {begin.min():g} to {begin.max() + length:g}",
            expected=f"within {knots[0]:g} to {knots[-1]:g}",
            next="raise exposure.margin_ticks, or lower the row time",
        )
    lo = np.clip(begin[:, None], knots[:-1], knots[1:])
    hi = np.clip(begin[:, None] + length, knots[:-1], knots[1:])
    inside, spans = (hi - lo) / length, np.diff(knots)
    if light.hold:
        return inside
    later = ((lo + hi) / 2 - knots[:-1]) / spans
    weights = np.zeros((len(begin), len(knots)))
    weights[:, :-1] += inside * (1 - later)
    weights[:, 1:] += inside * later
    return weights


def expose(light: Light, row_ns: float = 0.0) -> NDArray[np.float64]:
    """Mean linear light on the RGB arm over the exposure, float64[H,W,3].

    Args:
        light: the exposure is that of the middle row.
        row_ns: read-out time of a row; 0 exposes all rows at once.
    """
    pictures = light.rgb if light.arm is None else light.arm
    total = np.zeros(pictures.shape[1:])
    rows = np.arange(pictures.shape[1]) - pictures.shape[1] // 2 if row_ns else np.zeros(1)
    weights = window_weights(light, light.exposure[0] + rows * row_ns * 1e-9 * light.rate_hz)
    for k, picture in enumerate(pictures):
        if weights[:, k].any():
            total += weights[:, k, None, None] * picture
    return total


def encode(linear: NDArray, hooks: Iterable[Hooks] = ()) -> NDArray[Any]:
    """Pixels of linear light: the effects on linear light, clip to 0..1, sRGB (or the camera's response), the effects
    on the encoded picture, round, the effects on what is coded.

    Returns:
        uint8[H,W,3]; uint16 (full scale 65535) from a converter of more than 255 steps.
    """
    hooks = list(hooks)
    for h in hooks:
        if h.linear is not None:
            linear = h.linear(np.asarray(linear, np.float32))
    clipped = np.clip(linear, 0, 1)
    response = next((h.response for h in hooks if h.response is not None), None)
    encoded = srgb_from_linear(clipped) if response is None else response(clipped.astype(np.float32))
    picture = np.asarray(encoded, np.float32)
    for h in hooks:
        if h.encoded is not None:
            h.encoded(picture)
    levels = next((h.levels for h in hooks if h.levels), 255)
    steps = np.rint(np.clip(picture, 0, 1) * levels)
    pixels = steps.astype(np.uint8) if levels == 255 else _spread(steps, levels)
    for h in hooks:
        if h.coded is not None:
            pixels = h.coded(pixels)
    return pixels


def _spread(steps: NDArray, levels: int) -> NDArray[Any]:
    """Steps of a converter on the full scale of the smallest integer that holds them."""
    if levels < 255:
        return np.rint(steps * (255 / levels)).astype(np.uint8)
    return np.rint(steps * (65535 / levels)).astype(np.uint16)


def optics(pictures: Floats, changes: Sequence[Any]) -> Floats:
    """Pictures [n,H,W,C] after each of the changes that is not None, never below zero (cubic filters overshoot)."""
    wanted = [change for change in changes if change is not None]
    for change in wanted:
        pictures = change(pictures)
    return np.maximum(pictures, 0) if wanted else pictures
