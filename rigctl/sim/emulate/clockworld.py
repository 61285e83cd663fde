"""Marks of a rig whose true clocks are known: what the fits of clocks are judged by."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikerig.dataset.clocktime import NS
from spikerig.dataset.marks import Probe, Sight
from spikerig.rigctl.sim.draws import stream
from spikerig.rigctl.sim.emulate.latency import Latency
from spikerig.rigctl.sim.emulate.oscillator import Oscillator

US = 1000
Int64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Link:
    """A question's way out and its answer's way back."""

    out: Latency
    back: Latency


# Floors 80 us apart, as USB's polling makes them; deliveries on the bus's frames; one message in 50 stalls.
FULL_SPEED = Link(Latency(60, 40, 0, 0.02, 5), Latency(140, 40, 1000, 0.02, 5))
HIGH_SPEED = Link(Latency(55, 20, 0, 0.02, 5), Latency(130, 20, 125, 0.02, 5))
# The last byte of a transfer: through the FIFO, over the bus, up to the program.
STREAM = Latency(120, 60, 125, 0.02, 5)


@dataclass
class World:
    """Oscillators of one rig, each off by up to 50 ppm, warming by up to 1 ppm/min, and wandering; true time runs them.

    Args:
        seed: of everything.
        ramp_ppm_per_min: the largest.
        walk: of the frequency, 1/sqrt(s).
    """

    seed: int
    ramp_ppm_per_min: float = 1.0
    walk: float = 1e-8
    clocks: dict[str, Oscillator] = field(init=False)

    def __post_init__(self) -> None:
        rng = stream(self.seed, "clockworld")
        self.clocks = {}
        for name, start in (("host", 10**15), ("box", 1_700_000_000 * NS), ("spike", 0), ("rgb", 123_456_789)):
            ppm, ramp = rng.uniform(-50, 50), rng.uniform(-1, 1) * self.ramp_ppm_per_min
            self.clocks[name] = Oscillator(start + int(rng.integers(NS)), ppm, ramp, self.walk, self.seed, name)

    def at(self, clock: str, true_ns: ArrayLike) -> Int64:
        """What a clock shows at true times."""
        return self.clocks[clock].device_from_true(true_ns)

    def probes(
        self, seconds: float, link: Link = FULL_SPEED, every_s: float = 1.0, burst: int = 16, stamp_ns: int = 32_000
    ) -> list[Probe]:
        """Two-way probes of the box: bursts, 8 ms and a random part of a millisecond apart."""
        rng = stream(self.seed, "probes")
        found = []
        for start in np.arange(0.0, seconds, every_s):
            at = round(start * NS)
            for _ in range(burst):
                at += 7_500_000 + int(rng.integers(1_000_000))
                there = link.out.arrives_ns(at, rng)
                back = link.back.arrives_ns(there, rng)
                box = int(self.at("box", there)) // stamp_ns * stamp_ns + stamp_ns // 2
                found.append(Probe("box", 0, int(self.at("host", at)), box, int(self.at("host", back))))
                at = back
        return found

    def stamps(self, seconds: float, every_s: float = 0.01, link: Latency = STREAM, asked: bool = True) -> list[Probe]:
        """Arrivals of the spike camera's bytes; with `asked` the first tells when the stream was asked for."""
        rng = stream(self.seed, "stamps")
        found = []
        for k, start in enumerate(np.arange(0.0, seconds, every_s)):
            at = round(start * NS)
            came = link.arrives_ns(at, rng)
            sent = int(self.at("host", at - 300_000)) if asked and k == 0 else None
            found.append(Probe("spike", 0, sent, int(self.at("spike", at)), int(self.at("host", came))))
        return found

    def sights(
        self, clock: str, seconds: float, per_s: float, *, sd_ns: float = 24_000, response_ns: float = 0.0,
        row_ns: float = 0.0, rows: tuple[float, float] = (0.0, 0.0),
    ) -> list[Sight]:  # fmt: skip
        """A camera's sightings: noise, edges off by the response, rows off by the read-out."""
        rng = stream(self.seed, f"sights {clock}")
        found = []
        for true in np.sort(rng.uniform(0, seconds, round(seconds * per_s)) * NS).astype(np.int64):
            rising, row = bool(rng.integers(2)), float(rows[int(rng.integers(2))])
            off = sd_ns * rng.standard_normal() + (response_ns if rising else -response_ns) + row_ns * row
            seen = int(self.at(clock, true)) - round(off)
            found.append(Sight(clock, 0, seen, int(self.at("box", true)), sd_ns, rising, 0, row))
        return found

    def rgb_sights(self, seconds: float, per_s: float = 60.0, sd_ns: float = 23_000) -> list[Sight]:
        """Of a GoPro at 1/240 s: a response curve that is off by gamma 0.8, a read-out 5 % longer than assumed."""
        return self.sights("rgb", seconds, per_s, sd_ns=sd_ns, response_ns=267_000, row_ns=325.0, rows=(60.0, 1020.0))

    def off_ns(self, model, clock: str, true_ns: ArrayLike, origin_ns: int, rig: str = "box") -> Int64:
        """A fitted map's error at true times: its rig time minus the true one."""
        return model.rig_from_device(self.at(clock, true_ns)) - (self.at(rig, true_ns) - origin_ns)
