"""The record loop on the emulated rig: drivers, wires and faults and all."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from emulated_takes import CRYSTALS, WIRE, Scripted, plan_of, rig_of, take

from spikerig.dataset.errors import DeviceError, UsageError
from spikerig.dataset.marks import Probe, Reset, read_marks
from spikerig.dataset.rawtake import open_take, read_lines, verify_take
from spikerig.rigctl.live import judge
from spikerig.rigctl.record import record
from spikerig.rigctl.take_plan import Checks


def log(folder: Path, kind: str) -> list[dict]:
    return [told for _, told in read_lines(folder / "log.jsonl") if told["kind"] == kind]


def test_a_take_by_itself(tmp_path: Path) -> None:
    operator = Scripted()
    folder = tmp_path / "take"
    tally = take(folder, operator=operator)
    assert (tally.kept, tally.status, tally.lost_ticks, tally.poor) == (3, "complete", 0, {})
    found, figures = verify_take(folder)
    assert found == []
    assert figures["epochs"] == 1
    told = open_take(folder)
    assert told.profile.tick_bytes == 384
    assert [d["kind"] for d in told.devices] == ["spike", "rgb", "sync"]
    size = 0.1 * 20_000 * 384
    for view in told.views():
        ((_, start, stop),) = view.spikes
        assert size <= stop - start <= size + 3 * 524_288  # whole blocks of at least 512 KiB
        assert len(view.clips) == 1
        assert (folder / "rgb" / view.clips[0]).stat().st_size == view.clip["size_bytes"]
        assert 0.02 < view.checks["exposure"] < 0.7
        assert view.checks["sync_us"] < 500
    marks = list(read_marks(folder / "marks.jsonl"))
    assert sum(isinstance(m, Probe) and m.clock == "box" and m.sent_ns is not None for m in marks) > 50
    assert sum(isinstance(m, Probe) and m.clock == "spike" for m in marks) > 100
    assert not operator.asked
    assert json.loads((folder / "truth.json").read_text())[0]["rgb"][-1]["event"] == "clip"


def test_prompts_retake_skip_quit_and_going_on(tmp_path: Path) -> None:
    folder = tmp_path / "take"
    plan = plan_of(advance="prompt")
    first = Scripted(["c", "", "r", "", "s", "q"])
    tally = take(folder, plan, first)
    assert [keys[0] for _, keys in first.asked] == [""] * 6
    assert (tally.kept, tally.retaken, tally.skipped, tally.status) == (1, 1, ["001"], "aborted")
    assert [(v.name, v.attempt) for v in open_take(folder).views()] == [("000", 2)]
    with pytest.raises(UsageError, match="a take is there already"):
        take(folder, plan)
    with pytest.raises(UsageError, match="another plan"):
        take(folder, plan_of(advance="prompt", seconds=0.2), resume=True)
    stop_ns = open_take(folder).views()[0].stop_ns
    second = take(folder, plan, Scripted(), resume=True, after_ns=stop_ns)
    assert (second.kept, second.status) == (3, "complete")
    views = open_take(folder).views()
    assert [v.name for v in views] == ["000", "001", "002"]
    assert [v.spikes[0][0] for v in views] == [0, 1, 1]  # a new session is a new epoch
    found, figures = verify_take(folder)
    assert found == []
    assert figures["epochs"] == 2
    assert [m for m in read_marks(folder / "marks.jsonl") if isinstance(m, Reset) and m.clock == "host"]
    assert len(json.loads((folder / "truth.json").read_text())) == 2


def test_a_loss_on_the_link_is_told_and_the_viewpoint_taken_again(tmp_path: Path) -> None:
    folder = tmp_path / "take"
    plan = plan_of(viewpoints=1, seconds=0.3)
    operator = Scripted()
    calm = take(tmp_path / "calm", plan)
    assert calm.retaken == 0
    view = open_take(tmp_path / "calm").views()[0]
    at_s = (view.clip["start_ns"][1] + 200_000_000) / 1e9 - 1000.0  # within its spikes
    tally = take(folder, plan, operator, spike={"faults": [{"kind": "overflow", "at_s": at_s}]})
    assert tally.retaken == 1
    assert (tally.kept, tally.lost_ticks) == (1, 0)
    assert any("ticks lost" in line for line in operator.said)
    (told,) = log(folder, "transport")
    assert told["lost_bytes"] > 0
    found, figures = verify_take(folder)
    assert {f.check for f in found} == {"loss"}
    assert figures["lost_transport"] == told["lost_bytes"]
    lines = [t for _, t in read_lines(folder / "views.jsonl")]
    assert [line["kept"] for line in lines[:2]] == [False, True]
    assert len(lines[0]["spikes"]) == 2  # an epoch ended within it
    assert lines[0]["checks"]["lost_ticks"] > 0


def test_an_unplugged_camera_comes_back_in_a_new_epoch(tmp_path: Path) -> None:
    folder = tmp_path / "take"
    tally = take(folder, plan_of(viewpoints=1, seconds=0.2),
                 spike={"faults": [{"kind": "unplug", "at_s": 5.6, "for_s": 0.4}]})  # fmt: skip
    assert tally.status == "complete"
    assert log(folder, "transport")
    assert verify_take(folder)[1]["views_kept"] == 1
    assert any(isinstance(m, Reset) and m.clock == "spike" for m in read_marks(folder / "marks.jsonl"))


def test_a_camera_that_stays_away_ends_the_take_in_good_order(tmp_path: Path) -> None:
    folder = tmp_path / "take"
    plan = plan_of()
    with pytest.raises(DeviceError, match="no bytes") as caught:
        take(folder, plan, spike={"faults": [{"kind": "unplug", "at_s": 7.0}]})
    assert "--resume" in caught.value.next
    assert open_take(folder).status == "aborted"
    assert not [f for f in verify_take(folder)[0] if f.importance == "error"]
    left = 3 - len(open_take(folder).views())
    assert left > 0
    assert take(folder, plan, resume=True, after_ns=1_100_000_000_000).status == "complete"


def test_a_full_card_ends_the_take_and_what_was_kept_is_kept(tmp_path: Path) -> None:
    folder = tmp_path / "take"
    with pytest.raises(DeviceError):
        take(folder, rgb={"faults": {"card_full_s": 6.0}})
    told = open_take(folder)
    assert told.status == "aborted"
    assert len(told.views()) < 3
    assert not [f for f in verify_take(folder)[0] if f.importance == "error"]


def test_a_box_that_is_unplugged_is_told_and_comes_back(tmp_path: Path) -> None:
    folder = tmp_path / "take"
    operator = Scripted()
    start = 1_007_000_000_000
    tally = take(folder, operator=operator, box={"faults": {"unplugged": [[start, start + 2_000_000_000]]}})
    assert tally.status == "complete"
    said = [told["words"] for told in log(folder, "device")]
    assert any(word.startswith("clock box: ") for word in said)
    assert said[-1] == "clock box: it is back"
    epochs = {m.epoch for m in read_marks(folder / "marks.jsonl") if isinstance(m, Probe) and m.clock == "box"}
    assert epochs == {0, 1}


def test_two_recorders_do_not_share_a_take(tmp_path: Path) -> None:
    folder = tmp_path / "take"
    plan = plan_of(viewpoints=1, advance="prompt")

    class Second(Scripted):
        def ask(self, question: str, keys: object) -> str:
            rig = rig_of(plan, tmp_path / "other")
            with pytest.raises(UsageError, match="another recorder"):
                record(plan, rig, folder, Scripted(), resume=True)
            rig.close()
            return "q"

    assert take(folder, plan, Second()).status == "aborted"


def words_of(folder: Path) -> list[str]:
    plan, spec = folder.with_suffix(".plan.toml"), folder.with_suffix(".rig.toml")
    wire = "\n".join(f"{k} = {json.dumps(v)}" for k, v in WIRE.items())
    plan.write_text(
        f'name = "c"\nviewpoints = 3\nseconds = 0.1\nadvance = "auto"\nsettle_s = 0.1\n[spike.wire]\n{wire}\n'
        "[rgb]\nlead_s = 0.03\n[checks]\nfocus = 0\nspare_gb = 0\n[sync]\nprobe_s = 0.1\n"
        '[recorder]\non_full = "wait"\n'
    )
    spec.write_text("\n".join(
        [f"seed = {CRYSTALS['seed']}"] + [
            f"[{key}]\n" + "\n".join(f"{k} = {json.dumps(v)}" for k, v in CRYSTALS[key].items())
            for key in ("spike", "rgb", "box")
        ]
    ))  # fmt: skip
    return ["rig", "record", str(plan), "-o", str(folder), "--emulate", str(spec), "--json"]


HELD = """
import sys
from spikerig.dataset import cli
from spikerig.rigctl.take_writer import TakeWriter
real = TakeWriter.view
def view(writer, seen):
    real(writer, seen)
    if seen.kept:
        print("KEPT", file=sys.stderr, flush=True)
        sys.stdin.readline()
TakeWriter.view = view
sys.exit(cli.run(sys.argv[1:]))
"""


def held_after_the_first_view(words: list[str]) -> subprocess.Popen:
    """A take that waits for a line on stdin as soon as a viewpoint is kept: whatever the machine does meanwhile."""
    process = subprocess.Popen(
        [sys.executable, "-c", HELD, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip
    assert process.stderr is not None
    said = []
    while "KEPT\n" not in said:
        said.append(process.stderr.readline())
        assert said[-1], said
    return process


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_take_that_was_killed_or_interrupted_goes_on(tmp_path: Path, number: int) -> None:
    folder = tmp_path / "take"
    process = held_after_the_first_view(words_of(folder))
    os.kill(process.pid, number)
    out, _ = process.communicate("\n")
    told = open_take(folder)
    if number == signal.SIGINT:
        assert process.returncode == 130
        assert json.loads(out)["error"]["exit_code"] == 130
        assert told.status == "aborted"
    else:
        assert told.status == "recording"
    kept = [v.name for v in told.views() if v.kept]
    assert kept
    before = {v.name: v.spikes for v in told.views() if v.kept}
    words = [sys.executable, "-m", "spikerig.dataset", *words_of(folder), "--resume"]
    again = subprocess.run(words, capture_output=True, text=True)
    out, err = again.stdout, again.stderr
    assert again.returncode == 0, err
    result = json.loads(out)
    assert (result["kept"], result["status"]) == (3, "complete")
    after = {v.name: v.spikes for v in open_take(folder).views()}
    assert {name: after[name] for name in kept} == before
    assert not [f for f in verify_take(folder)[0] if f.importance == "error"]
    assert all(v.clips for v in open_take(folder).views())


@pytest.mark.parametrize(
    ("told", "word"),
    [
        ({"exposure": 0.001}, "too dark"),
        ({"exposure": 0.9}, "too bright"),
        ({"saturated": 0.5}, "fire all the time"),
        ({"focus": 0.2}, "out of focus"),
        ({"lost_ticks": 3}, "3 ticks lost"),
        ({"sync_us": 5000.0}, "clock residual"),
        ({"free_bytes": 1e6}, "disk left"),
        ({"exposure": None}, "no look"),
    ],
)
def test_each_check_speaks(told: dict, word: str) -> None:
    good = {"exposure": 0.3, "saturated": 0.0, "focus": 1.0, "lost_ticks": 0, "sync_us": 10.0, "free_bytes": 1e12}
    assert judge(Checks(), good, 1.0) == []
    (line,) = judge(Checks(), good | told, 1.0)
    assert word in line


def test_a_fetched_clip_that_is_not_as_asked_is_told(tmp_path: Path) -> None:
    calm, operator = tmp_path / "calm", Scripted()
    take(calm, plan_of(viewpoints=1))
    assert open_take(calm).views()[0].checks["clip"] == []
    assert not log(calm, "clip")
    folder = tmp_path / "take"
    tally = take(folder, plan_of(viewpoints=1), operator, rgb={"faults": {"forgets": [145]}})
    assert tally.kept == 1
    found = open_take(folder).views()[0].checks["clip"]
    assert [(f["check"], f["importance"]) for f in found] == [("shutter", "violation")]
    assert [told["check"] for told in log(folder, "clip")] == ["shutter"]
    assert any("1/240 s was asked for" in line for line in operator.said)


def test_a_recording_that_ends_early_is_not_kept(tmp_path: Path) -> None:
    calm, folder = tmp_path / "calm", tmp_path / "take"
    plan = plan_of(viewpoints=1, seconds=0.5)
    take(calm, plan)
    clip = open_take(calm).views()[0].clip
    at_s = (clip["start_ns"][1] + 250_000_000) / 1e9 - 1000.0
    operator = Scripted()
    tally = take(folder, plan, operator, rgb={"faults": {"too_hot_s": at_s}})
    lines = [t for _, t in read_lines(folder / "views.jsonl")]
    assert [line["kept"] for line in lines] == [False, True, True]  # taken again; told once more with its clip
    assert [line["checks"]["clip_ended_early"] for line in lines] == [True, False, False]
    assert tally.retaken == 1
    assert "too hot" in tally.poor["000"][0]  # a camera that is still hot is told
    assert any("stopped by itself (it is too hot)" in said for said in operator.said)
    with pytest.raises(DeviceError, match="ends its recordings early"):  # and never kept, however few tries
        take(tmp_path / "once", plan_of(viewpoints=1, seconds=0.5, tries=1), rgb={"faults": {"too_hot_s": at_s}})
