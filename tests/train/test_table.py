"""`train table`: cells that are kept, gone on with, refused or told as failed; what is wrong with an order."""

import contextlib
import fcntl
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from spikerig.dataset.cli import run
from spikerig.dataset.errors import DataError, UsageError
from spikerig.train import table_run
from spikerig.train.methods import configure
from spikerig.train.table import Order, label_enters, plan
from spikerig.train.table_pictures import crops
from spikerig.train.table_run import CELLS, Crew, Spent, Stopped, opened, read_cell, run_all, run_cell

SMALL = ("splats=300", "sh_degree=0")


def told(capsys, *words: str, code: int = 0) -> dict:
    assert run(["train", "table", *words, "--json"]) == code
    return json.loads(capsys.readouterr().out)


def fake(answers: dict | None = None, calls: list | None = None, exit_code: int = 0):
    """A `child` that runs nothing: a fit or a score with one number."""

    def child(what, words, log, crew):
        if calls is not None:
            calls.append((what, list(words)))
        fitted = {
            "steps": 9, "renders": 9, "renders_of": "pictures", "train_cpu_seconds": 1.0, "train_seconds": 1.0,
            "pose_label": "mid", "effective_tfs_weight": 0.0, "model_sha256": "0",
        }  # fmt: skip
        part = {"psnr": 20.0, "ssim": 0.5, "lpips": None, "luma_psnr": 21.0, "views": [{"name": "a", "psnr": 20.0}]}
        scored = {"novel_view": part, "blur_view": part, "ssim_variant": "s", "lpips_variant": "none"}
        document = fitted if what == "fit" else scored
        if what == "fit":
            (log.parent / "run").mkdir(exist_ok=True)
            (log.parent / "run/run.json").write_text("{}")
            (log.parent / "run/history.json").write_text('[{"psnr": 20.0, "cpu_seconds": 1, "renders": 9}]')
        else:
            (log.parent / "pictures").mkdir(exist_ok=True)
        return (answers or {}).get(what, document), Spent(what, exit_code, 2.0, 1.5, 3_000_000)

    return child


@pytest.fixture
def laid(tiny):
    return plan(Order((tiny,), methods=("plain", "oracle"), steps=9, settings=SMALL))


def everything(out: Path, laid, resume: bool = False, force: bool = False) -> dict:
    with opened(out, laid, resume=resume, force=force) as lock:
        return run_all(out, laid, lock, jobs=1, threads=1, done=lambda cell, record: None)


def test_a_table_end_to_end_with_a_cell_that_fails(tiny, tmp_path, capsys):
    words = [str(tiny), "-o", str(tmp_path / "t"), "--methods", "plain,spikenerf", "--steps", "40", "--jobs", "2"]
    words += ["--set", "splats=300", "--score-on", str(tiny), "--nerfbaselines"]
    doc = told(capsys, *words, "--extra", "spikenerf=--gray green", code=1)
    assert doc["schema"] == "spikerig.train.table/1"
    assert doc == json.loads((tmp_path / "t/table.json").read_text())
    good, bad = doc["cells"]
    assert (good["row"], good["status"], bad["row"], bad["status"]) == ("plain@mid", "done", "spikenerf@mid", "failed")
    assert "green" in bad["error"]["what"]
    cost = good["cost"]
    assert (cost["steps"], cost["renders"], cost["attempts"], cost["unmeasured"]) == (40, 40, 1, False)
    assert 0 < cost["train_cpu_seconds"] < cost["fit_cpu_seconds"]
    assert cost["fit_peak_bytes"] > 50e6
    assert good["novel"]["psnr"] > 14
    assert good["other"]["predictions_sha256"] == good["novel"]["predictions_sha256"]
    assert [row["renders"] for row in good["history"]][-1] == 40
    assert good["history"][1]["step"] == 1  # a curve looks early
    text = (tmp_path / "t/table.md").read_text()
    assert "failed: fit: the settings of this fit do not hold together" in text
    assert f"{good['novel']['psnr']:.2f}" in text
    assert "not in this table (row spikenerf@mid has no score)" in text
    cell = tmp_path / "t/cells/tiny-plain-mid-0"
    results = json.loads((cell / "nerfbaselines/results.json").read_text())
    assert results["metrics"]["psnr"] == pytest.approx(good["novel"]["psnr"], abs=1e-4)
    assert (tmp_path / "t/curves.svg").exists()
    assert (tmp_path / "t/crops.png").stat().st_size > 1000
    before = (cell / "cell.json").stat().st_mtime_ns
    again = told(capsys, *words, "--extra", "spikenerf=--gray green", "--resume", code=1)
    assert (cell / "cell.json").stat().st_mtime_ns == before
    assert again["cells"][0] == good
    assert len(recorded(tmp_path / "t/cells/tiny-spikenerf-mid-0")["attempts"]) == 2
    refused = told(capsys, *words, "--resume", "--set", "lr_means=1e-4", code=2)["error"]
    assert "lr_means" in refused["value"]
    assert "extra" in refused["value"]
    assert told(capsys, *words, code=2)["error"]["what"] == "there is a table already"


def test_kill_9_of_table_and_fit_and_resume(tiny, tmp_path):
    """The table dies, its fit goes on alone and keeps others out; killed too, a resumed table goes on from there."""
    out = tmp_path / "t"
    order = Order(
        (tiny,), methods=("plain",), steps=1000, settings=SMALL, extra={"plain": ("--checkpoint-every", "0.01")}
    )
    words = [
        str(tiny),
        "-o",
        str(out),
        "--methods",
        "plain",
        "--steps",
        "1000",
        "--extra",
        "plain=--checkpoint-every 0.01",
    ]
    words += [word for text in SMALL for word in ("--set", text)]
    process = subprocess.Popen(
        [sys.executable, "-m", "spikerig.dataset", "train", "table", *words], stderr=subprocess.DEVNULL
    )
    kept = out / CELLS / "tiny-plain-mid-0/run/checkpoint.safetensors"
    wait_for(kept.exists)
    process.kill()
    process.wait()
    (fit,) = pids_with(str(kept.parent))
    with pytest.raises(UsageError, match="at work"):
        everything(out, plan(order), resume=True)
    os.kill(fit, signal.SIGKILL)
    wait_for(lambda: free(out))
    record = everything(out, plan(order), resume=True)["tiny-plain-mid-0"]
    assert record["status"] == "done"
    assert record["unmeasured"]
    assert record["fit"]["steps"] == 1000
    assert "going on at step" in (out / CELLS / "tiny-plain-mid-0/log.txt").read_text()


def recorded(folder: Path) -> dict:
    """The record of a cell that has one."""
    record = read_cell(folder)
    assert record is not None
    return record


def wait_for(true, seconds: float = 180.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it did not come"
        time.sleep(0.02)


def free(out: Path) -> bool:
    """Whether nothing holds a table's folder."""
    with (out / table_run.LOCK).open() as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return False
    return True


def pids_with(word: str) -> list[int]:
    """Processes whose command names a word."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if word.encode() in (folder / "cmdline").read_bytes().split(b"\0"):
                found.append(int(folder.name))
    return found


def test_a_fit_killed_by_the_system_is_told_and_tried_again(laid, tmp_path, monkeypatch):
    monkeypatch.setattr(table_run, "child", fake(answers={"fit": {}}, exit_code=-9))
    records = everything(tmp_path, laid)
    assert {r["status"] for r in records.values()} == {"failed"}
    assert "SIGKILL" in records["tiny-plain-mid-0"]["error"]["what"]
    monkeypatch.setattr(table_run, "child", fake())
    records = everything(tmp_path, laid, resume=True)
    assert {r["status"] for r in records.values()} == {"done"}
    assert [a["exit"] for a in records["tiny-oracle-0"]["attempts"]] == [-9, 0, 0]
    assert not records["tiny-oracle-0"]["unmeasured"]  # the table saw what that attempt used


def test_finished_cells_stay_and_a_finished_fit_is_not_fitted_again(laid, tmp_path, monkeypatch):
    calls: list = []
    monkeypatch.setattr(table_run, "child", fake(calls=calls))
    everything(tmp_path, laid)
    assert [what for what, _ in calls] == ["fit", "own", "fit", "own"]
    calls.clear()
    everything(tmp_path, laid, resume=True)
    assert calls == []
    path = tmp_path / CELLS / "tiny-oracle-0/cell.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"status": "running"}))  # killed while it was scored
    record = everything(tmp_path, laid, resume=True)["tiny-oracle-0"]
    assert [what for what, _ in calls] == ["own"]
    assert (record["status"], record["unmeasured"]) == ("done", False)
    calls.clear()
    everything(tmp_path, laid, force=True)
    assert len(calls) == 4


def test_cells_of_other_settings_are_refused_or_made_anew_alone(tiny, laid, tmp_path, monkeypatch):
    calls: list = []
    monkeypatch.setattr(table_run, "child", fake(calls=calls))
    everything(tmp_path, laid)
    other = plan(Order((tiny,), methods=("plain", "oracle"), steps=9, settings=(*SMALL, "oracle:lr_means=1e-4")))
    with pytest.raises(UsageError) as error:
        everything(tmp_path, other, resume=True)
    assert "tiny-oracle-0: lr_means 0.0004 -> 0.0001" in str(error.value.value)
    assert "plain" not in str(error.value.value)
    calls.clear()
    everything(tmp_path, other, resume=True, force=True)
    assert [words[4] for what, words in calls if what == "fit"] == ["oracle"]
    assert not (tmp_path / CELLS / "tiny-plain-mid-0").samefile(tmp_path / CELLS / "tiny-oracle-0")


def test_more_rows_join_a_table(tiny, laid, tmp_path, monkeypatch):
    calls: list = []
    monkeypatch.setattr(table_run, "child", fake(calls=calls))
    everything(tmp_path, laid)
    calls.clear()
    more = plan(Order((tiny,), methods=("plain", "plain@first", "oracle"), steps=9, settings=SMALL))
    assert len(everything(tmp_path, more, resume=True)) == 3
    assert [words[words.index("--pose-label") + 1] for what, words in calls if what == "fit"] == ["first"]


def test_an_interrupted_cell_is_left_to_be_gone_on_with(laid, tmp_path, monkeypatch):
    crew = Crew(1, 0)

    def child(what, words, log, crew):
        crew.stopping = True
        return {}, Spent(what, 130, 1.0, 1.0, 1)

    monkeypatch.setattr(table_run, "child", child)
    (tmp_path / CELLS).mkdir()
    folder = tmp_path / CELLS / laid.cells[0].name
    with pytest.raises(Stopped):
        run_cell(folder, laid.cells[0], crew, False)
    assert recorded(folder)["status"] == "interrupted"


def test_a_child_in_a_table_that_stops_is_not_started(tmp_path):
    crew = Crew(1, 0, stopping=True)
    with pytest.raises(Stopped):
        table_run.child("fit", ["--version"], tmp_path / "log.txt", crew)


def test_damaged_cells_and_folders_of_others_are_refused(laid, tmp_path, monkeypatch):
    monkeypatch.setattr(table_run, "child", fake())
    everything(tmp_path / "t", laid)
    for damage in ("{", "[]", '{"schema": "other", "attempts": []}'):
        (tmp_path / "t/cells/tiny-oracle-0/cell.json").write_text(damage)
        with pytest.raises(DataError, match="damaged"):
            everything(tmp_path / "t", laid, resume=True)
    mine = tmp_path / "mine"
    (mine / "cells/thesis").mkdir(parents=True)
    (mine / "table.json").write_text("{}")
    for how in ({}, {"resume": True}, {"force": True}, {"resume": True, "force": True}):
        with pytest.raises(UsageError, match="no table"):
            everything(mine, laid, **how)
    assert sorted(p.name for p in mine.iterdir()) == ["cells", "table.json"]
    assert (mine / "cells/thesis").is_dir()
    (tmp_path / "file").write_text("x")
    with pytest.raises(UsageError, match="is a file"):
        everything(tmp_path / "file", laid)


def test_one_table_at_a_time_in_a_folder(laid, tmp_path):
    again = opened(tmp_path / "t", laid, resume=True, force=False)
    with opened(tmp_path / "t", laid, resume=False, force=False), pytest.raises(UsageError, match="at work"), again:
        pass
    with opened(tmp_path / "t", laid, resume=True, force=False):
        pass


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--methods", "plain,best"], "no such method (best)"),
        (["--methods", "plain@last"], "no such pose label (last)"),
        (["--label", "noon"], "noon"),
        (["--label", ","], "needs scenes, seeds and labels"),
        (["--field", "mesh"], "no such field"),
        (["--preset", "paper"], "no such preset"),
        (["--steps", "5", "--seconds", "5"], "not both"),
        (["--steps", "0"], "steps must be at least 1"),
        (["--seeds", "0,x"], "0,x"),
        (["--seeds=-1"], "-1"),
        (["--set", "warp=9"], "warp=9"),
        (["--set", "elsewhere:splats=9"], "no scene or row 'elsewhere'"),
        (["--set", "pose_label=first"], "the pose label is the row's"),
        (["--extra", "plain=--force --seed 3"], "--force, --seed is the table's to say"),
        (["--extra", "best=--trust"], "no row 'best'"),
        (["--extra", "plain=--gray 'x"], "cannot be split"),
        (["--extra", "plain"], "METHOD=WORDS"),
        (["--score-on", "nowhere.h5"], "nowhere.h5"),
        (["--jobs", "0"], "jobs"),
        (["--threads", "0"], "threads"),
        (["--lpips", "weights.safetensors"], "weights.safetensors"),
    ],
)
def test_a_wrong_order_is_exit_2_before_any_work(tiny, tmp_path, capsys, words, says):
    error = told(capsys, str(tiny), "-o", str(tmp_path / "t"), *words, code=2)["error"]
    assert says in f"{error['what']} {error['value']}"
    assert not (tmp_path / "t").exists()


def test_all_faults_of_an_order_at_once(tiny):
    order = Order((tiny,), methods=("best", "worst", "plain"), score_on={"other": tiny}, settings=("x:splats=3",))
    with pytest.raises(UsageError) as error:
        plan(order)
    for part in ("best", "worst", "'other'", "'x'"):
        assert part in error.value.value


def test_scenes_that_are_missing_twice_there_no_scenes_or_of_another_size(tiny, small, tmp_path):
    with pytest.raises(UsageError, match="not there") as error:
        plan(Order((tmp_path / "a.h5", tiny, tmp_path / "b.h5")))
    assert "a.h5" in error.value.value
    assert "b.h5" in error.value.value
    with pytest.raises(UsageError, match="same file name"):
        plan(Order((tiny, tiny)))
    (tmp_path / "c.h5").write_text("no scene")
    with pytest.raises(DataError):
        plan(Order((tmp_path / "c.h5",)))
    with pytest.raises(UsageError, match="another size") as error:
        plan(Order((tiny,), score_on={"tiny": small}))
    assert "32x20" in error.value.value


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A scene of another size than tiny's."""
    import tomllib
    from importlib.resources import files

    from spikerig.rigctl.sim.capture import capture
    from spikerig.rigctl.sim.spec import read_scene

    table = tomllib.loads(files("spikerig.rigctl.sim").joinpath("scenes/demo.toml").read_text(encoding="utf-8"))
    table["camera"] |= {"width": 32, "height": 20}
    table["orbit"] |= {"views": 2, "test_every": 2}
    table["points"] |= {"count": 20}
    path = tmp_path_factory.mktemp("small") / "small.h5"
    capture(read_scene(table), path)
    return path


def test_scenes_of_mixed_sizes_stand_on_one_sheet(tiny, small, tmp_path):
    from spikerig.dataset.images import read_image, write_image
    from spikerig.train.table_pictures import truth_of

    folders = {}
    for path in (tiny, small):
        name, truth = truth_of(path)
        folder = tmp_path / path.stem
        folder.mkdir()
        write_image(folder / f"{name}.png", np.roll(truth, 1))
        folders[path.stem, "plain"] = folder
    doc = {
        "rows": [{"name": "plain"}, {"name": "oracle"}],
        "scenes": [{"name": p.stem, "path": str(p)} for p in (tiny, small)],
    }
    (tmp_path / "sheet.png").write_bytes(crops(doc, folders))
    assert np.asarray(read_image(tmp_path / "sheet.png")).std() > 10


def test_the_pose_label_makes_a_row_only_where_it_enters(tiny):
    laid = plan(Order((tiny,), methods=("plain", "average", "oracle"), labels=("mid", "first"), steps=9))
    assert [row.name for row in laid.rows] == ["plain@mid", "plain@first", "average", "oracle"]
    assert not label_enters(configure("spike-hybrid", "draft"))
    assert not label_enters(configure("spikenerf-5x", "draft"))
    assert not label_enters(configure("ours", "draft"))
    assert label_enters(configure("edi", "draft"))
    assert label_enters(configure("spikenerf-5x", "draft", textures_per_view=1))
    by_name = {cell.row.name: cell.identity["config"]["pose_label"] for cell in laid.cells}
    assert (by_name["plain@mid"], by_name["plain@first"]) == ("mid", "first")


def test_settings_of_a_scene_and_of_a_row(tiny, small):
    settings = ("splats=50", "tiny:background=white", "oracle:splats=70", "oracle:steps=8")
    laid = plan(Order((tiny, small), methods=("plain", "oracle"), settings=settings, steps=5))
    assert {(c.row.method, c.identity["config"]["steps"]) for c in laid.cells} == {("plain", 5), ("oracle", 8)}
    found = {
        (c.scene, c.row.method): (c.identity["config"]["splats"], c.identity["config"]["background"])
        for c in laid.cells
    }
    assert found == {
        ("tiny", "plain"): (50, "white"), ("tiny", "oracle"): (70, "white"),
        ("small", "plain"): (50, "black"), ("small", "oracle"): (70, "black"),
    }  # fmt: skip


def test_a_cell_is_known_by_all_that_its_numbers_depend_on(tiny, small, tmp_path):
    weights = tmp_path / "w.bin"
    weights.write_bytes(b"1")
    one = Order((tiny,), methods=("plain",), extra={"plain": ("--points-of", str(weights))})

    def known(order):
        return plan(order).cells[0].sha256

    first = known(one)
    assert known(one) == first
    assert known(replace(one, nerfbaselines=True)) == first
    for change in (
        {"steps": 5},
        {"seeds": (1,)},
        {"ssim": "tf"},
        {"extra": {}},
        {"scenes": (small,)},
        {"lpips": weights},
    ):
        assert known(replace(one, **change)) != first, change
    weights.write_bytes(b"2")
    assert known(one) != first


def test_a_fit_counts_its_renders_and_cpu_over_a_resume(tiny, tmp_path):
    from spikerig.train.fit import load_state
    from spikerig.train.run import run_fit

    done = run_fit(tiny, configure("average", "draft", splats=300, steps=10, fresh_poses=0), tmp_path / "a")
    assert (done["renders"], done["renders_of"]) == (50, "pictures")
    done = run_fit(tiny, configure("plain", "draft", field="nerf-fast", steps=3, rays=64), tmp_path / "b")
    assert (done["renders"], done["renders_of"]) == (192, "rays")
    state, _ = load_state(tmp_path / "a/checkpoint.safetensors")
    assert (state.renders, state.cpu) == (
        50,
        pytest.approx(json.loads((tmp_path / "a/run.json").read_text())["train_cpu_seconds"]),
    )
    rows = json.loads((tmp_path / "a/history.json").read_text())
    assert [row["renders"] for row in rows] == [5 * row["step"] for row in rows]
    assert all(b["cpu_seconds"] >= a["cpu_seconds"] for a, b in pairwise(rows))
