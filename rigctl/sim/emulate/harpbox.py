"""An emulated Harp clock box on an emulated serial port: two firmwares, byte for byte, on the host's emulated time."""

from __future__ import annotations

import errno
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass, replace

from serial import SerialException

from spikerig.dataset.clocktime import NS
from spikerig.rigctl import harp
from spikerig.rigctl.harp import Message
from spikerig.rigctl.host import Host
from spikerig.rigctl.sim.draws import stream
from spikerig.rigctl.sim.emulate.harpcore import Firmware, HarpCore
from spikerig.rigctl.sim.emulate.latency import Latency
from spikerig.rigctl.sim.emulate.oscillator import Oscillator
from spikerig.rigctl.sim.emulate.serialport import WirePort

_STANDBY_NS = 3 * NS  # without a listener for this long, either core falls silent
_BYTE_NS = 10_000  # ten bits at 1 Mbit/s, on the ATxmega's UART


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


class HarpBoxWire(HarpCore):
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
        self.faults = faults or BoxFaults()
        pending = [(at, "reset", 0) for at in self.faults.resets] + [(at, "step", by) for at, by in self.faults.steps]
        super().__init__(clock, firmware, start_second, pending, who, serial)
        self.host = host
        self._to_box, self._to_host = to_box or Latency(), to_host or Latency()
        self._rng = stream(seed, "harpbox")
        self._done = host.now_ns()  # brought up to this true time
        self._inbox: deque[tuple[int, int]] = deque()  # (arrival, byte)
        self._outbox: deque[tuple[int, bytes]] = deque()  # (arrival at the host, bytes)
        self._last_in = self._last_out = 0
        self._closed_ns = host.now_ns()
        self._second = int(self.box_ns(self._done)) // NS
        self._second_ns = self._true_of((self._second + 1) * NS)  # when the next one begins, true time

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
