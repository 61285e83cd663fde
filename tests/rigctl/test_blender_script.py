"""The Blender script without Blender: its poses, its layout, and its calls against a small stand-in for bpy."""

import json
import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import OpenEXR
import pytest

from spikerig.dataset.cli import run
from spikerig.dataset.store import open_scene
from spikerig.rigctl.sim.sources.folder import read_folder

SCRIPT = Path(__file__).resolve().parents[2] / "docs" / "blender" / "render_rs3d.py"
WIDTH, HEIGHT, LENS = 24, 15, 30.0


@pytest.fixture(scope="module")
def script() -> SimpleNamespace:
    return SimpleNamespace(**runpy.run_path(str(SCRIPT)))


def plane_picture(pose: np.ndarray, focal: float) -> tuple[np.ndarray, np.ndarray]:
    """What a pinhole at an OpenGL pose sees of the floor z = 0, checkered, and how far along its axis it is."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(x - WIDTH / 2) / focal, -(y - HEIGHT / 2) / focal, -np.ones_like(x)], 2) @ pose[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.where(rays[:, :, 2] < 0, -pose[2, 3] / rays[:, :, 2], np.inf)
        at = pose[:3, 3] + z[:, :, None] * rays
        light = np.where(np.isfinite(z), 0.3 + 0.2 * np.sin(3 * at[:, :, 0]) * np.sin(3 * at[:, :, 1]), 0)
    return np.repeat(light[:, :, None], 3, 2).astype(np.float32), z


class Stand(ModuleType):
    """The few calls of bpy that the script makes; `render` writes what Blender would, in the way of a version.

    Args:
        version: 4 writes one multilayer part with dotted names, 5 a part for each pass and asks for a media type.
        stop_after: renders that succeed before it is killed half-way through a file.
    """

    def __init__(self, version: int = 4, stop_after: int = 10**9) -> None:
        super().__init__("bpy")
        settings = SimpleNamespace(file_format="PNG", color_depth="8", color_mode="RGB", exr_codec="PIZ")
        if version >= 5:
            settings.media_type = "IMAGE"
        lens = SimpleNamespace(
            type="PERSP", lens=LENS, sensor_width=36.0, sensor_height=24.0, sensor_fit="AUTO", shift_x=0.1, shift_y=0.0,
            dof=SimpleNamespace(use_dof=True),
        )  # fmt: skip
        self.cleared: list[str] = []
        camera = SimpleNamespace(
            name="Camera", data=lens, parent=object(), matrix_world=np.diag([1.0, 1, 1, 1]) + np.eye(4, k=3) * 0,
            constraints=SimpleNamespace(clear=lambda: self.cleared.append("constraints")),
            animation_data_clear=lambda: self.cleared.append("animation"),
        )  # fmt: skip
        camera.matrix_world[2, 3] = 3.0
        render = SimpleNamespace(
            resolution_x=2 * WIDTH, resolution_y=2 * HEIGHT, resolution_percentage=50, pixel_aspect_x=2.0,
            pixel_aspect_y=1.0, image_settings=settings, film_transparent=True, filepath="", use_motion_blur=True,
        )  # fmt: skip
        cycles, layer = SimpleNamespace(seed=0, samples=4096), SimpleNamespace(use_pass_z=False)
        self.scene = SimpleNamespace(camera=camera, render=render, cycles=cycles, view_layers=[layer])
        self.context = SimpleNamespace(scene=self.scene)
        self.ops = SimpleNamespace(render=SimpleNamespace(render=self.render))
        self.version, self.left, self.rendered, self.seeds = version, stop_after, [], []

    def render(self, write_still: bool) -> None:
        scene, settings = self.scene, self.scene.render.image_settings
        assert write_still
        path = Path(scene.render.filepath)
        if self.left == 0:
            path.write_bytes(b"half")
            raise KeyboardInterrupt
        self.left -= 1
        self.rendered.append(path.name)
        self.seeds.append(scene.cycles.seed)
        pose = np.array(scene.camera.matrix_world)
        light, z = plane_picture(pose, LENS / 36 * WIDTH)
        alpha = np.isfinite(z).astype(np.float32)
        colour = dict(zip("RGBA", [*np.moveaxis(light, 2, 0), alpha], strict=True))
        depth = np.where(np.isfinite(z), z, 1e10).astype(np.float32)
        assert settings.color_depth == "32"
        kind = OpenEXR.scanlineimage
        if settings.file_format == "OPEN_EXR":
            channels = colour if settings.color_mode == "RGBA" else {k: colour[k] for k in "RGB"}
            OpenEXR.File({"type": kind}, whole(channels)).write(str(path))
            return
        assert settings.file_format == "OPEN_EXR_MULTILAYER"
        assert scene.view_layers[0].use_pass_z
        if self.version < 5:
            channels = {f"ViewLayer.Combined.{k}": v for k, v in colour.items()} | {"ViewLayer.Depth.Z": depth}
            OpenEXR.File({"type": kind}, whole(channels)).write(str(path))
            return
        assert settings.media_type == "MULTI_LAYER_IMAGE"
        parts = {"ViewLayer.Combined": colour, "ViewLayer.Depth": {"Z": depth}}
        OpenEXR.File([OpenEXR.Part({"type": kind}, whole(c), n) for n, c in parts.items()]).write(str(path))


def whole(channels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: np.ascontiguousarray(samples) for name, samples in channels.items()}


def play(monkeypatch: pytest.MonkeyPatch, bpy: Stand, *words: str) -> None:
    mathutils = ModuleType("mathutils")
    mathutils.Matrix = np.array  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "bpy", bpy)
    monkeypatch.setitem(sys.modules, "mathutils", mathutils)
    monkeypatch.setattr(sys, "argv", ["blender", "-b", "x.blend", "-P", str(SCRIPT), "--", *words])
    runpy.run_path(str(SCRIPT), run_name="__main__")


@pytest.mark.parametrize("version", [4, 5])
def test_a_blend_becomes_a_scene(version: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Layout, settings and files as `sim frames` wants them: 18 slots that hold, half the views for testing."""
    bpy, out = Stand(version), tmp_path / "frames"
    play(monkeypatch, bpy, "--out", str(out), "--views", "4", "--seed", "3", "--samples", "16")
    assert len(bpy.rendered) == 2 * 18 + 2
    assert len(set(bpy.seeds)) == len(bpy.seeds)
    assert bpy.cleared == ["constraints", "animation"]
    assert bpy.scene.camera.parent is None
    assert (bpy.scene.cycles.samples, bpy.scene.render.use_motion_blur) == (16, False)
    assert not list(out.rglob("*.part*"))
    assert run(["sim", "frames", str(out), "-o", str(tmp_path / "s.h5"), "--workers", "1"]) == 0
    assert run(["data", "verify", str(tmp_path / "s.h5")]) == 0
    document = json.loads((out / "transforms.json").read_text())
    with open_scene(tmp_path / "s.h5") as file:
        scene = file.read()
    assert [v.split for v in scene.views] == ["train", "train", "test", "test"]
    assert scene.camera.K[0, 0] == pytest.approx(LENS / 36 * WIDTH)
    for view, row in zip(scene.views, document["views"], strict=True):
        frames = row["frames"]
        label = 8 if row["split"] == "train" else 0  # of 18, the earlier of the two nearest to the middle
        pose = np.linalg.inv(np.array(frames[label]["transform_matrix"]) @ np.diag([1, -1, -1, 1]))[:3]
        np.testing.assert_allclose(view.pose.cam_from_world, pose, atol=1e-6)
        light, z = plane_picture(np.array(frames[label]["transform_matrix"]), LENS / 36 * WIDTH)
        light[~np.isfinite(z)] = 1.0  # the background behind a transparent film
        assert scene.truth is not None
        np.testing.assert_allclose(scene.truth.light[view.name], light, atol=1e-6)
        if view.spikes is not None:
            assert view.spikes.ticks == 18
    assert scene.points is not None
    assert np.abs(scene.points.xyz[:, 2]).mean() < 0.05, "on the floor"


def test_a_dry_run_and_a_run_cut_short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["--out", str(tmp_path / "f"), "--views", "3", "--test", "1", "--subframes", "4"]
    play(monkeypatch, Stand(), *words, "--dry-run")
    assert sorted(p.name for p in (tmp_path / "f").iterdir()) == ["capture.toml", "transforms.json"]
    with pytest.raises(KeyboardInterrupt):
        play(monkeypatch, Stand(stop_after=5), *words)
    again = Stand()
    play(monkeypatch, again, *words)
    assert len(again.rendered) == 2 * 4 + 1 - 5
    assert again.rendered[0] == "01.part.exr"
    assert again.seeds == [5, 6, 7, 8], "as if it had never stopped"
    last = Stand()
    play(monkeypatch, last, *words)
    assert last.rendered == []
    with pytest.raises(SystemExit, match="other settings"):
        play(monkeypatch, Stand(), *words, "--seed", "1")


def test_the_papers_counts(script: SimpleNamespace) -> None:
    """200 views of 18 sub-frames, half for training, half for testing, where nothing else is said."""
    args = script.arguments(["--out", "x"])
    document = script.layout(args, 500.0, 400, 250, 4.0)
    assert [v["split"] for v in document["views"]] == ["train"] * 100 + ["test"] * 100
    assert {len(v["frames"]) for v in document["views"][:100]} == {18}
    assert {len(v["frames"]) for v in document["views"][100:]} == {1}
    eyes = np.array([v["frames"][0]["transform_matrix"] for v in document["views"][100:]])[:, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(eyes, axis=1), 4, rtol=1e-9)
    assert eyes[:, 2].min() > 4 * np.sin(np.radians(9.9))
    files = [f["file"] for v in document["views"] for f in v["frames"]]
    assert len(set(files)) == len(files) == 1900


def test_nerfs_poses_are_taken_as_they_are(script: SimpleNamespace, tmp_path: Path) -> None:
    poses = script.hemisphere(5, 4.0, (0, 0, 0), 1)
    for name in ("train", "test"):
        rows = [{"file_path": f"./{name}/r_{k}", "transform_matrix": p.tolist()} for k, p in enumerate(poses)]
        (tmp_path / f"{name}.json").write_text(json.dumps({"camera_angle_x": 0.69, "frames": rows}))
    words = ["--poses-train", str(tmp_path / "train.json"), "--poses-test", str(tmp_path / "test.json"), "--test", "2"]
    args = script.arguments(["--out", "x", *words, "--subframes", "5", "--protocol", "rig"])
    document = script.layout(args, 500.0, 400, 250, 4.0)
    assert [v["split"] for v in document["views"]] == ["train"] * 5 + ["test"] * 2
    for view, pose in zip(document["views"], [*poses, *poses[:2]], strict=True):
        middle = view["frames"][len(view["frames"]) // 2]["transform_matrix"]
        np.testing.assert_allclose(middle, pose, atol=1e-9)  # at mid-exposure the shake is zero


@pytest.mark.parametrize("length", [0.0, 7.5, 60.0])
def test_a_shake_is_as_long_as_asked(script: SimpleNamespace, length: float) -> None:
    base = script.looking_at(np.array([2.0, -3.0, 1.5]), np.zeros(3))
    depth, focal = np.linalg.norm([2.0, -3.0, 1.5]), 300.0
    phases = np.linspace(0, 1, 400)
    poses = script.shaken(base, phases, length, focal, depth, 0.2, np.random.default_rng(0))
    seen = np.stack([np.linalg.inv(p) @ [0, 0, 0, 1] for p in poses])
    pixels = focal * seen[:, :2] / -seen[:, 2:3]
    assert np.linalg.norm(np.diff(pixels, axis=0), axis=1).sum() == pytest.approx(length, rel=2e-2, abs=1e-9)
    turns = poses[:, :3, :3]
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turns.shape), atol=1e-12)
    again = script.shaken(base, phases, length, focal, depth, 0.2, np.random.default_rng(0))
    np.testing.assert_array_equal(poses, again)


def test_blenders_lens(script: SimpleNamespace) -> None:
    """A 50 mm lens: 36 mm lie along the longer side, unless the camera names one."""
    assert script.focal_of(50, 36, 24, "AUTO", 1920, 1080) == pytest.approx(50 / 36 * 1920)
    assert script.focal_of(50, 36, 24, "AUTO", 1080, 1920) == pytest.approx(50 / 36 * 1920)
    assert script.focal_of(50, 36, 24, "HORIZONTAL", 1080, 1920) == pytest.approx(50 / 36 * 1080)
    assert script.focal_of(50, 36, 24, "VERTICAL", 1920, 1080) == pytest.approx(50 / 24 * 1080)


def test_a_camera_looks_at_its_target(script: SimpleNamespace, tmp_path: Path) -> None:
    for pose in script.hemisphere(20, 3.0, (1.0, 2.0, 0.5), 0):
        ahead = np.linalg.inv(pose) @ [1.0, 2.0, 0.5, 1]
        np.testing.assert_allclose(ahead[:3], [0, 0, -3], atol=1e-9)
        assert pose[2, 1] > 0, "upright"
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    above = script.looking_at(np.array([0, 0, 5.0]), np.zeros(3))
    assert np.linalg.det(above[:3, :3]) == pytest.approx(1)


def test_cameras_and_options_that_cannot_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    bpy = Stand()
    bpy.scene.camera.data.type = "ORTHO"
    with pytest.raises(SystemExit, match="perspective"):
        play(monkeypatch, bpy, "--out", str(tmp_path / "f"))
    bpy = Stand()
    bpy.scene.camera = None
    with pytest.raises(SystemExit, match="no camera"):
        play(monkeypatch, bpy, "--out", str(tmp_path / "f"))
    for words in (["--views", "0"], ["--subframes", "1"], ["--shake-px", "5", "2"]):
        with pytest.raises(SystemExit):
            play(monkeypatch, Stand(), "--out", str(tmp_path / "f"), *words)
    assert not (tmp_path / "f").exists()
    assert "--views is at least 1" in capsys.readouterr().err


def test_rig_protocol_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["--out", str(tmp_path / "f"), "--views", "1", "--test", "0", "--protocol", "rig", "--subframes", "3"]
    play(monkeypatch, Stand(), *words)
    folder = read_folder(tmp_path / "f")
    assert (folder.settings.exposure.protocol, folder.settings.exposure.ticks) == ("rig", 320)
    assert folder.views[0].plan.knots.tolist() == [0, 160, 320]
