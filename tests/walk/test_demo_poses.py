"""The demo's other road, small: boards, calibration, alignment, COLMAP poses, training on both, and the price told."""

import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest

from spikerig.dataset import cli, demo, report
from spikerig.dataset.demo_poses import posed_steps, price
from spikerig.dataset.store import open_scene

pytest.importorskip("pycolmap", reason="extra 'poses' is not installed: COLMAP makes this road's poses")


def scene_file(folder: Path) -> Path:
    """The demo's world from 9 places over 50 degrees, one of them held out, at 160x100."""
    text = files("spikerig.rigctl.sim").joinpath("scenes/demo.toml").read_text(encoding="utf-8")
    for old, new in (
        ("width = 200", "width = 160"), ("height = 125", "height = 100"), ("views = 30", "views = 9"),
        ("arc_deg = 174", "arc_deg = 50"), ("test_every = 5", "test = [4]"), ("sub_poses = 17", "sub_poses = 9"),
        ('effects = "auto"', "effects = [" + '"threshold_fpn"]'), ("count = 7200", "count = 2000"),
    ):  # fmt: skip
        assert old in text
        text = text.replace(old, new)
    start = text.index("consider = [")
    text = text[:start] + text[text.index("]\n\n[tolerance]") + 2 :]
    text = text[: text.index("[tolerance]")] + text[text.index("[camera]") :]
    tomllib.loads(text)
    path = folder / "small.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], dict[str, Any]]:
    """(folder, what each step said, the report) of the whole road, run as its command lines are."""
    out = tmp_path_factory.mktemp("road")
    plan = posed_steps(out, (1.0, 40), 3, scene=str(scene_file(out)), boards=8, methods=("spikenerf",))
    done = {step.key: {"seconds": 0.0, "said": demo.run_step(step)} for step in plan}
    return out, done, report.build(out, plan, done)


def test_the_price_of_calibration_and_poses_is_told(walked: tuple[Path, dict, dict]) -> None:
    out, _, told = walked
    cost = told["estimated"]
    row = cost["methods"]["spikenerf"]
    assert row["cost_db"] == pytest.approx(row["true_db"] - row["posed_db"])
    assert row["cost_with_points_db"] == pytest.approx(row["true_db"] - row["colmap_db"])
    assert cost["cost_db"]["mean"] == cost["cost_db"]["worst"] == row["cost_db"]
    assert -1 < row["cost_db"] < 8, "the held-out cameras lie where they belong, to a pixel or so"
    assert cost["poses"]["registered"] == 8
    assert cost["poses"]["truth"]["deg"]["median"] < 1.5
    assert cost["calibration"]["crop_px"]["median"] < 0.05
    assert cost["calibration"]["same_mirror"] is True
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "What estimated calibration and poses cost" in page
    assert "similarity" in page
    assert any("estimated calibration and poses cost" in line for line in report.summary(told))


def test_both_roads_meet_the_same_pictures(walked: tuple[Path, dict, dict]) -> None:
    """Scored against the very same pixels, at poses of which the estimate moved none."""
    out, done, _ = walked
    truths = {done[f"{s}-spikenerf-score"]["said"]["novel_view"]["truth_sha256"] for s in ("true", "posed", "colmap")}
    assert len(truths) == 1
    with open_scene(out / "true.h5") as true, open_scene(out / "colmap.h5") as found:
        assert true.test == found.test == ("004",)
        held, moved = (s.view("004").pose.cam_from_world for s in (true, found))
        assert (held == moved).all()
        assert any((true.view(n).pose.cam_from_world != found.view(n).pose.cam_from_world).any() for n in found.train)
        assert found.info["poses"]["accepted"] is True
        assert found.info["align"]["calibration"] != true.info["align"]["calibration"]


def test_every_line_of_the_plan_is_a_command_that_exists() -> None:
    known = cli.commands()
    plan = posed_steps(Path("runs/x"), (20.0, 0), 3)
    assert all(".".join(step.words[:2]) in known for step in plan)
    assert len({step.key for step in plan}) == len(plan)
    poses = next(step for step in plan if step.key == "colmap-poses")
    assert "--force" not in poses.words, "a refused estimate must stop the demo"
    budgets = {step.words[step.words.index("--seconds") + 1] for step in plan if step.key.endswith("-fit")}
    assert budgets == {"20"}


def test_without_estimates_there_is_no_price() -> None:
    assert price({"demo": {"methods": {}}}, {}) is None
