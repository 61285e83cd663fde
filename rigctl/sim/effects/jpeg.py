"""JPEG: what the RGB camera's still pictures lose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import UsageError
from spikerig.dataset.images import srgb8_from_linear
from spikerig.rigctl.sim.arms import in_views
from spikerig.rigctl.sim.effects import Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits


@dataclass(frozen=True, slots=True)
class Jpeg:
    """The picture is written as a JPEG in memory, and read back.

    Args:
        quality: the IJG library's scale.
        colour: 4:2:0 halves the colour's resolution on both axes, 4:4:4 keeps it.
    """

    quality: int = limits(90, 1, 100, "IJG scale")
    colour: str = limits("4:2:0", unit="sampling", choices=("4:2:0", "4:4:4"))

    name: ClassVar[str] = "jpeg"
    stage: ClassVar[Stage] = Stage.RGB
    per: ClassVar[str] = "frame"
    source: ClassVar[str] = "ITU-T T.81 through OpenCV's libjpeg-turbo"
    vanishes: ClassVar[str] = 'left out; quality = 100 with colour = "4:4:4" stays within 4 codes'
    cost_ns: ClassVar[float] = 21.0

    def begin(self, site: Site) -> Hooks:
        """The same for every view."""
        return Hooks(coded=self.through)

    def through(self, pixels: NDArray[Any]) -> NDArray[np.uint8]:
        """Pixels uint8[H,W,3] as they come out of the file.

        Raises:
            UsageError: pixels of more than 8 bits.
        """
        import cv2

        if pixels.dtype != np.uint8:
            raise UsageError("a JPEG holds 8 bits", value="bit_depth above 8 with jpeg", next="leave one of them out")
        sampling = {"4:2:0": 0x221111, "4:4:4": 0x111111}[self.colour]
        how = [cv2.IMWRITE_JPEG_QUALITY, self.quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
        file = cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]), how)[1]
        back = np.asarray(cv2.imdecode(file, cv2.IMREAD_COLOR), np.uint8)
        return np.ascontiguousarray(back[..., ::-1])

    def magnitude(self, facts: Facts) -> Bound:
        """What the surveyed views lose."""
        return Bound(0.0, coding_loss(facts, self.through), f"quality {self.quality}; {in_views(facts)}")


def coding_loss(facts: Facts, through: Any) -> float:
    """How far codes of the surveyed views' pictures move on their way through a file."""
    pixels = [srgb8_from_linear(rgb) for _, rgb in facts.means]
    return facts.counted(np.array([through(codes).astype(np.float64) - codes for codes in pixels]))
