"""GoPro over Bluetooth: packets, messages and values, as pure functions on bytes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from spikerig.dataset.errors import DeviceError

PACKET = 20  # bytes of a packet, header included
COMMAND, SETTING, QUERY = "0072", "0074", "0076"
REPLIES = {COMMAND: "0073", SETTING: "0075", QUERY: "0077"}
SHUTTER, SLEEP, SET_TIME, AP, HARDWARE, ALIVE = 0x01, 0x05, 0x0D, 0x17, 0x3C, 0x5B
ASK_SETTINGS, ASK_STATUS, PUSHES = 0x12, 0x13, (0x92, 0x93, 0xA2)
REGISTER_STATUS = 0x53
BUSY, ENCODING, SECONDS, AP_SSID, SD, MINUTES_LEFT, KB_LEFT, POLL_MS = 8, 10, 13, 30, 33, 35, 54, 60
HOT, COLD, BATTERY, READY = 6, 85, 70, 82
_TEXTS = {30, 29}  # statuses that are text


def uuid(short: str) -> str:
    """The full UUID of a GP-xxxx characteristic."""
    return f"b5f9{short}-aa8d-11e3-9046-0002a5d5c51b"


# ---- packets --------------------------------------------------------------------------------------------------------


def packets(message: bytes) -> list[bytes]:
    """A message as packets of at most 20 bytes, with the 13-bit header that GoPro asks hosts to use.

    Raises:
        ValueError: longer than 13 bits can say.
    """
    if len(message) > 0x1FFF:
        raise ValueError(f"a message of {len(message)} bytes")
    head = (0x2000 | len(message)).to_bytes(2, "big")
    out = [head + message[: PACKET - 2]]
    rest = message[PACKET - 2 :]
    for n, at in enumerate(range(0, len(rest), PACKET - 1)):
        out.append(bytes([0x80 | (n & 0xF)]) + rest[at : at + PACKET - 1])
    return out


@dataclass
class Assembler:
    """Packets of one characteristic to messages. What does not fit together is thrown away and counted, never passed.

    Args:
        strict: continuation counters must count; a camera must bear hosts that always send 0x80.
    """

    strict: bool = True
    broken: int = 0
    why: str = ""
    _length: int = 0
    _got: bytearray | None = None
    _next: int = 0

    @property
    def underway(self) -> bool:
        """A message has begun and is not whole yet."""
        return self._got is not None

    def feed(self, packet: bytes) -> bytes | None:
        """Take a packet; the message, once it is whole."""
        if not packet:
            return self._drop("an empty packet")
        first = packet[0]
        if first & 0x80:
            return self._more(first & 0xF, packet[1:])
        if self._got is not None:
            self._drop(f"{len(self._got)} of {self._length} bytes came before the next message")
        kind = first >> 5
        if kind == 0:
            length, body = first & 0x1F, packet[1:]
        elif kind == 1 and len(packet) >= 2:
            length, body = int.from_bytes(packet[:2], "big") & 0x1FFF, packet[2:]
        elif kind == 2 and len(packet) >= 3:
            length, body = int.from_bytes(packet[1:3], "big"), packet[3:]
        else:
            return self._drop(f"a packet that begins with {first:#04x}")
        self._length, self._got, self._next = length, bytearray(body), 0
        return self._whole()

    def _more(self, counter: int, body: bytes) -> bytes | None:
        if self._got is None:
            return self._drop("a continuation of nothing")
        if self.strict and counter != self._next:
            return self._drop(f"continuation {counter:X} where {self._next:X} was due")
        self._next = (self._next + 1) & 0xF
        self._got += body
        return self._whole()

    def _whole(self) -> bytes | None:
        got = self._got or bytearray()
        if len(got) < self._length:
            return None
        if len(got) > self._length:
            return self._drop(f"{len(got)} bytes of {self._length}")
        self._got = None
        return bytes(got)

    def _drop(self, why: str) -> None:
        self.broken += 1
        self.why, self._got = why, None


# ---- messages -------------------------------------------------------------------------------------------------------


def command(number: int, *parameters: bytes) -> bytes:
    """A command: its number, and each parameter behind its length."""
    return bytes([number]) + b"".join(bytes([len(p)]) + p for p in parameters)


def values(body: bytes) -> dict[int, bytes]:
    """The (id, length, value) triples of a query's reply; of an id that comes twice the last.

    Raises:
        DeviceError: a value runs over the end.
    """
    found, at = {}, 0
    while at < len(body):
        if at + 2 > len(body) or at + 2 + body[at + 1] > len(body):
            raise DeviceError("the camera's values run over the end of its reply", value=body[at:].hex(" "))
        found[body[at]] = body[at + 2 : at + 2 + body[at + 1]]
        at += 2 + body[at + 1]
    return found


def decoded(number: int, raw: bytes) -> int | str | None:
    """A status or setting: text where it is one, else an unsigned number; None for an empty value."""
    if number in _TEXTS:
        return raw.split(b"\0")[0].decode("utf-8", "replace")
    if len(raw) > 8:
        return raw.hex(" ")
    return int.from_bytes(raw, "big") if raw else None


def hardware(data: bytes) -> dict[str, str]:
    """What the reply to "hardware info" tells: model number, name, firmware, serial, ssid.

    Raises:
        DeviceError: a field runs over the end.
    """
    names, found, at = ("number", "model", "board", "firmware", "serial", "ssid", "mac"), {}, 0
    for name in names:
        if at >= len(data):
            break
        raw = data[at + 1 : at + 1 + data[at]]
        if len(raw) != data[at]:
            raise DeviceError("the camera's hardware info runs over its end", value=data.hex(" "))
        text = raw.split(b"\0")[0].decode("utf-8", "replace")
        found[name] = str(int.from_bytes(raw, "big")) if name == "number" else text
        at += 1 + data[at]
    return found


def whole_seconds(when: tuple[int, int, int, int, int, int]) -> bytes:
    """Parameter of SET_TIME: (year, month, day, hour, minute, second)."""
    year, *rest = when
    return year.to_bytes(2, "big") + bytes(rest)


def known(statuses: Mapping[int, Any]) -> dict[str, Any]:
    """The statuses that matter to a recording, by name; None where the camera did not tell."""
    names = {
        "busy": BUSY, "encoding": ENCODING, "seconds": SECONDS, "battery_percent": BATTERY,
        "minutes_left": MINUTES_LEFT, "card_kb": KB_LEFT, "card_state": SD, "hot": HOT, "cold": COLD,
    }  # fmt: skip
    flags = ("busy", "encoding", "hot", "cold")
    found = {name: statuses.get(number) for name, number in names.items()}
    return {name: bool(v) if name in flags and v is not None else v for name, v in found.items()}
