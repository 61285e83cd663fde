"""An FT601 with a spike camera on its bus: sessions, memory that overflows without a word, faults on a timetable."""

from __future__ import annotations

import errno
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import UsageError
from spikerig.rigctl.sim.emulate.fifo import Fifo, Run
from spikerig.rigctl.sim.emulate.latency import Latency
from spikerig.rigctl.sim.emulate.spikewire import SpikeWire

CHIP_BYTES = 16_384
_BURST = 16_384  # bytes between looks at the memory when the link is slower than the camera
# Faults of one transfer, with what pyusb raises; None: no error, only fewer bytes.
_ONCE: Mapping[str, int | None] = {
    "short": None, "stall": errno.EPIPE, "overflow": errno.EOVERFLOW, "io": errno.EIO, "interrupted": errno.EINTR,
}  # fmt: skip
_SPANS = ("unplug", "hang", "busy", "denied", "strings", "config")  # that last for `for_s`
KINDS = (*_ONCE, *_SPANS, "drop")


@dataclass(frozen=True, slots=True)
class UsbFault:
    """Something that goes wrong.

    Args:
        kind: "short" (a transfer ends early), "stall" (EPIPE until clear_halt), "overflow" (EOVERFLOW), "io" (EIO),
            "interrupted" (EINTR); "drop" (bytes vanish before the chip, no error); for a span: "unplug", "hang" (no
            bytes come), "busy" (EBUSY), "denied" (EACCES), "strings" (damaged string descriptors), "config" (damaged
            settings).
        at_s: when, seconds of true time.
        for_s: how long a span lasts.
        bytes: the size of a drop. (A transfer that ends in an error loses all it carried: pyusb does not hand it on.)
    """

    kind: str
    at_s: float = 0.0
    for_s: float = 1e9
    bytes: int = 16_384

    def __post_init__(self) -> None:
        if self.kind not in KINDS or not (np.isfinite(self.at_s) and self.for_s > 0 and self.bytes >= 0):
            raise UsageError("no such fault", value=self, expected=", ".join(KINDS))

    @property
    def at_ns(self) -> int:
        """When, in nanoseconds."""
        return round(self.at_s * NS)

    @property
    def end_ns(self) -> int:
        """When a span is over."""
        return round((self.at_s + self.for_s) * NS)


def read_faults(tables: Sequence[Mapping[str, Any]]) -> tuple[UsbFault, ...]:
    """Faults from tables of a file.

    Raises:
        UsageError: a key or a kind is not known.
    """
    known = {f.name for f in fields(UsbFault)}
    for table in tables:
        if not set(table) <= known:
            raise UsageError("a fault has unknown keys", value=dict(table), expected=", ".join(sorted(known)))
    return tuple(UsbFault(**table) for table in tables)


@dataclass
class Transfer:
    """What a bulk read will bring: bytes, when, and the errno it ends with (0: none)."""

    done_ns: int
    runs: list[Run] = field(default_factory=list)
    error: int = 0


class Bridge:
    """The device on the bus.

    Args:
        wire: the camera behind it.
        serial, maker, model: its strings.
        ram_bytes: memory of the camera's logic before the chip's 16 KiB; 0: none.
        link_bytes_s: what the link carries; None: the profile's.
        faults: what goes wrong, and when.
        turn: what passes between the host's asking and the first byte; None: nothing.
        overflow_error: overflowing memory makes the next read fail with EOVERFLOW; the real chip says nothing.
        seed: of the latencies.
        port: where it is plugged in.
    """

    def __init__(
        self,
        wire: SpikeWire,
        *,
        serial: str = "000000000001",
        maker: str = "FTDI",
        model: str = "FTDI SuperSpeed-FIFO Bridge",
        ram_bytes: int = 0,
        link_bytes_s: float | None = None,
        faults: Sequence[UsbFault] = (),
        turn: Latency | None = None,
        overflow_error: bool = False,
        seed: int = 0,
        port: int = 1,
    ) -> None:
        self.wire, self.serial, self.maker, self.model, self.port = wire, serial, maker, model, port
        self.vendor, self.product = wire.profile.vendor, wire.profile.product
        self.link = float(link_bytes_s or wire.profile.link_bytes_s)
        self.fifo = Fifo(CHIP_BYTES + ram_bytes)
        self.owner: object | None = None
        self.halted = self.streaming = False
        self._session: int | None = None  # bytes left of a single session; None: without end
        self._turn, self._rng = turn, np.random.default_rng([seed, 0x601F])
        self._overflow_error, self._overflows = overflow_error, 0
        self._spans = [f for f in faults if f.kind in _SPANS]
        self._once = sorted((f for f in faults if f.kind in _ONCE), key=lambda f: f.at_ns)
        for f in faults:
            if f.kind == "drop":
                self.fifo.doom(wire.made(f.at_ns), f.bytes, "drop")

    def fault(self, now_ns: int, kind: str) -> UsbFault | None:
        """The span of a kind that holds now."""
        return next((f for f in self._spans if f.kind == kind and f.at_ns <= now_ns < f.end_ns), None)

    def plugged(self, now_ns: int) -> int | None:
        """How often it was plugged in again until now; None while it is out."""
        if self.fault(now_ns, "unplug"):
            return None
        back = sum(f.kind == "unplug" and f.end_ns <= now_ns for f in self._spans)
        if back and getattr(self, "_plugged", 0) != back:  # power was gone: all is forgotten
            self._plugged = back
            self.fifo.empty("unplug")
            self.fifo.skip(self.wire.made(max(f.end_ns for f in self._spans if f.end_ns <= now_ns)), "unplug")
            self.owner, self.halted, self.streaming = None, False, False
        return back

    def release(self, now_ns: int) -> None:
        """The host let go: the stream ends."""
        self._idle(now_ns)
        self.owner, self.streaming, self.halted = None, False, False

    def command(self, now_ns: int, verb: int, pipe: int, length: int) -> None:
        """Abort 0, one session 1, sessions without end 2, flush 3."""
        self._idle(now_ns)
        if verb in (1, 2) and pipe == 0x82:
            self.streaming, self._session = True, length if verb == 1 else None
        elif verb == 0:
            self.streaming = False
        elif verb == 3:
            self.fifo.empty("flush")

    def control(self, now_ns: int, kind: int, request: int, value: int) -> bytes | None:
        """The reply to a control read; None: a stall."""
        if kind == 0x80 and request == 6 and value >> 8 == 3:
            if self.fault(now_ns, "strings"):
                return b"\x05\x03\x00\xd8\xff"
            texts = {1: self.maker, 2: self.model, 3: self.serial}
            if value & 255 == 0:
                return b"\x04\x03\x09\x04"
            return _string(texts[value & 255]) if value & 255 in texts else None
        if kind == 0xC0 and request == 0xF1:
            return b"\x09\x01\x00\x00"
        if kind == 0xC0 and request == 0xCF and value == 1:
            return b"\xff" * 152 if self.fault(now_ns, "config") else self._config()
        return None

    def read(self, now_ns: int, size: int, until_ns: int, plugged: int) -> Transfer:
        """What a bulk read begun now brings; the memory is left as it will be at its end."""
        self._idle(now_ns)
        if self.halted:
            return Transfer(now_ns, error=errno.EPIPE)
        if self._overflow_error and self._overflows < (n := sum(x["why"] == "overflow" for x in self.fifo.lost)):
            self._overflows = n
            return Transfer(now_ns, error=errno.EOVERFLOW)
        start = now_ns if self._turn is None else self._turn.arrives_ns(now_ns, self._rng)
        unplug = min((f.at_ns for f in self._spans if f.kind == "unplug" and f.at_ns > now_ns), default=1 << 62)
        hang = self.fault(start, "hang") or min(
            (f for f in self._spans if f.kind == "hang" and f.at_ns > start), key=lambda f: f.at_ns, default=None
        )
        once = self._once[0] if self._once else None
        event_ns = min(unplug, max(once.at_ns, start) if once else 1 << 62)
        if not self.streaming:
            done = min(until_ns, unplug)
            return Transfer(done, error=errno.ENODEV if done == unplug else errno.ETIMEDOUT)
        wanted = size if self._session is None else min(size, self._session)
        end, count = self._drain(start, wanted, min(until_ns, event_ns, max(hang.at_ns, start) if hang else 1 << 62))
        if hang and end >= hang.at_ns and count < wanted and end < min(until_ns, event_ns):
            end = min(until_ns, event_ns)
            self.fifo.advance(self.wire.made(end), room=count)  # no more is taken: the memory fills and overflows
        if end >= unplug:
            self.fifo.take(count, "unplug")
            return Transfer(unplug, error=errno.ENODEV)
        if once and end >= once.at_ns:
            return self._broken(once, end, count)
        if self._session is not None:
            self._session -= count
            self.streaming = self._session > 0
        return Transfer(end, self.fifo.take(count), 0 if count else errno.ETIMEDOUT)

    def _broken(self, fault: UsbFault, end: int, count: int) -> Transfer:
        """A transfer that a fault cuts: what it carried is lost, but for a short one."""
        self._once.remove(fault)
        error = _ONCE[fault.kind]
        if error is None:
            return Transfer(end, self.fifo.take(count), 0 if count else errno.ETIMEDOUT)
        self.halted = fault.kind == "stall"
        self.fifo.take(count, fault.kind)
        return Transfer(end, error=error)

    def _drain(self, start: int, wanted: int, until: int) -> tuple[int, int]:
        """When `wanted` bytes have crossed the link, or the time is over; and how many have."""
        if float(self.wire.rate) * self.wire.profile.tick_bytes <= self.link:  # the memory only empties
            self._idle(start)
            short = max(0, wanted - self.fifo.level)
            end = max(start + round(wanted / self.link * NS), self._later(short) if short else 0)
            end = min(end, max(until, start))
            crossed = int((end - start) * self.link / NS) // 4 * 4
            self.fifo.advance(self.wire.made(end), room=wanted)
            return end, min(wanted, self.fifo.level, max(crossed, wanted if end < until else 0))
        at, count = start, 0
        while count < wanted and at < until:
            at = min(at + round(_BURST / self.link * NS), until)
            crossed = min(wanted, int((at - start) * self.link / NS) // 4 * 4)
            self.fifo.advance(self.wire.made(at), room=crossed)
            count = min(crossed, self.fifo.level)
        return at, count

    def _later(self, short: int) -> int:
        """When `short` more bytes than now will be held: what is doomed does not count."""
        target = self.fifo.seen + short
        for a, b, _ in self.fifo.doomed():
            if a < target and b > self.fifo.seen:
                target += b - max(a, self.fifo.seen)
        return self.wire.when(target)

    def _idle(self, now_ns: int) -> None:
        """Bring the memory up to now with nobody reading."""
        self.fifo.advance(self.wire.made(now_ns), why="overflow" if self.streaming else "idle")

    def truth(self, now_ns: int) -> dict[str, Any]:
        """Every byte's fate, in byte numbers of the camera."""
        return {
            "serial": self.serial, "profile": self.wire.profile.name, "made": self.fifo.seen, "held": self.fifo.level,
            "sent": [[r.start, r.stop] for r in self.fifo.sent], "lost": [dict(x) for x in self.fifo.lost],
        }  # fmt: skip

    def _config(self) -> bytes:
        strings = b"".join(_string(t) for t in (self.maker, self.model, self.serial))[:128].ljust(128, b"\0")
        ids = struct.pack("<HH", self.vendor, self.product)
        power = struct.pack("<BBHB", 9, 0xE0, 96, 0)
        fifo = struct.pack("<BBBHBB", 0, 0, 2, 0, 0, 0)  # 100 MHz, 245 mode, one channel, no options
        return ids + strings + power + fifo + struct.pack("<II", 0x10800, 0)


def _string(text: str) -> bytes:
    data = text.encode("utf-16-le")
    return bytes([len(data) + 2, 3]) + data
