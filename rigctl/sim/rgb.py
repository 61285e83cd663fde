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


def shares_of(light: Light, at: NDArray[np.float64], weight: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """Share of each picture in sums over instants.

    Args:
        light: for its knots.
        at: ticks, float64[R,N]; beyond the light, time runs back and forth over it.
        weight: of each instant.

    Returns:
        float64[R,K].
    """
    knots = light.knots.astype(np.float64)
    span = knots[-1] - knots[0]
    at = knots[0] + span - np.abs((at - knots[0]) % (2 * span) - span)
    k = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)
    later = np.zeros(at.shape) if light.hold else (at - knots[k]) / (knots[k + 1] - knots[k])
    row = np.arange(len(at))[:, None] * len(knots) + k
    size = len(at) * len(knots)
    total = np.zeros(size + 1)
    np.add.at(total, row, weight * (1 - later))
    np.add.at(total, row + 1, weight * later)
    return total[:size].reshape(len(at), len(knots))[:, : len(light.rgb)]


def wave_means(light: Light, hz: float) -> tuple[Floats, Floats]:
    """Mean over the exposure of linear light x cos and x sin of 2 pi hz t, t from its start; float64[H,W,3] each."""
    begin, end = light.exposure
    after = np.asarray((np.arange(4096) + 0.5) * ((end - begin) / 4096), np.float64)
    angle = 2 * np.pi * hz * after / light.rate_hz
    waves = np.stack([np.cos(angle), np.sin(angle)]) / 4096
    cosine, sine = np.tensordot(shares_of(light, np.stack([begin + after] * 2), waves), light.rgb, 1)
    return cosine, sine


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
