"""Moving pictures retaken: what an ideal spike camera, and an RGB camera beside it, would have seen of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import UsageError
from spikerig.rigctl.sim.draws import stream
from spikerig.rigctl.sim.sensor import spike_light
from spikerig.rigctl.sim.sources.moving import Moving
from spikerig.rigctl.sim.spec import Sensor
from spikerig.rigctl.sim.stream import opened, spike_blocks

Floats = NDArray[np.floating]
BLOCK = 2048  # ticks made at once: 26 MB of a Vidar
STILL_S = 0.1  # how long a single picture stands, unless said


@dataclass(frozen=True, slots=True)
class Retake:
    """How pictures become spikes.

    Args:
        rate_hz: ticks a second.
        gain: spikes a tick at RGB white.
        hold: each picture holds until the next; otherwise light goes linearly from one to the next.
        phase: charge before the first tick: `random` (even over a threshold) or `zero`.
        seed: of the phase.
        limit_s: seconds of the source at most.
    """

    rate_hz: float = 40_000.0
    gain: float = 0.4
    hold: bool = False
    phase: str = "random"
    seed: int = 0
    limit_s: float | None = None

    def __post_init__(self) -> None:
        for name, value, hi in (("--rate-hz", self.rate_hz, 1e8), ("--gain", self.gain, 1e9)):
            if not 0 < value <= hi:
                raise UsageError(f"{name} is out of range", value=value, expected=f"above 0, at most {hi:g}")
        if self.limit_s is not None and not (self.limit_s * self.rate_hz >= 1 and self.limit_s < 1e7):
            raise UsageError("--limit is less than a tick", value=f"{self.limit_s:g} s", expected="1 tick to 1e7 s")
        if self.phase not in ("random", "zero"):
            raise UsageError("no such phase", value=self.phase, expected="random or zero")
        if not 0 <= self.seed < 2**32:
            raise UsageError("a seed is a whole number", value=self.seed, expected="0 to 4294967295")

    @property
    def limit(self) -> int | None:
        """Ticks at most."""
        return None if self.limit_s is None else round(self.limit_s * self.rate_hz)

    def ticks(self, moving: Moving) -> int:
        """Ticks to come of a source, 0 where that is not known."""
        if moving.kind == "picture":
            return self.limit or round(STILL_S * self.rate_hz)
        whole = 0 if moving.seconds is None else round(moving.seconds * Fraction(self.rate_hz))
        return min(whole, self.limit) if self.limit and whole else self.limit or whole


def knots(moving: Moving, retake: Retake) -> Iterator[tuple[int, Floats]]:
    """(tick, linear light float32[H,W,3]) of each picture, and of the end; ticks increase.

    Raises:
        UsageError: pictures come faster than ticks.

    Edges:
        The last picture of `hold` lasts as long as the source says; with linear light it ends the stream. A single
        picture stands for `STILL_S`, or the limit. A limit between two pictures cuts there.
    """
    rate, limit = Fraction(retake.rate_hz), retake.limit
    tick, light, count = -1, None, 0
    for when, picture in moving.pictures:
        at = round(when * rate)
        if light is not None and at <= tick:
            raise UsageError(
                "pictures come faster than ticks", value=f"two at tick {tick}", next="raise --rate-hz, or lower --fps"
            )
        if limit is not None and at >= limit:
            if light is not None and tick < limit:
                u = np.float32((limit - tick) / (at - tick))
                yield limit, light if retake.hold else light + (picture - light) * u
            return
        tick, light, count = at, picture, count + 1
        yield tick, light
    if light is None or (count > 1 and not retake.hold):
        return
    end = retake.ticks(moving) if moving.kind == "picture" else tick + max(1, round(moving.last * rate))
    yield (end if limit is None else min(end, limit)), light


class Exposures:
    """An RGB camera beside: the mean light of regular exposures, exact for light that is linear or holds.

    Args:
        rate_hz: ticks a second.
        fps: frames a second.
        exposure_ms: of each, at most a frame's share of a second.
        hold: as of the light.
        keep: called with (number, first tick, end tick, mean linear light float64[H,W,3]) of each finished frame.
    """

    def __init__(
        self, rate_hz: float, fps: float, exposure_ms: float, hold: bool, keep: Callable[[int, int, int, Floats], None]
    ) -> None:
        self.period = Fraction(rate_hz) / Fraction(fps).limit_denominator(1_000_000) if fps > 0 else Fraction(0)
        self.length = round(exposure_ms * 1e-3 * rate_hz)
        if not 1 <= self.length <= self.period:
            raise UsageError(
                "an exposure is at least a tick and ends before the next frame",
                value=f"--rgb-fps {fps:g} --exposure-ms {exposure_ms:g}", expected=f"at most {1e3 / (fps or 1):g} ms",
            )  # fmt: skip
        self.hold, self.keep = hold, keep
        self.number = 0
        self.total: NDArray[np.float64] | None = None
        self.last: tuple[int, Floats] | None = None

    def add(self, tick: int, light: Floats) -> None:
        """The next knot of the light."""
        if self.last is not None:
            self._between(*self.last, tick, light)
        self.last = (tick, light)

    def _between(self, a: int, before: Floats, b: int, after: Floats) -> None:
        while True:
            start = round(self.number * self.period)
            end = start + self.length
            first, stop = max(start, a), min(end, b)
            if first < stop:
                u = 0.0 if self.hold else ((first + stop) / 2 - a) / (b - a)
                if self.total is None:
                    self.total = np.zeros(before.shape)
                self.total += (stop - first) * (before * (1 - u) + after * u if u else before)
            if end > b:
                return
            if self.total is not None:
                self.keep(self.number, start, end, self.total / self.length)
            self.total = None
            self.number += 1


def spikes_of(
    moving: Moving, retake: Retake, sink: Callable[[NDArray[np.uint8]], object], exposures: Exposures | None = None
) -> dict[str, Any]:
    """Integrate a source's light and hand the spikes on, block by block.

    Args:
        moving: the source; it is read to its end (or the limit).
        retake: how.
        sink: takes packed ticks uint8[n,H,ceil(W/8)].
        exposures: an RGB camera that looks on.

    Returns:
        ticks, spikes a tick, share of the charge that was clipped (beyond one spike a tick); JSON-ready.

    Cost:
        Memory of a few pictures and a block of ticks, however long the source is.
    """
    sensor = Sensor(gain=retake.gain)
    start = np.zeros((moving.height, moving.width))
    if retake.phase == "random":
        start = stream(retake.seed, "initial_phase", 0).random(start.shape)

    def lights() -> Iterator[tuple[int, Floats]]:
        for tick, picture in knots(moving, retake):
            if exposures is not None:
                exposures.add(tick, picture)
            yield tick, spike_light(picture[None], sensor)[0]

    account, fired = opened(start), 0
    for bits in spike_blocks(lights(), account, hold=retake.hold, block_ticks=BLOCK):
        fired += int(np.bitwise_count(bits).sum())
        sink(bits)
    clipped = float(account.lost.sum())
    return {
        "ticks": account.ticks,
        "spikes_per_tick": fired / (start.size * max(account.ticks, 1)),
        "clipped_share": clipped / max(fired + clipped, 1e-300),
    }
