"""An emulated Harp clock box without its cable: clock, registers, and what two firmwares do with orders."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikerig.dataset.clocktime import NS
from spikerig.rigctl import harp
from spikerig.rigctl.harp import Message
from spikerig.rigctl.sim.emulate.oscillator import Oscillator

Firmware = Literal["atxmega", "pico"]
_SLOT_NS = 1_000_000  # the ATxmega core works on orders once a millisecond
_PATIENCE_NS = 50_000_000  # after which it forgets half a frame
_SYNC_NS = 672_000 - 10 * 10_000  # the sync packet's last byte begins 672 us before the second; ten bits at 100 kbit/s
_KNOWN = {
    harp.WHO_AM_I: harp.U16,
    **dict.fromkeys(range(1, 8), harp.U8),
    harp.SECOND: harp.U32,
    harp.MICRO: harp.U16,
    **dict.fromkeys((harp.OPERATION, harp.RESET, harp.NAME, harp.CLOCK_CONFIG, 15, 16, 17), harp.U8),
    harp.SERIAL: harp.U16,
    harp.HEARTBEAT: harp.U16,
    19: harp.U8,
}
_WRITABLE = (harp.SECOND, harp.OPERATION, harp.RESET, harp.NAME, harp.SERIAL, harp.CLOCK_CONFIG, 15)


class HarpCore:
    """The box itself; whoever owns it calls `_byte` with what arrives and hears `_send` of what leaves.

    Args:
        clock: its oscillator.
        firmware: "atxmega" or "pico".
        start_second: its clock at true time 0, beside the oscillator's own offset.
        pending: (true time, "reset" or "step", ns): what will happen to its clock.
        who, serial: what it says it is.

    Attributes:
        truth: what happened, dicts with `at_ns` (true time) and `what`.
    """

    def __init__(
        self, clock: Oscillator, firmware: Firmware, start_second: int, pending: list[tuple[int, str, int]],
        who: int, serial: int,
    ) -> None:  # fmt: skip
        self.clock, self.firmware = clock, firmware
        self.truth: list[dict[str, Any]] = []
        self._who, self._serial = who, serial
        self._registers: dict[int, bytes] = {}
        self._shifts: list[tuple[int, int]] = [(0, start_second * NS)]  # (from true time, added to the oscillator's)
        self._pending = sorted(pending)
        self._frame = bytearray()
        self._frame_ns = 0
        self._open = False  # somebody listens
        self._second = self._second_ns = 0
        self._boot()

    def sync_out(self, from_ns: int, to_ns: int) -> list[tuple[int, bytes]]:
        """What left the clock jack: (true time at which a packet's last byte was out, its six bytes)."""
        first, last = (int(self.box_ns(at) + _SYNC_NS) // NS for at in (from_ns, to_ns))
        return [
            (self._true_of(second * NS - _SYNC_NS), harp.sync_packet(second - 1))
            for second in range(first + 1, last + 1)
        ]

    def _send(self, at: int, message: Message, late_ns: int = 0) -> None:
        raise NotImplementedError

    def box_ns(self, true_ns: ArrayLike) -> NDArray[np.int64]:
        """What the box's clock truly shows at true times (not wrapped, not in steps of 32 us)."""
        at = np.asarray(true_ns, np.int64)
        device = self.clock.device_from_true(at) + self._shifts[0][1]
        for (_, before), (begin, shift) in pairwise(self._shifts):
            device = device + np.where(at >= begin, shift - before, 0)
        return device

    def _true_of(self, box_ns: int) -> int:
        true = int(self.clock.true_from_device(box_ns - self._shifts[-1][1]))
        return true + (1 if self.box_ns(true) < box_ns else 0)

    def _boot(self) -> None:
        self._registers = {
            harp.WHO_AM_I: self._who.to_bytes(2, "little"),
            **dict.fromkeys(range(1, 8), b"\x01"),
            harp.OPERATION: bytes([0x60]),
            harp.RESET: b"\x40",
            harp.NAME: b"Emulated".ljust(25, b"\0"),
            harp.SERIAL: self._serial.to_bytes(2, "little"),
            harp.CLOCK_CONFIG: bytes([0x02 | 0x18 | 0x40]),
            15: b"\0",
            16: bytes(16),
            17: bytes(8),
        }
        if self.firmware == "atxmega":
            self._registers |= {harp.HEARTBEAT: b"\x02\x00", 19: bytes(32)}

    def _fault(self, at: int, what: str, by: int) -> None:
        now = self._shifts[-1][1]
        shift = now + by if what == "step" else -int(self.clock.device_from_true(at))
        self._shift(at, shift, what)
        if what == "reset":
            self._boot()
            self._frame.clear()

    def _shift(self, at: int, shift: int, what: str) -> None:
        self._shifts.append((at, shift))
        self._second = int(self.box_ns(at)) // NS
        self._second_ns = self._true_of((self._second + 1) * NS)
        self.truth.append({"at_ns": at, "what": what, "box_ns": int(self.box_ns(at))})

    def _tick(self, at: int) -> None:
        """A second begins: the event of once a second, when it is asked for."""
        operation = self._registers[harp.OPERATION][0]
        if not (operation & 3 == harp.ACTIVE and self._open):
            return
        if self.firmware == "atxmega" and operation & harp.HEARTBEAT_ON:
            value = (self._registers[harp.OPERATION][0] & 1 | 2).to_bytes(2, "little")
            self._send(at, Message(harp.EVENT, harp.HEARTBEAT, harp.U16, value), late_ns=60_000)
        elif operation & harp.ALIVE:
            second = (self._second % harp.ROLL_S).to_bytes(4, "little")
            self._send(at, Message(harp.EVENT, harp.SECOND, harp.U32, second), late_ns=0)

    def _byte(self, at: int, byte: int) -> None:
        strict = self.firmware == "atxmega"
        if strict and self._frame and at - self._frame_ns > _PATIENCE_NS:
            self._frame.clear()
        if not self._frame:
            self._frame_ns = at
            if byte not in (harp.READ, harp.WRITE):
                return
        self._frame.append(byte)
        if len(self._frame) >= 2 and len(self._frame) == self._frame[1] + 2:
            frame = bytes(self._frame)
            self._frame.clear()
            if frame[1] < 4 or (strict and (sum(frame[:-1]) & 0xFF != frame[-1] or frame[3] != harp.DEVICE_PORT)):
                return  # silence
            if strict:  # its turn comes in the next slot of the box's own millisecond
                box = int(self.box_ns(at))
                if frame[4] & 0x10 and (due := _due_ns(frame)) > box:
                    if due // NS == box // NS:
                        return  # later within this second: this firmware drops it
                    box = due
                at = self._true_of(-(-box // _SLOT_NS) * _SLOT_NS)
            self._obey(at, frame)

    def _obey(self, at: int, frame: bytes) -> None:
        kind, address, type_ = frame[4] & ~0x10, frame[2], frame[0]
        payload = frame[11:-1] if frame[4] & 0x10 else frame[5:-1]
        order = Message(type_, address, kind, payload)
        known = _KNOWN.get(address) if address in self._registers or address in (harp.SECOND, harp.MICRO) else None
        readonly = type_ == harp.WRITE and address not in _WRITABLE
        if self.firmware == "pico":
            if known is None:
                return
            if readonly:
                self._send(at, replace(order, type=type_ | harp.ERROR))
                return
        elif known is None or kind != known or readonly or (type_ == harp.WRITE and not self._fits(address, payload)):
            self._send(at, replace(order, type=type_ | harp.ERROR))
            return
        if type_ == harp.WRITE and not self._write(at, address, payload):
            self._send(at, replace(order, type=type_ | harp.ERROR))
            return
        if self._registers[harp.OPERATION][0] & harp.MUTE and address != harp.OPERATION:
            return
        self._send(at, Message(type_, address, known, self._value(at, address)))
        if type_ == harp.WRITE and address == harp.OPERATION and payload[0] & harp.DUMP:
            for k, number in enumerate(sorted({*self._registers, harp.SECOND, harp.MICRO})):
                later = at + (2_000_000 * (k + 1) if self.firmware == "atxmega" else 0)
                self._send(later, Message(harp.READ, number, _KNOWN[number], self._value(later, number)))

    def _fits(self, address: int, payload: bytes) -> bool:
        wanted = 4 if address == harp.SECOND else len(self._registers[address])
        return len(payload) == wanted

    def _write(self, at: int, address: int, payload: bytes) -> bool:
        if address == harp.SECOND:
            if self._registers[harp.CLOCK_CONFIG][0] & 0x80:
                return False
            phase = int(self.box_ns(at)) % NS
            wanted = int.from_bytes(payload[:4], "little") * NS + phase
            self._shift(at, wanted - int(self.clock.device_from_true(at)), "set")
        elif address == harp.OPERATION:
            self._operate(payload[0] & ~harp.DUMP)
        elif address == harp.CLOCK_CONFIG:
            lock = {0x80: 0x80, 0x40: 0x40}.get(payload[0] & 0xC0, self._registers[address][0] & 0xC0)
            self._registers[address] = bytes([self._registers[address][0] & 0x3F | lock])
        elif address == harp.RESET:
            self._pending.insert(0, (at + 1_000_000, "reset", 0))
            self._pending.sort()
        else:
            self._registers[address] = payload
        return True

    def _operate(self, value: int) -> None:
        self._registers[harp.OPERATION] = bytes([value & 0xFF])

    def _value(self, at: int, address: int) -> bytes:
        box = int(self.box_ns(at))
        if address == harp.SECOND:
            return (box // NS % harp.ROLL_S).to_bytes(4, "little")
        if address == harp.MICRO:
            return (box % NS // harp.GRAIN_NS).to_bytes(2, "little")
        return self._registers[address]


def _due_ns(frame: bytes) -> int:
    """When a stamped order is to be done, box time."""
    return int.from_bytes(frame[5:9], "little") * NS + int.from_bytes(frame[9:11], "little") * harp.GRAIN_NS
