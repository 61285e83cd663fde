"""Where ticks begin, told by the LED panel: its lights blink where the plan says, if the framing is right."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.wire import WireProfile

WINDOW = 16  # ticks counted together: what blinks is told from what only flickers
MOST_TICKS = 2048
SURE = 1.25  # how much better the best offset must be than any that is elsewhere


def panel_phase(data: NDArray[np.uint8], profile: WireProfile, lit: NDArray[np.bool_]) -> tuple[int, float]:
    """Byte at which ticks begin, and by how much it beats the next best elsewhere (`SURE` is enough).

    Args:
        data: uint8[n], a gapless stretch of bare rows; at least 8 windows of ticks.
        profile: of the wire.
        lit: bool[H,W], top row first, where the panel's LEDs are.

    Edges:
        Pictures with a black panel at both edges have no seam where top meets bottom, so `framing.find_phase` errs.
        Too few ticks: a confidence of 0.

    Cost:
        About 1 ms a tick of 12,500 bytes.
    """
    size = profile.tick_bytes
    windows = min(len(data) // size, MOST_TICKS) // WINDOW
    if windows < 8:
        return 0, 0.0
    total = np.zeros(8 * size)
    square = np.zeros(8 * size)
    for w in range(windows):
        ticks = data[w * WINDOW * size : (w + 1) * WINDOW * size].reshape(WINDOW, size)
        count = np.unpackbits(ticks, axis=1, bitorder="little").sum(0, dtype=np.float64)
        total += count
        square += count**2
    blink = np.maximum(square / windows - (total / windows) ** 2, 0)
    rows = np.zeros((profile.height, profile.row_bits))
    rows[:, : profile.width] = lit[::-1] if profile.bottom_up else lit
    wanted = rows.reshape(-1) - rows.mean()
    score = np.fft.irfft(np.fft.rfft(blink) * np.conj(np.fft.rfft(wanted)), len(blink))[::8]
    best = int(np.argmax(score))
    away = np.abs((np.arange(size) - best + size // 2) % size - size // 2)
    row = profile.row_bits // 8
    near = (away <= 1) | (np.abs(away - row) <= 1)
    rival = float(score[~near].max())
    return best, float(score[best]) / max(rival, 1e-12)
