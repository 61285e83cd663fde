"""Losses that no error and no clock tells, seen while the take runs, on the emulated bus: in and between viewpoints."""

import json
from pathlib import Path

import numpy as np
import pytest
from emulated_takes import Scripted, plan_of, take

from spikerig.dataset.rawtake import WireBytes, open_take, read_lines, verify_take
from spikerig.rigctl.devices import Block
from spikerig.rigctl.ingest import ingest
from spikerig.rigctl.numbering import FRAMING, Numbering
from spikerig.rigctl.slip_watch import Slip

START_S = 1000.0  # the emulated host's clock when a take begins


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("calm") / "take"
    take(folder)
    assert log(folder, "transport") == []
    return folder


def log(folder: Path, kind: str) -> list[dict]:
    return [told for _, told in read_lines(folder / "log.jsonl") if told["kind"] == kind]


def dropped(folder: Path, at_s: float, lost: int) -> Scripted:
    operator = Scripted()
    take(folder, operator=operator, spike={"faults": [{"kind": "drop", "at_s": at_s - START_S, "bytes": lost}]})
    told = json.loads((folder / "truth.json").read_text())[0]["spike"][0]["lost"]
    assert [x["stop"] - x["start"] for x in told if x["why"] == "drop"] == [lost]
    return operator


def test_a_loss_within_a_viewpoint_is_told_at_once_and_taken_again(calm: Path, tmp_path: Path) -> None:
    folder = tmp_path / "take"
    view = open_take(calm).views()[2]
    operator = dropped(folder, view.clip["start_ns"][1] / 1e9 + 0.075, 28)
    (told,) = log(folder, "transport")
    assert told["lost_bytes"] % 384 == 28
    assert told["confidence"] >= 0.999
    assert any("lost on the link: framing" in line for line in operator.said)
    assert any("ticks lost: look at cable" in line for line in operator.said)
    attempts = [t for _, t in read_lines(folder / "views.jsonl") if t["name"] == "002"]
    assert [(t["attempt"], t["kept"]) for t in attempts[:2]] == [(1, False), (2, True)]
    assert attempts[0]["checks"]["lost_ticks"] >= 1
    epochs = [{e for e, _, _ in v.spikes} for v in open_take(folder).views()]
    assert epochs == [{0}, {0}, {1}]
    findings, figures = verify_take(folder)
    assert [f.check for f in findings] == ["loss"]
    assert figures["lost_transport"] == told["lost_bytes"]
    first = next(c for c in WireBytes(open_take(folder)).chunks[1])
    assert first.head.why == FRAMING
    assert first.head.suspect > 0
    scene = ingest(folder, tmp_path / "s.h5")
    assert (scene["slips"], scene["lost_ticks"]) == ([], 0)


def test_a_loss_after_a_viewpoints_spikes_begins_an_epoch_for_all_that_follow(calm: Path, tmp_path: Path) -> None:
    folder = tmp_path / "take"
    first = open_take(calm).views()[0]
    dropped(folder, first.stop_ns / 1e9 - 0.65, 20)  # its spikes are over, and the camera stops
    (told,) = log(folder, "transport")
    assert told["lost_bytes"] % 384 == 20
    views = open_take(folder).views()
    assert [{e for e, _, _ in v.spikes} for v in views] == [{1}, {1}, {1}]
    assert [v.attempt for v in views] == [2, 1, 1]  # its camera had not stopped yet: taken again, to be sure
    scene = ingest(folder, tmp_path / "s.h5")
    assert (scene["slips"], scene["lost_ticks"]) == ([], 0)
    assert not [why for why in scene["left_out"].values() if "two places" in why]


def test_the_watch_can_be_left_out(calm: Path, tmp_path: Path) -> None:
    folder = tmp_path / "take"
    at = open_take(calm).views()[1].clip["start_ns"][1] / 1e9 + 0.075 - START_S
    plan = plan_of(recorder={"watch": False})
    take(folder, plan, spike={"faults": [{"kind": "drop", "at_s": at, "bytes": 28}]})
    assert log(folder, "transport") == []


# ---- one loss is counted once


def block(epoch: int, at: int, n: int, lost: int = 0, why: str = "", suspect: int = 0) -> Block:
    return Block(np.zeros(n, np.uint8), epoch, at, 0, 1, lost, why, suspect)


def slip(epoch: int, after: int, lost: int) -> Slip:
    return Slip(epoch, after, after + 100, lost, 1000 - lost, 0.999)


def test_a_slip_begins_an_epoch_at_the_next_block() -> None:
    numbers = Numbering(3)
    assert (numbers.take(block(0, 0, 500)).epoch, numbers.take(block(0, 500, 500)).byte_index) == (3, 500)
    assert numbers.slip(slip(3, 600, 28))
    new = numbers.take(block(0, 1000, 500))
    assert (new.epoch, new.byte_index, new.lost_bytes, new.lost_why, new.suspect_bytes) == (4, 0, 28, FRAMING, 400)
    after = numbers.take(block(0, 1500, 500))
    assert (after.epoch, after.byte_index, after.lost_bytes) == (4, 500, 0)
    own = numbers.take(block(1, 0, 500, 70, "overflow"))
    assert (own.epoch, own.byte_index, own.lost_bytes) == (5, 0, 70)


def test_what_the_time_tells_later_of_the_same_bytes_is_less_by_what_the_framing_told() -> None:
    for waiting in (False, True):
        numbers = Numbering(0)
        numbers.take(block(0, 0, 1000))
        assert numbers.slip(slip(0, 600, 28))
        if not waiting:
            numbers.take(block(0, 1000, 500))
        seen = 1000 if waiting else 1500
        late = numbers.take(block(1, 0, 500, 5028, "rate", seen - 550))
        assert (late.lost_bytes, late.epoch) == (5000, 1 if waiting else 2)
        assert numbers.take(block(2, 0, 500, 5028, "rate", 2000)).lost_bytes == 5028  # another loss


def test_another_loss_after_a_slip_counts_whole() -> None:
    numbers = Numbering(0)
    numbers.take(block(0, 0, 1000))
    assert numbers.slip(slip(0, 600, 28))
    numbers.take(block(0, 1000, 1000))
    assert numbers.take(block(1, 0, 500, 5028, "rate", 900)).lost_bytes == 5028  # its suspects begin later


def test_a_slip_in_an_epoch_that_a_told_loss_ended_is_told_already() -> None:
    numbers = Numbering(0)
    numbers.take(block(0, 0, 1000))
    numbers.take(block(1, 0, 500, 300, "overflow"))
    assert not numbers.slip(slip(0, 600, 28))
    assert numbers.take(block(1, 500, 500)).lost_bytes == 0
