"""The recorder: every byte that came is on disk or listed, whatever the disk, the link or a kill does."""

import errno
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from slow_disk import SlowDisk

from spikerig.dataset.errors import DeviceError, HostError
from spikerig.dataset.segments import PAGE, Chunk, Damage, scan
from spikerig.dataset.wire import WireProfile
from spikerig.rigctl.devices import Block
from spikerig.rigctl.host import RealHost
from spikerig.rigctl.record_cost import PacedSource
from spikerig.rigctl.recorder import SLOW, Recorder, RecorderOptions
from spikerig.rigctl.ring import Ring, ring_slots
from spikerig.rigctl.sim.emulate.virtual import VirtualHost

MS = 1_000_000
WIRE = WireProfile("small", 64, 48, 72, 20_000, packet_bytes=8192)  # 432 B a tick, 8.64 MB/s, 1024 ticks a chunk
SMALL = RecorderOptions(ring_s=0.5, on_full="wait", segment_bytes=1 << 20)


def pattern(source: PacedSource, start: int, stop: int) -> np.ndarray:
    return source._pattern[np.arange(start, stop) % source.period]


def chunks(folder: Path) -> list[Chunk]:
    found = [one for path in sorted(folder.glob("*.seg")) for one in scan(path, take=1)]
    assert not [one for one in found if isinstance(one, Damage)]
    return [one for one in found if isinstance(one, Chunk)]


def run(tmp_path: Path, options: RecorderOptions = SMALL, **more: int) -> tuple[Recorder, PacedSource, list, list]:
    host = VirtualHost()
    source = PacedSource(WIRE, host, **more)
    told: list = []
    acked: list = []
    recorder = Recorder(
        source, tmp_path / "spikes", host, 1, options=options, event=told.append,
        acknowledged=lambda head, path, offset: acked.append((head, path, offset)),
    )  # fmt: skip
    return recorder, source, told, acked


def test_what_is_kept_is_what_came_to_the_byte(tmp_path: Path) -> None:
    recorder, source, told, acked = run(tmp_path)
    host = recorder.host
    with host.worker("main"):
        recorder.start()
        spans = []
        for _ in range(3):
            host.sleep_until(host.now_ns() + 77 * MS)
            recorder.keep()
            host.sleep_until(host.now_ns() + 200 * MS)
            spans += recorder.pause()
        recorder.close()
    found = chunks(tmp_path / "spikes")
    assert [c.head for c in found] == [head for head, _, _ in acked]
    assert [c.head.number for c in found] == list(range(len(found)))
    assert len({c.path for c in found}) > 2  # several segments
    for epoch, start, stop in spans:
        assert epoch == 0
        assert start % WIRE.tick_bytes == 0
        assert stop - start == pytest.approx(0.2 * WIRE.bytes_s, abs=3 * WIRE.packet_bytes)
    at = 0
    for chunk in found:
        head = chunk.head
        assert head.byte_index == at + head.skipped
        at = head.byte_index + head.payload
        assert np.array_equal(chunk.read(), pattern(source, head.byte_index, at))
        ends = chunk.stamps["end"].astype(int) + head.byte_index
        late = chunk.stamps["after_ns"] / 1e9 - ends / WIRE.bytes_s
        assert np.all(late[:-1] < 1e-6)  # a packet comes when its last byte was made; the last may be cut
        assert np.all(late > -WIRE.packet_bytes / WIRE.bytes_s)
    assert sum(stop - start for _, start, stop in spans) == sum(c.head.payload for c in found)
    assert [e for e in told if e["kind"] not in ("direct-io", "set-aside", "ring")] == []


def test_payloads_are_aligned_and_whole(tmp_path: Path) -> None:
    recorder, _, _, acked = run(tmp_path)
    with recorder.host.worker("main"):
        recorder.start()
        recorder.keep()
        recorder.host.sleep_until(300 * MS)
        recorder.pause()
        recorder.close()
    assert recorder.payload % PAGE == 0
    assert recorder.payload % WIRE.tick_bytes == 0
    assert {head.payload for head, _, _ in acked[:-1]} == {recorder.payload}
    assert all(offset % PAGE == 0 for _, _, offset in acked)
    assert not list((tmp_path / "spikes").glob("*.next"))


class Lossy(PacedSource):
    """Loses 1000 bytes after each 40th packet, as a driver tells it."""

    def read(self, timeout_ns: int) -> Block | None:
        block = super().read(timeout_ns)
        if block is not None and self._count % 40 == 0:
            self._epoch, self._at = self._epoch + 1, len(block.data)
            return Block(block.data, self._epoch, 0, block.before_ns, block.after_ns, 1000, "overflow")
        return block


def test_losses_on_the_link_begin_an_epoch_and_are_listed(tmp_path: Path) -> None:
    host = VirtualHost()
    told: list = []
    recorder = Recorder(Lossy(WIRE, host), tmp_path, host, 1, options=SMALL, event=told.append)
    with host.worker("main"):
        recorder.start()
        recorder.keep()
        host.sleep_until(1000 * MS)
        spans = recorder.pause()
        recorder.close()
    losses = [e for e in told if e["kind"] == "transport"]
    state = recorder.state()
    assert len(losses) >= 3
    assert state.lost_transport == 1000 * len(losses) == sum(c.head.lost_transport for c in chunks(tmp_path))
    assert state.lost_recorder == 0
    assert [e for e, _, _ in spans] == list(range(len(spans)))
    first = {c.head.epoch: c.head for c in reversed(chunks(tmp_path))}
    assert all(first[e].why == "overflow" and first[e].byte_index == 0 for e in range(1, len(spans)))


def test_a_slow_disk_ends_recording_before_anything_is_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = SlowDisk(monkeypatch)
    recorder, source, told, _ = run(tmp_path, RecorderOptions(ring_s=0.5))
    host = recorder.host
    with host.worker("main"):
        recorder.start()
        recorder.keep()
        host.sleep_until(2000 * MS)
        state = recorder.state()
        disk.gate.set()
        spans = recorder.pause()
        assert state.trouble == SLOW
        assert not state.keeping
        assert state.high_water <= state.slots - 1
        recorder.keep()  # the operator tries again
        host.sleep_until(host.now_ns() + 100 * MS)
        spans += recorder.pause()
        recorder.close()
    assert recorder.state().lost_recorder == recorder.state().lost_transport == 0
    kinds = [e["kind"] for e in told]
    assert kinds.count("ring") == 2  # half full, three quarters full: told once each
    assert kinds.count("stopped") == 1
    (_, a, b), (_, c, d) = spans
    found = chunks(tmp_path / "spikes")
    assert sum(x.head.payload for x in found) == b - a + d - c
    assert sum(x.head.skipped for x in found) == a + c - b
    for one in found:
        assert np.array_equal(one.read(), pattern(source, one.head.byte_index, one.head.byte_index + one.head.payload))


def test_dropping_counts_every_byte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = SlowDisk(monkeypatch)
    recorder, _, told, _ = run(tmp_path, RecorderOptions(ring_s=0.3, on_full="drop"))
    host = recorder.host
    with host.worker("main"):
        recorder.start()
        recorder.keep()
        host.sleep_until(2000 * MS)
        disk.gate.set()
        recorder.ring.drained(30)
        host.sleep_until(host.now_ns() + 300 * MS)
        recorder.pause()
        recorder.close()
    state, at = recorder.state(), 0
    found = chunks(tmp_path / "spikes")
    for one in found:
        assert one.head.byte_index == at + one.head.lost_recorder + one.head.skipped
        at = one.head.byte_index + one.head.payload
    assert state.lost_recorder == sum(c.head.lost_recorder for c in found) > 0
    assert state.lost_transport == 0
    assert [e["kind"] for e in told].count("recorder") == 1
    assert {c.head.why for c in found} == {"start", "ring full", ""}


def test_a_full_disk_is_said_and_what_did_not_fit_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real, room = os.pwrite, [3]

    def pwrite(fd: int, data: memoryview, at: int) -> int:
        room[0] -= 1
        if room[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(fd, data, at)

    monkeypatch.setattr(os, "pwrite", pwrite)
    recorder, _, told, acked = run(tmp_path)
    host = recorder.host
    with host.worker("main"):
        recorder.start()
        recorder.keep()
        host.sleep_until(1000 * MS)
        assert recorder.state().trouble == "the disk is full"
        recorder.pause()
        recorder.close()
    assert len(acked) == 3 == len(chunks(tmp_path / "spikes"))
    state = recorder.state()
    assert state.lost_recorder == sum(e.get("lost_bytes", 0) for e in told)
    assert state.lost_recorder + sum(h.payload for h, _, _ in acked) == state.kept_bytes


def test_a_file_system_without_o_direct_is_told_and_works(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = os.open

    def refuses(path: object, flags: int, *more: int, **other: int) -> int:
        if flags & os.O_DIRECT:
            raise OSError(errno.EINVAL, "Invalid argument")
        return real(path, flags, *more, **other)  # type: ignore[arg-type]

    monkeypatch.setattr(os, "open", refuses)
    recorder, _, told, _ = run(tmp_path)
    with recorder.host.worker("main"):
        recorder.start()
        recorder.keep()
        recorder.host.sleep_until(200 * MS)
        recorder.pause()
        recorder.close()
    assert [e["kind"] for e in told] == ["direct-io"]
    assert sum(c.head.payload for c in chunks(tmp_path / "spikes")) == recorder.state().kept_bytes


class Dies(PacedSource):
    def read(self, timeout_ns: int) -> Block | None:
        if self._count == 50:
            raise DeviceError("the spike camera is gone", value="unplugged")
        return super().read(timeout_ns)


def test_a_camera_that_dies_costs_nothing_that_came(tmp_path: Path) -> None:
    host = VirtualHost()
    told: list = []
    recorder = Recorder(Dies(WIRE, host), tmp_path, host, 1, options=SMALL, event=told.append)
    with host.worker("main"):
        recorder.start()
        recorder.keep()
        host.sleep_until(1000 * MS)
        spans = recorder.pause()
        assert recorder.state().trouble == "the spike camera is gone"
        assert recorder.peek(10) is None
        recorder.close()
        recorder.close()
    assert [(e["kind"], e["words"]) for e in told][-1] == ("device", "the spike camera is gone: unplugged")
    assert spans == [(0, 0, 50 * WIRE.packet_bytes)]
    assert sum(c.head.payload for c in chunks(tmp_path)) == 50 * WIRE.packet_bytes


class Mute(PacedSource):
    def read(self, timeout_ns: int) -> Block | None:
        self.host.sleep_until(self.host.now_ns() + timeout_ns)
        return None


def test_a_silent_camera_is_told_once(tmp_path: Path) -> None:
    host = VirtualHost()
    told: list = []
    recorder = Recorder(Mute(WIRE, host), tmp_path, host, 1, options=SMALL, event=told.append)
    with host.worker("main"):
        recorder.start()
        host.sleep_until(5000 * MS)
        recorder.close()
    assert [e["kind"] for e in told] == ["silent"]


def test_a_look_at_the_stream_is_whole_ticks_kept_or_not(tmp_path: Path) -> None:
    recorder, source, _, _ = run(tmp_path)
    with recorder.host.worker("main"):
        recorder.start()
        seen = recorder.peek(100)
        recorder.close()
    assert seen is not None
    assert seen.shape == (100, WIRE.tick_bytes)
    ticks = np.resize(source._pattern[: source.period], source.period * WIRE.tick_bytes).reshape(-1, WIRE.tick_bytes)
    first = int(np.flatnonzero((ticks == seen[0]).all(1))[0])
    assert np.array_equal(np.take(ticks, range(first, first + 100), axis=0, mode="wrap"), seen)


def test_a_ring_that_does_not_fit_its_memory_is_refused_with_numbers() -> None:
    assert ring_slots(0.0512, 1.0, 12_800_000, 1 << 30) == 22
    with pytest.raises(HostError, match="memory it may have") as caught:
        ring_slots(0.0512, 10.0, 12_800_000, 1 << 30)
    assert "198 buffers" in str(caught.value)
    assert Ring(PAGE, 22).brim == 20


CHILD = """
import sys
from pathlib import Path
from spikerig.dataset.wire import WireProfile
from spikerig.rigctl.host import RealHost
from spikerig.rigctl.record_cost import PacedSource
from spikerig.rigctl.recorder import Recorder, RecorderOptions
host = RealHost()
source = PacedSource(WireProfile("k", 400, 250, 400, 4000), host, fifo=1 << 30)
def acknowledged(head, path, offset):
    print(head.number, path.name, offset, f"{head.digest:016x}", flush=True)
options = RecorderOptions(segment_bytes=8 << 20, ring_s=1.0)
recorder = Recorder(source, Path(sys.argv[1]), host, 1, options=options, acknowledged=acknowledged)
recorder.start()
recorder.keep()
host.sleep_until(host.now_ns() + 60_000_000_000)
"""


@pytest.mark.parametrize("seed", range(20))
def test_kill_9_costs_no_acknowledged_chunk(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    child = subprocess.Popen([sys.executable, "-c", CHILD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    lines = [child.stdout.readline()]  # the first acknowledgement; then a random moment
    time.sleep(rng.uniform(0, 0.3))
    os.kill(child.pid, signal.SIGKILL)
    lines += child.stdout.readlines()
    child.stdout.close()
    child.wait()
    told = [line.split() for line in lines if line.endswith("\n")]
    found = [one for path in sorted(tmp_path.glob("*.seg")) for one in scan(path, take=1)]
    there = [
        [str(c.head.number), c.path.name, str(c.offset - PAGE), f"{c.head.digest:016x}"]
        for c in found
        if isinstance(c, Chunk)
    ]
    assert told
    assert there[: len(told)] == told
    assert len(there) <= len(told) + 1  # one may have been on its way
    assert sum(isinstance(one, Damage) for one in found) <= 1


def test_real_time(tmp_path: Path) -> None:
    host = RealHost()
    recorder = Recorder(PacedSource(WIRE, host, fifo=1 << 30), tmp_path, host, 1)
    recorder.start()
    recorder.keep()
    host.sleep_until(host.now_ns() + 200 * MS)
    spans = recorder.pause()
    recorder.close()
    assert (
        sum(b - a for _, a, b in spans) == recorder.state().kept_bytes == sum(c.head.payload for c in chunks(tmp_path))
    )
    assert recorder.state().synced == recorder.state().chunks > 0
