"""The LED panel: a clock that cameras can see. The state of every LED is a pure function of the box's time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikerig.dataset.errors import UsageError

Int64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Led:
    """One LED: bit `bit` of the Gray code (-1: always on), `inverted` or not, at (x, y) of the panel's face, y down."""

    bit: int
    inverted: bool
    x_mm: float
    y_mm: float


class Edges(NamedTuple):
    """Toggles in the order of time: when (panel time), which LED, and whether it went on."""

    at_ns: Int64
    led: Int64
    rising: NDArray[np.bool_]


def two_rows(bits: int, pitch_mm: float = 5.0, height_mm: float = 120.0) -> tuple[Led, ...]:
    """The usual layout: each bit in the top row, its complement in the bottom row, an LED always on at each corner.

    Rolling shutters need edges at top and bottom; a bit and its complement give as many rising edges as falling ones.
    """
    top = [Led(k, False, pitch_mm * (k + 1), 0.0) for k in range(bits)]
    bottom = [Led(k, True, pitch_mm * (k + 1), height_mm) for k in range(bits)]
    ends = [Led(-1, False, x, y) for y in (0.0, height_mm) for x in (0.0, pitch_mm * (bits + 1))]
    return (*top, *bottom, *ends)


@dataclass(frozen=True, slots=True)
class Panel:
    """What the panel shows at box time t: the Gray code of n = floor(t / step_ns) modulo 2^bits.

    Args:
        step_ns: time of one code word, T.
        bits: of the code; it repeats after `step_ns * 2**bits`. 1 makes a plain square wave of half period `step_ns`.
        slow: the first bit that a long-exposure camera reads: bits from here on toggle at most once in 2^slow * T,
            which must be at least its exposure plus the read-out time of the panel's height.
        leds: the LEDs; empty means `two_rows(bits)`.

    Edges:
        Times before 0 count backwards: the code is periodic.

    Source:
        Gray code n ^ (n >> 1): bit k toggles at n = 2^k, 3 * 2^k, 5 * 2^k ...; the last bit also at the wrap.
    """

    step_ns: int = 100_000
    bits: int = 26
    slow: int = 5
    leds: tuple[Led, ...] = ()

    def __post_init__(self) -> None:
        if not (self.step_ns >= 1 and 1 <= self.bits <= 40 and 0 <= self.slow < self.bits):
            raise UsageError("a panel needs a step, 1 to 40 bits, and a slow bit among them", value=self)
        object.__setattr__(self, "leds", tuple(self.leds) or two_rows(self.bits))
        if any(not -1 <= led.bit < self.bits for led in self.leds):
            raise UsageError("an LED shows a bit that the code does not have", value=self.bits)

    @property
    def wrap_ns(self) -> int:
        """After this time the code repeats."""
        return self.step_ns << self.bits

    def state(self, at_ns: ArrayLike) -> NDArray[np.bool_]:
        """Which LEDs are on: bool[..., L] at panel times of any shape."""
        word = gray(np.asarray(at_ns, np.int64) // self.step_ns & (1 << self.bits) - 1)
        bit = np.array([led.bit for led in self.leds])
        lit = (word[..., None] >> np.maximum(bit, 0) & 1).astype(bool)
        return np.where(bit < 0, True, lit ^ np.array([led.inverted for led in self.leds]))

    def edges(self, start_ns: int, stop_ns: int, leds: ArrayLike | None = None) -> Edges:
        """Every toggle in [start_ns, stop_ns), of all LEDs or of those numbered in `leds`.

        Cost: one row a toggle; bit 0 of a 0.1 ms panel toggles 5,000 times a second.
        """
        asked = range(len(self.leds)) if leds is None else np.asarray(leds, np.int64).ravel().tolist()
        at: list[Int64] = [np.zeros(0, np.int64)]
        who, up = at.copy(), [np.zeros(0, bool)]
        for number in asked:
            led = self.leds[number]
            if led.bit < 0:
                continue
            first, apart = self._toggles(led.bit)
            lowest = -(-(start_ns - first) // apart)
            count = max(-(-(stop_ns - first) // apart) - lowest, 0)
            turn = lowest + np.arange(count, dtype=np.int64)
            at.append(first + turn * apart)
            who.append(np.full(count, number, np.int64))
            up.append((turn % 2 == 0) ^ led.inverted)
        times, led_of, rising = np.concatenate(at), np.concatenate(who), np.concatenate(up)
        order = np.lexsort((led_of, times))
        return Edges(times[order], led_of[order], rising[order])

    def _toggles(self, bit: int) -> tuple[int, int]:
        """Time of the bit's first rising edge, and the time between its toggles."""
        apart = 2 << bit if bit < self.bits - 1 else 1 << bit  # the last bit has no higher one to slow it
        return (1 << bit) * self.step_ns, apart * self.step_ns


def gray(n: ArrayLike) -> Int64:
    """Gray code of counts, int64: neighbours differ in one bit."""
    count = np.asarray(n, np.int64)
    return count ^ (count >> 1)


def count_from_gray(word: ArrayLike) -> Int64:
    """The count whose Gray code this is; inverse of `gray` for words of up to 62 bits."""
    count = np.array(word, np.int64)
    for shift in (1, 2, 4, 8, 16, 32):
        count ^= count >> shift
    return count
