"""Spike sources that are no USB camera: raw dumps at the sensor's speed, and the slot for a vendor's own library."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DataError, DeviceError, HostError, UsageError
from spikerig.dataset.wire import WireProfile
from spikerig.rigctl.devices import Block, DeviceFacts
from spikerig.rigctl.host import Host


class RawSource:
    """A file of wire bytes (a raw dump, a `.dat`) as a `SpikeSource`: bytes come as fast as the sensor made them.

    Args:
        path: of the file; it is read as it is played, never whole.
        profile: how its bytes lie, and how fast they come.
        host: time.
        loop: begin again at its end; a new epoch each time, unless the file is whole ticks.
        block_bytes: of a read; 0: as `VidarSource`.
        memory_bytes: what a late reader may fall behind before bytes are lost; 0: nothing is ever lost, the replay
            waits for its reader.

    Raises:
        UsageError: there is no such file.
        DataError: it holds less than a tick.

    Edges:
        At the file's end without `loop`, `read` raises DeviceError. `start` begins at the first byte.
    """

    def __init__(
        self,
        path: str | Path,
        profile: WireProfile,
        host: Host,
        *,
        loop: bool = False,
        block_bytes: int = 0,
        memory_bytes: int = 0,
    ) -> None:
        self.path, self.profile, self._host = Path(path), profile, host
        self._loop, self._memory = loop, memory_bytes
        try:
            self._file = self.path.open("rb", buffering=0)
        except OSError as error:
            raise UsageError("the raw dump cannot be read", value=f"{path}: {error.strerror}") from error
        self._bytes = self.path.stat().st_size
        if self._bytes < profile.tick_bytes:
            self._file.close()
            raise DataError("the raw dump holds less than a tick", value=f"{path}: {self._bytes} bytes",
                            expected=f"{profile.tick_bytes} bytes a tick of {profile.name}")  # fmt: skip
        self.facts = DeviceFacts("spike", "raw dump", self.path.name, "", str(self.path), {"bytes": self._bytes})
        size = block_bytes or max(524_288, round(0.008 * profile.bytes_s))
        self._buffers = [np.zeros(size, np.uint8) for _ in range(2)]
        self._turn, self.epoch, self._index = 0, -1, 0
        self._at = self._lost = 0  # of the file; before the next block
        self._since: int | None = None
        self._sent = 0  # bytes of the sensor's time that are over, read or lost

    def start(self) -> None:
        """Begin at the file's first byte."""
        if self._file.closed:
            raise DeviceError("the raw dump is closed", value=self.path)
        if self._since is not None:
            raise UsageError("the stream runs already", value=self.path)
        self._file.seek(0)
        self._at = self._index = self._sent = self._lost = 0
        self.epoch += 1
        self._since = self._host.now_ns()

    def read(self, timeout_ns: int) -> Block | None:
        """The next bytes, when the sensor would have made them."""
        if self._since is None:
            raise UsageError("the stream was not started", value=self.path)
        before = self._host.now_ns()
        self._lose(before)
        if self._at >= self._bytes:
            self._again()
        buffer = self._buffers[self._turn]
        want = min(len(buffer), self._bytes - self._at)
        due = self._since + round((self._sent + want) / self.profile.bytes_s * NS)
        if due > before + timeout_ns:
            want = min(want, max(0, int((before + timeout_ns - self._since) * self.profile.bytes_s / NS) - self._sent))
            due = before + timeout_ns
        self._host.sleep_until(due)
        got = self._file.readinto(buffer[:want].data) if want else 0
        if want and not got:
            raise DataError("the raw dump ended early", value=f"{self.path}: at byte {self._at}",
                            cause="it shrank while it was being played")  # fmt: skip
        if not got:
            return None
        return self._block(buffer[:got], before)

    def stop(self) -> None:
        """End the stream; may be called twice."""
        self._since = None

    def close(self) -> None:
        """Close the file; may be called twice."""
        self.stop()
        self._file.close()

    def _block(self, data: NDArray[np.uint8], before: int) -> Block:
        why = "overflow" if self._lost else ""
        block = Block(data, self.epoch, self._index, before, self._host.now_ns(), self._lost, why)
        self._turn ^= 1
        self._lost = 0
        self._at += len(data)
        self._index += len(data)
        self._sent += len(data)
        return block

    def _lose(self, now_ns: int) -> None:
        """What the sensor has made and the memory could not hold."""
        since = self._since or 0
        if not self._memory:
            self._since = max(since, now_ns - round(self._sent / self.profile.bytes_s * NS))  # wait for the reader
            return
        behind = int((now_ns - since) * self.profile.bytes_s / NS) - self._sent
        over = min(max(0, behind - self._memory), self._bytes - self._at)
        if over:
            self._at += over
            self._sent += over
            self._file.seek(self._at)
            self.epoch, self._index, self._lost = self.epoch + 1, 0, over

    def _again(self) -> None:
        if not self._loop:
            raise DeviceError("the raw dump is over", value=f"{self.path}: {self._bytes} bytes",
                              next="play it with loop, or record less")  # fmt: skip
        self._at = 0
        self._file.seek(0)
        if self._bytes % self.profile.tick_bytes:
            self.epoch, self._index = self.epoch + 1, 0


class VendorLink(Protocol):
    """What `VendorSource` asks of a binding to the vendor's closed library (SpikeLink, `libspikelinkapi`).

    A lab that has the library writes these five functions with ctypes; nothing of it is shipped here. They map onto
    its exports: open = CreateSpikeLinkInput + Init + Open, start = Start, take = GetFrames + ReleaseFrame (after the
    copy), stop = Stop, close = Close + Fini.
    """

    def open(self, *, interface: int, mode: int, serial: str, packet_bytes: int, queue: int, cusum: int) -> None:
        """Open the camera: interface 0x20 PCIe, 0x21 USB; mode 0x1000 K10 20k, 0x1001 K10 40k, 0x2000 M1."""
        ...

    def start(self) -> None:
        """Start the stream."""
        ...

    def take(self, into: NDArray[np.uint8], timeout_ms: int) -> tuple[int, int]:
        """Copy the next block: (bytes, its `pts`); (0, -1) when none came in time."""
        ...

    def stop(self) -> None:
        """Stop the stream."""
        ...

    def close(self) -> None:
        """Give the camera back."""
        ...


class VendorSource:
    """A camera behind a vendor's library as a `SpikeSource`.

    Args:
        link: the binding.
        profile: of the bytes that the library hands over.
        host: time.
        serial: of the camera.
        interface, mode: see `VendorLink.open`.
        cusum: ticks a block.

    Edges:
        The library counts blocks from 0 in `pts` and lets no gap be seen there when it drops data (its own messages on
        stdout say so): a jump in `pts` is told as a loss, and all else only bytes against time can show.
    """

    def __init__(
        self, link: VendorLink, profile: WireProfile, host: Host, *, serial: str = "000000000001",
        interface: int = 0x21, mode: int = 0x1000, cusum: int = 50,
    ) -> None:  # fmt: skip
        from spikerig.rigctl.pace import Pace

        self._link, self.profile, self._host = link, profile, host
        self.facts = DeviceFacts("spike", "vendor library", serial, "", f"spikelink:0x{interface:02x}")
        try:
            link.open(interface=interface, mode=mode, serial=serial, packet_bytes=profile.packet_bytes, queue=16,
                      cusum=cusum)  # fmt: skip
        except OSError as error:
            raise HostError("the vendor's library does not open the camera", value=str(error)) from error
        self._buffers = [np.zeros(cusum * profile.tick_bytes, np.uint8) for _ in range(2)]
        self.pace = Pace(profile.bytes_s)
        self._turn, self.epoch, self._index, self._pts = 0, -1, 0, -1
        self._loss: tuple[int, str, int] = (0, "", 0)
        self._open, self._streaming = True, False

    def start(self) -> None:
        """Begin the stream."""
        if not self._open or self._streaming:
            raise UsageError("the camera is closed, or streams already", value=self.facts.address)
        self._link.start()
        self._streaming, self._pts, self._loss = True, -1, (0, "", 0)
        self.epoch, self._index = self.epoch + 1, 0
        self.pace.begin()

    def read(self, timeout_ns: int) -> Block | None:
        """The next block of the library; a jump of its counter, or missing bytes for the time, begin an epoch."""
        if not self._streaming:
            raise UsageError("the stream was not started", value=self.facts.address)
        buffer = self._buffers[self._turn]
        before = self._host.now_ns()
        count, pts = self._link.take(buffer, max(1, timeout_ns // 1_000_000))
        after = self._host.now_ns()
        if not count:
            return None
        missing = pts - self._pts - 1 if self._pts >= 0 else 0
        self._pts = pts
        if missing:
            self._loss = (max(0, missing) * len(buffer), "counter", 0)
            self.epoch, self._index = self.epoch + 1, 0
            self.pace.begin()
        block = Block(buffer[:count], self.epoch, self._index, before, after, *self._loss)
        self._turn, self._index, self._loss = self._turn ^ 1, self._index + count, (0, "", 0)
        lapse = self.pace.add(before, after, count)
        if lapse is not None:
            self._loss = (lapse.bytes, "rate", lapse.suspect)
            self.epoch, self._index = self.epoch + 1, 0
            self.pace.split(lapse)
        return block

    def stop(self) -> None:
        """End the stream; may be called twice."""
        if self._streaming:
            self._link.stop()
        self._streaming = False

    def close(self) -> None:
        """Give the camera back; may be called twice."""
        self.stop()
        if self._open:
            self._link.close()
        self._open = False
