"""Where a blinking LED is in a picture: the pixels whose light beats with its period, and hardly does anything else."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.panel_read import Spot
from spikerig.dataset.errors import DataError
from spikerig.dataset.stream import SpikeStream
from spikerig.dataset.texture import window_sum

Floats = NDArray[np.float64]
BIN = 64  # ticks that are counted together
BEATS = 0.35  # share of a pixel's variance that lies in the beat; a square wave of even halves has 0.81
SWING = 0.02  # of white, or spikes a tick: least amplitude of the beat
CORE = 0.5  # of the strongest pixel's beat: those that belong to the LED
TURNS = 1.6  # periods that must be seen
WIDE = 480  # px: larger pictures are looked at in blocks
STEP = 1.03  # between periods that are tried


class Beats:
    """Sums over pictures that tell how much of each pixel's light beats with each of some periods."""

    def __init__(self, periods_ns: Sequence[float]) -> None:
        self.rate = 2 * np.pi / np.asarray(periods_ns, np.float64)
        self.count = 0
        self._waves = np.zeros(len(self.rate), np.complex128)

    def add(self, at_ns: float, picture: NDArray) -> None:
        """A picture [H,W] at a time."""
        light = np.asarray(picture, np.float32)
        if not self.count:
            self._sum, self._square = (np.zeros(light.shape) for _ in range(2))
            self._beat = np.zeros((len(self.rate), *light.shape), np.complex64)
        wave = np.exp(-1j * self.rate * at_ns)
        self.count += 1
        self._sum += light
        self._square += np.square(light)
        self._waves += wave
        self._beat += wave.astype(np.complex64)[:, None, None] * light

    def told(self) -> tuple[Floats, Floats]:
        """(amplitude, share of the variance) float64[P,H,W] of each period's beat."""
        mean = self._sum / self.count
        variance = np.maximum(self._square / self.count - mean**2, 1e-12)
        beat = self._beat / self.count - (self._waves / self.count)[:, None, None] * mean
        amplitude = 2 * np.abs(beat)
        return amplitude, amplitude**2 / 2 / variance


def spike_beats(streams: Iterable[SpikeStream], periods_ns: Sequence[float]) -> tuple[Beats, float]:
    """Beats of a viewpoint's spikes, and how long they last, ns."""
    beats, first, last = Beats(periods_ns), 0, 0
    for stream in streams:
        tick_ns = 1e9 / float(stream.rate_hz or 1)
        first, last = (stream.t0_ns, last) if not beats.count else (first, last)
        gone = stream.lost_before()
        for t in range(0, stream.ticks - BIN + 1, BIN):
            if gone[t] == gone[t + BIN]:
                last = stream.t0_ns + round((t + BIN) * tick_ns)
                beats.add(stream.t0_ns - first + (t + BIN / 2) * tick_ns, window_sum(stream, t, t + BIN) / BIN)
    return beats, last - first


def frame_beats(looks: Iterable[tuple[float, NDArray]], periods_ns: Sequence[float]) -> tuple[Beats, float, int]:
    """Beats of a clip's frames, how long they last (ns), and how many pixels wide one of its pixels is."""
    beats, first, last, block = Beats(periods_ns), 0.0, 0.0, 1
    for at_ns, light in looks:
        if not beats.count:
            first, block = at_ns, -(-light.shape[1] // WIDE)
        last = at_ns
        h, w = (n // block * block for n in light.shape)
        beats.add(at_ns - first, light[:h, :w].reshape(h // block, block, w // block, block).mean((1, 3)))
    return beats, last - first, block


def find_in_spikes(streams: Iterable[SpikeStream], periods_ns: Sequence[float]) -> list[Spot]:
    """The LED in a viewpoint's spikes.

    Args:
        streams: pieces of one stretch, in order.
        periods_ns: those it may have.

    Raises:
        DataError: nothing beats so.

    Cost: about 1 ms a 64 ticks of 400x250 and period.
    """
    beats, span_ns = spike_beats(streams, periods_ns)
    return _spots(beats, periods_ns, span_ns, "spikes")


def find_in_frames(looks: Iterable[tuple[float, NDArray]], period_ns: float) -> list[Spot]:
    """The LED in a clip.

    Args:
        looks: (time in ns, linear light [H,W]) of each frame.
        period_ns: of the LED.

    Raises:
        DataError: nothing beats so.
    """
    beats, span_ns, block = frame_beats(looks, [period_ns])
    return [Spot(0, s.x_px * block, s.y_px * block, s.radius_px * block)
            for s in _spots(beats, [period_ns], span_ns, "frames")]  # fmt: skip


def periods_to_try(period_ns: float, span_ns: float) -> list[float]:
    """Periods an LED may have that was said to have one (to some per cent), or any that a span can tell (0)."""
    if period_ns:
        return [period_ns * k for k in (0.94, 0.97, 1.0, 1.03, 1.06)]
    low, high = 1e8, span_ns / TURNS
    return [low * STEP**k for k in range(max(int(np.log(max(high / low, 1.0)) / np.log(STEP)) + 1, 1))]


def _spots(beats: Beats, periods_ns: Sequence[float], span_ns: float, where: str) -> list[Spot]:
    """The strongest pixel that beats as an LED does, and those around it that beat as it."""
    import cv2

    if not beats.count or span_ns < TURNS * min(periods_ns):
        raise DataError(
            "too short a look to find the LED in", value=f"{where}: {span_ns / 1e6:.0f} ms",
            expected=f"at least {TURNS} periods", next="longer viewpoints, or led.spike and led.rgb in the plan",
        )  # fmt: skip
    amplitude, share = beats.told()
    able = (share >= BEATS) & (amplitude >= SWING)
    best = np.where(able, amplitude * share, 0)
    if not able.any():
        raise DataError("no LED is seen to blink", value=where, cause="out of view, too dim, or another period",
                        next="led.period_ms and its pixels in the plan")  # fmt: skip
    period, y, x = np.unravel_index(int(np.argmax(best)), best.shape)
    core = (able[period] & (amplitude[period] >= CORE * amplitude[period, y, x])).astype(np.uint8)
    _, labels = cv2.connectedComponents(core)
    rows, columns = np.nonzero(labels == labels[y, x])
    weight = amplitude[period, rows, columns]
    x_px, y_px = (float((v + 0.5) @ weight / weight.sum()) for v in (columns, rows))
    return [Spot(0, x_px, y_px, max(float(np.sqrt(len(rows) / np.pi)), 1.0))]
