"""Plans of scene files and folders: captured, resolved, written as TOML; and the command."""

import json
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hard_plan import AUTO
from hard_sim import small, small_table

from spikerig.dataset import cli
from spikerig.dataset.errors import UsageError
from spikerig.dataset.images import write_image
from spikerig.dataset.store import open_scene
from spikerig.rigctl.sim.capture import capture
from spikerig.rigctl.sim.judge import calibrate
from spikerig.rigctl.sim.judge.check_scenes import case_named, scene_of, table_of
from spikerig.rigctl.sim.judge.folder_plan import plan_folder, work_folder
from spikerig.rigctl.sim.judge.plan import plan, resolve, resolved_table
from spikerig.rigctl.sim.judge.tomltext import toml_text
from spikerig.rigctl.sim.sources.folder import read_folder
from spikerig.rigctl.sim.sources.frames import capture_folder
from spikerig.rigctl.sim.spec import Tolerance, load_scene_toml, read_scene


def test_capture_with_auto_says_why(tmp_path: Path) -> None:
    spec = small(**AUTO, tolerance={"spikes": 1.0, "dn": 1.0})
    report = capture(spec, tmp_path / "auto.h5")
    made = plan(spec)
    assert set(report["effects"]) == {e.name for e in made.effects}
    assert report["plan_line"].startswith("effects that matter: ")
    with open_scene(tmp_path / "auto.h5") as scene:
        rows = scene.info["plan"]["effects"]
        assert [(row["name"], row["on"]) for row in rows] == [(row.effect.name, row.on) for row in made.rows]
        assert all(row["reason"] and row["formula"] for row in rows)
        assert scene.info["scene_file"]["effects"].keys() == {e.name for e in made.effects}
        auto = scene.view(scene.train[0]).spikes
    capture(resolve(spec, made), tmp_path / "listed.h5")
    with open_scene(tmp_path / "listed.h5") as scene:
        assert "plan" not in scene.info
        listed = scene.view(scene.train[0]).spikes
    assert auto is not None
    assert listed is not None
    assert np.array_equal(auto.bits, listed.bits)


def folder_of(path: Path, settings: str) -> Path:
    """Three pictures of one training view, and one of a view to test."""
    rng = np.random.default_rng(3)
    picture = rng.integers(20, 230, (12, 16, 3)).astype(np.uint8)
    views = []
    path.mkdir()
    for name, count in (("a", 3), ("b", 1)):
        frames = []
        for k in range(count):
            write_image(path / f"{name}{k}.png", np.roll(picture, k, 1))
            pose = np.eye(4)
            pose[0, 3] = 0.05 * k
            frames.append({"file": f"{name}{k}.png", "transform_matrix": pose.tolist()})
        views.append({"name": name, "split": "train" if name == "a" else "test", "frames": frames})
    table = {"camera_angle_x": 1.0, "views": views}
    (path / "transforms.json").write_text(json.dumps(table), encoding="utf-8")
    (path / "capture.toml").write_text(settings, encoding="utf-8")
    return path


FOLDER = """effects = "auto"
consider = ["shot_noise", "hot_pixels", "read_noise", { name = "threshold_fpn", sd = 0.1 }]
[tolerance]
spikes = 0.9
dn = 0.5
[exposure]
exposure_ms = 2.0
"""


def test_a_folder_has_a_plan(tmp_path: Path) -> None:
    folder = read_folder(folder_of(tmp_path / "f", FOLDER))
    made = plan_folder(folder)
    assert "hot_pixels" in [row.effect.name for row in made.rows if not row.on]
    assert {"threshold_fpn", "read_noise"} <= {e.name for e in made.effects}
    assert (made.samples.least, made.samples.chosen) == (3, False)
    told_of = capture_folder(folder, tmp_path / "f.h5")
    assert told_of["plan"] == made.as_json()
    with open_scene(tmp_path / "f.h5") as scene:
        assert scene.info["plan"] == json.loads(json.dumps(made.as_json()))
    work = work_folder(folder, made)
    assert (work.train, work.test) == (1, 1)
    assert calibrate.predict(work, made).total > 0


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Any:
    """Run a command line: (exit code, JSON document or None, text on stderr)."""

    def call(*words: object) -> tuple[int, Any, str]:
        capsys.readouterr()
        code = cli.run([str(w) for w in words])
        said = capsys.readouterr()
        return code, json.loads(said.out) if said.out else None, said.err

    return call


def test_the_command(run: Any, tmp_path: Path) -> None:
    scene, out = tmp_path / "s.toml", tmp_path / "out.toml"
    scene.write_text(toml_text(small_table(**AUTO, tolerance={"spikes": 1.0, "dn": 5.0})), encoding="utf-8")
    code, document, _ = run("sim", "effects", scene, "--write", out, "--json")
    assert code == 0
    assert document["schema"] == "spikerig.sim.effects/1"
    rows = {row["name"]: row for row in document["effects"]}
    assert rows.keys() == {"shot_noise", "dark_current", "threshold_fpn", "initial_phase", "read_noise"}
    assert not rows["read_noise"]["on"]
    for row in rows.values():
        assert row.keys() == {"name", "stage", "on", "spikes", "dn", "formula", "reason", "cpu_seconds"}
    assert document["cpu_seconds"]["total"] > 0
    assert document["samples"]["most"] == 5
    listed = tomllib.loads(out.read_text(encoding="utf-8"))
    assert [e["name"] for e in listed["effects"]] == [n for n, r in rows.items() if r["on"] and n != "initial_phase"]
    code, _, text = run("sim", "effects", scene, "--no-seconds")
    assert code == 0
    for piece in ("threshold_fpn", "on", "light samples: 5 an exposure, as given", "left out: at most"):
        assert piece in text
    assert run("sim", "effects", scene, "--write", out)[0] == 2
    assert run("sim", "effects", scene, "--settings", out)[0] == 2
    assert "did you mean 'demo'?" in run("sim", "effects", "demoo")[2]
    folder = folder_of(tmp_path / "f", FOLDER)
    code, document, _ = run("sim", "effects", folder, "--write", tmp_path / "settings.toml", "--json")
    assert code == 0
    again = read_folder(folder, tmp_path / "settings.toml")
    assert {e.name for e in again.rig.effects} == {row["name"] for row in document["effects"] if row["on"]}


def test_the_resolved_file_is_the_scene() -> None:
    for case in (case_named("paper"), case_named("from-zero")):
        spec = scene_of(case, (5.0, 5.0))
        made = plan(spec)
        text = toml_text(resolved_table(table_of(case, (5.0, 5.0)), made))
        again = read_scene(tomllib.loads(text), case.name)
        assert again == resolve(spec, made)
        assert replace(again, name="x") != replace(spec, name="x")


def test_toml_text_reads_back() -> None:
    table = {
        "s": 'quote " \\ \n \x7f é', "b": True, "i": -3, "f": 1e-30, "inf": float("inf"), "empty": [], "l": [1.5, 2.0],
        "rows": [{"name": "x", "v": [1, 2]}, {"name": "y"}], "none": {},
        "t": {"a b": 1, "deep": {"k": "v"}, "solids": [{"kind": "box", "skin": {"a": [1, 2, 3]}}, {"kind": "room"}]},
    }  # fmt: skip
    assert tomllib.loads(toml_text(table)) == table
    with pytest.raises(UsageError):
        toml_text({"x": None})


def test_faults_of_auto_are_told() -> None:
    table = small_table(
        effects="auto", consider=["shot_nose", "read_noise", "read_noise"], tolerance={"spike": 1, "dn": -1}
    )
    with pytest.raises(UsageError) as caught:
        read_scene(table)
    text = str(caught.value)
    for piece in ("did you mean 'shot_noise'?", "a second time", "tolerance.spike: unknown key", "tolerance.dn: is -1"):
        assert piece in text
    assert load_scene_toml("demo").tolerance == Tolerance(0.5, 0.5)
