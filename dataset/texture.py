"""Textures from spikes: what the light was, and where that is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import frozen_array


@dataclass(frozen=True, slots=True)
class Texture:
    """Light from spikes: light float32[H,W] (1.0 = a spike every tick), known bool[H,W]; light is 0 where not known.

    `at` is the instant or window centre in ticks, `method` says how it was made.
    """

    light: NDArray[np.float32]
    known: NDArray[np.bool_]
    at: float
    method: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "light", frozen_array(self.light, np.float32))
        object.__setattr__(self, "known", frozen_array(self.known, np.bool_))
