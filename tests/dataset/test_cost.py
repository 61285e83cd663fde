"""The sweep harness measures, saves, loads and prints the same numbers."""

import json
from pathlib import Path

import pytest

from spikerig.dataset import cost
from spikerig.dataset.errors import DataError, UsageError


def _sweep(calls: list[int]) -> cost.Sweep:
    def run(n: int) -> bytearray:
        calls.append(n)
        return bytearray(n)

    settings = [cost.Setting("blocks", n, lambda n=n: run(n), lambda r: 1.0 / len(r)) for n in (1_000_000, 2_000_000)]
    return cost.sweep("t", "Title", settings, knob="n", error_unit="1/n", reference="theory", repeats=3)


def test_a_sweep_runs_each_setting_once_more_than_it_times() -> None:
    calls: list[int] = []
    done = _sweep(calls)
    assert calls == [1_000_000] * 4 + [2_000_000] * 4
    assert [r.error for r in done.rows] == [1e-6, 5e-7]
    assert done.rows[1].peak_bytes >= 2_000_000
    assert done.rows[0].peak_bytes < 2_000_000


def test_saved_sweeps_come_back_and_make_a_page(tmp_path: Path) -> None:
    done = _sweep([])
    path = cost.save(done, tmp_path)
    assert cost.load(path) == done
    assert (tmp_path / "t.svg").read_text(encoding="utf-8").startswith("<?xml")
    text = cost.page(tmp_path)
    for needed in ("### Title", "| blocks | 1000000 | 1e-06 |", done.command, "![Title](cost/t.svg)"):
        assert needed in text
    json.loads(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"rows": [{"series": 1}]}'])
def test_a_file_that_is_no_sweep_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "x.json").write_text(text, encoding="utf-8")
    with pytest.raises(DataError, match="not a saved sweep"):
        cost.load(tmp_path / "x.json")


def test_an_empty_sweep_is_refused() -> None:
    with pytest.raises(UsageError):
        cost.sweep("t", "t", [], knob="", error_unit="", reference="")


def test_the_cost_page_shows_the_saved_sweeps() -> None:
    docs = Path(__file__).resolve().parents[2] / "docs"
    assert (docs / "cost.md").read_text(encoding="utf-8") == cost.page(docs / "cost"), "spikerig cost page"
