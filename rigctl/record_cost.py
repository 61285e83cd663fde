"""`spikerig cost record`: how fast this machine records, with a source that keeps time like a camera."""

from __future__ import annotations

import resource
import shutil
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from spikerig.dataset.errors import UsageError
from spikerig.dataset.terminal import emit, note
from spikerig.dataset.wire import WireProfile
from spikerig.rigctl.devices import Block, DeviceFacts
from spikerig.rigctl.host import Host, RealHost

FIFO = 16 << 20  # bytes that wait in the kernel's queue of transfers: usbfs's own limit where nobody raised it


class PacedSource:
    """A `SpikeSource` of made-up bytes at a camera's pace, with a queue that overflows as a USB queue does.

    Args:
        profile: rate, tick and packet.
        host: the clock.
        fifo: bytes that may wait for `read`; what does not fit is lost, the epoch counts up.
        pattern: the bytes that repeat; by default 4 packets of noise.

    Edges:
        Byte k of an epoch is `pattern[k % len(pattern)]`.
    """

    def __init__(
        self, profile: WireProfile, host: Host, *, fifo: int = FIFO, pattern: NDArray[np.uint8] | None = None
    ) -> None:
        self.profile, self.host, self.fifo = profile, host, fifo
        self.facts = DeviceFacts("spike", profile.name, "paced", "", "emulated")
        n = profile.packet_bytes
        made = np.random.default_rng(0).integers(0, 256, 4 * n, np.uint8) if pattern is None else pattern
        self.period = len(made)
        self._pattern = np.concatenate([made, np.resize(made, n)])
        self._buffers = [np.empty(n, np.uint8) for _ in range(2)]
        self._epoch, self._at, self._count, self._made = -1, 0, 0, 0
        self._start_ns = 0
        self.worst_backlog = 0

    def start(self) -> None:
        """Begin."""
        self._epoch += 1
        self._at = self._made = 0
        self._start_ns = self.host.now_ns()

    def read(self, timeout_ns: int) -> Block | None:
        """The next packet, when it is due."""
        before, n = self.host.now_ns(), self.profile.packet_bytes
        due = self._start_ns + round((self._made + n) / self.profile.bytes_s * 1e9)
        if due > before + timeout_ns:
            self.host.sleep_until(before + timeout_ns)
            return None
        self.host.sleep_until(due)
        now = self.host.now_ns()
        waiting = int((now - self._start_ns) * self.profile.bytes_s / 1e9) - self._made
        self.worst_backlog = max(self.worst_backlog, waiting)
        lost = 0
        if waiting > self.fifo + n:
            lost = (waiting - self.fifo) // n * n
            self._made += lost
            self._epoch, self._at = self._epoch + 1, 0
        data, first = self._buffers[self._count % 2], self._at % self.period
        data[:] = self._pattern[first : first + n]
        block = Block(data, self._epoch, self._at, before, now, lost, "overflow" if lost else "")
        self._at, self._made, self._count = self._at + n, self._made + n, self._count + 1
        return block

    def stop(self) -> None:
        """Nothing to stop."""

    def close(self) -> None:
        """Nothing to give back."""


def record(
    out: Annotated[Path, typer.Option("--out", "-o", help="A folder on the disk to measure; it is made and removed.")],
    seconds: Annotated[float, typer.Option(help="How long.")] = 30.0,
    mb_s: Annotated[float, typer.Option(help="Megabytes a second; 260 is 400x250 at 20 kHz with 416-bit rows.")] = 260,
    ring_s: Annotated[float, typer.Option(help="Seconds of data between camera and disk.")] = 1.0,
    direct: Annotated[bool, typer.Option(help="O_DIRECT, or through the page cache.")] = True,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Record at a camera's pace to a disk and tell what was lost and what it cost: exit 1 on loss.

    The source is emulated in this process: it keeps time, and loses what waits longer than a USB queue of 16 MiB holds.
    """
    if not (0 < seconds <= 3600 and 1 <= mb_s <= 10_000):
        raise UsageError("not a time or speed to measure", value=(seconds, mb_s), expected="up to 3600 s, 1-10000 MB/s")
    told = measure(out, seconds, mb_s * 1e6, ring_s, direct)
    if as_json:
        emit("spikerig.cost.record/1", told)
    note(
        f"{told['mb_s_asked']:.0f} MB/s for {told['seconds']:.1f} s: {told['mb_s']:.1f} MB/s on disk, lost "
        f"{told['lost_transport']} B on the link and {told['lost_recorder']} B in the recorder, ring at most "
        f"{told['high_water']} of {told['slots']}, reader at most {told['reader_late_ms']:.0f} ms late, "
        f"{told['cpu_s']:.1f} s of CPU; {told['trouble'] or 'all well'}"
    )
    if told["lost_transport"] or told["lost_recorder"] or told["trouble"]:
        raise typer.Exit(1)


def measure(folder: Path, seconds: float, bytes_s: float, ring_s: float, direct: bool) -> dict[str, Any]:
    """Record for so long into a new folder, which is removed again; what came of it.

    Raises:
        UsageError: the folder exists.
        HostError: the disk has not the room.
    """
    from spikerig.dataset import machine
    from spikerig.rigctl.recorder import Recorder, RecorderOptions

    if folder.exists():
        raise UsageError("the folder exists already", value=folder, next="give another: it is removed afterwards")
    profile = WireProfile("paced", 400, 250, 416, bytes_s / 13_000)
    host, waits = RealHost(), []
    source = PacedSource(profile, host)
    options = RecorderOptions(ring_s=ring_s, memory=8 << 30, direct=direct)
    cpu = resource.getrusage(resource.RUSAGE_SELF)
    try:
        recorder = Recorder(source, folder, host, 1, options=options, event=waits.append)
        recorder.start()
        began = time.monotonic()
        recorder.keep()
        host.sleep_until(host.now_ns() + round(seconds * 1e9))
        took = time.monotonic() - began
        recorder.pause()
        recorder.close()
        state = recorder.state()
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    now = resource.getrusage(resource.RUSAGE_SELF)
    return {
        "mb_s_asked": bytes_s / 1e6,
        "mb_s": state.kept_bytes / took / 1e6,
        "seconds": took,
        "bytes": state.kept_bytes,
        "lost_transport": state.lost_transport,
        "lost_recorder": state.lost_recorder,
        "high_water": state.high_water,
        "slots": state.slots,
        "reader_late_ms": source.worst_backlog / bytes_s * 1e3,
        "cpu_s": now.ru_utime + now.ru_stime - cpu.ru_utime - cpu.ru_stime,
        "trouble": state.trouble,
        "events": waits,
        "machine": machine.describe(),
    }
