"""Light of spikes over each pixel's own exposure: what a rolling shutter lets an RGB sensor see."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import UsageError
from spikerig.dataset.scene import Frame
from spikerig.dataset.spikes import SpikeStream
from spikerig.dataset.texture import Texture, tfp_window, window_sum


def exposure_texture(stream: SpikeStream, frame: Frame, sensor_row: NDArray[np.float32]) -> Texture:
    """Mean light of every pixel over its own exposure, start_ns + row_ns * sensor_row onward.

    Args:
        stream: raw spikes on the frame's clock.
        frame: exposure times; an instantaneous one (exposure 0) counts as one tick.
        sensor_row: float32[h,w] of the raw spike pixels.

    Returns:
        A Texture at the middle row's mid-exposure; not known where the exposure leaves the stream or lost a tick.
    """
    _same_clock(stream, frame)
    window = max(1, round(frame.exposure_ns * _rate(stream) * 1e-9))
    first = stream.tick_at(frame.start_ns) + sensor_row.astype(np.float64) * (frame.row_ns * _rate(stream) * 1e-9)
    at = float(np.clip(np.median(first) + window / 2, 0, stream.ticks))
    return windows_at(stream, np.rint(first).astype(np.int64), window, at, f"exposure-{window}")


def tfp_rows(stream: SpikeStream, frame: Frame, sensor_row: NDArray[np.float32], phase: float, window: int) -> Texture:
    """TFP at the same phase of every pixel's own exposure (0 its start, 1 its end), `window` ticks about it.

    Args:
        stream, frame, sensor_row: as in `exposure_texture`.
        phase: of the exposure.
        window: ticks; placed as in `dataset.texture.tfp_window`.
    """
    _same_clock(stream, frame)
    ns = frame.start_ns + phase * frame.exposure_ns
    centre = stream.tick_at(int(ns)) + sensor_row.astype(np.float64) * (frame.row_ns * _rate(stream) * 1e-9)
    first = np.floor(centre).astype(np.int64) + tfp_window(0, window)[0]
    at = float(np.clip(np.median(centre), 0, stream.ticks))
    return windows_at(stream, first, window, at, f"tfp-{window}-rows")


def windows_at(stream: SpikeStream, first: NDArray[np.int64], window: int, at: float, method: str) -> Texture:
    """Spikes of each pixel in its own window [first, first + window), over the window's length.

    Args:
        stream: the spikes.
        first: int64[H,W], the window's first tick.
        window: ticks, >= 1.
        at, method: of the Texture.

    Edges:
        A pixel whose window leaves the stream or touches a lost tick is not known.

    Cost:
        One count for each distinct first tick, over the rows that have it.
    """
    if first.shape != (stream.height, stream.width) or window < 1:
        raise UsageError("a window starts somewhere for every pixel", value=(first.shape, window))
    lost = stream.lost_before()
    light, known = np.zeros(first.shape, np.float32), np.zeros(first.shape, bool)
    for t0 in np.unique(first):
        here = first == t0
        if t0 < 0 or t0 + window > stream.ticks or lost[t0] != lost[t0 + window]:
            continue
        rows = np.flatnonzero(here.any(axis=1))
        a, b = int(rows[0]), int(rows[-1]) + 1
        part = SpikeStream(np.ascontiguousarray(stream.bits[t0 : t0 + window, a:b]), stream.width)
        share = window_sum(part, 0, window) / np.float32(window)
        light[a:b][here[a:b]] = share[here[a:b]]
        known |= here
    return Texture(light, known, at, method)


def _rate(stream: SpikeStream) -> float:
    if stream.rate_hz is None:
        raise UsageError("these spikes have no rate, so they cannot be held against a frame", next="give --rate-hz")
    return stream.rate_hz


def _same_clock(stream: SpikeStream, frame: Frame) -> None:
    if stream.clock != frame.clock:
        raise UsageError("spikes and frame are on different clocks", value=f"{stream.clock} and {frame.clock}",
                         next="bring both to the rig's clock first")  # fmt: skip
