"""The system's serial ports: opening one for the clock box, and looking for the box on all that may hold it."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterable
from typing import Any, cast

from spikerig.dataset.errors import DeviceError, HostError, RigError
from spikerig.rigctl.devices import DeviceFacts
from spikerig.rigctl.host import Host
from spikerig.rigctl.syncbox import BAUD, HarpBox, SerialPort


def serial_opener(path: str) -> Callable[[], SerialPort]:
    """Opens a real port for `HarpBox`: 1 Mbit/s, exclusive, low latency where the system can.

    Raises (when called):
        DeviceError: no such port, or another program has it.
        HostError: no permission.
    """

    def opened() -> SerialPort:
        import serial

        try:
            port = serial.Serial(path, BAUD, timeout=0.5, write_timeout=1.0, exclusive=True)
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EPERM) or "Permission denied" in str(error):
                raise HostError(
                    "no permission for the clock box's port", value=path, next="add yourself to the group dialout"
                ) from error
            taken = error.errno == errno.EAGAIN or "lock" in str(error)
            raise DeviceError(
                "the clock box's port is taken" if taken else "the clock box's port cannot be opened",
                value=path,
                cause="another program holds it" if taken else str(error),
                next="close the other program" if taken else "spikerig rig find",
            ) from error
        try:
            port.set_low_latency_mode(True)
        except (AttributeError, OSError, ValueError, NotImplementedError):
            pass  # 16 ms of an FTDI's latency timer stay: the probes' round trip shows it
        try:
            port.dtr = True
        except OSError:
            pass  # a pseudo-terminal has no such line
        return cast("SerialPort", port)

    return opened


def find(
    host: Host, ports: Iterable[tuple[str, str]] | None = None, opener_of: Callable[[str], Any] = serial_opener
) -> tuple[list[DeviceFacts], list[str]]:
    """Ask every serial port that may hold a clock box.

    Args:
        host: the clock that stamps.
        ports: (path, what the system says of it); None: the system's ports with a USB identity of a Harp device, which
            are an FTDI's or a Raspberry Pi Pico's.
        opener_of: makes an opener of a path.

    Returns:
        The boxes found, and a line for each port that is none or does not open, with the reason.
    """
    found, told = [], []
    for path, says in _serial_ports() if ports is None else ports:
        try:
            box = HarpBox(opener_of(path), host, address=path, timeout_ns=300_000_000)
        except RigError as error:
            told.append(f"{path} ({says}): {error.what}" + (f": {error.cause}" if error.cause else ""))
        else:
            found.append(box.facts)
            box.close()
    return found, told


def _serial_ports() -> list[tuple[str, str]]:
    from serial.tools.list_ports import comports

    likely = {0x0403, 0x2E8A}  # FTDI; Raspberry Pi
    return [(port.device, port.description or "?") for port in comports() if port.vid in likely]
