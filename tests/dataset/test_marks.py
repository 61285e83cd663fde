import pytest

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.marks import MarkLog, Probe, Reset, Sight, read_marks

MARKS = [
    Probe("box", 0, 10, 1_000_000_000_000_000_007, 30),
    Probe("spike", 2, None, 5, 40),
    Sight("rgb", 0, 77, 78, 1.5, True, 3, 120.25),
    Reset("box", 1, 99, "stepped back"),
]


def test_what_goes_in_comes_out(tmp_path):
    log = MarkLog(tmp_path / "marks.jsonl")
    log.add(MARKS)
    log.close()
    assert list(read_marks(tmp_path / "marks.jsonl")) == MARKS


def test_a_torn_line_is_left_out_and_the_log_goes_on(tmp_path):
    path = tmp_path / "marks.jsonl"
    log = MarkLog(path)
    log.add(MARKS[:2])
    log.close()
    path.write_bytes(path.read_bytes()[:-9])
    assert list(read_marks(path)) == MARKS[:1]
    again = MarkLog(path, resume=True)
    again.add(MARKS[2:])
    again.close()
    assert list(read_marks(path)) == [MARKS[0], *MARKS[2:]]


def test_marks_are_not_overwritten(tmp_path):
    MarkLog(tmp_path / "m").close()
    with pytest.raises(UsageError, match="already"):
        MarkLog(tmp_path / "m")


@pytest.mark.parametrize(
    "line",
    [
        b"[]",
        b"{}",
        b'{"kind": "probe"}',
        b"\xff\xfe",
        b'{"kind": "reset", "clock": "moon", "epoch": 0, "host_ns": 1, "why": ""}',
        b'{"kind": "reset", "clock": "box", "epoch": "0", "host_ns": 1, "why": ""}',
        b'{"kind": "reset", "clock": "box", "epoch": true, "host_ns": 1, "why": ""}',
        b'{"kind": "reset", "clock": "box", "epoch": 0, "host_ns": 1, "why": "", "more": 1}',
    ],
)
def test_a_foreign_line_is_named(tmp_path, line):
    (tmp_path / "m").write_bytes(
        b'{"kind": "reset", "clock": "box", "epoch": 0, "host_ns": 1, "why": ""}\n' + line + b"\n"
    )
    with pytest.raises(DataError) as told:
        list(read_marks(tmp_path / "m"))
    assert "line 2" in str(told.value)
