"""Where ticks begin, told by the LED panel: its lights blink where the plan says, if the framing is right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.panel_read import Spot
from spikerig.dataset.panel import Panel
from spikerig.dataset.wire import WireProfile

WINDOW = 16  # ticks counted together: what blinks is told from what only flickers
MOST_TICKS = 1024
REACH = 4  # rows: as near as this two offsets see the same LEDs
FAR, NEAR = 1.5, 1.08  # how much better the best offset must be than any elsewhere, and than its neighbours


def panel_scores(
    data: NDArray[np.uint8], profile: WireProfile, pairs: Sequence[tuple[Spot, Spot]]
) -> NDArray[np.float64] | None:
    """How well each byte would do as the beginning of ticks, float64[tick_bytes]; None of too few ticks.

    An LED and its complement count against each other, whatever the scene does: what scores is minus their covariance.

    Args:
        data: uint8[n], a gapless stretch of bare rows; at least 8 windows of ticks.
        profile: of the wire.
        pairs: LEDs that show a bit, and those that show its complement, in the picture (top row first).

    Edges:
        Pictures with a black panel at both edges have no seam where top meets bottom, so `framing.find_phase` errs.

    Cost:
        A few seconds for 12,500 bytes a tick; memory of 4 bytes a pixel and window.
    """
    size = profile.tick_bytes
    windows = min(len(data) // size, MOST_TICKS) // WINDOW
    if windows < 8:
        return None
    counts = np.empty((windows, 8 * size), np.float32)
    for w in range(windows):
        ticks = data[w * WINDOW * size : (w + 1) * WINDOW * size].reshape(WINDOW, size)
        counts[w] = np.unpackbits(ticks, axis=1, bitorder="little").sum(0, dtype=np.uint8)
    counts -= counts.mean(0)
    score = np.zeros(size)
    begin = 8 * np.arange(size)
    for one, other in pairs:
        first, second = (
            np.mean([counts[:, (begin + pixel) % (8 * size)] for pixel in _wire_pixels(spot, profile)], axis=0)
            for spot in (one, other)
        )
        score -= (first * second).mean(0)
    return score


def _wire_pixels(spot: Spot, profile: WireProfile) -> list[int]:
    """Numbers of an LED's pixels on the wire, from the tick's first."""
    rows, columns, inside = spot.disk(profile.height, profile.width)
    y, x = np.nonzero(inside)
    y, x = y + rows.start, x + columns.start
    return ((profile.height - 1 - y if profile.bottom_up else y) * profile.row_bits + x).tolist()


def complements(panel: Panel, found: Sequence[Spot]) -> list[tuple[Spot, Spot]]:
    """Pairs of spots of LEDs that show a bit and its complement."""
    by_bit = {(panel.leds[s.led].bit, panel.leds[s.led].inverted): s for s in found}
    return [(s, by_bit[bit, True]) for (bit, inverted), s in by_bit.items() if not inverted and (bit, True) in by_bit]


def best_of(scores: NDArray[np.float64], profile: WireProfile) -> tuple[int, bool]:
    """The best byte, and whether it stands out from those far away and from its neighbours."""
    best, size = int(np.argmax(scores)), profile.tick_bytes
    away = np.abs((np.arange(size) - best + size // 2) % size - size // 2)
    far = away > REACH * (profile.row_bits // 8) + 1
    near = ~far & (away > 0)
    rivals = (float(scores[which].max(initial=0.0)) for which in (far, near))
    return best, all(scores[best] > least * rival for least, rival in zip((FAR, NEAR), rivals, strict=True))
