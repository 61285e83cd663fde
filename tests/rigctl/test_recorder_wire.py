"""Faults on the emulated bus, through driver and recorder to the segments: each gap's record against the true gap.

Every word of the stream is its own number (`vidar_bench.Numbered`), so what is on disk tells what is missing.
"""

import errno
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from framing_scenes import wire_bytes
from slow_disk import SlowDisk
from vidar_bench import MID, MS, camera

from spikerig.dataset.errors import DeviceError
from spikerig.dataset.framing import find_phase, rates_at
from spikerig.dataset.segments import PAGE, Chunk, Damage, scan
from spikerig.rigctl.recorder import SLOW, Recorder, RecorderOptions
from spikerig.rigctl.sim.emulate.spikewire import Loop
from spikerig.rigctl.vidar import VidarSource

S = 1000 * MS
QUIET = ("direct-io", "set-aside", "framing", "ring")  # "ring": emulated time runs faster than this disk


@dataclass
class Run:
    """A recorder on an emulated camera, and what it said."""

    recorder: Recorder
    bridge: Any
    told: list[dict[str, Any]]

    def kinds(self) -> list[str]:
        return [t["kind"] for t in self.told if t["kind"] not in QUIET]


def started(folder: Path, faults: Any = (), **options: Any) -> Run:
    host, bus, bridge = camera(MID, faults=faults, ram_bytes=2_000_000)
    told: list[dict[str, Any]] = []
    source = VidarSource(MID, host, bus, patience_ns=2 * S)
    chosen = RecorderOptions(**{"ring_s": 0.5, "on_full": "wait", "segment_bytes": 8 << 20, **options})
    recorder = Recorder(source, folder, host, 1, options=chosen, event=told.append)
    return Run(recorder, bridge, told)


def record(run: Run, until_s: float) -> list[tuple[int, int, int]]:
    host = run.recorder.host
    with host.worker("main"):
        run.recorder.start()
        run.recorder.keep()
        host.sleep_until(round(until_s * S))
        spans = run.recorder.pause()
        run.recorder.close()
    return spans


@dataclass
class Gap:
    """Between two chunks: what the second one's header says, and what is truly missing there."""

    why: str
    transport: int
    recorder: int
    suspect: int
    true: int
    epochs: tuple[int, int]


def stored(folder: Path) -> tuple[list[Chunk], list[Gap]]:
    """The chunks, each free of gaps but in a suspect end; and the gaps between them."""
    found = [one for path in sorted(folder.glob("*.seg")) for one in scan(path, take=1)]
    assert not [one for one in found if isinstance(one, Damage)]
    chunks = [one for one in found if isinstance(one, Chunk)]
    words = [c.read().view(np.uint32).astype(np.int64) for c in chunks]
    gaps = []
    suspects = {b.head.epoch - 1: b.head.suspect for b in reversed(chunks) if b.head.byte_index == 0}
    for chunk, inside in zip(chunks, words, strict=True):
        last = max(c.head.byte_index + c.head.payload for c in chunks if c.head.epoch == chunk.head.epoch)
        sure = (last - suspects.get(chunk.head.epoch, 0) - chunk.head.byte_index) // 4
        assert all(at + 1 >= sure for at in np.flatnonzero(np.diff(inside) != 1))
    for (one, a), (two, b) in pairwise(zip(chunks, words, strict=True)):
        head = two.head
        true = 4 * int(b[0] - a[-1] - 1)
        if true or head.epoch != one.head.epoch:
            gaps.append(Gap(head.why, head.lost_transport, head.lost_recorder, head.suspect, true,
                            (one.head.epoch, head.epoch)))  # fmt: skip
    return chunks, gaps


@pytest.mark.parametrize("kind", ["stall", "overflow", "io", "interrupted", "unplug"])
def test_an_error_on_the_bus_becomes_a_gap_record(tmp_path: Path, kind: str) -> None:
    more = {"for_s": 0.2} if kind == "unplug" else {}
    run = started(tmp_path, [{"kind": kind, "at_s": 0.5, **more}])
    spans = record(run, 1.0)
    _, (gap,) = stored(tmp_path)
    assert gap.why == {"unplug": "unplugged"}.get(kind, kind)
    assert gap.epochs == (0, 1)
    assert gap.true > 0
    assert abs(gap.transport - gap.true) < 300  # by the time: the camera's pace is known to some ppm
    assert gap.recorder == 0
    assert [e for e, _, _ in spans] == [0, 1]
    assert run.kinds() == ["transport"]
    (told,) = [t for t in run.told if t["kind"] == "transport"]
    assert (told["lost_bytes"], told["suspect_bytes"]) == (gap.transport, gap.suspect)
    assert run.recorder.state().lost_transport == gap.transport


def test_a_loss_that_no_error_tells_is_in_the_gap_record_with_its_suspects(tmp_path: Path) -> None:
    run = started(tmp_path, [{"kind": "drop", "at_s": 0.7, "bytes": 6400}])
    record(run, 1.2)
    chunks, (gap,) = stored(tmp_path)
    assert (gap.why, gap.epochs) == ("rate", (0, 1))
    assert abs(gap.transport - 6400) < 300
    before = np.concatenate([c.read() for c in chunks if c.head.epoch == 0])[-gap.suspect :]
    steps = np.diff(before.view(np.uint32).astype(np.int64)) - 1
    assert 4 * steps.max() == 6400  # it lies among the suspect bytes


def test_after_a_loss_the_framing_is_found_again_and_told(tmp_path: Path) -> None:
    data = wire_bytes(MID, "texture", 256)
    host, bus, _ = camera(MID, Loop(data), faults=[{"kind": "overflow", "at_s": 0.5}], ram_bytes=2_000_000)
    told: list[dict[str, Any]] = []
    options = RecorderOptions(ring_s=0.5, on_full="wait")
    run = Run(Recorder(VidarSource(MID, host, bus), tmp_path, host, 1, options=options, event=told.append), bus, told)
    record(run, 1.0)
    (found,) = [t for t in told if t["kind"] == "framing"]
    raw = {c.head.epoch: c for path in sorted(tmp_path.glob("*.seg")) for c in reversed(list(scan(path, take=1)))
           if isinstance(c, Chunk)}  # fmt: skip
    size = 64 * MID.tick_bytes
    begin = {e: find_phase(np.resize(raw[e].read()[:size], size), MID, like=rates_at(data, MID, 0)) for e in (0, 1)}
    assert min(b.confidence for b in begin.values()) > 0.999
    starts = {e: (raw[e].head.byte_index + begin[e].offset) % MID.tick_bytes for e in (0, 1)}
    assert found["shift"] == (starts[1] - starts[0]) % MID.tick_bytes
    assert found["confidence"] > 0.999


def test_a_camera_that_stays_away_costs_nothing_that_came(tmp_path: Path) -> None:
    run = started(tmp_path, [{"kind": "unplug", "at_s": 0.5}])
    spans = record(run, 4.0)
    chunks, gaps = stored(tmp_path)
    assert gaps == []
    assert sum(c.head.payload for c in chunks) == sum(b - a for _, a, b in spans) > 0.4 * MID.bytes_s
    assert run.recorder.state().trouble == "the spike camera went away and did not come back"
    assert run.recorder.dead
    assert run.kinds() == ["silent", "stopped", "device"]


def test_keeping_ends_before_the_ring_runs_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk, run = SlowDisk(monkeypatch), started(tmp_path, on_full="stop")
    recorder, host = run.recorder, run.recorder.host
    with host.worker("main"):
        recorder.start()
        recorder.keep()
        host.sleep_until(2 * S)
        stopped = recorder.state()
        disk.gate.set()
        first = recorder.pause()
        recorder.keep()
        host.sleep_until(host.now_ns() + 200 * MS)
        second = recorder.pause()
        recorder.close()
    assert (stopped.trouble, stopped.keeping) == (SLOW, False)
    assert stopped.high_water < stopped.slots
    _, (gap,) = stored(tmp_path)
    assert gap.epochs == (0, 0)
    assert (gap.transport, gap.recorder) == (0, 0)
    assert gap.true == second[0][1] - first[0][2]  # not wanted, and not lost
    assert run.kinds() == ["stopped"]
    assert [t["kind"] for t in run.told].count("ring") == 2  # half full, three quarters full


def test_losses_of_the_recorder_are_counted_apart_from_the_links(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk, run = SlowDisk(monkeypatch), started(tmp_path, [{"kind": "overflow", "at_s": 2.5}], on_full="drop")
    recorder, host = run.recorder, run.recorder.host
    with host.worker("main"):
        recorder.start()
        recorder.keep()
        host.sleep_until(1500 * MS)
        disk.gate.set()
        while host.now_ns() < 3 * S:  # from here on the disk keeps up
            recorder.ring.drained(30)
            host.sleep_until(host.now_ns() + 50 * MS)
        recorder.pause()
        recorder.close()
    _, (full, link) = stored(tmp_path)
    assert (full.why, full.transport, full.recorder) == ("ring full", 0, full.true)  # to the byte
    assert (link.why, link.recorder) == ("overflow", 0)
    assert abs(link.transport - link.true) < 300
    state = recorder.state()
    assert (state.lost_recorder, state.lost_transport) == (full.true, link.transport)


def test_a_full_disk_keeps_what_it_took(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real, room = os.pwrite, [3]

    def pwrite(fd: int, data: memoryview, at: int) -> int:
        room[0] -= 1
        if room[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(fd, data, at)

    monkeypatch.setattr(os, "pwrite", pwrite)
    run = started(tmp_path)
    record(run, 1.5)
    chunks, gaps = stored(tmp_path)
    assert (len(chunks), gaps) == (3, [])
    state = run.recorder.state()
    assert state.trouble == "the disk is full"
    assert sum(c.head.payload for c in chunks) + state.lost_recorder == state.kept_bytes


CHILD = """
import sys
from pathlib import Path
from slow_disk import SlowDisk
from vidar_bench import MID, camera
from spikerig.rigctl.host import RealHost
from spikerig.rigctl.recorder import Recorder, RecorderOptions
from spikerig.rigctl.vidar import VidarSource
host, bus, bridge = camera(MID, host=RealHost(), ram_bytes=1 << 28)
source = VidarSource(MID, host, bus)
def acknowledged(head, path, offset):
    print(head.number, path.name, offset, f"{head.digest:016x}", flush=True)
options = RecorderOptions(segment_bytes=4 << 20, ring_s=1.0)
recorder = Recorder(source, Path(sys.argv[1]), host, 1, options=options, acknowledged=acknowledged)
recorder.start()
recorder.keep()
host.sleep_until(host.now_ns() + 60_000_000_000)
"""


@pytest.mark.parametrize("seed", range(3))
def test_kill_9_while_the_bus_streams(tmp_path: Path, seed: int) -> None:
    """Three moments with driver and bus; twenty without in test_recorder.py."""
    paths = os.pathsep.join([str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")])
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(tmp_path)], stdout=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": paths},
    )  # fmt: skip
    assert child.stdout is not None
    lines = [child.stdout.readline()]  # the first acknowledgement; then a random moment
    time.sleep(np.random.default_rng(seed).uniform(0, 0.5))
    os.kill(child.pid, signal.SIGKILL)
    lines += child.stdout.readlines()
    child.stdout.close()
    child.wait()
    told = [line.split() for line in lines if line.endswith("\n")]
    found = [one for path in sorted(tmp_path.glob("*.seg")) for one in scan(path, take=1)]
    there = [c for c in found if isinstance(c, Chunk)]
    heads = [[str(c.head.number), c.path.name, str(c.offset - PAGE), f"{c.head.digest:016x}"] for c in there]
    assert told
    assert heads[: len(told)] == told
    for chunk in there[: len(told)]:
        words = chunk.read().view(np.uint32).astype(np.int64)
        assert np.all(np.diff(words) == 1) or chunk.head.epoch < there[-1].head.epoch


def test_a_camera_that_never_comes_is_an_error_at_once() -> None:
    host, bus, _ = camera(MID, faults=[{"kind": "unplug", "at_s": 0.0}])
    with pytest.raises(DeviceError, match="no spike camera"):
        VidarSource(MID, host, bus)
