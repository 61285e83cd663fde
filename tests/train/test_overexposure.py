"""The overexposure study: what its numbers say of known pictures, its picture, its refusals, and a small run."""

import json
import tomllib
from importlib.resources import files

import numpy as np
import pytest

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.images import read_image
from spikerig.dataset.store import open_scene
from spikerig.rigctl.sim.capture import capture
from spikerig.rigctl.sim.spec import read_scene
from spikerig.train import overexposure as study


@pytest.fixture(scope="module")
def bright(tmp_path_factory):
    """A small scene of which much is brighter than white."""
    table = tomllib.loads(files("spikerig.rigctl.sim").joinpath("scenes/demo.toml").read_text(encoding="utf-8"))
    table["camera"] |= {"width": 64, "height": 40}
    table["orbit"] |= {"views": 5, "test_every": 5}
    table["points"] |= {"count": 400}
    table["world"]["lamp"]["power"] = [20.0, 19.0, 17.0]
    table["sensor"] = {"gain": 0.15}
    table["effects"] = []
    table.pop("consider")
    table.pop("tolerance")
    path = tmp_path_factory.mktemp("bright") / "bright.h5"
    capture(read_scene(table), path)
    return path


def light(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    picture = rng.uniform(0.2, 0.8, (60, 80, 1)) * np.ones(3)
    picture[20:50, 20:60] *= 6
    return picture


def test_the_truth_is_perfect_and_a_clipped_picture_is_not():
    true = light()
    same = study.grade_light([(true, true)])
    assert same["detail"] == pytest.approx(1)
    assert same["light_ratio"] == pytest.approx(1)
    assert same["mu_psnr_highlights"] > 100
    clipped = study.grade_light([(np.minimum(true, 1), true)])
    assert clipped["detail"] < 0.3
    assert clipped["light_ratio"] < 0.4
    assert clipped["mu_psnr_highlights"] < clipped["mu_psnr"] < 40


def test_detail_does_not_see_the_level_and_the_level_does_not_see_detail():
    true = light()
    darker = study.grade_light([(true / 3, true)])
    assert darker["detail"] > 0.99
    assert darker["light_ratio"] == pytest.approx(1 / 3)
    other = study.grade_light([(light(1), true)])
    assert abs(other["detail"]) < 0.3
    assert other["light_ratio"] == pytest.approx(1, abs=0.15)


def test_smoothing_keeps_a_constant_and_blurs_a_dot():
    everywhere, half = np.ones((41, 41), bool), np.arange(41)[:, None] * np.ones(41) < 20
    step = np.where(half, 2.5, 9.0)
    assert study.smooth(step, half)[half] == pytest.approx(2.5)  # what lies outside is not seen
    dot = np.zeros((41, 41))
    dot[20, 20] = 1
    assert study.smooth(dot, everywhere)[20, 20] == pytest.approx(1 / (2 * np.pi * study.SIGMA**2), rel=0.01)


def test_the_mu_law_ends_at_the_peak():
    assert study.mu_law(np.array([0.0, 4.0, 9.0]), 4.0).tolist() == pytest.approx([0, 1, 1])
    assert study.mu_law(np.array([0.4]), 4.0)[0] > 0.7


def test_a_scene_without_highlights_is_refused(tiny, monkeypatch):
    monkeypatch.setattr(study, "highlights", lambda light: light.max(-1) > 9)
    with open_scene(tiny) as scene, pytest.raises(DataError, match="brighter than RGB white"):
        study.looks(scene)


def test_a_row_that_does_not_exist_and_a_file_that_does_are_told(bright, tmp_path):
    with pytest.raises(UsageError, match="no such row"):
        study.overexposure(bright, methods="plain,edi")
    (tmp_path / "overexposure.json").write_text("{}")
    with pytest.raises(UsageError, match="exists"):
        study.overexposure(bright, out=tmp_path)


def test_spikes_bring_back_light_above_white(bright, tmp_path, capsys):
    study.overexposure(bright, methods="plain,ours", steps=120, out=tmp_path, as_json=True)
    shown = json.loads(capsys.readouterr().out)
    doc = json.loads((tmp_path / "overexposure.json").read_text())
    assert shown["rows"] == doc["rows"]
    plain, ours = doc["rows"]
    assert doc["frames_clipped"] > 0.1
    assert doc["brightest"] > 2
    assert plain["light_ratio"] < 0.8
    assert ours["light_ratio"] > plain["light_ratio"] + 0.05
    assert ours["mu_psnr_highlights"] > plain["mu_psnr_highlights"]
    picture = read_image(tmp_path / "overexposure.png")
    assert picture.shape == (2 * (40 * study.ZOOM + 4), 3 * (64 * study.ZOOM + 4), 3)
