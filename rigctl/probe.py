"""What bytes from an unknown spike camera look like: hypotheses on its wire, each with what speaks for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset import m1k40
from spikerig.dataset.framing import FEWEST, find_phase, fold, period_gain, row_lag
from spikerig.dataset.wire import WireProfile

Bytes = NDArray[np.uint8]
CONVINCED = 0.95
_DEPENDENT = 64.0  # bits of a moving scene are no independent witnesses
_STANDS_OUT = 6.0  # scatters
_MOST_TICKS = 512


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A wire that the bytes may be of.

    Args:
        profile: the wire.
        gain: nats by which its period foretells the bits (`framing.period_gain`); None: too few bytes.
        confidence: among all hypotheses and none of them.
        phase: byte of the first tick's begin, and its own confidence.
        rate_hz: ticks a second, from the measured bytes a second; None without.
        trailer: the spare bits of a row: "none", "constant 0x....", "varies", "dark".
        tags: M1K40 tags are in place.
    """

    profile: WireProfile
    gain: float | None
    confidence: float
    phase: int
    phase_confidence: float
    rate_hz: float | None
    trailer: str
    tags: bool

    def as_json(self) -> dict[str, Any]:
        """A JSON-ready record."""
        p = self.profile
        return {
            "profile": p.name, "width": p.width, "height": p.height, "row_bits": p.row_bits, "framing": p.framing,
            "tick_bytes": p.tick_bytes, "gain_nats": self.gain, "confidence": self.confidence,
            "phase_bytes": self.phase, "phase_confidence": self.phase_confidence, "rate_hz": self.rate_hz,
            "trailer": self.trailer, "tags": self.tags,
        }  # fmt: skip


@dataclass(frozen=True, slots=True)
class Findings:
    """All hypotheses, likeliest first, and what was seen without any.

    Args:
        hypotheses: sorted by confidence.
        row_bits: the lag at which rows repeat, in bits, found without a hypothesis on rows; None: none stands out.
        row_stands_out: by how many scatters.
        bytes: looked at.
        ones: share of set bits.
    """

    hypotheses: tuple[Hypothesis, ...]
    row_bits: int | None
    row_stands_out: float
    bytes: int
    ones: float

    @property
    def convincing(self) -> Hypothesis | None:
        """The one that convinces, or None."""
        best = self.hypotheses[0] if self.hypotheses else None
        return best if best and best.confidence >= CONVINCED else None


def examine(data: Bytes, profiles: Sequence[WireProfile], bytes_s: float | None = None) -> Findings:
    """Score what the bytes may be.

    Args:
        data: uint8[n], a gapless stretch; some hundred ticks.
        profiles: the hypotheses; those that differ only in rate or link count as one, the first.
        bytes_s: as measured, to tell the tick rate.

    Returns:
        Findings. A camera that sees nothing but noise, or the dark, convinces nobody.

    Cost:
        About 0.1 s a hypothesis.
    """
    shapes: dict[tuple[Any, ...], WireProfile] = {}
    for p in profiles:
        shapes.setdefault((p.framing, p.width, p.height, p.row_bits, p.bottom_up), p)
    gains = {p.name: _gain(data, p) for p in shapes.values()}
    told = {name: g / _DEPENDENT for name, g in gains.items() if g is not None}
    top = max((*told.values(), 0.0))
    total = np.exp(np.log(len(shapes) + 1) + 4 - top) + sum(np.exp(g - top) for g in told.values())
    made = []
    for p in shapes.values():
        sure = float(np.exp(told[p.name] - top) / total) if p.name in told else 0.0
        made.append(_hypothesis(data, p, gains[p.name], sure, bytes_s))
    made.sort(key=lambda h: (-h.confidence, h.profile.name))
    lag, out = _rows(data, made)
    ones = float(np.bitwise_count(data).sum() / (8 * max(len(data), 1)))
    return Findings(tuple(made), lag if out >= _STANDS_OUT else None, out, len(data), ones)


def _gain(data: Bytes, profile: WireProfile) -> float | None:
    if profile.framing == "m1k40":  # the tags decide: 2000 blocks with lines in range, by chance once in e^1400
        tagged = len(data) >= 2 * m1k40.FRAME and m1k40.find_start(data[: 2 * m1k40.FRAME], sure=True) is not None
        return 1e6 if tagged else -1e6
    if len(data) < 2 * FEWEST * profile.tick_bytes:
        return None
    return period_gain(data, profile.tick_bytes, _MOST_TICKS)


def _hypothesis(data: Bytes, p: WireProfile, gain: float | None, sure: float, bytes_s: float | None) -> Hypothesis:
    rate = bytes_s / p.tick_bytes if bytes_s else None
    if gain is None or (p.framing == "m1k40" and gain < 0):
        return Hypothesis(p, gain, sure, 0, 0.0, rate, "none", False)
    phase = find_phase(data[: _MOST_TICKS * p.tick_bytes], p)
    trailer = _trailer(data, p, phase.offset) if p.row_bits > p.width and p.framing == "none" else "none"
    return Hypothesis(p, gain, sure, phase.offset, phase.confidence, rate, trailer, p.framing == "m1k40")


def _trailer(data: Bytes, p: WireProfile, offset: int) -> str:
    """What the spare bits of the rows hold, if the tick begins at `offset`."""
    rates, _ = fold(data[offset:], p.tick_bytes, 128)
    spare = rates.reshape(p.height, p.row_bits)[:, p.width :]
    still = np.all((spare == 0) | (spare == 1)) and np.all(spare == spare[0])
    if not still:
        return "varies"
    value = int(sum(int(b) << k for k, b in enumerate(spare[0])))
    return f"constant 0x{value:0{(len(spare[0]) + 3) // 4}x}"


def _rows(data: Bytes, made: Sequence[Hypothesis]) -> tuple[int, float]:
    """The row lag in a tick folded by the best hypothesis; 0 where there is none to fold by."""
    best = next((h for h in made if h.gain is not None and h.profile.framing == "none"), None)
    if best is None:
        return 0, 0.0
    return row_lag(fold(data, best.profile.tick_bytes, _MOST_TICKS)[0])
