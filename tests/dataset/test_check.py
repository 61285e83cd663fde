"""`spikerig data check`: every check passes on a good scene, trips on a spoiled one, and says when it cannot decide."""

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from spoil_checks import DAMAGED, SPOILED, Change, late, write_good

from spikerig.calib.check_cli import all_checks, check_scene, chosen, page
from spikerig.dataset import cli
from spikerig.dataset.check import BEYOND, Check, Fault, Figure, Result, check, fault, run_checks
from spikerig.dataset.check_look import Survey, Undecided
from spikerig.dataset.errors import UsageError
from spikerig.dataset.scene import Scene
from spikerig.dataset.store import write_scene

CASES = [
    pytest.param(name, change, importance, id=f"{name}-{k}")
    for name, ways in SPOILED.items()
    for k, (change, importance) in enumerate(ways)
]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Scene]:
    path = tmp_path_factory.mktemp("checks") / "good.h5"
    return path, write_good(path)


def run(capsys: pytest.CaptureFixture[str], *words: str | Path) -> tuple[int, dict[str, Any]]:
    code = cli.run(["data", "check", *map(str, words), "--json"])
    return code, json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("profile", ["scene", "release", "capture"])
def test_a_good_scene_passes_every_check(
    good: tuple[Path, Scene], profile: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, told = run(capsys, good[0], "--profile", profile, "--strict")
    assert code == 0
    assert told["schema"] == "spikerig.data.check/1"
    assert told["findings"] == []
    assert told["ok"] is True
    assert {c["check"]: c["status"] for c in told["checks"] if c["status"] != "passed"} == {}
    assert all(c["seconds"] >= 0 for c in told["checks"])
    names = {c["check"] for c in told["checks"]}
    assert names == {c.name for c in all_checks() if profile in c.profiles}
    assert ("edges-lie-together" in names) == (profile != "capture")
    why = {text for c in told["checks"] for text in c["undecided"].values()}
    assert why <= {"no spikes", "held out, without spikes", "no path"}


def test_every_check_has_a_way_to_trip_it() -> None:
    assert set(SPOILED) | {"file-is-whole"} == {c.name for c in all_checks()}


@pytest.mark.parametrize(("name", "change", "importance"), CASES)
def test_a_spoiled_scene_trips_its_check(
    good: tuple[Path, Scene], tmp_path: Path, name: str, change: Change, importance: str
) -> None:
    path = tmp_path / "spoiled.h5"
    write_scene(path, change(good[1]))
    (rule,) = chosen(name)
    (result,) = check_scene(path, [rule], rule.profiles[-1])
    assert importance in {f.importance for f in result.findings}, result.undecided
    assert result.status == ("passed" if {f.importance for f in result.findings} == {"note"} else "failed")
    assert all(f.check == name and f.fix and f.message and f.where.startswith("/") for f in result.findings)


@pytest.mark.parametrize("damage", DAMAGED)
def test_a_damaged_file_is_one_finding_and_nothing_falls_over_it(
    good: tuple[Path, Scene], tmp_path: Path, damage: Callable[[Path], None], capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "damaged.h5"
    path.write_bytes(good[0].read_bytes())
    damage(path)
    code, told = run(capsys, path, "--only", "structure,ticks,poses,frames-are-in-step")
    assert code == 1
    assert "error" in {f["importance"] for f in told["findings"] if f["check"] == "file-is-whole"}
    where = next(f["where"] for f in told["findings"])
    assert where == "/" if damage.__name__ == "unfinished" else where.startswith("/views/001")


def test_exit_codes(good: tuple[Path, Scene], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    warned = tmp_path / "warned.h5"
    write_scene(warned, late(3.5)(good[1]))
    assert run(capsys, warned, "--only", "sync")[0] == 0
    code, told = run(capsys, warned, "--only", "sync", "--strict")
    assert code == 1
    assert told["counts"] == {"error": 0, "warning": 1, "note": 0}
    assert told["findings"][0]["check"] == "frames-are-in-step"
    (tmp_path / "text.h5").write_text("no scene")
    assert run(capsys, tmp_path / "text.h5")[0] == 4
    assert run(capsys, tmp_path / "none.h5")[0] == 2
    assert run(capsys, warned, "--only", "ponies")[0] == 2
    assert run(capsys, warned, "--profile", "best")[0] == 2


def test_people_are_told_on_stderr(
    good: tuple[Path, Scene], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "spoiled.h5"
    write_scene(path, replace(late(300, 1)(good[1]), clock=None))
    assert cli.run(["data", "check", str(path), "--only", "ticks,sync"]) == 1
    out = capsys.readouterr()
    assert out.out == ""
    assert "error: spikes-cover-the-exposure: /views/001: the exposure goes on 44.0 ticks after the spikes" in out.err
    assert "fix: record longer" in out.err
    assert "undecided: clock-is-certain: no clock model" in out.err
    assert "measured: frames-are-in-step: lag_ticks" in out.err


def test_the_page_of_checks_is_the_checks_themselves() -> None:
    docs = Path(__file__).parents[2] / "docs" / "checks.md"
    assert docs.read_text(encoding="utf-8") == page(), "python -m spikerig.calib.check_cli > docs/checks.md"


def test_only_chosen_checks() -> None:
    assert {c.group for c in chosen("sync")} == {"sync"}
    assert [c.name for c in chosen("views-differ, cameras-moved")] == ["views-differ", "cameras-moved"]
    with pytest.raises(UsageError, match="no such check"):
        chosen("sync,what")


class _Empty:
    """A scene of two views of which nothing is read."""

    names = ("a", "b")


def _try(rule: Check) -> Result:
    return run_checks([rule], _Empty())[0]  # type: ignore[arg-type]


def test_what_a_result_says() -> None:
    def only_b(look: Any) -> str:
        if look.name == "a":
            raise Undecided("too dark")
        return look.name.upper()

    @check("sync", "warning", "never", "nothing", measure=only_b)
    def some_views(scene: object, seen: Mapping[str, str]) -> Iterator[Fault | Figure]:
        yield Figure("views", len(seen))
        for name, value in seen.items():
            yield fault(name, value, "note")
            yield fault("", "all", "error")

    result = _try(some_views)
    assert (result.status, result.figures, result.undecided) == ("failed", {"views": 1}, {"a": "too dark"})
    assert [(f.where, f.importance) for f in result.findings] == [("/views/b", "note"), ("/", "error")]

    @check("sync", "warning", "never", "nothing", measure=lambda look: 1 // 0)
    def beyond(scene: object, seen: Mapping[str, int]) -> Iterator[Fault]:
        yield from ()

    result = _try(beyond)
    assert result.status == "undecided"
    assert BEYOND in result.undecided["a"]

    @check("sync", "warning", "never", "nothing")
    def by_itself(scene: object, _: Mapping[str, int]) -> Iterator[Fault]:
        yield fault("", "found before it gave up")
        raise Undecided("no idea")

    result = _try(by_itself)
    assert (result.status, result.findings, result.undecided) == ("undecided", [], {"": "no idea"})


def test_lost_ticks_do_not_count() -> None:
    lost = np.array([[3, 6], [5, 9]])
    made = Survey(12, 2, 2, None, 0, "rig", lost, np.zeros((2, 2), np.uint32), np.zeros(12, np.int64))
    assert made.kept == 6
