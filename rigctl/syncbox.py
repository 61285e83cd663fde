"""The clock box: a Harp device on a serial port that is asked for its time, and tells it once a second by itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DeviceError
from spikerig.dataset.marks import Probe
from spikerig.rigctl import harp
from spikerig.rigctl.devices import DeviceFacts
from spikerig.rigctl.harp import Message
from spikerig.rigctl.host import Host

BAUD = 1_000_000
_BYTE_NS = 10 * NS // BAUD
_STEP_NS = 50_000_000  # a clock that is this far from where it should be was reset or set


class SerialPort(Protocol):
    """What is used of pyserial's `Serial`; `timeout` in seconds, a read that runs out returns what there is."""

    timeout: float | None

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read at once."""
        ...

    def read(self, size: int = 1) -> bytes:
        """Up to `size` bytes."""
        ...

    def write(self, data: bytes) -> int | None:
        """Send bytes."""
        ...

    def close(self) -> None:
        """Give the port back."""
        ...


class HarpBox:
    """A `SyncBox` that speaks Harp.

    Args:
        opener: opens the port; called again after an unplug. `serial_opener(path)` is the real one.
        host: the clock that stamps.
        address: of the port, for people.
        timeout_ns: how long an answer may take.

    Raises:
        DeviceError: nothing answers, or it is no Harp device.

    Attributes:
        facts: what the box is; `more["link"]` is "uart" (ATxmega core) or "cdc" (Pico core).
        epoch: counts the resets and steps of its clock, and unplugs.
        bad: bytes skipped and answers that did not come.

    Edges:
        Stamps are floors of 32 us; `device_ns` has half a step added, and on the UART, where the question's 6 bytes
        and the answer's 14 take known and different times, also half their difference: what is left is the USB's own
        asymmetry. `device_ns` is unwrapped across 2^32 s within an epoch.
    """

    def __init__(
        self, opener: Callable[[], SerialPort], host: Host, *, address: str = "", timeout_ns: int = 500_000_000
    ) -> None:
        self._opener, self._host, self._timeout_ns = opener, host, timeout_ns
        self.epoch, self.bad = 0, 0
        self._heard: list[Probe] = []
        self._last: tuple[int, int] | None = None  # device and host time of the last answer of this epoch
        self._newest_ns: int | None = None  # device time last told, of this epoch
        self._port: SerialPort | None = None
        self._decoder = harp.Decoder()
        self._shift_ns = self._slot_ns = self._wait_ns = 0
        self.facts = DeviceFacts("sync", "", "", "", address)
        self._open()

    def probe(self) -> Probe:
        """See `SyncBox.probe`. An answer that is refused, damaged or late is one DeviceError; the next may be well.

        On the UART it first waits up to 1 ms, each time another part of it: that firmware works once a millisecond, and
        who asks at a fixed time after its last answer would wait equally long each time, and never find the quick way.

        Raises:
            DeviceError: no answer in time; the port is gone (call `reopen`).
        """
        if self._slot_ns:
            self._wait_ns = (self._wait_ns + round(0.618034 * self._slot_ns)) % self._slot_ns
            self._host.sleep_until(self._host.now_ns() + self._wait_ns)
        sent_ns, told, received_ns = self._ask(harp.read(harp.SECOND, harp.U32))
        return self._seen(told.stamp_ns + harp.GRAIN_NS // 2 + self._shift_ns, sent_ns, received_ns)

    def heard(self) -> list[Probe]:
        """See `SyncBox.heard`."""
        self._gone(self._listen)
        told, self._heard = self._heard, []
        return told

    def reopen(self, patience_ns: int = 10 * NS) -> None:
        """After an unplug: open again, with growing pauses, until the same box answers; a new epoch.

        Raises:
            DeviceError: it did not come back in time, or another box did.
        """
        before, until = self.facts, self._host.now_ns() + patience_ns
        self.close()
        pause = 50_000_000
        while True:
            try:
                self._open()
                break
            except DeviceError:
                self.close()
                if self._host.now_ns() + pause > until:
                    raise
            self._host.sleep_until(self._host.now_ns() + pause)
            pause = min(2 * pause, NS)
        if (self.facts.model, self.facts.serial) != (before.model, before.serial):
            now, self.facts = self.facts, before
            self.close()
            raise DeviceError(
                "another box answers on this port",
                value=f"{now.model} {now.serial}",
                expected=f"{before.model} {before.serial}",
                next="spikerig rig find",
            )
        self._begin_epoch()

    def set_second(self, second: int) -> None:
        """Set the box's clock to a whole second (its phase within the second stays); a new epoch.

        Raises:
            DeviceError: the box refuses; its clock may be locked.
        """
        self._ask(harp.write(harp.SECOND, harp.U32, second))
        self._begin_epoch()

    def _begin_epoch(self) -> None:
        self.epoch += 1
        self._last = self._newest_ns = None

    def close(self) -> None:
        """Give the port back."""
        port, self._port = self._port, None
        if port is not None:
            try:
                port.close()
            except OSError:
                pass  # an unplugged port cannot be closed any better

    def _open(self) -> None:
        self._decoder = harp.Decoder()
        self._port = self._opener()
        who = int(self._value(harp.read(harp.WHO_AM_I, harp.U16)))
        major, minor = self._value(harp.read(harp.FW_HIGH)), self._value(harp.read(harp.FW_LOW))
        name = self._text(harp.NAME)
        serial = self._value(harp.read(harp.SERIAL, harp.U16))
        # Register 18 came with the ATxmega core and is silent on the Pico core: it tells the two apart.
        uart = self._answers(harp.read(harp.HEARTBEAT, harp.U16))
        self._ask(harp.write(harp.OPERATION, harp.U8, harp.ACTIVE | (harp.HEARTBEAT_ON if uart else harp.ALIVE) | 0x60))
        self._shift_ns = (14 - 6) * _BYTE_NS // 2 if uart else 0
        self._slot_ns = 1_000_000 if uart else 0
        more: Mapping[str, Any] = {"who": who, "name": name, "link": "uart" if uart else "cdc"}
        self.facts = DeviceFacts("sync", f"harp-{who}", str(int(serial)), f"{major}.{minor}", self.facts.address, more)

    def _value(self, question: Message) -> int:
        values = self._ask(question)[1].values()
        if len(values) == 0:
            raise DeviceError("the clock box answered without a value", value=f"register {question.address}")
        return int(values[0])

    def _text(self, address: int) -> str:
        return self._ask(harp.read(address))[1].payload.split(b"\0")[0].decode("latin-1")

    def _answers(self, question: Message) -> bool:
        try:
            return not self._exchange(question)[1].refused
        except DeviceError:
            return False

    def _ask(self, question: Message) -> tuple[int, Message, int]:
        sent_ns, answer, received_ns = self._exchange(question)
        if answer.refused:
            raise DeviceError(
                "the clock box refuses",
                value=f"{'write to' if question.type == harp.WRITE else 'read of'} register {question.address}",
                cause="an unknown or read-only register, or a locked clock",
            )
        return sent_ns, answer, received_ns

    def _exchange(self, question: Message) -> tuple[int, Message, int]:
        """Send a question; the host's times around it, and its answer. Events in between are kept."""
        self._gone(self._listen)  # what is old must not be taken for the answer
        sent_ns = self._host.now_ns()
        self._gone(lambda port: port.write(harp.encode(question)))
        until = sent_ns + self._timeout_ns
        while (left := until - self._host.now_ns()) > 0:
            for message in self._decoder.feed(self._gone(lambda port, left=left: _arrived(port, left))):
                received_ns = self._host.now_ns()
                if message.address == question.address and message.type & ~harp.ERROR == question.type:
                    return sent_ns, message, received_ns
                self._event(message, received_ns)
        self.bad += 1
        for message in self._decoder.give_up():
            self._event(message, self._host.now_ns())
        raise DeviceError(
            "the clock box does not answer",
            value=f"register {question.address}, {self._timeout_ns / 1e6:.0f} ms, {self.facts.address or 'its port'}",
            cause="no Harp device, another baud rate, or a damaged message",
            next="spikerig rig find",
        )

    def _listen(self, port: SerialPort) -> None:
        if waiting := port.in_waiting:
            for message in self._decoder.feed(port.read(waiting)):
                self._event(message, self._host.now_ns())

    def _event(self, message: Message, received_ns: int) -> None:
        if message.type == harp.EVENT and message.address in (harp.SECOND, harp.HEARTBEAT) and message.stamp:
            # The old 1 Hz event has its sub-second part forced to zero; both are sent as the second begins.
            self._heard.append(self._seen(message.stamp_ns + harp.GRAIN_NS // 2, None, received_ns))

    def _seen(self, stamp_ns: int, sent_ns: int | None, received_ns: int) -> Probe:
        """A stamp as a mark: unwrapped, and a new epoch where the clock did not go on as it must.

        An answer is as old as its question at most. What the box said by itself may have lain unread for long: it may
        be behind the host, but not ahead, and not before what was said earlier.
        """
        at, stepped = stamp_ns, False
        if self._last is not None:
            expected = self._last[0] + received_ns - self._last[1]
            at = harp.unwrapped_ns(stamp_ns, expected)
            slack = _STEP_NS + (received_ns - self._last[1]) // 1000
            stepped = at - expected > slack or (sent_ns is not None and expected - at > slack + received_ns - sent_ns)
        if stepped or (sent_ns is None and self._newest_ns is not None and at < self._newest_ns):
            self.epoch += 1
            at, self._last = stamp_ns, None
        self._newest_ns = at
        if sent_ns is not None:
            self._last = (at, received_ns)
        return Probe("box", self.epoch, sent_ns, at, received_ns)

    def _gone(self, act: Callable[[SerialPort], Any]) -> Any:
        """Do something with the port; an unplug becomes a DeviceError."""
        if self._port is None:
            raise DeviceError("the clock box's port is closed", value=self.facts.address, next="spikerig rig find")
        try:
            return act(self._port)
        except OSError as error:  # pyserial's SerialException is one; in_waiting raises a bare one
            raise DeviceError(
                "the clock box is gone",
                value=self.facts.address or None,
                cause=f"unplugged, or another program reads the port ({error})",
                next="plug it in again; spikerig rig find",
            ) from error


def _arrived(port: SerialPort, left_ns: int) -> bytes:
    """At least one byte, unless time runs out, and all that are there."""
    port.timeout = left_ns / 1e9
    first = port.read(1)
    return first + (port.read(waiting) if first and (waiting := port.in_waiting) else b"")
