"""The Harp protocol's bytes: frames with a checksum, a clock of 32 us steps, and the 1 Hz sync packet. Pure functions.

Source: harp-tech/protocol, BinaryProtocol-8bit, Device and SynchronizationClock.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DataError, UsageError

READ, WRITE, EVENT, ERROR = 1, 2, 3, 8
DEVICE_PORT = 0xFF
GRAIN_NS = 32_000  # the clock's step; stamps are floors
ROLL_S = 1 << 32  # seconds are a u32

U8, U16, U32, S16, FLOAT = 0x01, 0x02, 0x04, 0x82, 0x44
_STAMPED = 0x10
_DTYPES = {0x01: "u1", 0x02: "<u2", 0x04: "<u4", 0x08: "<u8"}
_DTYPES |= {0x80 | size: kind.replace("u", "i") for size, kind in _DTYPES.items()} | {FLOAT: "<f4"}

# Registers every device has.
WHO_AM_I, HW_HIGH, FW_HIGH, FW_LOW = 0, 1, 6, 7
SECOND, MICRO, OPERATION, RESET = 8, 9, 10, 11
NAME, SERIAL, CLOCK_CONFIG, HEARTBEAT = 12, 13, 14, 18

ACTIVE, HEARTBEAT_ON, DUMP, MUTE, ALIVE = 0x01, 0x04, 0x08, 0x10, 0x80


@dataclass(frozen=True, slots=True)
class Message:
    """One frame.

    Args:
        type: READ, WRITE or EVENT; of an answer the same as asked, plus ERROR when refused.
        address: register.
        kind: payload type without the stamp bit (U8, U16, ...).
        payload: its bytes, a whole number of elements.
        stamp: (seconds, steps of 32 us), or None.
        port: 255 is the device itself.
    """

    type: int
    address: int
    kind: int = U8
    payload: bytes = b""
    stamp: tuple[int, int] | None = None
    port: int = DEVICE_PORT

    @property
    def refused(self) -> bool:
        """Whether a device says no."""
        return bool(self.type & ERROR)

    @property
    def stamp_ns(self) -> int:
        """The stamp in ns of the box's time, wrapped at 2^32 s: the start of its 32 us step."""
        if self.stamp is None:
            raise DataError("a Harp message that must be stamped is not", value=self)
        return self.stamp[0] * NS + self.stamp[1] * GRAIN_NS

    def values(self) -> NDArray:
        """The payload's elements.

        Raises:
            DataError: an unknown element type.
        """
        if self.kind not in _DTYPES:
            raise DataError("an unknown Harp payload type", value=hex(self.kind), expected="U8 ... S64 or float")
        return np.frombuffer(self.payload, _DTYPES[self.kind])


def read(address: int, kind: int = U8) -> Message:
    """A question for a register's value."""
    return Message(READ, address, kind)


def write(address: int, kind: int, *values: float) -> Message:
    """An order to set a register."""
    return Message(WRITE, address, kind, np.array(values, _DTYPES[kind]).tobytes())


def encode(message: Message) -> bytes:
    """The frame's bytes.

    Raises:
        UsageError: the payload is too long or not whole elements.
    """
    size = message.kind & 0x0F
    stamp = b"" if message.stamp is None else struct.pack("<IH", *message.stamp)
    length = 4 + len(stamp) + len(message.payload)
    if size not in (1, 2, 4, 8) or len(message.payload) % size or length > 254:
        raise UsageError("a Harp payload is whole elements, at most 250 bytes", value=message)
    kind = message.kind | (_STAMPED if stamp else 0)
    body = struct.pack("<BBBBB", message.type, length, message.address, message.port, kind) + stamp + message.payload
    return body + bytes([sum(body) & 0xFF])


class Decoder:
    """Frames out of a stream of bytes that may begin anywhere and hold errors.

    A frame whose checksum, type or length cannot be is not one: one byte is skipped and the search goes on, so that a
    damaged frame costs itself and nothing behind it.

    Attributes:
        skipped: bytes thrown away so far.
    """

    def __init__(self) -> None:
        self._held = bytearray()
        self.skipped = 0

    def feed(self, data: bytes) -> list[Message]:
        """Frames completed by these bytes, in order."""
        self._held += data
        found: list[Message] = []
        while len(self._held) >= 2:
            size = self._held[1] + 2
            if not plausible(self._held):
                self._skip()
            elif len(self._held) < size:
                break
            elif sum(self._held[: size - 1]) & 0xFF != self._held[size - 1]:
                self._skip()
            else:
                found.append(_parse(bytes(self._held[:size])))
                del self._held[:size]
        return found

    def give_up(self) -> list[Message]:
        """No more bytes will come for the frame begun: it is none. Frames hidden behind its head come out."""
        if not self._held:
            return []
        self._skip()
        return self.feed(b"")

    @property
    def waiting(self) -> bool:
        """Whether a frame has begun and is not whole."""
        return bool(self._held)

    def _skip(self) -> None:
        del self._held[0]
        self.skipped += 1


def plausible(head: bytes | bytearray) -> bool:
    """Whether a frame may begin with these bytes, two at least; as far as they tell."""
    if head[0] & ~ERROR not in (READ, WRITE, EVENT) or head[1] < 4:
        return False
    if len(head) < 5:
        return True
    size, stamped = head[4] & 0x0F, head[4] & _STAMPED
    left = head[1] - (10 if stamped else 4)
    return head[4] & ~_STAMPED in _DTYPES and left >= 0 and left % size == 0


def _parse(frame: bytes) -> Message:
    kind, at = frame[4], 5
    stamp = None
    if kind & _STAMPED:
        stamp = struct.unpack_from("<IH", frame, 5)
        at = 11
    return Message(frame[0], frame[2], kind & ~_STAMPED, frame[at:-1], stamp, frame[3])


def unwrapped_ns(stamp_ns: int, near_ns: int) -> int:
    """The time that shows as `stamp_ns` after wrapping at 2^32 s and is nearest to `near_ns`."""
    period = ROLL_S * NS
    return stamp_ns + period * round((near_ns - stamp_ns) / period)


class SyncTime(NamedTuple):
    """What a sync packet says: the box's time at the end of its last byte."""

    second: int
    at_ns: int


def sync_packet(ending_second: int) -> bytes:
    """The six bytes sent in the last millisecond of a second."""
    return b"\xaa\xaf" + struct.pack("<I", ending_second % ROLL_S)


def parse_sync(packet: bytes) -> SyncTime:
    """The time a sync packet tells.

    The start of the last byte lies 672 us before the second it announces; at 100 kbit/s a byte of ten bits lasts
    100 us, so its end, which is when a receiver has it, lies 572 us before. (The specification's "672 us following
    reception" is 100 us off; firmware counts 574 to 582 us.)

    Raises:
        DataError: these are no six bytes of a packet.
    """
    if len(packet) != 6 or packet[:2] != b"\xaa\xaf":
        raise DataError("not a Harp sync packet", value=packet.hex(" "), expected="aa af and four bytes")
    second = (struct.unpack_from("<I", packet, 2)[0] + 1) % ROLL_S
    return SyncTime(second, second * NS - 572_000)
