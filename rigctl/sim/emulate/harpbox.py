"""An emulated Harp clock box on an emulated serial port: two firmwares, byte for byte, on the host's emulated time."""

from __future__ import annotations

import errno
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from serial import SerialException

from spikerig.dataset.clocktime import NS
from spikerig.rigctl import harp
from spikerig.rigctl.harp import Message
from spikerig.rigctl.host import Host
from spikerig.rigctl.sim.draws import stream
from spikerig.rigctl.sim.emulate.latency import Latency
from spikerig.rigctl.sim.emulate.oscillator import Oscillator
from spikerig.rigctl.sim.emulate.serialport import WirePort

Firmware = Literal["atxmega", "pico"]
_SLOT_NS = 1_000_000  # the ATxmega core works on orders once a millisecond
_PATIENCE_NS = 50_000_000  # after which it forgets half a frame
_STANDBY_NS = 3 * NS  # without a listener for this long, either core falls silent
_BYTE_NS = 10_000  # ten bits at 1 Mbit/s, on the ATxmega's UART
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


@dataclass(frozen=True, slots=True)
class BoxFaults:
    """What goes wrong, when: true times in ns, shares from 0 to 1.

    Args:
        corrupt: share of the box's messages in which one bit flips.
        lose: share of its messages that never come.
        twice: share of its messages that come twice.
        unplugged: (from, to) while the port is gone; the box keeps its time, for it has its own supply.
        resets: moments when the box boots: its clock begins at 0.
        steps: (moment, ns) by which its clock jumps.
    """

    corrupt: float = 0.0
    lose: float = 0.0
    twice: float = 0.0
    unplugged: tuple[tuple[int, int], ...] = ()
    resets: tuple[int, ...] = ()
    steps: tuple[tuple[int, int], ...] = ()


class HarpBoxWire:
    """The box and its cable. `HarpBox(device_errors(wire.port), host)` is the driver on it.

    Args:
        host: whose time is true time.
        clock: the box's oscillator.
        firmware: "atxmega" or "pico".
        to_box, to_host: delays of the two directions.
        start_second: the box's clock at true time 0, beside the oscillator's own offset.
        faults, seed: what goes wrong.

    Attributes:
        truth: what happened, dicts with `at_ns` (true time) and `what`.
    """

    def __init__(
        self,
        host: Host,
        clock: Oscillator,
        *,
        firmware: Firmware = "atxmega",
        to_box: Latency | None = None,
        to_host: Latency | None = None,
        start_second: int = 0,
        faults: BoxFaults | None = None,
        seed: int = 0,
        who: int = 1216,
        serial: int = 77,
    ) -> None:
        self.host, self.clock, self.firmware = host, clock, firmware
        self._to_box, self._to_host = to_box or Latency(), to_host or Latency()
        self.faults = faults or BoxFaults()
        self._rng = stream(seed, "harpbox")
        self.truth: list[dict[str, Any]] = []
        self._who, self._serial = who, serial
        self._registers: dict[int, bytes] = {}
        self._shifts: list[tuple[int, int]] = [(0, start_second * NS)]  # (from true time, added to the oscillator's)
        self._pending = sorted(
            [(at, "reset", 0) for at in self.faults.resets] + [(at, "step", by) for at, by in self.faults.steps]
        )
        self._boot()
        self._done = host.now_ns()  # brought up to this true time
        self._inbox: deque[tuple[int, int]] = deque()  # (arrival, byte)
        self._frame = bytearray()
        self._frame_ns = 0
        self._outbox: deque[tuple[int, bytes]] = deque()  # (arrival at the host, bytes)
        self._last_in = self._last_out = 0
        self._open = False
        self._closed_ns = host.now_ns()
        self._second = int(self.box_ns(self._done)) // NS
        self._second_ns = self._true_of((self._second + 1) * NS)  # when the next one begins, true time

    def box_ns(self, true_ns: ArrayLike) -> NDArray[np.int64]:
        """What the box's clock truly shows at true times (not wrapped, not in steps of 32 us)."""
        at = np.asarray(true_ns, np.int64)
        device = self.clock.device_from_true(at) + self._shifts[0][1]
        for (_, before), (begin, shift) in pairwise(self._shifts):
            device = device + np.where(at >= begin, shift - before, 0)
        return device

    def port(self) -> WirePort:
        """Open the port.

        Raises:
            SerialException: the cable is out, or the port is open already.
        """
        if self.out():
            raise SerialException(errno.ENOENT, "could not open port: No such file or directory")
        if self._open:
            raise SerialException(errno.EAGAIN, "Could not exclusively lock port: Resource temporarily unavailable")
        self._run()
        self._open = True
        if self.host.now_ns() - self._closed_ns >= _STANDBY_NS:
            self._operate(self._registers[harp.OPERATION][0] & ~3)
        self._outbox.clear()
        self._inbox.clear()
        self._frame.clear()
        if self.firmware == "pico":
            self._operate(self._registers[harp.OPERATION][0] | harp.ACTIVE)
        return WirePort(self)

    def closed(self) -> None:
        """The port was closed."""
        self._run()
        self._open = False
        self._closed_ns = self.host.now_ns()

    def out(self) -> bool:
        """Whether the cable is out now."""
        now = self.host.now_ns()
        return any(begin <= now < end for begin, end in self.faults.unplugged)

    def next_cut_ns(self) -> int | None:
        """When it will next be pulled."""
        later = [begin for begin, _ in self.faults.unplugged if begin > self.host.now_ns()]
        return min(later, default=None)

    def send(self, data: bytes) -> None:
        """Bytes from the host set out."""
        self._run()
        at = max(self._to_box.arrives_ns(self.host.now_ns(), self._rng), self._last_in)
        for byte in data:
            at += _BYTE_NS if self.firmware == "atxmega" else 0
            self._inbox.append((at, byte))
        self._last_in = at

    def arrived(self) -> int:
        """How many bytes the host could read now."""
        self._run()
        now = self.host.now_ns()
        return sum(len(data) for at, data in self._outbox if at <= now)

    def take(self, size: int) -> bytes:
        """Bytes that arrived, `size` at most."""
        taken = bytearray()
        while len(taken) < size and self._outbox and self._outbox[0][0] <= self.host.now_ns():
            at, data = self._outbox.popleft()
            taken += data
            if len(taken) > size:
                self._outbox.appendleft((at, bytes(taken[size:])))
                del taken[size:]
        return bytes(taken)

    def next_ns(self) -> int:
        """When something may next happen: a message arrives, an order is done, or a second begins."""
        self._run()
        now = self.host.now_ns()
        times = [at for at, _ in list(self._outbox)[:1]] + [at for at, _ in self._inbox]
        times.append(self._second_ns)
        return max(min(times), now + 1)

    # ---- the box itself, brought up to the host's time whenever somebody looks

    def _run(self) -> None:
        now = self.host.now_ns()
        while True:
            second_ns = self._second_ns
            fault_ns = self._pending[0][0] if self._pending else now + 1
            byte_ns = self._inbox[0][0] if self._inbox else now + 1
            first = min(second_ns, fault_ns, byte_ns)
            if first > now:
                break
            self._done = max(self._done, first)
            if first == fault_ns:
                self._fault(*self._pending.pop(0))
            elif first == second_ns:
                self._second += 1
                self._second_ns = self._true_of((self._second + 1) * NS)
                self._tick(first)
            else:
                self._byte(*self._inbox.popleft())
        self._done = now

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

    def _send(self, at: int, message: Message, late_ns: int = 0) -> None:
        """A message leaves the box at true time `at`, stamped; what happens to it on the way is drawn here."""
        box = int(self.box_ns(at + late_ns))
        micro = 0 if message.type == harp.EVENT and message.address == harp.SECOND else box % NS // harp.GRAIN_NS
        data = bytearray(harp.encode(replace(message, stamp=(box // NS % harp.ROLL_S, micro))))
        lots = self._rng.random(3)
        bit = int(self._rng.integers(8 * len(data)))
        leaves = at + late_ns + (_BYTE_NS * len(data) if self.firmware == "atxmega" else 0)
        arrives = max(self._to_host.arrives_ns(leaves, self._rng), self._last_out)
        self._last_out = arrives
        if lots[0] < self.faults.lose or not self._open:
            self.truth.append({"at_ns": at, "what": "lost"})
            return
        if lots[1] < self.faults.corrupt:
            data[bit // 8] ^= 1 << bit % 8
            self.truth.append({"at_ns": at, "what": "corrupt"})
        place = bisect_right([t for t, _ in self._outbox], arrives)
        self._outbox.insert(place, (arrives, bytes(data) * (2 if lots[2] < self.faults.twice else 1)))


def _due_ns(frame: bytes) -> int:
    """When a stamped order is to be done, box time."""
    return int.from_bytes(frame[5:9], "little") * NS + int.from_bytes(frame[9:11], "little") * harp.GRAIN_NS
