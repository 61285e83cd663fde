"""A raw take: read after any crash, and nothing of a foreign one believed."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import xxhash

from spikerig.dataset.cli import run
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.rawtake import WireBytes, open_take, verify_take
from spikerig.dataset.segments import STAMP, ChunkHead, encode_head, padded
from spikerig.dataset.wire import WireProfile

WIRE = WireProfile("small", 64, 48, 64, 20_000)
SIZE = 10 * WIRE.tick_bytes  # of a chunk here


def body(epoch: int, start: int, size: int = SIZE) -> np.ndarray:
    return (np.arange(start, start + size) * 7 + epoch).astype(np.uint8)


def chunk(number: int, epoch: int, start: int, **more: int | str) -> bytes:
    data = body(epoch, start)
    head = ChunkHead(9, number, epoch, start, WIRE.tick_bytes, 0, 1, payload=SIZE)
    head = replace(head, digest=xxhash.xxh3_64_intdigest(data.data), **more)
    return encode_head(head, np.zeros(0, STAMP)) + data.tobytes().ljust(padded(SIZE), b"\0")


def view(name: str, **more: object) -> str:
    base = {"name": name, "attempt": 1, "start_ns": 0, "stop_ns": 9, "spikes": [[0, 0, SIZE]], "clips": [],
            "checks": {}, "kept": True}  # fmt: skip
    return json.dumps(base | more) + "\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    take = tmp_path / "take"
    (take / "spikes").mkdir(parents=True)
    told = {"format": "spikerig-take", "version": 1, "status": "complete", "number": 9, "plan": {}, "devices": [],
            "wire": {**asdict(WIRE), "sure": {}}}  # fmt: skip
    (take / "take.json").write_text(json.dumps(told))
    (take / "views.jsonl").write_text(view("a") + view("b") + view("a", attempt=2))
    first = chunk(0, 0, 0, why="start") + chunk(1, 0, SIZE) + chunk(2, 0, 3 * SIZE, skipped=SIZE)
    (take / "spikes" / "0000.seg").write_bytes(first + bytes(1 << 16))
    (take / "spikes" / "0001.seg").write_bytes(chunk(3, 1, 0, lost_transport=77, why="overflow"))
    return take


def test_spans_of_bytes_with_what_is_missing(folder: Path) -> None:
    wire = WireBytes(open_take(folder))
    data, missing = wire.read(0, 5, 4 * SIZE)
    whole = body(0, 0, 4 * SIZE)
    whole[2 * SIZE : 3 * SIZE] = 0
    assert np.array_equal(data, whole[5:])
    assert missing == [(2 * SIZE, 3 * SIZE)]
    assert wire.span(0) == (0, 4 * SIZE)
    assert wire.read(1, 0, SIZE + 3)[1] == [(SIZE, SIZE + 3)]
    assert wire.read(5, 0, 10) == (pytest.approx(np.zeros(10)), [(0, 10)])
    assert wire.read(0, 2 * SIZE, 3 * SIZE)[1] == [(2 * SIZE, 3 * SIZE)]
    with pytest.raises(UsageError):
        wire.read(0, 0, 1 << 50)


def test_a_damaged_chunk_is_missing_and_told(folder: Path) -> None:
    path = folder / "spikes" / "0000.seg"
    data = bytearray(path.read_bytes())
    data[4096 + 100] ^= 1
    path.write_bytes(data)
    wire = WireBytes(open_take(folder))
    found, missing = wire.read(0, 0, 2 * SIZE)
    assert missing == [(0, SIZE)]
    assert not found[:SIZE].any()
    assert len(wire.damage) == 1


def test_views_last_word_first_order_torn_line_left_out(folder: Path) -> None:
    with (folder / "views.jsonl").open("a") as file:
        file.write(view("c")[:20])
    views = open_take(folder).views()
    assert [(v.name, v.attempt) for v in views] == [("a", 2), ("b", 1)]


@pytest.mark.parametrize(
    "line",
    [
        view("x", clips=["../../etc/passwd"]),
        view("x", spikes=[[0, 9, 3]]),
        view("x", spikes=[[0, -9, 3]]),
        view("x", spikes="no"),
        view("x", checks=3),
        '{"name": "x"}\n',
        "[" * 100_000 + "\n",
        "not json\n",
        "[]\n",
    ],
    ids=lambda s: s[:20].strip(),
)
def test_views_that_lie_are_refused_by_line(folder: Path, line: str) -> None:
    with (folder / "views.jsonl").open("a") as file:
        file.write(line)
    with pytest.raises(DataError, match="line"):
        open_take(folder).views()
    assert [f.importance for f in verify_take(folder)[0] if f.check == "views"] == ["error"]


@pytest.mark.parametrize(
    "change",
    [
        {"format": "other"},
        {"version": 2},
        {"wire": {"name": "x"}},
        {"wire": {**asdict(WIRE), "width": -1}},
        {"wire": {**asdict(WIRE), "height": 1 << 40}},
        {"number": -1},
        {"plan": 3},
        {"devices": 3},
    ],
    ids=str,
)
def test_descriptions_that_lie_are_refused(folder: Path, change: dict) -> None:
    told = json.loads((folder / "take.json").read_text())
    (folder / "take.json").write_text(json.dumps(told | change))
    with pytest.raises(DataError, match="description is damaged"):
        open_take(folder)


def test_no_take_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no take"):
        open_take(tmp_path)


def checks(folder: Path) -> list[tuple[str, str]]:
    return [(f.check, f.importance) for f in verify_take(folder)[0]]


def test_a_good_take_has_only_its_told_loss(folder: Path) -> None:
    found, figures = verify_take(folder)
    assert [(f.check, f.importance) for f in found] == [("loss", "warning")]
    assert figures == {"status": "complete", "chunks": 4, "bytes": 4 * SIZE, "epochs": 2, "lost_transport": 77,
                       "lost_recorder": 0, "views_kept": 2}  # fmt: skip


def test_bytes_missing_unsaid_chunks_missing_and_damage_are_critical(folder: Path) -> None:
    (folder / "spikes" / "0001.seg").write_bytes(chunk(3, 0, 9 * SIZE) + chunk(5, 0, 10 * SIZE) + b"rubbish")
    assert checks(folder) == [("gap", "error"), ("order", "error"), ("chunk", "error")]
    (folder / "spikes" / "0000.seg").unlink()
    assert checks(folder)[0] == ("order", "error")


def test_the_command(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["data", "verify", str(folder), "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["chunks"] == 4
    assert [f["check"] for f in told["findings"]] == ["loss"]
