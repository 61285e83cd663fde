"""A clock watched while it runs: raw marks in, what its map is now and how good, at any time."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from spikerig.calib.clock_follow import Follower
from spikerig.dataset.marks import Probe

FLOOR_NS = 30_000_000_000  # a delay's floor is the least of this time
FRESH_NS = 5_000_000_000  # without a mark for longer, a clock holds over


@dataclass
class ClockWatch:
    """A device's clock against the host's, by two-way probes (or arrivals alone) in groups.

    Args:
        clock: of the marks.
        stamp_ns: step of its stamps.
        assumed_ns: bound on the bias where probes are one-way only.
    """

    clock: str
    stamp_ns: int = 0
    assumed_ns: float = 5_000_000.0
    follower: Follower = field(default_factory=lambda: Follower(least_ns=300_000.0))
    epoch: int = -1
    marks: int = 0
    left_out: int = 0
    steps: int = 0
    resets: int = 0
    floors: deque[tuple[int, int]] = field(default_factory=deque)  # (host, least delay) of groups
    two_way: bool = True
    last_ns: int | None = None  # host time of the last mark used

    def add(self, group: list[Probe]) -> str:
        """Take probes that belong together (a burst); the fastest counts. Says "used", "far", "step" or "reset".

        Of one-way stamps the one that came earliest against the device's time counts.
        """
        if not group:
            return "far"
        self.marks += len(group)
        told = "used"
        if group[-1].epoch != self.epoch:
            group = [p for p in group if p.epoch == group[-1].epoch]
            told = "reset" if self.epoch >= 0 else "used"
            self.resets += self.epoch >= 0
            self.epoch = group[-1].epoch
            self.follower.again()
        both = [p for p in group if p.sent_ns is not None]
        self.two_way = bool(both)
        if both:
            best = min(both, key=lambda p: p.received_ns - (p.sent_ns or 0))
            delay = best.received_ns - int(best.sent_ns or 0)
            host, excess = best.received_ns - delay // 2, delay - self._floor(best.received_ns, delay)
        else:
            best = min(group, key=lambda p: p.received_ns - p.device_ns)
            late = [p.received_ns - p.device_ns for p in group]
            host, excess = best.received_ns, (max(late) - min(late)) / max(len(late), 2)
        sd = float(np.sqrt(1e6 + self.stamp_ns**2 / 12 + (excess / 2) ** 2))
        verdict = self.follower.add(host, best.device_ns, sd)
        if verdict == "used":
            self.last_ns = host
        elif verdict == "step":
            self.last_ns, told = host, "step"
            self.steps += 1
        else:
            self.left_out += 1
            told = "far"
        return told

    def jumped(self, by_ns: int) -> None:
        """The host's clock stood still for `by_ns` while the device's went on (a suspend)."""
        self.follower.stood(by_ns, 1_000_000.0)
        self.floors.clear()

    def at(self, host_ns: int) -> tuple[int, float]:
        """The device's time at a host time, and twice the sigma: what it is good to, bias bound included."""
        device, sigma = self.follower.predict(host_ns)
        return device, 2 * float(np.hypot(sigma, self.bias_ns / np.sqrt(3) if self.two_way else self.bias_ns / 2))

    @property
    def bias_ns(self) -> float:
        """Half the delay's floor; of one-way stamps the assumption."""
        if not self.two_way:
            return self.assumed_ns
        return min((d for _, d in self.floors), default=0) / 2

    def told(self, now_ns: int) -> dict[str, Any]:
        """The state, JSON-ready."""
        if self.last_ns is None:
            return {"clock": self.clock, "state": "searching", "marks": self.marks}
        device, good = self.at(now_ns)
        hold = now_ns - self.last_ns
        return {
            "clock": self.clock,
            "state": "locked" if hold <= FRESH_NS else "holding over",
            "epoch": self.epoch,
            "offset_ns": device - now_ns,
            "skew_ppm": self.follower.skew_ppm,
            "skew_sd_ppm": self.follower.skew_sd_ppm,
            "uncertainty_us": good / 1e3,
            "bias_bound_us": self.bias_ns / 1e3,
            "hold_over_s": hold / 1e9,
            "delay_floor_us": 2 * self.bias_ns / 1e3 if self.two_way else None,
            "marks": self.marks,
            "left_out": self.left_out,
            "steps": self.steps,
            "resets": self.resets,
        }

    def _floor(self, host_ns: int, delay: int) -> int:
        self.floors.append((host_ns, delay))
        while host_ns - self.floors[0][0] > FLOOR_NS:
            self.floors.popleft()
        return min(d for _, d in self.floors)
