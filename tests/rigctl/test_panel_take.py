"""From a take's bytes and clips, by the panel in them, to both cameras in rig time: against the oscillators."""

import json
import shutil
from dataclasses import asdict, replace

import numpy as np
import panel_worlds as worlds
import pytest
import xxhash

from spikerig.calib.clock_cli import read_clocks
from spikerig.dataset.cli import run
from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.images import srgb8_from_linear
from spikerig.dataset.marks import MarkLog, Sight, read_marks
from spikerig.dataset.panel import Panel
from spikerig.dataset.rawtake import WireBytes, open_take
from spikerig.dataset.segments import STAMP, ChunkHead, encode_head, padded
from spikerig.dataset.wire import WireProfile
from spikerig.rigctl import panel_take
from spikerig.rigctl.ingest_sights import found_in
from spikerig.rigctl.panel_take import read_spots
from spikerig.rigctl.sim.emulate.clockworld import HIGH_SPEED, World
from spikerig.rigctl.sim.emulate.gopro_mp4 import Recording, write_clip

WIRE = WireProfile("small", 200, 64, 200, 20_000)
FIRST, OFFSET, TICKS, FRAMES = 2000, 37, 6000, 150
PANEL = Panel(bits=15, slow=6)  # 3.3 s; exposures of 1/480 s and a read-out of 7 ms
SPIKE = worlds.spots(PANEL, 200, 64, 1.8)
RGB = worlds.spots(PANEL, 480, 270, 3.1)


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    folder = tmp_path_factory.mktemp("panel") / "take"
    (folder / "spikes").mkdir(parents=True)
    (folder / "rgb").mkdir()
    world = World(5)
    box = world.clocks["box"].device_from_true
    t0 = round((FIRST + OFFSET / WIRE.tick_bytes - 1) / WIRE.rate_hz * NS)
    stream = worlds.spikes_of(
        PANEL, SPIKE, TICKS, lambda d: box(world.clocks["spike"].true_from_device(d)), rate_hz=20_000.0, t0_ns=t0,
        shape=(64, 200),
    )  # fmt: skip
    data = np.frombuffer(stream.bits[:, ::-1].tobytes(), np.uint8)
    head = ChunkHead(9, 0, 0, FIRST * WIRE.tick_bytes + OFFSET, WIRE.tick_bytes, 0, 1, why="start", payload=len(data))
    head = replace(head, digest=xxhash.xxh3_64_intdigest(data.data))
    (folder / "spikes" / "0000.seg").write_bytes(
        encode_head(head, np.zeros(0, STAMP)) + data.tobytes().ljust(padded(len(data)), b"\0")
    )
    begun = 300_000_000

    def picture(start, exposure, row_ns):
        looks = worlds.frames_of(PANEL, RGB, [start], exposure, row_ns, box, noise=0.0)
        return np.repeat(srgb8_from_linear(next(looks)[2])[..., None], 3, -1)

    shot = Recording(world.clocks["rgb"], begun, FRAMES)
    clips = [p.name for p in write_clip(folder / "rgb", 42, shot, picture, 1 << 40)]
    around = [int(world.at("host", begun - 130_000_000)), int(world.at("host", begun - 20_000_000))]
    told = {"format": "spikerig-take", "version": 1, "status": "complete", "number": 9, "plan": {}, "devices": [],
            "wire": {**asdict(WIRE), "sure": {}}}  # fmt: skip
    (folder / "take.json").write_text(json.dumps(told))
    span = [0, FIRST * WIRE.tick_bytes + OFFSET, (FIRST + TICKS) * WIRE.tick_bytes + OFFSET]
    view = {"name": "a", "attempt": 1, "start_ns": 0, "stop_ns": 9, "spikes": [span], "clips": clips, "checks": {},
            "kept": True, "clip": {"name": clips[0], "bytes": 1, "start_ns": around, "stop_ns": around}}  # fmt: skip
    (folder / "views.jsonl").write_text(json.dumps(view) + "\n")
    log = MarkLog(folder / "marks.jsonl")
    log.add(world.probes(4, HIGH_SPEED) + world.stamps(4))
    log.close()
    spots = {"schema": "spikerig.panel/1", "panel": {"step_ns": 100_000, "bits": 15, "slow": 6}}
    for name, row in (("spike", SPIKE), ("rgb", RGB)):
        spots[name] = [[s.led, s.x_px, s.y_px, s.radius_px] for s in row]
    (folder.parent / "spots.json").write_text(json.dumps(spots))
    return world, folder, shot


class Known:  # where ticks begin is found elsewhere, from pictures with more in them than LEDs
    def __init__(self, *_):
        pass

    def offset(self, epoch):
        return OFFSET


def test_a_panel_is_found_by_its_blinking(taken, monkeypatch, tmp_path):
    told = json.loads((taken[1].parent / "spots.json").read_text())
    folder = shutil.copytree(taken[1], tmp_path / "take")
    (tmp_path / "find.json").write_text(json.dumps(told | {"spike": "find", "rgb": "find"}))
    monkeypatch.setattr(panel_take, "Framing", Known)
    take = open_take(folder)
    view = read_spots(tmp_path / "find.json")
    assert view.find == ("spike", "rgb")
    found = found_in(take, take.views(), view, WireBytes(take), Known())
    for got, true in ((found.spike, SPIKE), (found.rgb, RGB)):
        by_led = {s.led: s for s in got}
        assert sorted(by_led) == list(range(2 * PANEL.bits))  # those that are always on tell no time
        off = [np.hypot(by_led[s.led].x_px - s.x_px, by_led[s.led].y_px - s.y_px) for s in true if s.led in by_led]
        assert max(off) < 0.6
        assert got[0].radius_px == pytest.approx(true[0].radius_px, abs=0.7)
    told = panel_take.read_panel(folder, view, force=True)
    assert told["trouble"] == []
    assert told["spike"] > 30
    assert told["rgb"] > 50
    short = replace(view, panel=Panel(bits=4, slow=2))
    with pytest.raises(DataError, match="so short a look"):
        found_in(take, take.views(), short, WireBytes(take), Known())
    other = replace(view, panel=Panel(step_ns=83_000, bits=15, slow=6))
    with pytest.raises(DataError, match="blink"):
        found_in(take, take.views(), other, WireBytes(take), Known())


def test_a_takes_panel_ties_both_cameras_to_the_rig(taken, monkeypatch, capsys):
    world, folder, shot = taken

    monkeypatch.setattr(panel_take, "Framing", Known)
    assert run(["rig", "panel", str(folder), str(folder.parent / "spots.json"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["spike"] > 30
    assert told["rgb"] > 50
    assert run(["rig", "panel", str(folder), str(folder.parent / "spots.json")]) == 2  # not twice unasked
    assert run(["rig", "panel", str(folder), str(folder.parent / "spots.json"), "--force"]) == 0
    assert sum(isinstance(m, Sight) for m in read_marks(folder / "marks.jsonl")) == told["spike"] + told["rgb"]
    assert run(["calib", "clock", str(folder)]) == 0
    clocks = read_clocks(folder / "clock.json")

    at = world.clocks["spike"].true_from_device(np.linspace(0.11, 0.39, 200) * NS)
    spike = clocks.fit("spike", 0)
    off = np.abs(world.off_ns(spike.model, "spike", at, clocks.origin_ns))
    assert np.percentile(off, 99) <= 25_000
    assert (off <= spike.uncertainty_ns(world.at("spike", at))).mean() >= 0.95

    rgb = clocks.fit("rgb", 42)
    half = round(NS / 960)
    middles = rgb.model.rig_from_device(shot.media_ns[:FRAMES] + half)
    off = np.abs(middles - (world.at("box", shot.true_starts_ns[:FRAMES] + half) - clocks.origin_ns))
    assert np.percentile(off, 99) <= 100_000
    assert (off <= rgb.uncertainty_ns(shot.media_ns[:FRAMES] + half)).mean() >= 0.95


def test_a_take_without_a_panel_is_told(taken, tmp_path):
    _, folder, _ = taken
    spots = read_spots(folder.parent / "spots.json")
    away = replace(spots, spike=(), rgb=tuple(replace(s, x_px=2.0, y_px=130.0, radius_px=1.0) for s in spots.rgb))
    with pytest.raises(DataError, match="nothing in this take"):
        panel_take.read_panel(folder, away, force=True)


@pytest.mark.parametrize(
    "spoil",
    [b"", b"[]", b'{"schema": "x"}', b'{"schema": "spikerig.panel/1", "panel": {"bits": 99}, "spike": [], "rgb": []}',
     b'{"schema": "spikerig.panel/1", "panel": {}, "spike": [[999, 1, 1, 1]], "rgb": []}',
     b'{"schema": "spikerig.panel/1", "panel": {}, "spike": [], "rgb": []}',
     b'{"schema": "spikerig.panel/1", "panel": {"colour": 1}, "spike": [[0, 1, 1, 1]], "rgb": []}'],
)  # fmt: skip
def test_files_of_spots_are_not_believed(tmp_path, spoil):
    (tmp_path / "s.json").write_bytes(spoil)
    with pytest.raises(DataError):
        read_spots(tmp_path / "s.json")
    with pytest.raises(UsageError):
        read_spots(tmp_path / "none.json")
