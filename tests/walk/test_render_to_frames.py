"""From a trained model along a path back into the simulator: files are the only joint, and poses survive."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spikerig.dataset.cli import run
from spikerig.dataset.images import read_image
from spikerig.dataset.store import open_scene
from spikerig.rigctl.sim.capture import capture
from spikerig.rigctl.sim.spec import load_scene_toml, with_changes
from spikerig.train.layout import frame_row, read_layout


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from dataclasses import replace

    spec = with_changes(load_scene_toml("demo"), views=5)
    spec = replace(spec, lens=replace(spec.lens, width=48, height=30), cloud=replace(spec.cloud, count=400))
    path = tmp_path_factory.mktemp("scene") / "scene.h5"
    capture(spec, path)
    return path


@pytest.fixture(scope="module")
def model(scene: Path) -> Path:
    out = scene.parent / "run"
    words = ["train", "fit", str(scene), "-o", str(out), "--preset", "draft", "--steps", "20", "--splats", "400"]
    assert run(words) == 0
    return out


def render(model: Path, out: Path, *words: str) -> dict[str, Any]:
    assert run(["train", "render", str(model), "-o", str(out), *words]) == 0
    return json.loads((out / "transforms.json").read_text())


def simulate(folder: Path, out: Path, *words: str) -> None:
    assert run(["sim", "frames", str(folder), "-o", str(out), "--workers", "1", *words]) == 0
    assert run(["data", "verify", str(out)]) == 0


def ours(matrix: list[list[float]]) -> np.ndarray:
    return np.linalg.inv(np.array(matrix) @ np.diag([1, -1, -1, 1]))[:3]


def test_a_shaken_path_becomes_spikes(scene: Path, model: Path, tmp_path: Path) -> None:
    document = render(model, tmp_path / "shaken", "--path", "shake", "--subframes", "5", "--seed", "2")
    simulate(tmp_path / "shaken", tmp_path / "twin.h5")
    with open_scene(scene) as before, open_scene(tmp_path / "twin.h5") as after:
        assert after.names == before.names
        assert after.test == before.test
        np.testing.assert_allclose(after.camera.K, before.camera.K, atol=1e-9)
        assert after.points is not None
        assert len(after.points.xyz) > 300
        for row in document["views"]:
            name, frames = row["name"], row["frames"]
            assert all(f["file"].endswith(".exr") for f in frames), "linear light without being asked"
            seen, meant = after.view(name), before.view(name)
            np.testing.assert_allclose(seen.pose.cam_from_world, meant.pose.cam_from_world, atol=1e-6)
            if name in after.test:
                assert (row["split"], len(frames), seen.spikes) == ("test", 1, None)
                continue
            phases = np.array([f["phase"] for f in frames])
            assert {0.0, 1.0} <= set(phases.round(12).tolist())
            assert phases[0] < 0
            assert phases[-1] > 1
            assert seen.trajectory is not None
            assert seen.spikes is not None
            exposure = np.arange(5) / 4
            assert seen.frame.exposure_ns == 8_000_000
            np.testing.assert_allclose(
                (seen.trajectory.at_ns - seen.frame.start_ns) / seen.frame.exposure_ns, exposure, atol=1e-9
            )
            inside = [f for f in frames if -1e-9 <= f["phase"] <= 1 + 1e-9]
            poses = np.stack([ours(f["transform_matrix"]) for f in inside])
            np.testing.assert_allclose(seen.trajectory.poses, poses, atol=1e-6)
            assert np.abs(poses[0] - poses[-1]).max() > 1e-4, "it moves"
            sharp = read_image(tmp_path / "shaken" / inside[2]["file"])
            np.testing.assert_array_equal(after.truth_light(name), sharp)


@pytest.mark.parametrize("path", ["orbit", "train"])
def test_every_path_is_laid_out(scene: Path, model: Path, tmp_path: Path, path: str) -> None:
    render(model, tmp_path / "p", "--path", path, "--frames", "3", "--format", "exr")
    simulate(tmp_path / "p", tmp_path / "still.h5")
    with open_scene(scene) as before, open_scene(tmp_path / "still.h5") as after:
        if path == "train":
            assert after.names == before.train
            for name in after.names:
                poses = [file.view(name).pose.cam_from_world for file in (before, after)]
                np.testing.assert_allclose(poses[0], poses[1], atol=1e-6)
        else:
            assert list(after.names) == ["0000", "0001", "0002"]


def test_held_out_views_keep_their_split(model: Path, tmp_path: Path) -> None:
    document = render(model, tmp_path / "p")
    assert {view["split"] for view in document["views"]} == {"test"}
    assert document["views"][0]["frames"][0]["file"].endswith(".png")


def test_a_layout_of_others_is_drawn_as_it_stands(scene: Path, model: Path, tmp_path: Path) -> None:
    """What a dry run of the Blender script writes: poses, files and a lens of its own, without a picture."""
    with open_scene(scene) as file:
        poses = [file.view(name).pose.cam_from_world for name in file.names[:2]]
    frames = [frame_row(f"v/{k}.exr", pose) | {"phase": float(k)} for k, pose in enumerate(poses)]
    view = {"name": "v", "split": "train", "depth": "v/depth.exr", "frames": frames}
    table = {"camera_angle_x": 1.0, "w": 40, "h": 20, "views": [view]}
    plan = tmp_path / "plan.json"
    plan.write_text(json.dumps(table))
    assert render(model, tmp_path / "out", "--path", str(plan)) == table
    assert read_image(tmp_path / "out/v/1.exr").shape == (20, 40, 3)
    simulate(tmp_path / "out", tmp_path / "s.h5")
    with open_scene(tmp_path / "s.h5") as file:
        seen = file.view("v")
        assert seen.trajectory is not None
        np.testing.assert_allclose(seen.trajectory.poses, poses, atol=1e-6)
        assert file.camera.K[0, 0] == pytest.approx(20 / np.tan(0.5))


def test_a_layout_drawn_over_the_scenes_own_view_is_its_picture(scene: Path, model: Path, tmp_path: Path) -> None:
    """The same pose through the scene's own path and through a layout gives the same picture."""
    document = render(model, tmp_path / "a", "--path", "train", "--format", "exr")
    render(model, tmp_path / "b", "--path", str(tmp_path / "a" / "transforms.json"))
    for view in document["views"]:
        file = view["frames"][0]["file"]
        np.testing.assert_allclose(read_image(tmp_path / "a" / file), read_image(tmp_path / "b" / file), atol=2e-4)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"file": "../x.exr"}, 4),
        ({"file": "/tmp/x.exr"}, 4),
        ({"file": "x.txt"}, 4),
        ({"file": 3}, 4),
        ({"transform_matrix": [[1]]}, 4),
        ({"transform_matrix": "no"}, 4),
    ],
)
def test_layouts_that_cannot_be_drawn(scene: Path, model: Path, tmp_path: Path, change: dict, code: int) -> None:
    row = frame_row("x.exr", np.eye(3, 4)) | change
    plan = tmp_path / "plan.json"
    plan.write_text(json.dumps({"views": [{"name": "v", "frames": [row]}]}))
    assert run(["train", "render", str(model), "-o", str(tmp_path / "o"), "--path", str(plan)]) == code
    assert not list((tmp_path / "o").iterdir())


def test_a_layout_says_how_wide_it_sees(scene: Path) -> None:
    from spikerig.dataset.errors import DataError

    with open_scene(scene) as file:
        camera = file.camera
    views = [{"name": "v", "frames": [frame_row("x.exr", np.eye(3, 4))]}]
    half = read_layout(Path("p"), {"views": views, "w": camera.width * 2, "h": camera.height * 2}, camera).camera
    np.testing.assert_allclose(half.K[:2], 2 * camera.K[:2])
    for bad in ({"fl_x": 0}, {"camera_angle_x": 0}, {"w": 0}, {"views": []}, {"views": [{}]}):
        with pytest.raises(DataError):
            read_layout(Path("p"), {"views": views} | bad, camera)
