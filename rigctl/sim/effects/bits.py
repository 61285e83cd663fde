"""Bit depth: how finely the RGB camera's codes are stepped."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from spikerig.rigctl.sim.effects import Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits


@dataclass(frozen=True, slots=True)
class BitDepth:
    """Codes are rounded to 2^bits - 1 steps. More than 8 bits are kept as uint16, full scale 65535.

    Args:
        bits: of a code.
    """

    bits: int = limits(10, 1, 16, "bits")

    name: ClassVar[str] = "bit_depth"
    stage: ClassVar[Stage] = Stage.RGB
    per: ClassVar[str] = "frame"
    source: ClassVar[str] = "rounding; HERO9 files hold 8 bits, HERO10 and later 10"
    vanishes: ClassVar[str] = "bits = 8, what is kept anyway"
    cost_ns: ClassVar[float] = 1.0

    def begin(self, site: Site) -> Hooks:
        """The same for every view."""
        return Hooks() if self.bits == 8 else Hooks(levels=2**self.bits - 1)

    def magnitude(self, facts: Facts) -> Bound:
        """Half a step of either kind."""
        steps = 2**self.bits - 1
        dn = 0.0 if self.bits == 8 else 0.5 + 127.5 / steps
        return Bound(0.0, dn, f"0.5 + 0.5 x 255 / {steps}")
