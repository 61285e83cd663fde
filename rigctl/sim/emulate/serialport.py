"""The host's end of an emulated serial cable: what pyserial's `Serial` would be, errors included."""

from __future__ import annotations

import errno
from collections.abc import Callable
from typing import Protocol

from serial import SerialException

from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DeviceError
from spikerig.rigctl.host import Host


class Cable(Protocol):
    """What a port asks of the device behind it."""

    host: Host

    def out(self) -> bool:
        """Whether the cable is out now."""
        ...

    def next_cut_ns(self) -> int | None:
        """When it will next be pulled."""
        ...

    def arrived(self) -> int:
        """Bytes to read."""
        ...

    def take(self, size: int) -> bytes:
        """Read them."""
        ...

    def send(self, data: bytes) -> None:
        """Send bytes."""
        ...

    def next_ns(self) -> int:
        """When something may next happen."""
        ...

    def closed(self) -> None:
        """The port was closed."""
        ...


class WirePort:
    """What pyserial's `Serial` would be on this cable."""

    def __init__(self, wire: Cable) -> None:
        self._wire: Cable | None = wire
        self.timeout: float | None = 0.5

    @property
    def in_waiting(self) -> int:
        """Bytes to read; a bare OSError when the cable is out, as pyserial has it."""
        wire = self._there()
        if wire.out():
            raise OSError(errno.EIO, "Input/output error")
        return wire.arrived()

    def read(self, size: int = 1) -> bytes:
        """Up to `size` bytes; sleeps until they are there or `timeout` is over."""
        wire = self._there()
        until = wire.host.now_ns() + round(NS * (self.timeout if self.timeout is not None else 3600))
        while True:
            self._check(wire)
            if wire.arrived() >= size or wire.host.now_ns() >= until:
                return wire.take(size)
            cut = wire.next_cut_ns()
            wire.host.sleep_until(min(wire.next_ns(), until, until if cut is None else cut))

    def write(self, data: bytes) -> int:
        """Send bytes."""
        wire = self._there()
        if wire.out():
            raise SerialException(errno.EIO, "write failed: [Errno 5] Input/output error")
        wire.send(bytes(data))
        return len(data)

    def close(self) -> None:
        """Close; may be called twice."""
        if self._wire is not None:
            self._wire.closed()
            self._wire = None

    def _there(self) -> Cable:
        if self._wire is None:
            raise SerialException("Attempting to use a port that is not open")
        return self._wire

    def _check(self, wire: Cable) -> None:
        if wire.out():
            raise SerialException(
                "device reports readiness to read but returned no data "
                "(device disconnected or multiple access on port?)"
            )


def device_errors(port: Callable[[], WirePort]) -> Callable[[], WirePort]:
    """Opening that fails as `HarpBox` wants it: with a DeviceError."""

    def opened() -> WirePort:
        try:
            return port()
        except OSError as error:
            raise DeviceError("the clock box's port cannot be opened", value="emulated", cause=str(error)) from error

    return opened
