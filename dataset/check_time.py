"""Checks of time: ticks against exposures, rates, lost ticks, and the clocks of both arms."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from spikerig.dataset.check import Check, Fault, check, fault
from spikerig.dataset.check_look import SceneLook, Undecided, ViewLook
from spikerig.dataset.clocktime import NS

MARGIN_TICKS = 256  # spikes wanted on each side of the exposure
LOST_SHARE = 0.1  # of an exposure, from which on lost ticks are an error
RATE_PPM = 1000.0  # a crystal is off by under 100
UNEVEN = 0.01  # relative difference of exposures
READ_OUT_S = 0.1  # longest believable read-out of a frame
SIGMA_SHARE = 0.05  # of an exposure, from which on the clock's uncertainty is an error


def _rate(look: ViewLook) -> float | None:
    return look.survey.rate_hz


@check(
    "ticks",
    "error",
    "a view's spikes have no tick rate, so no time",
    "give the rate when the scene is built (`data build --rate-hz`)",
    measure=_rate,
)
def rate_is_known(scene: SceneLook, seen: Mapping[str, float | None]) -> Iterator[Fault]:
    """Without a rate, ticks cannot be held against an exposure."""
    for name, rate in seen.items():
        if rate is None:
            yield fault(name, "the tick rate is not known")
        elif not (np.isfinite(rate) and rate > 0):
            yield fault(name, f"a tick rate of {rate:g} Hz")


@check(
    "ticks",
    "warning",
    "views differ in tick rate, or the clock model's slope puts the rate over 1000 ppm off nominal",
    "take the measured rate; look for lost blocks in the recording",
    measure=_rate,
)
def rate_is_nominal(scene: SceneLook, seen: Mapping[str, float | None]) -> Iterator[Fault]:
    """The rate as measured by the clock model, against what the views say."""
    rates = {name: rate for name, rate in seen.items() if rate}
    if not rates:
        raise Undecided("no view has a rate")
    usual = float(np.median(list(rates.values())))
    for name, rate in rates.items():
        if abs(rate / usual - 1) > RATE_PPM * 1e-6:
            yield fault(name, f"{rate:g} Hz, while the median view has {usual:g}")
    clock = scene.clock
    if clock is not None and len(clock.device_ns) > 1:
        device, rig = (float(t[-1] - t[0]) for t in (clock.device_ns, clock.rig_ns))
        ppm = 1e6 * (device / rig - 1)
        if abs(ppm) > RATE_PPM:
            yield fault("", f"the clock model runs the spike camera {ppm:+.0f} ppm off its nominal rate")


@dataclass(frozen=True, slots=True)
class Cover:
    """Spikes around an exposure: ticks before and after it (negative: missing), its length, ticks lost in it."""

    before: float
    after: float
    length: float
    lost: int
    margin: float


def _cover(look: ViewLook) -> Cover:
    first, last = look.exposure_ticks
    s = look.survey
    a, b = int(np.floor(first)), int(np.ceil(last))
    lost = sum(max(0, min(b, int(stop)) - max(a, int(start))) for start, stop in s.lost)
    sigma = _sigma_ticks(look) or 0.0
    return Cover(first, s.ticks - last, last - first, lost, max(MARGIN_TICKS, 3 * sigma))


@check(
    "ticks",
    "error",
    "spikes do not cover read-out and exposure of every valid row (both on one clock, by the clock model where "
    "need be)",
    "record longer around the exposure; look at the clock model",
    measure=_cover,
)
def spikes_cover_the_exposure(scene: SceneLook, seen: Mapping[str, Cover]) -> Iterator[Fault]:
    """The exposure of every row lies inside the spikes."""
    for name, c in seen.items():
        for missing, end in ((-c.before, "before"), (-c.after, "after")):
            if missing > 0.5:
                yield fault(name, f"the exposure goes on {missing:.1f} ticks {end} the spikes")


@check(
    "ticks",
    "note",
    "fewer ticks are kept beside the exposure than the larger of 256 and three sigma of the clock",
    "keep more on each side: textures at the ends of an exposure look beyond it",
    measure=_cover,
)
def margin_is_wide(scene: SceneLook, seen: Mapping[str, Cover]) -> Iterator[Fault]:
    """Windows at the ends of the exposure reach beyond it."""
    for name, c in seen.items():
        least = min(c.before, c.after)
        if -0.5 <= least < c.margin - 0.5:
            yield fault(name, f"{max(least, 0):.0f} ticks beside the exposure, {c.margin:.0f} wanted")


@check(
    "ticks",
    "warning",
    "ticks were lost inside the exposure; over 10 % of it is an error",
    "record the view again; look at the link's load",
    measure=_cover,
)
def no_ticks_lost_in_exposure(scene: SceneLook, seen: Mapping[str, Cover]) -> Iterator[Fault]:
    """Textures that touch a lost tick are not known."""
    for name, c in seen.items():
        if c.lost:
            share = c.lost / max(c.length, 1.0)
            grave = "error" if share > LOST_SHARE else None
            yield fault(name, f"{c.lost} ticks lost inside the exposure ({100 * min(share, 1):.1f} %)", grave)


@dataclass(frozen=True, slots=True)
class Shot:
    """A picture's times: start, exposure, row time (ns), its transfer, split, and the rows of its valid pixels."""

    start_ns: int
    exposure_ns: int
    row_ns: int
    transfer: str
    split: str
    rows: tuple[float, float]

    @property
    def span_ns(self) -> tuple[float, float]:
        """From the first to the last instant at which any row was exposed."""
        late = self.row_ns * self.rows[0], self.row_ns * self.rows[1]
        return self.start_ns + min(late), self.start_ns + max(late) + self.exposure_ns


def _shot(look: ViewLook) -> Shot:
    f, rows = look.frame, look.view.sensor_row[look.view.valid]
    span = (float(rows.min()), float(rows.max())) if rows.size else (0.0, 0.0)
    return Shot(f.start_ns, f.exposure_ns, f.row_ns, f.transfer, look.view.split, span)


@check(
    "ticks",
    "warning",
    "exposures of the views to train on differ by over 1 %, or one is 0",
    "fix the shutter; without a common exposure the gain between both arms differs from view to view",
    measure=_shot,
)
def exposures_are_equal(scene: SceneLook, seen: Mapping[str, Shot]) -> Iterator[Fault]:
    """Auto exposure, or frames of different modes; an exposure of no length shows no blur and matches no spikes."""
    shots = {name: s for name, s in seen.items() if s.split == "train"}
    if not shots:
        raise Undecided("no view to train on")
    usual = float(np.median([s.exposure_ns for s in shots.values()]))
    for name, s in shots.items():
        if s.exposure_ns <= 0:
            yield fault(name, f"an exposure of {s.exposure_ns} ns", "note" if s.exposure_ns == 0 else "error")
        elif usual > 0 and abs(s.exposure_ns / usual - 1) > UNEVEN:
            yield fault(name, f"exposed {s.exposure_ns / 1e6:.3f} ms, the median view {usual / 1e6:.3f} ms")


@check(
    "ticks",
    "warning",
    "the row time is negative, the read-out takes over 100 ms, or a rolling picture's valid pixels are all of one row",
    "look at the camera's mode; align again from the raw recording",
    measure=_shot,
)
def rows_are_timed(scene: SceneLook, seen: Mapping[str, Shot]) -> Iterator[Fault]:
    """A rolling shutter's time goes by the row."""
    for name, s in seen.items():
        read_out = abs(s.row_ns) * (s.rows[1] - s.rows[0]) / NS
        if s.row_ns < 0:
            yield fault(name, f"a row time of {s.row_ns} ns")
        if read_out > READ_OUT_S:
            yield fault(name, f"a read-out of {1e3 * read_out:.0f} ms")
        if s.row_ns and s.rows[0] == s.rows[1]:
            yield fault(name, f"{s.row_ns} ns a row, but all pixels are of row {s.rows[0]:g}")


@check(
    "ticks",
    "error",
    "two views were exposed at the same time",
    "one camera cannot: times were copied or are wrong",
    measure=_shot,
)
def exposures_do_not_overlap(scene: SceneLook, seen: Mapping[str, Shot]) -> Iterator[Fault]:
    """One rig, one take: exposures follow each other; where all start together, no times were recorded."""
    timed = sorted((s.span_ns, name) for name, s in seen.items())
    if len(timed) > 1 and len({span[0] for span, _ in timed}) == 1:
        raise Undecided("all views start at the same instant: times of the take were not recorded")
    for (one, a), (two, b) in itertools.pairwise(timed):
        if two[0] < one[1] or one[0] == two[0]:
            yield fault(b, f"exposed while {a} was: {max(one[1] - two[0], 0) / 1e6:.3f} ms of both")


def _clocks(look: ViewLook) -> tuple[str, str]:
    return look.survey.clock, look.frame.clock


@check(
    "sync",
    "error",
    "spikes and picture are on different clocks, and the scene has no clock model",
    "fit the clocks, or bring both to the rig's",
    measure=_clocks,
)
def clocks_are_joined(scene: SceneLook, seen: Mapping[str, tuple[str, str]]) -> Iterator[Fault]:
    """Times of two clocks cannot be compared without a model."""
    for name, (spikes, frame) in seen.items():
        if spikes != frame and scene.clock is None:
            yield fault(name, f"spikes on the clock {spikes!r}, picture on {frame!r}")


def _sigma_ticks(look: ViewLook) -> float | None:
    clock, s = look.scene.clock, look.survey
    if clock is None or not s.rate_hz:
        return None
    device = s.t0_ns if s.clock != look.frame.clock else int(clock.device_from_rig(np.int64(s.t0_ns)))
    return float(clock.sigma_at(np.int64(device))) * s.rate_hz / NS


def _sigma(look: ViewLook) -> tuple[float, float]:
    sigma = _sigma_ticks(look)
    if sigma is None:
        raise Undecided("no clock model")
    return sigma, look.frame.exposure_ns * (look.survey.rate_hz or 0.0) / NS


@check(
    "sync",
    "warning",
    "the clock model's uncertainty at a view exceeds one tick; over 5 % of the exposure is an error",
    "probe the clocks more often, and after the last view",
    measure=_sigma,
)
def clock_is_certain(scene: SceneLook, seen: Mapping[str, tuple[float, float]]) -> Iterator[Fault]:
    """A clock that nobody probed drifts away."""
    for name, (sigma, exposure) in seen.items():
        if sigma > 1:
            grave = "error" if exposure > 0 and sigma > max(1.0, SIGMA_SHARE * exposure) else None
            yield fault(name, f"the clock is known to {sigma:.1f} ticks", grave)


TIME: tuple[Check, ...] = (
    rate_is_known, rate_is_nominal, spikes_cover_the_exposure, margin_is_wide, no_ticks_lost_in_exposure,
    exposures_are_equal, rows_are_timed, exposures_do_not_overlap, clocks_are_joined, clock_is_certain,
)  # fmt: skip
