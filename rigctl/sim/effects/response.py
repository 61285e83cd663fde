"""Response: the camera's curve from light to code, in place of sRGB."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spikerig.dataset.images import srgb_from_linear
from spikerig.rigctl.sim.effects import Floats, Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits

PROTUNE = 113.0  # base of GoPro's log curve


@dataclass(frozen=True, slots=True)
class ResponseCurve:
    """Linear light to code by another curve, then contrast: y + contrast (3 y^2 - 2 y^3 - y), an S about the middle.

    The frame still says `srgb`, as a camera's file would; the curve is among the truth's effects.

    Args:
        curve: srgb, gamma (x^(1/gamma)) or protune (log(112 x + 1) / log(113), GoPro's flat colour).
        gamma: of that curve.
        contrast: 0 none; 1 is steepest, 3/2 in the middle.
    """

    curve: str = limits("srgb", unit="word", choices=("srgb", "gamma", "protune"))
    gamma: float = limits(2.2, 0.1, 10, "exponent")
    contrast: float = limits(0.3, 0, 1, "of an S curve")

    name: ClassVar[str] = "response_curve"
    stage: ClassVar[Stage] = Stage.RGB
    per: ClassVar[str] = "frame"
    source: ClassVar[str] = "IEC 61966-2-1; GoPro CineForm SDK: CFHD_CURVE_PROTUNE, a log of base 113"
    vanishes: ClassVar[str] = 'curve = "srgb", contrast = 0'
    cost_ns: ClassVar[float] = 11.0
    on_noise: ClassVar[bool] = True  # its bound is taken with the noise that reaches it

    def begin(self, site: Site) -> Hooks:
        """The same for every view."""
        return Hooks() if self.curve == "srgb" and self.contrast == 0 else Hooks(response=self.encoded)

    def encoded(self, light: Floats) -> Floats:
        """Codes 0 to 1 of linear light 0 to 1."""
        if self.curve == "gamma":
            y = np.power(light, light.dtype.type(1 / self.gamma))
        elif self.curve == "protune":
            y = np.log1p(light * light.dtype.type(PROTUNE - 1)) / light.dtype.type(np.log(PROTUNE))
        else:
            y = srgb_from_linear(light)
        return y + light.dtype.type(self.contrast) * (y * y * (3 - 2 * y) - y)

    def magnitude(self, facts: Facts) -> Bound:
        """The two curves' difference at this scene's light."""
        light = np.clip(facts.rgb, 0, 1)
        dn = facts.counted(255 * (self.encoded(light) - srgb_from_linear(light)))
        return Bound(
            0.0, dn, f"{self.curve}, contrast {self.contrast:g}, against sRGB at light up to {facts.most(light):.3g}"
        )
