"""The FT600/FT601 USB bridge on the wire: commands, the config block, descriptors, errors. Pure functions on bytes.

Nothing here has a vendor's document behind it: the commands were read in four independent open drivers (kernel module
lambdaconcept/ft60x_driver, LimeSuite, LeechCore, apertus ft60x-rs) that agree on what is used here.
"""

from __future__ import annotations

import errno
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from types import MappingProxyType

from spikerig.dataset.errors import DeviceError

VENDOR = 0x0403
PRODUCTS: Mapping[int, str] = MappingProxyType({0x601E: "FT600", 0x601F: "FT601"})
COMMANDS, NOTICES, DATA_OUT, DATA_IN = 0x01, 0x81, 0x02, 0x82  # endpoints of the one-channel layout
INTERFACES = (0, 1)  # commands, data: both are claimed
PACKET = 1024  # wMaxPacketSize at SuperSpeed
DEFAULT_SERIAL = "000000000001"  # the same on every chip that nobody has written to
CONFIG_REQUEST, VERSION_REQUEST = 0xCF, 0xF1  # control, bmRequestType 0xC0
CONFIG_BYTES = 152
ABORT, SESSION, STREAM, FLUSH = 0, 1, 2, 3
CLOCKS_MHZ = (100, 66, 50, 40)
CHANNELS = ("four", "two", "one", "one out", "one in")
STREAM_BYTES = 0x4000_0000


def command(verb: int, pipe: int = DATA_IN, length: int = 0, index: int = 0) -> bytes:
    """The 20 bytes of a command to endpoint 0x01; the chip does not reply.

    Args:
        verb: ABORT, SESSION (one of `length` bytes), STREAM (sessions of `length` bytes without end) or FLUSH.
        pipe: the endpoint it is about; 0 for all.
        length: bytes.
        index: counts up in some drivers and stays 0 in others: the chip ignores it.

    Source:
        LimeSuite ConnectionFT601.cpp, ft60x_driver ft60x.c, ft60x-rs.
    """
    return struct.pack("<IBBHIII", index, pipe, verb, 0, length, 0, 0)


def start_commands() -> tuple[bytes, ...]:
    """What begins a stream: flush what a dead program may have left, then sessions without end on the data pipe."""
    return command(FLUSH, 0), command(STREAM, DATA_IN, STREAM_BYTES)


def stop_commands() -> tuple[bytes, ...]:
    """What ends it; the order of the vendor's own library."""
    return command(ABORT), command(ABORT), command(FLUSH)


@dataclass(frozen=True, slots=True)
class ChipConfig:
    """The bridge's own settings, read only: writing them re-enumerates the chip, and a bad string bricks it.

    Args:
        vendor, product: USB identity.
        maker, model, serial: its strings.
        clock_mhz: of the parallel bus; 4 bytes (FT601) or 2 (FT600) a cycle.
        mode_600: the 600 mode; else 245.
        channels: of the FIFO, in words.
        options: bits as stored.
    """

    vendor: int
    product: int
    maker: str
    model: str
    serial: str
    clock_mhz: int
    mode_600: bool
    channels: str
    options: int

    @property
    def bus_bytes_s(self) -> float:
        """What the parallel bus can carry at most."""
        return self.clock_mhz * 1e6 * (4 if self.product == 0x601F else 2)


def parse_config(data: bytes) -> ChipConfig:
    """The config block of control request 0xCF.

    Raises:
        DeviceError: it is not 152 bytes, or its strings do not hold together.
    """
    if len(data) != CONFIG_BYTES:
        raise DeviceError("the bridge's config block is not whole", value=f"{len(data)} bytes", expected="152 bytes")
    vendor, product = struct.unpack_from("<HH", data, 0)
    strings, at = [], 4
    for _ in range(3):
        size = data[at] if at < 132 else 0
        if size < 2 or size % 2 or at + size > 132 or data[at + 1] != 3:
            raise DeviceError(
                "the bridge's strings are damaged", value=bytes(data[at : at + 8]).hex(" "),
                expected="three USB string descriptors in 128 bytes", cause="a failed write of its settings",
                next="restore the chip with the vendor's configuration tool",
            )  # fmt: skip
        strings.append(bytes(data[at + 2 : at + size]).decode("utf-16-le", "replace"))
        at += size
    clock, mode, channels, options = struct.unpack_from("<BBBH", data, 137)
    if clock >= len(CLOCKS_MHZ) or channels >= len(CHANNELS):
        raise DeviceError("the bridge's config block makes no sense", value=f"clock {clock}, channels {channels}")
    maker, model, serial = strings
    return ChipConfig(vendor, product, maker, model, serial, CLOCKS_MHZ[clock], bool(mode), CHANNELS[channels], options)


def parse_version(data: bytes) -> str:
    """The chip's firmware from control request 0xF1: `09 01 00 00` is 1.09."""
    if len(data) != 4:
        raise DeviceError("the bridge's version is 4 bytes", value=bytes(data).hex(" "))
    return f"{data[1]}.{data[0]:02d}"


class Fault(Enum):
    """What a USB error means to the driver."""

    TIMEOUT = "timeout"  # nothing came; with data it is a short read and no error at all
    STALL = "stall"  # the endpoint halted: clear_halt, and only then; the transfer's bytes are gone
    OVERFLOW = "overflow"  # more came than asked for: bytes are gone
    GONE = "unplugged"  # dispose, look for its serial, open again
    BUSY = "busy"  # somebody else has the interface
    DENIED = "denied"  # no permission: udev
    AGAIN = "interrupted"  # a signal: try again
    BROKEN = "io"  # everything else: bytes may be gone; a few times, then treat as gone


# libusb: TIMEOUT -7, PIPE -9, OVERFLOW -8, NO_DEVICE -4, BUSY -6, ACCESS -3, INTERRUPTED -10, NOT_FOUND -5, IO -1
_FAULTS: Mapping[int, Fault] = MappingProxyType({
    errno.ETIMEDOUT: Fault.TIMEOUT, errno.EPIPE: Fault.STALL, errno.EOVERFLOW: Fault.OVERFLOW,
    errno.ENODEV: Fault.GONE, errno.ENOENT: Fault.GONE, errno.ESHUTDOWN: Fault.GONE, errno.EBUSY: Fault.BUSY,
    errno.EACCES: Fault.DENIED, errno.EPERM: Fault.DENIED, errno.EINTR: Fault.AGAIN,
})  # fmt: skip


def fault_of(error: OSError) -> Fault:
    """What an error of pyusb means; unknown numbers are BROKEN."""
    return _FAULTS.get(error.errno or 0, Fault.BROKEN)
