"""The study of poses: what counts as a success, what is saved, and how it goes on."""

import json
from pathlib import Path

import numpy as np
import pytest
from calib_worlds import moved, ring, turn

from spikerig.dataset import cli
from spikerig.rigctl import pose_study
from spikerig.rigctl.pose_study import Row, errors, spec_of, table


def test_success_is_within_a_degree_and_two_percent() -> None:
    """Ten good cameras, one turned by 1.6 degrees, one moved by 5 %, two not placed; the gauge is free."""
    truth = {f"v{k:02d}": p for k, p in enumerate(ring(14))}
    poses = np.stack(list(truth.values()))[:12]
    poses[3] = turn(0, np.radians(1.6), 0) @ poses[3]
    poses[7, :, 3] -= poses[7, :, :3] @ np.array([0, 0, 0.05 * 4.0])
    found = moved(poses, 3.0, turn(0.4, -0.2, 1.0), np.array([1.0, 2.0, 3.0]))
    views, placed, within, deg, share = errors(dict(zip(truth, found, strict=False)), truth)
    assert (views, placed, within) == (14, 12, 10)
    assert deg is not None
    assert 0 < deg < 0.6
    assert share is not None
    assert 0 < share < 0.01
    assert errors({}, truth) == (14, 0, 0, None, None)
    assert errors(dict.fromkeys(truth, truth["v00"]), truth)[2:] == (0, None, None)


def rows(blur: float, scene: str, reasons: tuple[str, ...] = ()) -> list[Row]:
    return [
        Row(scene, blur, "rgb", "", 20, 4, 2, 0.9, 0.01, 0.4, 1.0),
        Row(scene, blur, "spike", "tfp64", 20, 20, 18, 0.2, 0.001, 0.3, 1.0),
        Row(scene, blur, "maps", "tfp64", 20, 20, 19, 0.1, 0.001, 0.3, 3.0, reasons),
    ]


def test_a_refused_result_is_no_success() -> None:
    text = table([*rows(8.0, "demo"), *rows(8.0, "mesh", ("they differ",))])
    assert "**4 of 40 views (10%)**" in text
    assert "**36 of 40 views (90%)**" in text
    assert "**19 of 40 views (48%)**" in text
    assert "refused (19 of 20 right)" in text


def test_scenes_are_made_small_and_equally_blurred() -> None:
    spec = spec_of("mesh", 8.0, 5)
    assert (spec.lens.width, spec.lens.height, spec.shake.path_px) == (200, 125, (8.0, 8.0))
    assert (spec.orbit.views, spec.orbit.arc_deg, spec.orbit.test_every) == (5, 120.0, 0)


def test_it_goes_on_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made: list[tuple[str, float]] = []

    def measure(scene: str, blur: float, views: int, seed: int) -> list[Row]:
        if len(made) == 2:
            raise KeyboardInterrupt
        made.append((scene, blur))
        return rows(blur, scene)

    monkeypatch.setattr(pose_study, "measure", measure)
    words = ["cost", "pose-study", "-o", str(tmp_path), "--scenes", "demo,mesh,leaves", "--blur", "8", "--json"]
    assert cli.run(words) == 130
    assert len(json.loads((tmp_path / "pose_study.json").read_text())["rows"]) == 6
    made.clear()
    capsys.readouterr()
    assert cli.run(words) == 0
    assert made == [("leaves", 8.0)]
    assert len(json.loads(capsys.readouterr().out)["rows"]) == 9
    assert cli.run([*words, "--views", "9"]) == 2  # another study is not mixed in
    assert cli.run([*words, "--force", "--blur", "much"]) == 2
    (tmp_path / "pose_study.json").write_text("{}")
    assert cli.run(words) == 4
