"""Folders of sub-frames: the same bits as the light they hold, and every fault told at once."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from hard_sim import small

from spikerig.dataset.cli import run
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.images import read_image, srgb_from_linear, write_image
from spikerig.dataset.store import open_scene
from spikerig.rigctl.sim.capture import camera_of, view_path
from spikerig.rigctl.sim.caster.light import Stage
from spikerig.rigctl.sim.sensor import Light
from spikerig.rigctl.sim.simulate import simulate
from spikerig.rigctl.sim.sources.folder import read_folder
from spikerig.rigctl.sim.sources.frames import capture_folder
from spikerig.rigctl.sim.sources.pictures import mend
from spikerig.rigctl.sim.sources.points import read_points

PHASES = np.linspace(0, 1, 5)
SETTINGS = 'seed = 4\neffects = ["shot_noise", "read_noise"]\n[exposure]\nexposure_ms = 1\n[points]\ncount = 50\n'


def opengl(cam_from_world: np.ndarray) -> list[list[float]]:
    """Camera-to-world of a camera with y up and z back, as Blender and NeRF write it."""
    world_from_cam = np.linalg.inv(np.vstack([cam_from_world, [0, 0, 0, 1]]))
    return (world_from_cam @ np.diag([1, -1, -1, 1])).tolist()


def make(root: Path, suffix: str = ".exr", depth: bool = True, settings: str = SETTINGS) -> dict[str, Any]:
    """Three views of the small scene, the last for testing; returns what transforms.json holds."""
    spec, root = small(), root
    root.mkdir(exist_ok=True)
    stage, camera = Stage(spec.world), camera_of(spec)
    views = []
    for number in range(3):
        path, frames = view_path(spec, number), []
        for k, phase in enumerate([0.5] if number == 2 else PHASES):
            pose = path.poses(phase)[0]
            light = stage.picture(camera, pose, 1)
            name = f"v{number}_{k}{suffix}"
            encoded = np.rint(srgb_from_linear(np.clip(light, 0, 1)) * 65535).astype(np.uint16)
            write_image(root / name, light if suffix == ".exr" else encoded, force=True)
            frames.append({"file": name, "transform_matrix": opengl(pose)})
        view: dict[str, Any] = {"name": f"v{number}", "split": "test" if number == 2 else "train", "frames": frames}
        if depth and number < 2:
            write_image(root / f"d{number}.exr", stage.depth(camera, path.poses(0.5)[0]), force=True)
            view["depth"] = f"d{number}.exr"
        views.append(view)
    table = {"camera_angle_x": np.radians(60.0), "views": views}
    save(root, table)
    if settings:
        (root / "capture.toml").write_text(settings)
    return table


def save(root: Path, table: dict[str, Any]) -> None:
    (root / "transforms.json").write_text(json.dumps(table))


def test_exr_frames_are_the_light(tmp_path: Path) -> None:
    """The scene from a folder holds, bit for bit, what `simulate` makes of the same light; poses survive."""
    make(tmp_path / "f")
    report = capture_folder(read_folder(tmp_path / "f"), tmp_path / "s.h5")
    assert (report["train_views"], report["test_views"], report["points"]) == (2, 1, 50)
    spec = small()
    stage, camera = Stage(spec.world), camera_of(spec)
    folder = read_folder(tmp_path / "f")
    with open_scene(tmp_path / "s.h5") as file:
        scene = file.read()
    assert np.allclose(scene.camera.K, camera.K)
    for number in (0, 1):
        path, view = view_path(spec, number), scene.views[number]
        rgb = np.stack([stage.picture(camera, path.poses(p)[0], 1) for p in PHASES])
        light = Light(rgb, np.array([0, 10, 20, 30, 40]), (0, 40), 40_000.0, (number + 1) * 1_000_000_000)
        seen = simulate(light, folder.rig.sensor, folder.rig.effects, 4, number)
        assert view.spikes is not None
        assert np.array_equal(view.spikes.bits, seen.spikes.bits)
        assert view.spikes.t0_ns == seen.spikes.t0_ns
        assert np.array_equal(view.frame.pixels, seen.frame.pixels)
        assert view.trajectory is not None
        assert np.allclose(view.trajectory.poses, path.poses(PHASES), atol=1e-12)
        assert np.allclose(view.pose.cam_from_world, path.poses(0.5)[0], atol=1e-12)
        assert np.array_equal(file_light(scene, view.name), rgb[2])
    assert scene.views[2].spikes is None
    assert np.allclose(scene.views[2].pose.cam_from_world, view_path(spec, 2).poses(0.5)[0], atol=1e-12)
    assert scene.points is not None
    assert np.abs(np.linalg.norm(scene.points.xyz - [0, 0, 0.4], axis=1) - 0.4).min() < 0.02


def file_light(scene: Any, name: str) -> np.ndarray:
    return scene.truth.light[name]


def test_png_frames_are_decoded(tmp_path: Path) -> None:
    make(tmp_path / "e")
    make(tmp_path / "p", ".png")
    for name in "ep":
        assert run(["sim", "frames", str(tmp_path / name), "-o", str(tmp_path / f"{name}.h5"), "--workers", "1"]) == 0
    scenes = []
    for name in "ep":
        with open_scene(tmp_path / f"{name}.h5") as file:
            scenes.append(file.read())
    for a, b in zip(scenes[0].views, scenes[1].views, strict=True):
        assert np.abs(a.frame.pixels.astype(int) - b.frame.pixels.astype(int)).max() <= 1
        assert np.allclose(file_light(scenes[0], a.name), file_light(scenes[1], a.name), atol=2e-4)


def test_the_papers_protocol_and_the_command(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    make(tmp_path / "f", depth=False, settings="")
    words = ["sim", "frames", str(tmp_path / "f"), "-o", str(tmp_path / "s.h5"), "--workers", "1", "--json"]
    assert run([*words, "--protocol", "paper", "--seed", "7"]) == 0
    out = capfd.readouterr()
    told = json.loads(out.out)
    assert told["schema"] == "spikerig.sim.frames/1"
    assert (told["ticks"], told["protocol"], told["seed"], told["points"]) == (18, "paper", 7, 0)
    assert "no initial points" in out.err
    with open_scene(tmp_path / "s.h5") as file:
        view = file.view("v0")
    assert view.trajectory is not None
    assert view.trajectory.at_ns[[0, -1]].tolist() == [1_000_000_000, 1_000_450_000]
    assert np.array_equal(view.trajectory.poses[0], view.trajectory.poses[1])  # where light holds, so does the camera
    assert run(words) == 2
    assert run([*words[:-2], "0", "--protocol", "papr", "--force"]) == 2
    assert "did you mean 'paper'" in capfd.readouterr().err


def test_phases_make_margins(tmp_path: Path) -> None:
    table = make(tmp_path / "f")
    for view in table["views"][:2]:
        for frame, phase in zip(view["frames"], [-0.5, 0, 0.5, 1, 1.25], strict=True):
            frame["phase"] = phase
    save(tmp_path / "f", table)
    folder = read_folder(tmp_path / "f")
    assert folder.views[0].plan.knots.tolist() == [-20, 0, 20, 40, 50]
    assert folder.views[0].track.phases.tolist() == [0, 0.5, 1]
    capture_folder(folder, tmp_path / "s.h5")
    with open_scene(tmp_path / "s.h5") as file:
        view = file.view("v0")
    assert view.spikes is not None
    assert view.spikes.ticks == 70
    assert view.spikes.t0_ns == 1_000_000_000 - 20 * 25_000


def test_the_nearest_frame_is_the_label(tmp_path: Path) -> None:
    table = make(tmp_path / "f")
    for view in table["views"][:2]:
        view["frames"].pop()
    save(tmp_path / "f", table)
    plan = read_folder(tmp_path / "f").views[0].plan
    assert plan.knots.tolist() == [0, 13, 27, 40]
    assert plan.label == 13 / 40  # the earlier of two equally near
    (tmp_path / "f" / "capture.toml").write_text(SETTINGS.replace("[exposure]", '[exposure]\nlabel = "first"'))
    assert read_folder(tmp_path / "f").views[0].plan.label == 0


def test_all_faults_of_a_layout_at_once(tmp_path: Path) -> None:
    root = tmp_path / "f"
    table = make(root)
    (tmp_path / "secret.exr").write_bytes((root / "v0_0.exr").read_bytes())
    frames = table["views"][0]["frames"]
    frames[0]["file"] = "../secret.exr"
    frames[1]["file"] = "missing.exr"
    frames[2]["transform_matrix"][0][0] = 3.0
    frames[3]["transform_matrix"] = [[1, 2], [3]]
    frames[4]["tramsform_matrix"] = []
    table["views"][1]["name"] = "a/b"
    table["views"][2]["split"] = "val"
    table["views"].append({"name": "v0", "frames": []})
    table["w"] = 30
    table["fl_x"] = -5
    table["camera_angle_x"] = 0.5
    save(root, table)
    with pytest.raises(DataError) as caught:
        read_folder(root)
    text = str(caught.value)
    for piece in (
        "views[0].frames[0].file: is '../secret.exr', which leads out of the folder",
        "views[0].frames[1].file: is 'missing.exr', and there is no such file",
        "views[0].frames[2].transform_matrix: holds no rotation",
        "views[0].frames[3].transform_matrix: is not 4x4",
        "did you mean 'transform_matrix'?",
        "views[1].name: is 'a/b'",
        "views[2].split: is 'val'",
        "views[3].frames: is missing or empty",
        "w: is 30, but the first picture has 29",
        "fl_x: is -5",
    ):
        assert piece in text, (piece, text)


@pytest.mark.parametrize(
    ("phases", "says"),
    [
        ([0, None, 0.5, 0.75, 1], "phases in part"),
        ([0, 0.25, 0.5, 0.75, 0.9], "ends of the exposure"),
        ([0, 0.5, 0.25, 0.75, 1], "not in the order of time"),
        ([0, 0.001, 0.5, 0.75, 1], "too many"),
        ([0, "x", 0.5, 0.75, 1], "expected numbers"),
    ],
)
def test_phases_that_cannot_be(tmp_path: Path, phases: list, says: str) -> None:
    table = make(tmp_path / "f")
    for frame, phase in zip(table["views"][0]["frames"], phases, strict=True):
        if phase is not None:
            frame["phase"] = phase
    save(tmp_path / "f", table)
    with pytest.raises(DataError, match=says):
        read_folder(tmp_path / "f")


def test_pictures_that_cannot_be_used(tmp_path: Path) -> None:
    """NaN, infinities, negative light, another size, a truncated file: all told, nothing written."""
    root = tmp_path / "f"
    make(root)
    good = Stage(small().world).picture(camera_of(small()), view_path(small(), 0).poses(0.5)[0], 1)
    for name, value in (("v0_1.exr", np.nan), ("v0_2.exr", np.inf), ("v1_0.exr", -0.25)):
        bad = good.copy()
        bad[3, 4] = value
        write_image(root / name, bad, force=True)
    write_image(root / "v1_3.exr", good[:-1], force=True)
    data = (root / "v1_4.exr").read_bytes()
    (root / "v1_4.exr").write_bytes(data[: len(data) // 2])
    with pytest.raises(DataError) as caught:
        capture_folder(read_folder(root), tmp_path / "s.h5")
    text = str(caught.value)
    for piece in (
        "5 faults",
        "v0/v0_1.exr: values that are no light (3 NaN of 1566)",
        "v0/v0_2.exr: values that are no light (3 infinite of 1566)",
        "v1/v1_0.exr: values that are no light (3 negative of 1566, the least -0.25)",
        "v1/v1_3.exr: is 29x17, the first picture 29x18",
        "v1/v1_4.exr: the picture is damaged",
    ):
        assert piece in text, (piece, text)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["f"]


@pytest.mark.parametrize("how", ["zero", "clip"])
def test_bad_values_are_mended_counted_and_reported(
    tmp_path: Path, how: str, capfd: pytest.CaptureFixture[str]
) -> None:
    """What is mended is as if the picture had held the mended values; the rest keeps its bits."""
    values = {"v0_1.exr": np.nan, "v0_2.exr": np.inf, "v1_0.exr": -0.25, "v1_3.exr": -np.inf, "v2_0.exr": np.inf}
    for folder in "ab":
        root = tmp_path / folder
        make(root)
        for name, value in values.items():
            light = read_image(root / name).copy()
            mended = light.max() if how == "clip" and value == np.inf else 0
            light[3, 4] = value if folder == "a" else mended
            write_image(root / name, light, force=True)
    words = ["--workers", "1", "--json", "--bad-values", how]
    told = []
    for folder in "ab":
        assert run(["sim", "frames", str(tmp_path / folder), "-o", str(tmp_path / f"{folder}.h5"), *words]) == 0
        out = capfd.readouterr()
        told.append(json.loads(out.out)["bad_values"])
        assert ("9 infinite, 3 negative" in out.err) == (folder == "a")
    assert told[0] == {"how": how, "pictures": 5, "nan": 3, "infinite": 9, "negative": 3}
    assert told[1] == {"how": how, "pictures": 0, "nan": 0, "infinite": 0, "negative": 0}
    scenes = []
    for folder in "ab":
        with open_scene(tmp_path / f"{folder}.h5") as file:
            scenes.append(file.read())
    for a, b in zip(scenes[0].views, scenes[1].views, strict=True):
        assert np.array_equal(a.frame.pixels, b.frame.pixels)
        assert np.array_equal(file_light(scenes[0], a.name), file_light(scenes[1], b.name))
        if a.spikes is not None and b.spikes is not None:
            assert np.array_equal(a.spikes.bits, b.spikes.bits)
    assert run(["sim", "frames", str(tmp_path / "a"), "-o", str(tmp_path / "c.h5"), "--bad-values", "zeros"]) == 2
    assert "did you mean 'zero'" in capfd.readouterr().err


def test_mending_a_picture_of_nothing_good() -> None:
    light = np.array([np.nan, np.inf, -np.inf, -1], np.float32)
    mended, bad = mend(light.copy(), "clip")
    assert mended.tolist() == [0, 0, 0, 0]
    assert bad == (1, 2, 1)
    fine = np.array([0.0, 65504], np.float32)
    assert mend(fine, "refuse") == (fine, (0, 0, 0))


def test_a_layer_on_another_window(tmp_path: Path) -> None:
    """Renders with a data window of their own, the picture in a named layer, depth as Blender names it."""
    root = tmp_path / "f"
    table = make(root)
    plain = read_image(root / "v0_0.exr")
    edges = (np.array([0, 0], np.int32), np.array([28, 17], np.int32))
    inner = (np.array([2, 3], np.int32), np.array([28, 17], np.int32))
    for view in table["views"]:
        for frame in view["frames"]:
            light = read_image(root / frame["file"])[3:, 2:]
            layers = {f"beauty.{c}": np.ascontiguousarray(light[:, :, k]) for k, c in enumerate("RGB")}
            channels = layers | {"R": 0 * light[:, :, 0].copy(), "Depth.Z": np.full(light.shape[:2], 2, np.float16)}
            header = {"dataWindow": inner, "displayWindow": edges}
            OpenEXR.File(header, channels).write(str(root / frame["file"]))
    for view in table["views"][:2]:
        view["depth"] = view["frames"][2]["file"]
    save(root, {**table, "layer": "beauty"})
    report = capture_folder(read_folder(root), tmp_path / "s.h5")
    assert report["points"] == 50
    with open_scene(tmp_path / "s.h5") as file:
        scene = file.read()
    seen = file_light(scene, "v0")
    assert seen.shape == plain.shape
    assert not seen[:3].any()
    assert not seen[:, :2].any()
    assert seen[3:, 2:].any()
    assert scene.points is not None
    pose = scene.views[0].pose.cam_from_world
    z = scene.points.xyz[:25] @ pose[2, :3] + pose[2, 3]
    assert np.allclose(z, 2, rtol=0.06), "two units ahead, within the noise of depth"
    save(root, {**table, "layer": 3})
    with pytest.raises(DataError, match="layer: is 3"):
        read_folder(root)


@pytest.mark.parametrize(
    ("text", "says"), [("{", "not JSON"), ("[]", "not a JSON object"), ("{}", "views: is missing or empty")]
)
def test_files_that_are_no_transforms(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(DataError, match="cannot be read"):
        read_folder(tmp_path)
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(DataError, match=says):
        read_folder(tmp_path)


def test_settings_that_the_frames_say(tmp_path: Path) -> None:
    make(tmp_path / "f", settings="[exposure]\nsub_poses = 4\n")
    with pytest.raises(UsageError, match="the frames say it"):
        read_folder(tmp_path / "f")
    with pytest.raises(UsageError, match="cannot be read"):
        read_folder(tmp_path / "f", tmp_path / "none.toml")


@pytest.mark.parametrize("binary", [True, False])
def test_points_from_ply(tmp_path: Path, binary: bool) -> None:
    xyz, rgb = np.array([[0.5, -1, 2], [3, 4, 5.25]], np.float32), np.array([[1, 2, 3], [255, 0, 9]], np.uint8)
    kind = "binary_little_endian" if binary else "ascii"
    names = [("x", "float"), ("y", "float"), ("z", "float"), ("red", "uchar"), ("green", "uchar"), ("blue", "uchar")]
    head = f"ply\nformat {kind} 1.0\nelement vertex 2\n" + "".join(f"property {t} {n}\n" for n, t in names)
    pairs = list(zip(xyz, rgb, strict=True))
    rows = [p.tobytes() + c.tobytes() for p, c in pairs]
    if not binary:
        rows = [f"{p[0]} {p[1]} {p[2]} {c[0]} {c[1]} {c[2]}\n".encode() for p, c in pairs]
    file = tmp_path / "f" / "points.ply"
    table = make(tmp_path / "f", depth=False)
    file.write_bytes(head.encode() + b"end_header\n" + b"".join(rows))
    save(tmp_path / "f", {**table, "points": "points.ply"})
    capture_folder(read_folder(tmp_path / "f"), tmp_path / "s.h5")
    with open_scene(tmp_path / "s.h5") as scene:
        points = scene.points
    assert points is not None
    assert points.source == "given"
    assert np.array_equal(points.xyz, xyz)
    assert np.array_equal(points.rgb, rgb)
    file.write_bytes(file.read_bytes()[:-3] if binary else head.encode() + b"end_header\n" + rows[0])
    with pytest.raises(DataError, match=r"truncated|do not fit"):
        read_points(file)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("plx\n", "not a PLY"),
        ("ply\nformat binary_big_endian 1.0\nelement vertex 0\nend_header\n", "another kind"),
        ("ply\nformat ascii 1.0\nelement face 1\nelement vertex 1\nend_header\n", "does not begin with"),
        ("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "lacks"),
        ("ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n1\n", "plain number"),
    ],
)
def test_files_that_are_no_points(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "p.ply").write_text(text)
    with pytest.raises(DataError, match=says):
        read_points(tmp_path / "p.ply")
