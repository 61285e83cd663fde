"""Small emulated GoPro clips for tests."""

from pathlib import Path

import numpy as np

from spikerig.rigctl.sim.emulate.gopro_mp4 import Recording, write_clip
from spikerig.rigctl.sim.emulate.oscillator import Oscillator

S = 1_000_000_000


def pictures(height: int = 48, width: int = 64):
    """A grey level that says the time: it rises by 1 each 4 ms, from 0 to 250 and again."""

    def at(start_ns: int, exposure_ns: int, row_ns: float) -> np.ndarray:
        return np.full((height, width, 3), grey(start_ns), np.uint8)

    return at


def grey(start_ns: int) -> int:
    """The grey level of `pictures` at a time."""
    return (start_ns // 4_000_000) % 251


def clip(folder: Path, frames: int = 150, chapter_bytes: int = 1 << 40, **settings) -> tuple[list[Path], Recording]:
    """A clip in `folder`, its chapters and what truly happened."""
    clock = Oscillator(offset_ns=7 * S, ppm=43, walk=1e-8, seed=3, name="gopro")
    take = Recording(clock, 5 * S, frames, **settings)
    return write_clip(folder, 42, take, pictures(), chapter_bytes), take
