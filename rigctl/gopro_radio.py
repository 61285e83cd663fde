"""Asking a GoPro over Bluetooth: questions paired with answers, damaged answers asked for again.

The link is an argument (`BleLink`): bleak's in rigctl/gopro_bleak.py, or an emulated camera's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Protocol

from spikerig.dataset.errors import DeviceError
from spikerig.rigctl.gopro_ble import (
    ALIVE,
    ASK_SETTINGS,
    ASK_STATUS,
    COMMAND,
    PUSHES,
    QUERY,
    REGISTER_STATUS,
    REPLIES,
    SETTING,
    Assembler,
    command,
    decoded,
    packets,
    uuid,
    values,
)
from spikerig.rigctl.host import Host

_WAIT_NS, _QUIET_NS, _TRIES = 2_000_000_000, 200_000_000, 3
_REFUSED = {1: "error", 2: "a parameter it does not take"}


class LinkLost(DeviceError):
    """The connection is gone; connecting again may mend it."""


class BleLink(Protocol):
    """A connection to one camera, every notification subscribed."""

    def write(self, characteristic: str, packet: bytes) -> None:
        """Write a packet to a characteristic (full UUID), with response.

        Raises:
            LinkLost: it is gone.
        """
        ...

    def receive(self, timeout_ns: int) -> tuple[str, bytes] | None:
        """The next notification (full UUID, packet); None when none came in time.

        Raises:
            LinkLost: it is gone.
        """
        ...

    def close(self) -> None:
        """End the connection; may be called twice."""
        ...


@dataclass
class Radio:
    """Questions and answers with a camera over Bluetooth.

    Args:
        dial: makes a connection; DeviceError where it does not come about (HERO9s often need several tries).
        host: the clock that waiting goes by.
        tries: of dialling.
    """

    dial: Callable[[], BleLink]
    host: Host
    tries: int = 5
    pushed: dict[int, Any] = field(default_factory=dict)
    requeries: int = 0
    _link: BleLink | None = None
    _heard: dict[str, Assembler] = field(default_factory=dict)

    def connect(self) -> None:
        """Connect, which also wakes the camera; waits 1, 2, 4 ... s between tries.

        Raises:
            DeviceError: no try came through.
        """
        for n in range(self.tries):
            try:
                self._link, self._heard = self.dial(), {uuid(short): Assembler() for short in REPLIES.values()}
                return
            except DeviceError as error:
                if n == self.tries - 1:
                    raise DeviceError(
                        "the camera does not answer over Bluetooth", value=f"{self.tries} tries",
                        cause=error.cause or error.what,
                        next="wake it; on it: Preferences > Connections > Reset, pair again; or record without "
                        "Bluetooth (gopro.link = \"hand\")",
                    ) from error  # fmt: skip
                self.host.sleep_until(self.host.now_ns() + (1 << n) * 1_000_000_000)

    def ask(self, characteristic: str, message: bytes, *, again: bool = True) -> bytes:
        """Send a message and return the body of its reply after the id, as its length says.

        Args:
            again: ask up to three times, where the reply is lost or damaged; of an action only where doing it twice
                does no harm.

        Raises:
            DeviceError: no whole reply.
        """
        cause = "no reply"
        for n in range(_TRIES if again else 1):
            try:
                if n:
                    self.requeries += 1
                    self._settle()
                for packet in packets(message):
                    self._linked().write(uuid(characteristic), packet)
                reply, cause = self._reply(REPLIES[characteristic], message[0])
            except LinkLost as error:
                reply, cause = None, error.what
                self.close()
            if reply is not None:
                return reply
        raise DeviceError(
            "the camera's answer did not come whole", value=f"{characteristic}: {message.hex(' ')}", cause=cause,
            next="bring the computer nearer, keep its USB 3 cables away from the antenna",
        )  # fmt: skip

    def do(self, number: int, *parameters: bytes, again: bool = True) -> bytes:
        """A command; what its reply brings beside the status.

        Raises:
            DeviceError: refused, or no answer.
        """
        reply = self.ask(COMMAND, command(number, *parameters), again=again)
        self._check(f"command {number:#04x}", reply)
        return reply[1:]

    def set(self, number: int, value: int) -> int:
        """Set a setting; the camera's word on it: 0 done, else refused."""
        reply = self.ask(SETTING, command(number, bytes([value])))
        return reply[0] if reply else 1

    def keep_alive(self) -> None:
        """Say that somebody is there; every 3 s."""
        self._check("keep-alive", self.ask(SETTING, command(ALIVE, b"\x42")))

    def settings(self, numbers: Iterable[int] = ()) -> dict[int, Any]:
        """Current settings by id; all that it has where none are named."""
        return self._query(ASK_SETTINGS, numbers)

    def statuses(self, numbers: Iterable[int] = ()) -> dict[int, Any]:
        """Current statuses by id; unknown ids come along as they are."""
        return self._query(ASK_STATUS, numbers)

    def register(self, numbers: Iterable[int]) -> dict[int, Any]:
        """Have statuses pushed whenever they change; their values now."""
        found = self._query(REGISTER_STATUS, numbers)
        self.pushed |= found
        return found

    def close(self) -> None:
        """End the connection; may be called twice."""
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def _linked(self) -> BleLink:
        if self._link is None:
            self.connect()
        if self._link is None:
            raise LinkLost("there is no connection")
        return self._link

    def _query(self, kind: int, numbers: Iterable[int]) -> dict[int, Any]:
        reply = self.ask(QUERY, bytes([kind, *numbers]))
        self._check(f"query {kind:#04x}", reply)
        return {number: decoded(number, raw) for number, raw in values(reply[1:]).items()}

    def _check(self, what: str, reply: bytes) -> None:
        if not reply or reply[0]:
            code = reply[0] if reply else None
            raise DeviceError(
                "the camera refuses", value=what, cause=_REFUSED.get(code or 0, f"status {code}"),
                next="wait until it is idle; look at its screen",
            )  # fmt: skip

    def _reply(self, short: str, number: int) -> tuple[bytes | None, str]:
        """The reply to message `number`, or None and why; damaged pieces end the wait at once."""
        wanted, until = uuid(short), self.host.now_ns() + _WAIT_NS
        ears = self._heard[wanted]
        while (left := until - self.host.now_ns()) > 0:
            note = self._linked().receive(left)
            if note is None:
                break
            broken = ears.broken
            message = self._take(*note)
            if message and note[0] == wanted and message[0] == number:
                return message[1:], ""
            if ears.broken > broken and not ears.underway:
                return None, ears.why
        return None, f"silence for {_WAIT_NS / 1e9:g} s"

    def _settle(self) -> None:
        """Throw away the rest of what was broken: until the camera is quiet."""
        until = self.host.now_ns() + _WAIT_NS
        while self.host.now_ns() < until and (note := self._linked().receive(_QUIET_NS)) is not None:
            self._take(*note)
        self._heard = {characteristic: Assembler() for characteristic in self._heard}

    def _take(self, characteristic: str, packet: bytes) -> bytes | None:
        ears = self._heard.get(characteristic)
        message = ears.feed(packet) if ears else None
        if message and message[0] in PUSHES and len(message) > 1:
            try:
                self.pushed |= {n: decoded(n, raw) for n, raw in values(message[2:]).items()}
            except DeviceError:
                return None  # a damaged push: the next query tells
        return message
