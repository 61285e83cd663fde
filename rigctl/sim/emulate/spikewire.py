"""A spike camera up to its wire: ticks become bytes at an oscillator's pace, from a scene or from a loop."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from fractions import Fraction
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import UsageError
from spikerig.dataset.m1k40 import pack_blocks
from spikerig.dataset.vidar_dat import Raster, pack_rows
from spikerig.dataset.wire import WireProfile
from spikerig.rigctl.sim.emulate.oscillator import Oscillator

Bits: TypeAlias = NDArray[np.uint8]
BitsAt: TypeAlias = Callable[[int, int], Bits]
_CACHED = 8  # encoded stretches that are kept


def encode_ticks(bits: Bits, profile: WireProfile, trailer: int = 0) -> Bits:
    """Packed ticks as wire bytes.

    Args:
        bits: uint8[n,H,ceil(W/8)], top row first, LSB first.
        profile: how they lie on the wire.
        trailer: what a bare row's spare bits hold, LSB first; its meaning on the real camera is not known.

    Returns:
        uint8[n * tick_bytes].
    """
    if profile.framing == "m1k40":
        return pack_blocks(bits).reshape(-1)
    wanted = (profile.height, (profile.width + 7) // 8)
    if bits.ndim != 3 or bits.shape[1:] != wanted:
        raise UsageError("ticks do not fit the wire", value=bits.shape, expected=f"[n, {wanted[0]}, {wanted[1]}]")
    ordered = bits if profile.bottom_up else bits[:, ::-1]
    data = np.frombuffer(pack_rows(ordered, Raster(profile.height, profile.width, profile.row_bits)), np.uint8).copy()
    spare = profile.row_bits - profile.width
    if trailer and spare:
        row = np.zeros(profile.row_bits, np.uint8)
        row[profile.width :] = [(trailer >> k) & 1 for k in range(spare)]
        rows = data.reshape(-1, profile.row_bits // 8)
        rows |= np.packbits(row, bitorder="little")
    return data


class Loop:
    """The same few ticks for ever: the cheapest source, a copy.

    Args:
        data: wire bytes of a whole number of ticks.
    """

    timeless = True  # bytes to come are known before their time

    def __init__(self, data: Bits) -> None:
        self.data = np.ascontiguousarray(data, np.uint8)

    def copy(self, start: int, out: Bits) -> None:
        """Fill `out` with the bytes from `start` on."""
        done, size = 0, len(self.data)
        while done < len(out):
            at = (start + done) % size
            n = min(len(out) - done, size - at)
            out[done : done + n] = self.data[at : at + n]
            done += n


class Ticks:
    """Wire bytes of ticks that a function gives, encoded a stretch at a time.

    Args:
        bits: (t0, t1) -> uint8[t1-t0,H,ceil(W/8)], any range of ticks counted from the camera's first.
        profile: of the wire.
        trailer: see `encode_ticks`.
        stretch: ticks encoded at once.
    """

    def __init__(self, bits: BitsAt, profile: WireProfile, trailer: int = 0, stretch: int = 64) -> None:
        self._bits, self._profile, self._trailer, self._stretch = bits, profile, trailer, stretch
        self._made: OrderedDict[int, Bits] = OrderedDict()

    def copy(self, start: int, out: Bits) -> None:
        """Fill `out` with the bytes from `start` on."""
        done, size = 0, self._profile.tick_bytes * self._stretch
        while done < len(out):
            number, at = divmod(start + done, size)
            piece = self._encoded(number)[at : at + len(out) - done]
            out[done : done + len(piece)] = piece
            done += len(piece)

    def _encoded(self, number: int) -> Bits:
        if number not in self._made:
            first = number * self._stretch
            bits = self._bits(first, first + self._stretch)
            self._made[number] = encode_ticks(bits, self._profile, self._trailer)
            if len(self._made) > _CACHED:
                self._made.popitem(last=False)
        return self._made[number]


class Reel:
    """Ticks of a simulation that only runs forward (`stream.spike_blocks`), as a function of tick ranges.

    Args:
        blocks: uint8[n,H,ceil(W/8)], one after the other.
        keep: ticks behind the newest that can still be asked for.

    Edges:
        Before the first tick and after the last block all is dark.

    Raises:
        UsageError: ticks are asked for that were let go.
    """

    def __init__(self, blocks: Iterable[Bits], keep: int = 65_536) -> None:
        self._blocks: Iterator[Bits] = iter(blocks)
        self._held: list[tuple[int, Bits]] = []
        self._keep, self._end, self._over = keep, 0, False

    def __call__(self, t0: int, t1: int) -> Bits:
        """Ticks t0 to t1, uint8[t1-t0,H,ceil(W/8)]."""
        while self._end < t1 and not self._over:
            block = next(self._blocks, None)
            if block is None:
                self._over = True
                break
            self._held.append((self._end, block))
            self._end += len(block)
            while self._held[0][0] + len(self._held[0][1]) < min(self._end - self._keep, t0):
                self._held.pop(0)
        if not self._held:
            raise UsageError("a reel without a picture", value=f"ticks {t0} to {t1}")
        if max(t0, 0) < self._held[0][0]:
            raise UsageError("these ticks were let go", value=f"{t0}", expected=f"from {self._held[0][0]} on")
        out = np.zeros((t1 - t0, *self._held[0][1].shape[1:]), np.uint8)
        for first, block in self._held:
            a, b = max(t0, first), min(t1, first + len(block))
            if a < b:
                out[a - t0 : b - t0] = block[a - first : b - first]
        return out


class SpikeWire:
    """What the camera's logic puts on its parallel bus, for ever, whether somebody reads or not.

    Byte b belongs to tick b // tick_bytes. A tick's bytes leave evenly during the tick after it was exposed, so byte b
    is out at camera time (b / tick_bytes + 1) ticks. Whoever starts to read does so in the middle of a tick.

    Args:
        profile: how ticks lie on the wire.
        source: their bytes: a `Loop` or `Ticks`.
        oscillator: the camera's clock over true time; None: a perfect one.
        born_ns: true time of its tick 0, before anything reads.
        rate_hz: the true number of ticks a second of its clock, where that differs from the profile's.
    """

    def __init__(
        self,
        profile: WireProfile,
        source: Loop | Ticks,
        oscillator: Oscillator | None = None,
        *,
        born_ns: int = 0,
        rate_hz: float | None = None,
    ) -> None:
        self.profile, self.source, self.oscillator = profile, source, oscillator
        self.rate = Fraction(rate_hz or profile.rate_hz).limit_denominator(1_000_000)
        self._pace = self.rate * profile.tick_bytes / NS  # bytes a nanosecond of the camera's clock
        self._born = self._device(born_ns)

    def made(self, true_ns: int) -> int:
        """Bytes put out until then."""
        since = self._device(true_ns) - self._born
        return max(0, since * self._pace.numerator // self._pace.denominator - self.profile.tick_bytes)

    def when(self, count: int) -> int:
        """True time at which `count` bytes are out."""
        count += self.profile.tick_bytes
        at = self._true(self._born - (-count * self._pace.denominator // self._pace.numerator))
        while self.made(at) + self.profile.tick_bytes < count:  # rounding of the oscillator
            at += 1
        return at

    def tick_true_ns(self, tick: int) -> int:
        """True time at which a tick's exposure begins."""
        return self._true(self._born + round(tick * NS / self.rate))

    def copy(self, start: int, out: Bits) -> None:
        """Fill `out` with the bytes from `start` on."""
        self.source.copy(start, out)

    def _device(self, true_ns: int) -> int:
        return true_ns if self.oscillator is None else int(self.oscillator.device_from_true(true_ns))

    def _true(self, device_ns: int) -> int:
        return device_ns if self.oscillator is None else int(self.oscillator.true_from_device(device_ns))
