"""What the record loop asks of a device: three Protocols. Drivers and replays fulfil them; emulation sits below."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.marks import Probe
from spikerig.dataset.wire import WireProfile


@dataclass(frozen=True, slots=True)
class DeviceFacts:
    """A device as found: kind ("spike", "rgb", "sync"), model, serial, firmware, address, and whatever else it told."""

    kind: str
    model: str
    serial: str
    firmware: str
    address: str
    more: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Block:
    """Bytes of a spike camera as one transfer brought them.

    Args:
        data: uint8[n], wire bytes; the buffer is the driver's and is overwritten by the second `read` after this one.
        epoch: counts up by 1 at each start of the stream and after each loss: within an epoch no byte is missing as
            far as the driver can tell.
        byte_index: of the first byte, counted from the epoch's start.
        before_ns, after_ns: host time before the transfer was asked for, and after it came back.
        lost_bytes: known or estimated loss on the transport just before this block; 0 within an epoch.
        lost_why: what told of the loss ("overflow", "unplugged", "rate", ...); empty without one.
        suspect_bytes: how many bytes at the end of the epoch just ended may lie behind the loss: it happened somewhere
            among them. They are whole and in order but for that one gap.
    """

    data: NDArray[np.uint8]
    epoch: int
    byte_index: int
    before_ns: int
    after_ns: int
    lost_bytes: int = 0
    lost_why: str = ""
    suspect_bytes: int = 0


class SpikeSource(Protocol):
    """A spike camera: a stream of wire bytes of a known layout."""

    facts: DeviceFacts
    profile: WireProfile

    def start(self) -> None:
        """Begin the stream; old bytes are drained and thrown away. The epoch counts up."""
        ...

    def read(self, timeout_ns: int) -> Block | None:
        """The next bytes; None when none came in time.

        Raises:
            DeviceError: the device is gone or broken beyond what the driver mends by itself.
        """
        ...

    def stop(self) -> None:
        """End the stream; may be called twice."""
        ...

    def close(self) -> None:
        """Give the device back; may be called twice, and after errors."""
        ...


@dataclass(frozen=True, slots=True)
class Clip:
    """A recording on the RGB camera: its name there, bytes, and host times around the start and stop commands."""

    name: str
    size_bytes: int
    start_ns: tuple[int, int]
    stop_ns: tuple[int, int]


class FrameSource(Protocol):
    """The RGB camera: it records to its own card, and hands files over when idle."""

    facts: DeviceFacts

    def settle(self, settings: Mapping[str, Any]) -> Mapping[str, Any]:
        """Bring the camera to these settings; tells what was set, what was not, and what only the file will show."""
        ...

    def start(self) -> None:
        """Start a recording and return when the camera says it encodes."""
        ...

    def stop(self) -> Clip:
        """Stop it and return when the camera is idle again; the clip just made."""
        ...

    def poll(self) -> Mapping[str, Any]:
        """Keep the connection alive; the state (encoding, busy, battery, card space, hot). Call every second."""
        ...

    def fetch(self, clip: Clip, folder: Path) -> list[Path]:
        """Bring a clip's files (chapters) into a folder; goes on where a broken download stopped."""
        ...

    def close(self) -> None:
        """Give the camera back; may be called twice, and after errors."""
        ...


class SyncBox(Protocol):
    """The clock box: it can be asked what time it is, and drives the LED panel by that time."""

    facts: DeviceFacts

    def probe(self) -> Probe:
        """Ask for the time once: host time before and after, box time between.

        Raises:
            DeviceError: no answer, or a bad one.
        """
        ...

    def heard(self) -> list[Probe]:
        """Stamped events (heartbeats) that came by themselves since the last call: one-way, `sent_ns` is None."""
        ...

    def close(self) -> None:
        """Give the port back; may be called twice, and after errors."""
        ...
