"""The spike camera's clock against the rig's: offset, skew, wander, jitter, resets.

Each says how far the camera's clock is ahead at a time of the rig. Stamps stay as they are and what the pixels see
moves: a clock that is ahead stamps light too late. The exact map is kept in `Truth.clock`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.draws import stream
from spikerig.rigctl.sim.effects import Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits

Ahead = Callable[[NDArray[np.int64]], NDArray[np.float64]]
SURE = 2.0  # standard deviations that 95 % of the views stay within
SPAN_S, GRAIN_S = float(2**22), 2.0**-14  # a random walk's longest take and finest step: 48 days, 61 us


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """The clock is ahead by the same in all views.

    Args:
        offset_us: of the spike camera.
        frame_us: of the RGB camera: its stamps are late by as much, its pictures are the same.
    """

    offset_us: float = limits(100.0, -1e5, 1e5, "us")
    frame_us: float = limits(0.0, -1e8, 1e8, "us")

    name: ClassVar[str] = "clock_offset"
    stage: ClassVar[Stage] = Stage.CLOCK
    per: ClassVar[str] = "knot"
    source: ClassVar[str] = "SpikeNVS: the clock box aligns the cameras to 0.0001 s"
    vanishes: ClassVar[str] = "offset_us = frame_us = 0"
    cost_ns: ClassVar[float] = 4.0

    def begin(self, site: Site) -> Hooks:
        """The same at all times."""
        return Hooks(clock_ns=constant(self.offset_us), frame_clock_ns=constant(self.frame_us))

    def magnitude(self, facts: Facts) -> Bound:
        """The light's change over the exposure times the ticks ahead."""
        return shifted(facts, self.offset_us)


@dataclass(frozen=True, slots=True)
class ClockSkew:
    """The clock runs fast by a constant rate, from the start of the take on.

    Args:
        ppm: microseconds ahead a second.
    """

    ppm: float = limits(10.0, -1e4, 1e4, "ppm")

    name: ClassVar[str] = "clock_skew"
    stage: ClassVar[Stage] = Stage.CLOCK
    per: ClassVar[str] = "knot"
    source: ClassVar[str] = "crystal oscillators without temperature control: 10 to 50 ppm by their data sheets"
    vanishes: ClassVar[str] = "ppm = 0"
    cost_ns: ClassVar[float] = 4.0

    def begin(self, site: Site) -> Hooks:
        """In proportion to the time."""
        return Hooks(clock_ns=lambda at_ns: at_ns.astype(np.float64) * (self.ppm * 1e-6))

    def magnitude(self, facts: Facts) -> Bound:
        """As an offset of ppm x the take's length: the last view's."""
        return shifted(facts, self.ppm * take_s(facts))


@dataclass(frozen=True, slots=True)
class ClockWander:
    """The clock wanders off in a random walk (white noise of its rate), one path for the whole take.

    Args:
        sd_us: standard deviation after a second; it grows with the square root of the time.
    """

    sd_us: float = limits(1.0, 0, 1e4, "us/sqrt(s)")

    name: ClassVar[str] = "clock_wander"
    stage: ClassVar[Stage] = Stage.CLOCK
    per: ClassVar[str] = "knot"
    source: ClassVar[str] = "white frequency noise (IEEE 1139): sd(t) = sigma sqrt(t); the size is ours"
    vanishes: ClassVar[str] = "sd_us = 0"
    cost_ns: ClassVar[float] = 4.0

    def begin(self, site: Site) -> Hooks:
        """The path at any time; views share it."""

        def ahead(at_ns: NDArray[np.int64]) -> NDArray[np.float64]:
            return self.sd_us * 1e3 * np.array([walk(site.seed, at * 1e-9) for at in at_ns.tolist()])

        return Hooks(clock_ns=ahead if self.sd_us > 0 else constant(0.0))

    def magnitude(self, facts: Facts) -> Bound:
        """As an offset of two standard deviations at the last view."""
        return shifted(facts, SURE * self.sd_us * float(np.sqrt(take_s(facts))))


@dataclass(frozen=True, slots=True)
class ClockJitter:
    """Each view's stamps are off by a normal amount of their own.

    Args:
        sd_us: of the spike camera.
        frame_us: of the RGB camera: its stamps differ, its pictures are the same.
    """

    sd_us: float = limits(25.0, 0, 1e5, "us")
    frame_us: float = limits(0.0, 0, 1e8, "us")

    name: ClassVar[str] = "clock_jitter"
    stage: ClassVar[Stage] = Stage.CLOCK
    per: ClassVar[str] = "knot"
    source: ClassVar[str] = "stamps made by the host when a block arrives (SpikeCV's SDK); the size is ours: one tick"
    vanishes: ClassVar[str] = "sd_us = frame_us = 0"
    cost_ns: ClassVar[float] = 4.0

    def begin(self, site: Site) -> Hooks:
        """The view's amounts."""
        spikes, frame = site.draw(self.name).standard_normal(2)
        return Hooks(clock_ns=constant(self.sd_us * spikes), frame_clock_ns=constant(self.frame_us * frame))

    def magnitude(self, facts: Facts) -> Bound:
        """As an offset of two standard deviations."""
        return shifted(facts, SURE * self.sd_us)


@dataclass(frozen=True, slots=True)
class ClockReset:
    """The clock jumps between two views.

    Args:
        view: the first with the new time.
        jump_us: how far ahead; back, it may not reach into the view before.
    """

    view: int = limits(1, 0, 100_000, "view number")
    jump_us: float = limits(1000.0, -1e5, 1e5, "us")

    name: ClassVar[str] = "clock_reset"
    stage: ClassVar[Stage] = Stage.CLOCK
    per: ClassVar[str] = "knot"
    source: ClassVar[str] = "a camera or clock box that starts anew within a take; the size is ours"
    vanishes: ClassVar[str] = "jump_us = 0, or a view that the take does not have"
    cost_ns: ClassVar[float] = 4.0

    def begin(self, site: Site) -> Hooks:
        """Nothing before the jump, all of it after."""
        return Hooks(clock_ns=constant(self.jump_us if site.view >= self.view else 0.0))

    def magnitude(self, facts: Facts) -> Bound:
        """As an offset of the jump, in the views after it."""
        return shifted(facts, self.jump_us, max(facts.views - self.view, 0) / facts.views)


def constant(ahead_us: float) -> Ahead:
    """The same at all times."""
    return lambda at_ns: np.full(len(at_ns), ahead_us * 1e3)


def take_s(facts: Facts) -> float:
    """From the start of the take to the end of its last view."""
    return facts.views * facts.period_s + facts.exposure_s


def shifted(facts: Facts, by_us: float, share: float = 1.0) -> Bound:
    """Bound of light that comes late: slope x ticks, as exposure and margin see it; the RGB picture is as it was.

    Edges:
        Beyond an exposure's length the light is taken to differ as much as over one exposure.
    """
    ticks = abs(by_us) * 1e-6 * facts.rate_hz
    change, before = (facts.slope * min(ticks, float(n)) for n in (facts.ticks, facts.margin_ticks))
    told = f"{facts.most(facts.slope):.3g} x {ticks:.3g} ticks"
    return Bound(facts.counted(change, before, share), 0.0, told)


def walk(seed: int, at_s: float) -> float:
    """A unit random walk (variance 1 a second, from 0) at a time up to 48 days: one path, whoever asks in any order.

    Source:
        Levy's construction: the middle of a stretch is normal around the mean of its ends, variance a quarter of its
        length; each middle is a draw of its own.
    """
    begin, length, index = 0.0, SPAN_S, 0
    at_s = min(max(at_s, 0.0), SPAN_S)
    start, end = 0.0, float(np.sqrt(SPAN_S)) * _unit(seed, 0.0, 0)
    while length > GRAIN_S:
        middle = (start + end) / 2 + float(np.sqrt(length / 4)) * _unit(seed, length, index)
        length /= 2
        index *= 2
        if at_s < begin + length:
            end = middle
        else:
            begin, start, index = begin + length, middle, index + 1
    return start + (end - start) * (at_s - begin) / length


@lru_cache(maxsize=4096)
def _unit(seed: int, length: float, index: int) -> float:
    return float(stream(seed, f"{ClockWander.name}/{length:g}/{index}").standard_normal())
