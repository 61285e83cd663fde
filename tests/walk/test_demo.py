"""The demo as data: its plan, its ledger, its arithmetic. `make demo` itself is the long test."""

import json
import sys
from pathlib import Path

import pytest

from spikerig.dataset import cli, demo, report
from spikerig.dataset.errors import RigError, UsageError


def test_every_line_of_the_plan_is_a_command_that_exists() -> None:
    known = cli.commands()
    plan = demo.steps(Path("runs/x"), {"demo": 24.0, "chroma": 14.0}, 3)
    for step in plan:
        assert ".".join(step.words[:2]) in known, step.words
    assert len({step.key for step in plan}) == len(plan)
    assert all("--force" in step.words for step in plan), "a step cut short by an interrupt must be able to run again"
    budgets = [step.words[step.words.index("--seconds") + 1] for step in plan if step.key.endswith("-fit")]
    assert budgets == ["24"] * 5 + ["14"] * 5, "equal seconds within a scene"


def test_gains_are_differences_of_held_out_psnr() -> None:
    methods = {
        "plain": {"psnr": 22.0},
        "average": {"psnr": 23.5},
        "spikenerf": {"psnr": 25.0},
        "spike-ratio": {"psnr": 27.25},
        "oracle": {"psnr": 27.75},
    }
    got = report.gains(methods)
    assert got == {"gain_db": 5.25, "gain_tfs_db": 3.0, "gain_over_average_db": 3.75, "gap_to_oracle_db": 0.5}
    assert report.gains({"plain": {"psnr": 22.0}})["gain_db"] is None


def test_an_interrupted_demo_goes_on_and_a_finished_one_is_kept(tmp_path: Path) -> None:
    plan = demo.steps(tmp_path, {"demo": 1.0}, 0)
    ledger = demo._ledger(tmp_path, plan, force=False)
    ledger["done"]["demo-capture"] = {"seconds": 1.0, "said": {}}
    demo._write(tmp_path / "steps.json", ledger)
    assert "demo-capture" in demo._ledger(tmp_path, plan, force=False)["done"]
    with pytest.raises(UsageError, match="other settings"):
        demo._ledger(tmp_path, demo.steps(tmp_path, {"demo": 2.0}, 0), force=False)
    (tmp_path / "report.json").write_text("{}")
    with pytest.raises(UsageError, match="finished"):
        demo._ledger(tmp_path, plan, force=False)
    assert demo._ledger(tmp_path, plan, force=True)["done"] == {}
    assert not (tmp_path / "report.json").exists()


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(UsageError, match="no demo"):
        demo._ledger(tmp_path, [], force=True)
    assert (tmp_path / "thesis.tex").exists()


def test_a_failed_step_hands_its_exit_code_and_reason_up(monkeypatch: pytest.MonkeyPatch) -> None:
    step = demo.Step("x", ("data", "info", "/no/such/file", "--json"), "look at nothing")
    with pytest.raises(RigError, match="look at nothing") as caught:
        demo.run_step(step)
    assert caught.value.exit_code in (2, 4)
    assert "spikerig data info" in caught.value.next


def test_the_report_escapes_what_comes_from_files() -> None:
    row = {"psnr": 1.0, "luma_psnr": 1.0, "ssim": 0.5, "steps": 1, "train_seconds": 1.0}
    scene = {"methods": {"<script>": row}, **report.gains({}), "pose_label": "<b>", "plan": "<u>"}
    result = {
        "scenes": {"<i>": scene},
        "seconds": 1.0,
        "commands": ["<u>"],
        "machine": {"cpu": "<c>", "cores": 1, "isa": "plain", "threads": 1, "commit": None},
    }
    page = report._page(result, {"<i>": {"sheet": b"", "errors": b"", "curve": b""}})
    for bad in ("<script>", "<i>", "<u>", "<c>"):
        assert bad not in page
    assert json.dumps(report.summary(result))
    assert sys.getsizeof(page) > 1000
