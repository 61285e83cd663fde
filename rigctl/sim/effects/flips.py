"""Bit flips on the wire."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from spikerig.dataset.spikes import SpikeStream
from spikerig.rigctl.sim.effects import Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import RARE, Bound, Facts
from spikerig.rigctl.sim.limits import limits

PART = 1 << 20  # bits drawn for at once


@dataclass(frozen=True, slots=True)
class BitFlips:
    """Each bit of a pixel arrives wrong by chance; nothing tells which.

    Args:
        chance: of a bit.
    """

    chance: float = limits(1e-6, 0, 1, "a bit")

    name: ClassVar[str] = "bit_flips"
    stage: ClassVar[Stage] = Stage.WIRE
    per: ClassVar[str] = "tick"
    source: ClassVar[str] = "a raw raster has no checksum (docs/format.md); the chance is ours"
    vanishes: ClassVar[str] = "chance = 0"
    cost_ns: ClassVar[float] = 0.07

    def begin(self, site: Site) -> Hooks:
        """Errors of one view."""
        rng = site.draw(self.name)

        def wire(stream: SpikeStream) -> SpikeStream:
            pixels = stream.height * stream.width
            step = max(1, PART // max(1, pixels))
            bits = stream.bits.copy()
            for first in range(0, stream.ticks, step):
                total = min(step, stream.ticks - first) * pixels
                wrong = rng.choice(total, rng.binomial(total, self.chance), replace=False, shuffle=False)
                tick, pixel = np.divmod(wrong, pixels)
                y, x = np.divmod(pixel, stream.width)
                np.bitwise_xor.at(bits, (first + tick, y, x // 8), (1 << (x % 8)).astype(np.uint8))
            return replace(stream, bits=bits)

        return Hooks(wire=wire)

    def magnitude(self, facts: Facts) -> Bound:
        """Ones that appear and ones that vanish: both binomial, of chance, among the ticks."""
        ones = np.rint(facts.counts).astype(np.int64)
        size = facts.normal().shape[1:]
        rng = np.random.default_rng(95)
        change = rng.binomial(facts.ticks - ones, self.chance, size) - rng.binomial(ones, self.chance, size)
        spikes = facts.counted(change.astype(np.float64))
        any_bit = -np.expm1(facts.ticks * np.log1p(-self.chance)) if self.chance < 1 else 1.0
        if any_bit < RARE:  # too rare for draws
            spikes = max(spikes, facts.counted(np.ones(1), share=float(any_bit)))
        return Bound(spikes, 0.0, f"{self.chance:g} x {facts.ticks} bits")
