"""Random streams: one for every purpose, so that adding an effect leaves all other draws as they were."""

from __future__ import annotations

from zlib import crc32

import numpy as np


def stream(seed: int, purpose: str, view: int | None = None) -> np.random.Generator:
    """The random stream of one purpose, and of one view where it differs between views.

    Args:
        seed: of the scene.
        purpose: the effect's name, "shake" or "points".
        view: number of the view; None for what belongs to the sensor and stays (a fixed pattern).
    """
    words = [seed, crc32(purpose.encode())] + ([] if view is None else [view])
    return np.random.default_rng(np.random.SeedSequence(words))
