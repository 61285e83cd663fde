"""From a raw take to a scene: right in time, whole in spite of damage, honest about the rest."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from emulated_takes import plan_of, take
from framing_scenes import wire_bytes

from spikerig.calib.panel_read import Spot
from spikerig.dataset.cli import run
from spikerig.dataset.errors import DataError, RefusedError, UsageError
from spikerig.dataset.framing import Phase
from spikerig.dataset.kernels import count
from spikerig.dataset.marks import Sight, read_marks
from spikerig.dataset.rawtake import WireBytes, open_take, read_lines, verify_take
from spikerig.dataset.segments import Chunk, scan
from spikerig.dataset.store import open_scene, verify_scene
from spikerig.rigctl import ingest_times
from spikerig.rigctl.ingest import IngestConfig, ingest
from spikerig.rigctl.ingest_sights import panel_in_view, panel_pairs, sights
from spikerig.rigctl.ingest_slips import MendedBytes
from spikerig.rigctl.ingest_times import Framing, Times, clip_number, read_truth
from spikerig.rigctl.ingest_truth import TrueWorld
from spikerig.rigctl.profiles import PROFILES
from spikerig.rigctl.slips import find_slips


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ingest") / "take"
    tally = take(folder, plan_of(test_every=3))
    assert tally.status == "complete"
    return folder


@pytest.fixture
def folder(taken: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(taken, tmp_path / "take"))


def first_byte(folder: Path) -> int:
    """The camera's own number of the epoch's first byte, from what the rig says of itself."""
    (end,) = [told for _, told in read_lines(folder / "log.jsonl") if told["kind"] == "end"]
    return json.loads((folder / "truth.json").read_text())[0]["spike"][0]["sent"][-1][1] - end["bytes"]


def test_ticks_begin_where_the_camera_began_them(taken: Path) -> None:
    told = open_take(taken)
    framing = Framing(WireBytes(told), [s for v in told.views() for s in v.spikes])
    assert framing.offset(0) == -first_byte(taken) % 384


def test_viewpoints_tell_together_what_none_tells_alone(taken: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ingest_times, "find_phase", lambda *_: Phase(7, 0.5, "seam"))
    told = open_take(taken)
    spans = [s for v in told.views() for s in v.spikes]
    assert Framing(WireBytes(told), spans).offset(0) == -first_byte(taken) % 384
    noise = np.random.default_rng(3).integers(0, 256, 3 * 512 * 384, dtype=np.uint8)
    wire = SimpleNamespace(take=told, read=lambda epoch, start, stop: (noise[start:stop], []))
    with pytest.raises(RefusedError, match="where ticks begin"):
        Framing(wire, [(0, k * 512 * 384, (k + 1) * 512 * 384) for k in range(3)]).offset(0)  # type: ignore[arg-type]


def test_a_scene_right_in_time_and_place(taken: Path, tmp_path: Path) -> None:
    out = tmp_path / "s.h5"
    told = ingest(taken, out)
    assert (told["views"], told["test"], told["left_out"], told["lost_ticks"]) == (3, ["000"], {}, 0)
    assert verify_scene(out) == []
    with open_scene(out) as file:
        scene = file.read()
    raw = open_take(taken)
    truth = read_truth(raw)
    times = Times(raw, truth)
    world = TrueWorld(raw, times, truth).world
    for view in scene.views[1:]:
        spikes, frame = view.spikes, view.frame
        assert spikes is not None
        # every tick was exposed when the scene says
        true_t0 = int(times.true_from_rig(truth[0], np.array([spikes.t0_ns]))[0])
        device = 20_000 * (1 + 21e-6)
        assert spikes.rate_hz == pytest.approx(device / (1 + 8e-6), rel=2e-6)
        # the spikes cover the exposure and a margin
        rows = frame.row_ns * (frame.pixels.shape[0] - 1)
        margin = 256 / 20_000 * 1e9
        assert spikes.t0_ns <= frame.start_ns - margin
        assert spikes.t0_ns + spikes.ticks / spikes.rate_hz * 1e9 >= frame.start_ns + frame.exposure_ns + rows + margin
        # and hold the light of those instants: counts of 2 ms pieces against the world's own light
        number = int(view.name)
        gray = world.pictures(number) @ (np.array(world.spec.sensor.response) * world.spec.sensor.gain)
        off_ns = []
        for first in range(100, spikes.ticks - 140, 100):
            seen = count(spikes.bits, 64, first, first + 40).astype(float)
            mid = true_t0 + round((first + 20) / spikes.rate_hz * 1e9)
            off_ns.append(best_shift(world, gray, seen / 40, mid))
        assert abs(np.median(off_ns)) < 150_000
        assert np.allclose(view.pose.cam_from_world, world.poses(number, times.true_from_rig(truth[0],
                           np.array([view.mid_ns])))[0], atol=1e-9)  # fmt: skip


def best_shift(world, gray: np.ndarray, seen: np.ndarray, mid: int) -> float:
    """By how many ns the light that fits best lies beside the instant told."""
    shifts = np.arange(-1_000_000, 1_000_001, 50_000)
    wrong = []
    for shift in shifts:
        at = np.array([mid + shift]) + np.linspace(-1e6, 1e6, 9).astype(int)
        where = world.phase_at(at) * (len(gray) - 1)
        low = np.minimum(where.astype(int), len(gray) - 2)
        share = (where - low)[:, None, None]
        wrong.append((((gray[low] * (1 - share) + gray[low + 1] * share).mean(0) - seen) ** 2).sum())
    return float(shifts[int(np.argmin(wrong))])


def test_several_frames_a_viewpoint_and_own_choices(taken: Path, tmp_path: Path) -> None:
    out = tmp_path / "s.h5"
    told = ingest(taken, out, IngestConfig(frames=3, test_every=0, truth=False, name="mine", margin_ticks=100))
    assert told["views"] == 9
    with open_scene(out) as file:
        scene = file.read()
    assert scene.name == "mine"
    assert scene.truth is None
    assert "calib poses" in scene.info["poses"]
    starts = [v.frame.start_ns for v in scene.views if v.name.startswith("001-")]
    assert np.allclose(np.diff(starts), 1001e6 / 120, atol=20_000)
    with pytest.raises(UsageError, match="exists already"):
        ingest(taken, out)


def test_a_damaged_chunk_becomes_lost_ticks(folder: Path, tmp_path: Path) -> None:
    wide = IngestConfig(margin_ticks=600)  # the frame in the hole says nothing: another is taken, and reaches over it
    whole = ingest(folder, tmp_path / "whole.h5", wide)
    assert whole["lost_ticks"] == 0
    with open_scene(tmp_path / "whole.h5") as file:
        before = file.read()
    view = open_take(folder).views()[1]
    _, start, stop = view.spikes[0]
    found = [c for path in sorted((folder / "spikes").glob("*.seg")) for c in scan(path)]
    hit = next(c for c in found if isinstance(c, Chunk) and start <= (start + stop) // 2 - 100_000
               <= c.head.byte_index + c.head.payload)  # fmt: skip
    data = bytearray(hit.path.read_bytes())
    data[hit.offset + 5] ^= 1
    hit.path.write_bytes(data)
    assert run(["data", "ingest", str(folder), "-o", str(tmp_path / "told.h5")]) == 1
    told = ingest(folder, tmp_path / "s.h5", wide)
    assert told["lost_ticks"] > 100
    with open_scene(tmp_path / "s.h5") as file:
        scene = file.read()
    spikes, good = scene.view("001").spikes, before.view("001").spikes
    assert spikes is not None
    assert good is not None
    lost = np.zeros(spikes.ticks, bool)
    for a, b in spikes.lost:
        lost[a:b] = True
    assert not spikes.bits[lost].any()
    by = round((spikes.t0_ns - good.t0_ns) * 20_000 / 1e9)  # ticks that it begins later
    same = slice(max(by, 0), min(good.ticks, spikes.ticks + by))
    bits, left = (x[same.start - by : same.stop - by] for x in (spikes.bits, ~lost))
    assert left.sum() > 200
    assert np.array_equal(bits[left], good.bits[same][left])
    assert len(scene.view("002").spikes.lost) == 0


def test_a_view_whose_every_tick_is_lost_is_left_out_and_told(folder: Path, tmp_path: Path) -> None:
    _, start, stop = open_take(folder).views()[1].spikes[0]
    for path in sorted((folder / "spikes").glob("*.seg")):
        data = bytearray(path.read_bytes())
        for c in scan(path):
            if isinstance(c, Chunk) and start < c.head.byte_index + c.head.payload and c.head.byte_index < stop:
                data[c.offset + 4096 + 7] ^= 1  # the payload does not match its digest any more
        path.write_bytes(data)
    told = ingest(folder, tmp_path / "s.h5", IngestConfig(frames=2, test_every=0))
    assert list(told["left_out"]) == ["001"]
    assert "every tick of its exposures is lost" in told["left_out"]["001"]
    assert told["views"] == 4
    with open_scene(tmp_path / "s.h5") as file:
        scene = file.read()
    assert [v.name for v in scene.views] == ["000-0", "000-1", "002-0", "002-1"]
    assert run(["data", "ingest", str(folder), "-o", str(tmp_path / "again.h5")]) == 1


def test_what_cannot_be_cut_is_left_out_and_told(folder: Path, tmp_path: Path) -> None:
    views = open_take(folder).views()
    (folder / "rgb" / views[1].clips[0]).write_bytes(b"no clip at all")
    lines = [told for _, told in read_lines(folder / "views.jsonl")]
    last = next(line for line in reversed(lines) if line["name"] == "002")
    with (folder / "views.jsonl").open("a") as file:
        file.write(json.dumps(last | {"clips": []}) + "\n")
    assert run(["data", "ingest", str(folder), "-o", str(tmp_path / "s.h5")]) == 1
    told = ingest(folder, tmp_path / "s.h5", force=True)
    assert told["views"] == 1
    assert sorted(told["left_out"]) == ["001", "002"]
    assert "its clip is not in the take" in told["left_out"]["002"]
    with (folder / "views.jsonl").open("a") as file:
        file.write(json.dumps(next(x for x in lines if x["name"] == "000") | {"clips": []}) + "\n")
    with pytest.raises(DataError, match="no view can be made"):
        ingest(folder, tmp_path / "none.h5")
    assert not (tmp_path / "none.h5").exists()


def test_without_the_panel_and_without_truth_nothing_is_paired(folder: Path, tmp_path: Path) -> None:
    (folder / "truth.json").unlink()
    with pytest.raises(DataError, match="no view can be made") as caught:
        ingest(folder, tmp_path / "s.h5")
    assert "nothing ties this clip's frames" in str(caught.value)


@pytest.mark.parametrize("text", ["{", "{}", "[3]", '[{"rgb": 3}]'])
def test_a_truth_that_lies_is_refused(folder: Path, tmp_path: Path, text: str) -> None:
    (folder / "truth.json").write_text(text)
    with pytest.raises(DataError):
        ingest(folder, tmp_path / "s.h5")


def test_names_of_clips() -> None:
    assert clip_number("100GOPRO/GX010078.MP4") == 78
    with pytest.raises(DataError):
        clip_number("../../etc/passwd")


WIDE = {"name": "wide", "width": 160, "height": 96, "row_bits": 160, "rate_hz": 20_000, "packet_bytes": 16384}
EDGES = [6, 5, 154, 5, 6, 91, 154, 91]
PANEL = {"bits": 12, "slow": 7, "spike": EDGES, "rgb": EDGES, "spike_radius_px": 2.5, "rgb_radius_px": 2.5}


def test_the_panel_ties_frames_and_spikes_without_any_truth(tmp_path: Path) -> None:
    folder = tmp_path / "take"
    take(folder, plan_of(viewpoints=2, spike={"wire": WIDE}, panel=PANEL))
    raw = open_take(folder)
    spans = [s for v in raw.views() for s in v.spikes]
    wire = WireBytes(raw)
    assert Framing(wire, spans, panel_pairs(raw)).offset(0) == -first_byte(folder) % raw.profile.tick_bytes
    with pytest.raises(RefusedError, match="where ticks begin"):
        Framing(wire, spans, [(Spot(0, 60.0 + x, 30.0, 2.5), Spot(1, 60.0 + x, 60.0, 2.5)) for x in (0, 11)]).offset(0)
    truth = read_truth(raw)
    (folder / "truth.json").unlink()
    told = ingest(folder, tmp_path / "s.h5")
    assert (told["views"], told["left_out"], told["panel_unread"]) == (2, {}, {})
    assert told["rgb_times"] == {"sights": 2}
    assert told["sigma_us"] < 300
    with open_scene(tmp_path / "s.h5") as file:
        scene = file.read()
    assert run(["rig", "panel", str(folder)]) == 0  # the same code, where the plan has the panel
    marks = [m for m in read_marks(folder / "marks.jsonl") if isinstance(m, Sight)]
    assert len(marks) == told["sights"]
    assert ingest(folder, tmp_path / "again.h5")["sigma_us"] == told["sigma_us"]  # sights that are there count once
    times = Times(raw, truth)
    clips = {v.name: clip_number(v.clips[0]) for v in raw.views()}
    for view in scene.views:
        rows = [r for r in truth[0]["rgb"] if r["event"] == "clip" and r["number"] == clips[view.name]]
        off = times.rig_from_true(truth[0], np.array(rows[0]["true_ns"])) - view.frame.start_ns
        assert np.abs(off).min() < 300_000
        assert not view.valid[5, 6]  # an LED
        assert view.valid[48, 64]


@pytest.mark.parametrize("lost", [12, 28])
def test_a_loss_that_time_cannot_see_becomes_lost_ticks(taken: Path, tmp_path: Path, lost: int) -> None:
    view = open_take(taken).views()[1]
    calm_s = (view.clip["start_ns"][1] + 75_000_000) / 1e9 - 1000.0  # within its spikes
    folder = tmp_path / "take"
    plan = plan_of(test_every=3, recorder={"watch": False})  # else it is taken again: test_record_slips.py
    take(folder, plan, spike={"faults": [{"kind": "drop", "at_s": calm_s, "bytes": lost}]})
    assert verify_take(folder)[0] == []  # time told nothing
    (hole,) = [x for x in json.loads((folder / "truth.json").read_text())[0]["spike"][0]["lost"] if x["why"] == "drop"]
    told = ingest(folder, tmp_path / "s.h5")
    (slip,) = told["slips"]
    assert slip["lost"] == lost
    assert told["left_out"] == {}
    first = first_byte(folder) + lost  # "end" counts what came
    assert slip["after"] <= hole["start"] - first <= slip["before"]
    with open_scene(tmp_path / "s.h5") as file:
        scene = file.read()
    ((a, b),) = scene.view("001").spikes.lost
    assert 0 < b - a <= 100
    assert told["lost_ticks"] == b - a
    bits = scene.view("001").spikes.bits  # on either side of the loss the picture lies at the same place
    before, after = (count(bits, 64, t, t + 64).astype(float).ravel() for t in (a - 64, b))
    alike = [np.corrcoef(np.roll(before, -8 * by), after)[0, 1] for by in (0, lost, -lost)]
    assert alike[0] > max(alike[1:]) + 0.1, alike


def test_bytes_in_doubt_when_the_take_ended_are_suspect(folder: Path) -> None:
    raw = open_take(folder)
    _, start, stop = raw.views()[-1].spikes[0]
    assert MendedBytes(raw, []).suspect(0, start, stop) == []
    (end,) = [told for _, told in read_lines(folder / "log.jsonl") if told["kind"] == "end"]
    doubt = end["bytes"] - stop + 5_000  # as the driver's `doubtful_bytes` would have it
    with (folder / "log.jsonl").open("a") as file:
        file.write(json.dumps(end | {"suspect_bytes": doubt}) + "\n")
    assert MendedBytes(raw, []).suspect(0, start, stop) == [(stop - 5_000, stop)]
    (folder / "log.jsonl").write_text('{"kind": "end", "epoch": "x", "bytes": 1}\n')
    with pytest.raises(DataError, match="log is damaged"):
        MendedBytes(raw, [])


def test_frames_of_a_long_shutter_are_timed_as_well_as_is_claimed(tmp_path: Path) -> None:
    # At 1/120 s the encoder leaves out 1 to 3 % of each edge in predicted frames: up to 0.2 ms, always late.
    folder = tmp_path / "take"
    panel = {**PANEL, "bits": 14, "slow": 8}
    take(folder, plan_of(viewpoints=6, spike={"wire": WIDE}, panel=panel, rgb={"settings": {"shutter": "1/120"}}))
    raw = open_take(folder)
    truth = read_truth(raw)
    wire = WireBytes(raw)
    times = Times(raw, truth)
    framing = Framing(wire, [s for v in raw.views() for s in v.spikes], panel_pairs(raw))
    panel = panel_in_view(raw.plan)
    assert panel is not None
    times.fit(sights(raw, raw.views(), panel, times.marks, wire, framing)[0])
    off, claimed = [], []
    for clip in (r for r in truth[0]["rgb"] if r["event"] == "clip"):
        media, true = np.array(clip["media_ns"]), np.array(clip["true_ns"])
        model = times.clocks.fit("rgb", clip["number"], int(media[0])).model
        off.append(model.rig_from_device(media) - times.rig_from_true(truth[0], true))
        claimed.append(2 * model.sigma_at(media))
    wrong = np.abs(np.concatenate(off))
    assert np.percentile(wrong, 99) <= 100_000
    assert (wrong <= np.concatenate(claimed)).mean() >= 0.95


@pytest.mark.parametrize(
    ("kind", "lost", "sure"), [("texture", 100, True), ("object", 100, False), ("texture", 0, False)]
)
def test_a_loss_of_whole_rows_is_told_where_the_picture_has_edges(kind: str, lost: int, sure: bool) -> None:
    profile = PROFILES["vidar-400x250-20k"]  # 100 bytes are two rows of it
    data = np.tile(wire_bytes(profile, kind, 256), 5)
    cut = 600 * profile.tick_bytes + 300
    came = np.concatenate([data[:cut], data[cut + lost :]])

    def read(epoch: int, start: int, stop: int) -> tuple[np.ndarray, list[tuple[int, int]]]:
        return came[start:stop], [] if stop <= len(came) else [(len(came), stop)]

    wire = SimpleNamespace(profile=profile, read=read)
    found = find_slips(wire, [(0, 0, len(came))])  # type: ignore[arg-type]
    assert [s.lost for s in found] == [lost] * sure
    assert all(s.after <= cut <= s.before for s in found)
