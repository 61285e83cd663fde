"""What is asked of an estimate of poses, and what comes back: records."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.consensus import Path
from spikerig.calib.mapping import Map
from spikerig.calib.pictures import Looks
from spikerig.dataset.errors import UsageError

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Wanted:
    """What to estimate, and what is good enough.

    Args:
        arms: pictures of the `spike` arm, of `rgb`, or of `both` as a COLMAP rig of fixed relative pose.
        kinds: of texture; empty chooses by how many features are found again, and how near (sharpness and noise).
        maps: how many kinds of texture are mapped independently; two or more can disagree, and then nothing is kept.
        instants: poses over each exposure, ends included; 1 gives the middle alone.
        min_share: of the views that must be placed.
        max_error_px: mean residual above which a map is refused.
        pattern: the sensor's fixed pattern, measured on the views themselves, is divided out of their textures.
    """

    arms: str = "spike"
    kinds: tuple[str, ...] = ()
    maps: int = 3
    instants: int = 5
    min_share: float = 0.8
    max_error_px: float = 1.5
    pattern: bool = True

    def __post_init__(self) -> None:
        if self.arms not in ("spike", "rgb", "both"):
            raise UsageError("unknown arms", value=self.arms, expected="spike, rgb or both")
        if not (1 <= self.maps <= 8 and 1 <= self.instants <= 101 and 0 < self.min_share <= 1):
            raise UsageError(
                "maps, instants or min_share out of range", value=(self.maps, self.instants, self.min_share)
            )


@dataclass(frozen=True, slots=True)
class Estimate:
    """Poses in a world of their own, and why to trust them or not.

    Args:
        images: names of all views asked for.
        poses: cam_from_world [3,4] at mid-exposure, by view, of those placed.
        paths: over the exposure, by view; one without chi-square was not measured and stands still.
        best: the map they come from.
        kinds: of texture mapped; the first is `best`'s.
        looked: sharpness and noise of the kinds.
        agreement_deg, agreement_share: largest median difference between the maps that agree.
        agreeing: how many of the maps agree with the best, itself included, and how many there were.
        reasons: why it is refused; empty when it is not.
        pattern_sd: of the fixed pattern that was divided out (a share of the light); None: nothing was.
    """

    images: tuple[str, ...]
    poses: Mapping[str, Floats]
    paths: Mapping[str, Path]
    best: Map
    kinds: tuple[str, ...]
    looked: tuple[Looks, ...] = ()
    agreement_deg: float | None = None
    agreement_share: float | None = None
    agreeing: tuple[int, int] = (1, 1)
    reasons: tuple[str, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)
    pattern_sd: float | None = None
