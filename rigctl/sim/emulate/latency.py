"""How long a message takes: a floor, a tail, and now and then a stall; each direction its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spikerig.dataset.errors import UsageError


@dataclass(frozen=True, slots=True)
class Latency:
    """One direction of a link.

    Args:
        floor_us: no message is faster.
        tail_us: mean of the exponential part above the floor.
        grain_us: deliveries happen on a grid of this period (USB frames: 125 or 1000); 0: any time.
        stall: share of messages that also wait `stall_ms`, exponential.
        stall_ms: mean of that wait.
    """

    floor_us: float = 60.0
    tail_us: float = 40.0
    grain_us: float = 0.0
    stall: float = 0.0
    stall_ms: float = 5.0

    def __post_init__(self) -> None:
        numbers = (self.floor_us, self.tail_us, self.grain_us, self.stall, self.stall_ms)
        if not (all(np.isfinite(n) and n >= 0 for n in numbers) and self.stall <= 1):
            raise UsageError("a latency's numbers are finite and not negative", value=self)

    def arrives_ns(self, sent_ns: int, rng: np.random.Generator) -> int:
        """When a message sent at `sent_ns` arrives; three draws a call, whatever they decide."""
        tail, lot, wait = rng.exponential(), rng.random(), rng.exponential()
        late_us = self.floor_us + self.tail_us * tail + (1e3 * self.stall_ms * wait if lot < self.stall else 0.0)
        at = sent_ns + round(1e3 * late_us)
        grain = round(1e3 * self.grain_us)
        return at if grain <= 0 else -(-at // grain) * grain
