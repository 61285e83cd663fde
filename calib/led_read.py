"""A plain blinking LED as the spike camera sees it: when it went on and off, and whether it is steady."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.panel_read import CONTRAST, REACH, Spot, counted
from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DataError
from spikerig.dataset.stream import SpikeStream

Floats = NDArray[np.float64]
Int64 = NDArray[np.int64]
SMOOTH = 16  # ticks that are looked at together to tell on from off
CLEAR = 8  # ticks beside an edge that tell no level
LEVEL = 2000  # ticks beside an edge that tell its levels, at most
LOW, HIGH = 0.3, 0.7  # of the way from off to on: below the one it is off, above the other on
STEADY_NS = 200_000.0  # rms from an even beat below which the LED counts as steady
WRONG = 0.1  # by which a plan may be wrong about the period


@dataclass(frozen=True, slots=True)
class Blinks:
    """What one viewpoint's spikes show of the LED.

    Args:
        at_ns: int64[E], when it went on or off, the camera's own time, rising.
        rising: bool[E], on.
        sd_ns: float64[E].
        span_ns: first and last moment looked at.
    """

    at_ns: Int64
    rising: NDArray[np.bool_]
    sd_ns: Floats
    span_ns: tuple[int, int]


@dataclass(frozen=True, slots=True)
class Beat:
    """A steady LED: edges of viewpoint i go on at `starts_ns[i] + n * period_ns`, off `on_ns` later.

    Args:
        period_ns, on_ns: of the spike camera's own time; 0 where the LED is not steady.
        starts_ns: int64 of each viewpoint.
        rms_ns: of all edges from that.
    """

    period_ns: float
    on_ns: float
    starts_ns: tuple[int, ...]
    rms_ns: float


def spike_blinks(streams: Iterable[SpikeStream], spots: Sequence[Spot]) -> Blinks:
    """When the LED went on and off in a viewpoint's spikes.

    Args:
        streams: pieces of one gapless stretch, in order; `t0_ns` is on the camera's clock.
        spots: where the LED is, or several that blink alike.

    Raises:
        DataError: the LED is not seen to go on and off.

    Edges: edges nearer than 24 ticks to a lost tick, an end or another edge are left out.
    Source: as `panel_read`: expected counts of an integrate-and-fire pixel are exact over a window of any phase.
    """
    counts, lost, t0, rate, pixels = _counts(streams, spots)
    tick_ns = NS / rate
    weights = np.full(SMOOTH, 1 / SMOOTH)
    level = np.convolve(counts.astype(np.float64), weights, "same") if len(counts) >= 4 * SMOOTH else np.zeros(1)
    off, on = (float(v) for v in np.percentile(level, (5, 95)))
    span = (t0, t0 + round(len(counts) * tick_ns))
    if on - off < CONTRAST * pixels:
        raise DataError(
            "the LED does not blink where the plan has it", value=f"{(on - off) / pixels:.3f} spikes a tick and pixel",
            expected=f"at least {CONTRAST} between off and on", cause="another place, too dim, or too slow",
        )  # fmt: skip
    rough = _crossings(level, off + LOW * (on - off), off + HIGH * (on - off))
    sums = np.concatenate([[0], np.cumsum(counts)])
    gone = np.concatenate([[0], np.cumsum(lost)])
    told: list[tuple[float, bool, float]] = []
    for k, (at, rising) in enumerate(rough):
        before = rough[k - 1][0] if k else 0
        after = rough[k + 1][0] if k + 1 < len(rough) else len(counts)
        reach = min(REACH, (at - before) // 2, (after - at) // 2)
        a, b = at - reach, at + reach
        first, last = max(before + CLEAR, a - LEVEL), min(after - CLEAR, b + LEVEL)
        if reach < SMOOTH + CLEAR or gone[last] > gone[first]:
            continue
        ends = ((sums[at - CLEAR] - sums[first]) / (at - CLEAR - first),
                (sums[last] - sums[at + CLEAR]) / (last - at - CLEAR))  # fmt: skip
        dark, light = ends if rising else ends[::-1]
        if light - dark < 0.5 * (on - off):
            continue
        share = (sums[b] - sums[a] - dark * (b - a)) / (light - dark)  # ticks of full light
        sd = np.hypot(np.sqrt(pixels / 6) / (light - dark), 0.02) * tick_ns  # phases of the pixels are random
        told.append((b - share if rising else a + share, rising, sd))
    if not told:
        raise DataError("the LED neither goes on nor off in these spikes", value=f"{len(counts)} ticks",
                        next="a longer viewpoint, or an LED that blinks faster")  # fmt: skip
    at_ns = t0 + np.rint(np.array([t for t, *_ in told]) * tick_ns).astype(np.int64)
    return Blinks(at_ns, np.array([r for _, r, _ in told]), np.array([s for *_, s in told]), span)


def _counts(
    streams: Iterable[SpikeStream], spots: Sequence[Spot]
) -> tuple[NDArray[np.int64], NDArray[np.bool_], int, float, int]:
    """Spikes of all spots together in each tick, which ticks are lost, when it began, the rate, pixels."""
    parts, gone, t0, rate, pixels = [], [], 0, 0.0, 0
    for stream in streams:
        where = [s.disk(stream.height, stream.width) for s in spots]
        if not parts:
            t0, rate, pixels = stream.t0_ns, float(stream.rate_hz or 0), sum(int(i.sum()) for *_, i in where)
        parts.append(np.sum([counted(stream, *w) for w in where], 0, dtype=np.int64))
        hole = np.zeros(stream.ticks, bool)
        for a, b in stream.lost:
            hole[a:b] = True
        gone.append(hole)
    if not parts or not rate:
        raise DataError("there are no spikes to look for the LED in", value=f"{len(parts)} pieces")
    return np.concatenate(parts), np.concatenate(gone), t0, rate, pixels


def _crossings(level: Floats, low: float, high: float) -> list[tuple[int, bool]]:
    """Where a level changes sides for good: (tick, upwards)."""
    state = np.where(level > high, 1, np.where(level < low, -1, 0))
    told = np.flatnonzero(state)
    turns = np.flatnonzero(np.diff(state[told]))
    middle = (low + high) / 2
    found = []
    for k in turns.tolist():
        a, b, rising = int(told[k]), int(told[k + 1]), bool(state[told[k + 1]] > 0)
        beyond = level[a : b + 1] > middle if rising else level[a : b + 1] < middle
        found.append((a + int(np.argmax(beyond)), rising))
    return found


def beat_of(views: Sequence[Blinks], period_ns: float = 0.0) -> Beat:
    """The even beat of all viewpoints together, each with its own start.

    Args:
        views: what each shows.
        period_ns: as far as known, to a tenth; 0: not at all.

    Raises:
        DataError: no viewpoint shows a whole period, another one than was said, or none though one was said.

    Edges:
        A light of which no period was said and whose edges lie more than 0.2 ms (rms) from any even beat is not steady:
        its period is 0.
    """
    apart = [np.diff(v.at_ns[v.rising == way]) for v in views for way in (True, False)]
    steps = np.concatenate([np.zeros(0), *apart])
    if not len(steps):
        raise DataError("no viewpoint is long enough for the LED", value=f"{len(views)} viewpoints, none with a period",
                        next="longer viewpoints, or an LED that blinks faster")  # fmt: skip
    period = _likely(steps, period_ns)
    view = np.concatenate([np.full(len(v.at_ns), k) for k, v in enumerate(views)])
    own = np.concatenate([v.at_ns - v.at_ns[0] for v in views]).astype(np.float64)
    rising = np.concatenate([v.rising for v in views])
    on, rest = _first_on(views, period), np.zeros(len(own))
    starts = np.array([0.0 if v.rising[0] else -on for v in views])
    for _ in range(4):
        turn = np.rint((own - starts[view] - np.where(rising, 0, on)) / period)
        design = np.zeros((len(own), len(views) + 2))
        design[np.arange(len(own)), view] = 1
        design[:, -2], design[:, -1] = turn, ~rising
        found, *_ = np.linalg.lstsq(design, own, rcond=None)
        starts, period, on = found[: len(views)], float(found[-2]), float(found[-1])
        rest = own - design @ found
    rms = float(np.sqrt(np.mean(rest**2)))
    if rms > STEADY_NS or not 0 < on < period:
        if period_ns:
            raise DataError(
                "what blinks keeps no even beat", value=f"{rms / 1e3:.0f} us rms from one of {period / 1e6:.1f} ms",
                expected=f"at most {STEADY_NS / 1e3:.0f} us", cause="another place than the LED's, or a poor lamp",
                next="the right led.spike; led.period_ms = 0 for a light that is not steady",
            )  # fmt: skip
        return Beat(0.0, 0.0, (0,) * len(views), rms)
    if period_ns and abs(period / period_ns - 1) > WRONG:
        raise DataError("the LED has another period than the plan says", value=f"{period / 1e6:.1f} ms",
                        expected=f"{period_ns / 1e6:.1f} ms", next="the right led.period_ms, or 0: found")  # fmt: skip
    return Beat(period, on, tuple(int(v.at_ns[0]) + round(s) for v, s in zip(views, starts, strict=True)), rms)


def _likely(steps: Floats, told_ns: float) -> float:
    """The period: the median step, less those over edges that were left out."""
    if told_ns:
        turns = np.maximum(np.rint(steps / told_ns), 1)
        return float(np.median(steps / turns))
    least = float(np.percentile(steps, 10))
    return float(np.median(steps / np.maximum(np.rint(steps / least), 1)))


def _first_on(views: Sequence[Blinks], period: float) -> float:
    """How long the LED is on, from an edge up and the next one down."""
    told = [
        float((v.at_ns[k + 1] - v.at_ns[k]) if v.rising[k] else period - (v.at_ns[k + 1] - v.at_ns[k]))
        for v in views for k in range(len(v.at_ns) - 1) if v.rising[k] != v.rising[k + 1]
    ]  # fmt: skip
    return float(np.median(told)) % period if told else period / 2
