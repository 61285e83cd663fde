"""`spikerig cost poses`: what is swept, and what a setting's error is."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from spikerig.calib import pose_cost
from spikerig.calib.mapping import Map, Options, Placed
from spikerig.dataset import cli, cost
from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.capture import capture
from spikerig.rigctl.sim.spec import load_scene_toml


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    spec = load_scene_toml("demo")
    orbit = dataclasses.replace(spec.orbit, views=4, arc_deg=20.0, test_every=0, test=())
    path = tmp_path_factory.mktemp("cost") / "four.h5"
    capture(dataclasses.replace(spec, orbit=orbit, exposure=dataclasses.replace(spec.exposure, sub_poses=3)), path)
    return path


def test_errors_are_against_the_truth(scene: Path) -> None:
    truth = pose_cost.Truth(scene, 0)
    assert truth.off(truth.poses)[0] == pytest.approx(0, abs=1e-5)
    turned = {n: p.copy() for n, p in truth.poses.items()}
    c, s = np.cos(0.1), np.sin(0.1)
    turned["000"] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ turned["000"]
    assert truth.off(turned)[0] > 0.3
    assert np.isnan(truth.off({"000": turned["000"]})[0])


def test_larger_pictures_have_a_larger_camera(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    truth, seen = pose_cost.Truth(scene, 3), []

    def build(pictures: dict[str, np.ndarray], camera: Camera, options: Options) -> Map:
        seen.append(camera)
        assert {p.shape for p in pictures.values()} == {(camera.height, camera.width)}
        return Map({n: Placed(p, 1) for n, p in truth.poses.items()})

    monkeypatch.setattr("spikerig.calib.mapping.build_map", build)
    for times in (0.5, 1.0, 2.0):
        pose_cost.one_map(truth, Options(), times)
    for camera, times in zip(seen, (0.5, 1.0, 2.0), strict=True):
        scale = [[camera.width / truth.camera.width], [camera.height / truth.camera.height], [1]]
        assert camera.width == round(times * truth.camera.width)
        assert np.allclose(camera.K, truth.camera.K * scale)


def test_a_sweep_is_saved_and_says_that_it_ran_once(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pose_cost, "plan", lambda truth, threads: [("s", 1, lambda: (0.2, "deg"))])
    assert cli.run(["cost", "poses", str(scene), "-o", str(tmp_path), "--json"]) == 0
    text = cost.table(cost.load(tmp_path / "poses.json"))
    assert "each ran once" in text
    assert "| s | 1 | 0.2 deg |" in text
    assert cli.run(["cost", "poses", str(scene), "-o", str(tmp_path), "--json"]) == 2
