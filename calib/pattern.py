"""The fixed pattern of the spike sensor, from the views of a scene alone: what stays while the scene moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.spikes import SpikeStream
from spikerig.dataset.texture import tfp

Floats = NDArray[np.float64]
ENOUGH = 8  # streams; a median of fewer keeps too much of the scene
MOST = 0.25  # a pixel that differs by more from its neighbours shows the scene, or is dead
REACH = 2  # pixels around, that a pixel is compared with


def fixed_pattern(streams: Sequence[SpikeStream]) -> Floats | None:
    """Each pixel's gain against its neighbours', as far as all views agree on it.

    Features that stay on the sensor pull matches towards no motion: 4 % of pattern cost a third to a half of the
    precision of the demo's maps (docs/poses.md).

    Args:
        streams: of views of one camera that moved between and during them, all of one size.

    Returns:
        Gain float64[H,W] about 1, to divide light by; None where there are fewer than 8 streams.

    Edges:
        What stands at one place in most views counts as pattern. The estimate is shrunk by its own scatter over the
        views, and kept within 25 %. Slow changes over the field (vignetting) are not in it.

    Cost:
        One TFP a stream over its whole length, and a median of N pictures.

    Source: Wiener's shrinking of a mean with known error; median of N: sd 1.25 sigma / sqrt(N).
    """
    if len(streams) < ENOUGH or len({(s.ticks, s.height, s.width) for s in streams}) > 1:
        return None
    ratios = []
    for stream in streams:
        texture = tfp(stream, stream.ticks / 2, stream.ticks)
        light = np.where(texture.known, texture.light, 0.0) + 0.5 / stream.ticks  # half a spike: the dark stays finite
        logs = np.log(light.astype(np.float64))
        ratios.append(logs - _around(logs))
    stack = np.stack(ratios)
    middle = np.median(stack, 0)
    scatter = 1.4826 * np.median(np.abs(stack - middle), 0)
    error = (1.2533 * scatter) ** 2 / len(stack)
    signal = max(float(np.median(middle**2 / 0.455 - error)), 0.0)  # the median of a squared normal is 0.455
    return np.exp(np.clip(middle * signal / np.maximum(signal + error, 1e-12), -MOST, MOST))


def _around(p: Floats) -> Floats:
    """Median of the square of side 2 REACH + 1 around each pixel, edges repeated."""
    side = 2 * REACH + 1
    wide = np.lib.stride_tricks.sliding_window_view(np.pad(p, REACH, mode="edge"), (side, side))
    return np.median(wide, (2, 3))
