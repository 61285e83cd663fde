"""Where the LED panel's lamps are in a picture, by the beats of those that blink neither too fast nor too slowly."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.led_find import BEATS, BIN, CORE, SWING, TURNS, Beats, frame_beats, spike_beats
from spikerig.calib.panel_read import Spot
from spikerig.dataset.errors import DataError
from spikerig.dataset.panel import Panel, two_rows
from spikerig.dataset.stream import SpikeStream

Floats = NDArray[np.float64]
LEAST = 2  # bits that must be found, each in both rows
OFF_PX = 1.5  # that a lamp may lie off where the others have it


def find_panel_in_spikes(streams: Iterable[SpikeStream], panel: Panel, span_ns: float, tick_ns: float) -> list[Spot]:
    """The lamps of all bits in a viewpoint's spikes.

    Args:
        streams: pieces of one stretch, in order.
        panel: of the usual two rows.
        span_ns, tick_ns: how long the stretch and a tick are.

    Raises:
        DataError: fewer than two bits' lamps are seen to blink, or not in two rows.

    Edges:
        The row that shows the code itself is taken to be the upper one in the picture; mirrored pictures are told.
        Perspective is not: the panel's face maps affinely.
    """
    bits = _bits(panel, span_ns, 4 * BIN * tick_ns)
    beats, _ = spike_beats(streams, [_period(panel, b) for b in bits])
    return _lamps(beats, bits, panel, 1, "spikes")


def find_panel_in_frames(
    looks: Iterable[tuple[float, NDArray]], panel: Panel, span_ns: float, frame_ns: float
) -> list[Spot]:
    """The lamps of all bits in a clip of frames `frame_ns` apart; see `find_panel_in_spikes`."""
    bits = _bits(panel, span_ns, 4 * frame_ns)
    beats, _, block = frame_beats(looks, [_period(panel, b) for b in bits])
    return _lamps(beats, bits, panel, block, "frames")


def _period(panel: Panel, bit: int) -> float:
    return float(4 * panel.step_ns << bit)


def _bits(panel: Panel, span_ns: float, least_ns: float) -> list[int]:
    """Bits whose beat is slow enough to be seen and fast enough to be told."""
    bits = [b for b in range(panel.bits - 1) if least_ns <= _period(panel, b) <= span_ns / TURNS]
    if len(bits) < LEAST or panel.leds != two_rows(panel.bits):
        raise DataError(
            "the panel cannot be found in so short a look", value=f"{span_ns / 1e6:.0f} ms: {len(bits)} bits",
            expected="two bits at least, of a panel of two rows", next="its spots in a file",
        )  # fmt: skip
    return bits


def _lamps(beats: Beats, bits: list[int], panel: Panel, block: int, where: str) -> list[Spot]:
    """Spots of all lamps, from where the two of each bit are."""
    amplitude, share = beats.told()
    able = (share >= BEATS) & (amplitude >= SWING)
    terms, places, radii = [], [], []
    for k, bit in enumerate(bits):
        for row, (x, y, radius) in enumerate(_pair(np.where(able[k], amplitude[k], 0.0))):
            terms.append((1.0, float(bit), float(row)))
            places.append((x, y))
            radii.append(radius)
    if len(terms) < 2 * LEAST:
        raise DataError("the panel is not seen to blink", value=f"{where}: {len(terms) // 2} of {len(bits)} bits",
                        cause="out of view, too dim, or another panel", next="its spots in a file")  # fmt: skip
    found, *_ = np.linalg.lstsq(np.array(terms), np.array(places), rcond=None)
    off = float(np.abs(np.array(terms) @ found - places).max())
    if off > OFF_PX or not np.hypot(*found[1]) > 1:
        raise DataError("what blinks is no panel of two rows", value=f"{where}: lamps lie up to {off:.1f} px off",
                        expected=f"at most {OFF_PX} px", next="its spots in a file")  # fmt: skip
    radius = float(np.median(radii)) * block
    return [
        Spot(n, float(at[0]) * block, float(at[1]) * block, radius)
        for n, led in enumerate(panel.leds)
        if led.bit >= 0
        for at in [found[0] + found[1] * led.bit + found[2] * led.inverted]
    ]


def _pair(amplitude: Floats) -> list[tuple[float, float, float]]:
    """(x, y, radius) of the two strongest groups of pixels, the upper one first; none where there are not two."""
    import cv2

    if not amplitude.any():
        return []
    core = (amplitude >= CORE * amplitude.max()).astype(np.uint8)
    count, labels = cv2.connectedComponents(core)
    total = np.bincount(labels.reshape(-1), amplitude.reshape(-1), count)
    total[0] = 0
    if count < 3:
        return []
    told = []
    for label in np.argsort(-total)[:2]:
        rows, columns = np.nonzero(labels == label)
        weight = amplitude[rows, columns]
        x, y = (float((v + 0.5) @ weight / weight.sum()) for v in (columns, rows))
        told.append((x, y, max(float(np.sqrt(len(rows) / np.pi)), 1.0)))
    return sorted(told, key=lambda t: t[1])
