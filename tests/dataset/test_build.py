"""`spikerig data build`: folders become a scene, and every fault is told at once; `data verify` from the shell."""

import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hard_store import stream

from spikerig.dataset.build import BuildConfig, area_resize, build_scene, natural
from spikerig.dataset.cli import run
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.images import linear_from_srgb, srgb8_from_linear, write_image
from spikerig.dataset.spikes import write_spikes
from spikerig.dataset.store import open_scene

H, W = 13, 21  # of hard_store.stream
STEMS = [f"r_{i}" for i in (0, 1, 2, 10, 11)]


def pixels_of(i: int, height: int = H, width: int = W, channels: int = 3) -> np.ndarray:
    return np.random.default_rng(i).integers(0, 256, (height, width, channels), np.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "rgb").mkdir()
    (tmp_path / "spikes").mkdir()
    frames = []
    for i, stem in enumerate(STEMS):
        write_image(tmp_path / "rgb" / f"{stem}.png", pixels_of(i))
        write_spikes(tmp_path / "spikes" / f"{stem}.npz", stream(40, i))
        matrix = np.eye(4)
        matrix[:3, 3] = [i, 2, 3]
        frames.append({"file_path": f"./train/{stem}", "transform_matrix": matrix.tolist()})
    (tmp_path / "t.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames}))
    return tmp_path


def config(folder: Path, **more: Any) -> BuildConfig:
    return BuildConfig(**{"rgb": folder / "rgb", "spikes": folder / "spikes", "transforms": folder / "t.json"} | more)


def test_folders_become_a_scene(folder: Path) -> None:
    made = build_scene(config(folder, test_every=3, exposure_us=200.0), folder / "s.h5")
    assert (made["views"], made["train"], made["test"]) == (5, ["r_1", "r_2", "r_11"], ["r_0", "r_10"])
    with open_scene(folder / "s.h5") as scene:
        assert scene.names == tuple(STEMS), "natural order: r_2 before r_10"
        fx = W / 2 / np.tan(0.4)
        np.testing.assert_allclose(scene.camera.K, [[fx, 0, W / 2], [0, fx, H / 2], [0, 0, 1]])
        for i, stem in enumerate(STEMS):
            view, spikes = scene.view(stem), stream(40, i)
            np.testing.assert_array_equal(view.frame.pixels, pixels_of(i))
            assert view.spikes is not None
            np.testing.assert_array_equal(view.spikes.bits, spikes.bits)
            np.testing.assert_array_equal(view.spikes.lost, spikes.lost)
            np.testing.assert_allclose(view.pose.centre, [i, 2, 3], atol=1e-12)
            assert view.frame.exposure_ns == 200_000
            assert view.frame.start_ns == spikes.t0_ns + (1_000_000 - 200_000) // 2, "centred in 40 ticks of 25 us"
            assert view.frame.transfer == "srgb"
            assert view.valid.all()
            np.testing.assert_array_equal(view.sensor_row[:, 3], np.arange(H))
        assert (scene.points, scene.light_gain, scene.has_truth) == (None, None, False)


def test_an_exposure_not_given_is_as_long_as_the_spikes(folder: Path) -> None:
    build_scene(config(folder), folder / "s.h5")
    with open_scene(folder / "s.h5") as scene:
        frame = scene.view("r_2").frame
        assert (frame.exposure_ns, frame.start_ns) == (1_000_000, stream(40, 2).t0_ns)


def test_every_fault_is_told_at_once_and_nothing_is_written(folder: Path) -> None:
    os.remove(folder / "rgb" / "r_1.png")
    os.remove(folder / "spikes" / "r_2.npz")
    write_image(folder / "rgb" / "extra.png", pixels_of(9))
    write_image(folder / "rgb" / "r_10.png", pixels_of(9, H + 1), force=True)
    write_spikes(folder / "spikes" / "r_11.npz", stream(40, 1, None), force=True)
    (folder / "spikes" / "r_0.npz").write_bytes(b"PK\x03\x04 broken")
    with pytest.raises(DataError) as told:
        build_scene(config(folder), folder / "s.h5")
    for part in (
        "6 things do not fit together",
        "r_1: a pose, but no picture",
        "r_2: a pose, but no spikes",
        "extra.png: no pose",
        f"r_10.png: {W} x {H + 1}",
        "r_11.npz: does not say its rate: give --rate-hz",
        "r_0.npz: ",
    ):
        assert part in str(told.value), part
    assert not list(folder.glob("s.h5*"))


def test_what_has_no_partner_is_left_out_when_asked(folder: Path) -> None:
    os.remove(folder / "rgb" / "r_1.png")
    os.remove(folder / "spikes" / "r_2.npz")
    write_image(folder / "rgb" / "extra.png", pixels_of(9))
    made = build_scene(config(folder, skip_unmatched=True), folder / "s.h5")
    assert made["train"] == ["r_0", "r_10", "r_11"]
    assert len(made["notes"]) == 3
    assert "left out: r_1: a pose, but no picture" in made["notes"]


def test_a_held_out_view_needs_no_spikes(folder: Path) -> None:
    os.remove(folder / "spikes" / "r_0.npz")
    build_scene(config(folder, test_every=5), folder / "s.h5")
    with open_scene(folder / "s.h5") as scene:
        assert scene.test == ("r_0",)
        assert scene.view("r_0").spikes is None


def test_pictures_of_another_size_need_an_explicit_choice(folder: Path) -> None:
    for i, stem in enumerate(STEMS):
        write_image(folder / "rgb" / f"{stem}.png", pixels_of(i, 3 * H, 3 * W), force=True)
    with pytest.raises(DataError, match="--resize"):
        build_scene(config(folder), folder / "s.h5")
    build_scene(config(folder, resize=True), folder / "s.h5")
    with open_scene(folder / "s.h5") as scene:
        fx = W / 2 / np.tan(0.4)
        np.testing.assert_allclose(scene.camera.K, [[fx, 0, W / 2], [0, fx, H / 2], [0, 0, 1]])
        light = linear_from_srgb(pixels_of(1, 3 * H, 3 * W)).astype(np.float64)
        want = srgb8_from_linear(light.reshape(H, 3, W, 3, 3).mean((1, 3)))
        assert np.abs(scene.view("r_1").frame.pixels.astype(int) - want).max() <= 1
    for i, stem in enumerate(STEMS):
        write_image(folder / "rgb" / f"{stem}.png", pixels_of(i, 3 * H, 2 * W), force=True)
    with pytest.raises(DataError, match="differ in shape"):
        build_scene(config(folder, resize=True), folder / "s.h5", force=True)


def test_a_resize_moves_no_pixel_centre() -> None:
    """A ramp in x + 0.5 stays that ramp, scaled: centres at +0.5 on both sides."""
    ramp = np.repeat((np.arange(40, dtype=np.float32) + 0.5)[None, :, None], 20, 0).repeat(3, 2)
    small = area_resize(ramp, 10, 5)
    np.testing.assert_allclose(small[:, :, 0], np.broadcast_to((np.arange(10) + 0.5) * 4, (5, 10)), rtol=1e-6)
    assert area_resize(ramp, 40, 20) is ramp


def test_transparent_pictures_need_a_background(folder: Path) -> None:
    for i, stem in enumerate(STEMS):
        write_image(folder / "rgb" / f"{stem}.png", pixels_of(i, channels=4), force=True)
    with pytest.raises(DataError, match="5 things") as told:
        build_scene(config(folder), folder / "s.h5")
    assert "--background black|white" in str(told.value)
    build_scene(config(folder, background=1.0), folder / "s.h5")
    with open_scene(folder / "s.h5") as scene:
        rgba = pixels_of(1, channels=4) / 255
        want = rgba[:, :, :3] * rgba[:, :, 3:] + 1 - rgba[:, :, 3:]
        np.testing.assert_array_equal(scene.view("r_1").frame.pixels, np.rint(want * 255))
        assert scene.info["background"] == 1.0


def test_deep_and_linear_pictures_become_8_bit_srgb(folder: Path) -> None:
    deep = np.random.default_rng(0).integers(0, 65536, (H, W, 3), np.uint16)
    write_image(folder / "rgb" / "r_0.png", deep, force=True)
    os.remove(folder / "rgb" / "r_1.png")
    light = np.random.default_rng(1).random((H, W, 3), np.float32)
    write_image(folder / "rgb" / "r_1.exr", light)
    os.remove(folder / "rgb" / "r_2.png")
    gray = pixels_of(3, channels=1)
    (folder / "rgb" / "r_2.jpg").write_bytes(cv2.imencode(".jpg", np.full((H, W), 77, np.uint8))[1].tobytes())
    write_image(folder / "rgb" / "r_10.png", gray, force=True)
    build_scene(config(folder), folder / "s.h5")
    with open_scene(folder / "s.h5") as scene:
        np.testing.assert_array_equal(scene.view("r_0").frame.pixels, np.rint(deep / 65535 * 255))
        np.testing.assert_array_equal(scene.view("r_1").frame.pixels, srgb8_from_linear(light))
        assert (scene.view("r_2").frame.pixels == 77).all()
        np.testing.assert_array_equal(scene.view("r_10").frame.pixels, np.repeat(gray, 3, 2))


def test_pictures_alone_make_a_scene_of_a_stated_size(folder: Path) -> None:
    for i, stem in enumerate(STEMS):
        write_image(folder / "rgb" / f"{stem}.png", pixels_of(i, 2 * H, 2 * W), force=True)
    made = build_scene(config(folder, spikes=None, size=(W, H), test_every=1), folder / "s.h5")
    assert (made["train"], len(made["test"])) == ([], 5)
    with open_scene(folder / "s.h5") as scene:
        view = scene.view("r_2")
        assert (view.spikes, view.frame.exposure_ns, view.frame.pixels.shape) == (None, 0, (H, W, 3))
        assert scene.camera.K[0, 0] == pytest.approx(W / 2 / np.tan(0.4))


def silhouettes(folder: Path, radius: float) -> None:
    """Cameras 4 from the origin around it, looking at it; alpha is a disc, the outline of a ball at the origin."""
    frames = []
    for i, stem in enumerate(STEMS):
        a = 2 * np.pi * i / len(STEMS)
        back = np.array([np.sin(a), 0, np.cos(a)])  # OpenGL: z points away from what is seen
        right = np.cross([0, 1, 0], back)
        matrix = np.eye(4)
        matrix[:3, :] = np.stack([right, [0, 1, 0], back, 4 * back], 1)
        frames.append({"file_path": stem, "transform_matrix": matrix.tolist()})
        y, x = np.mgrid[0:H, 0:W] + 0.5
        f = W / 2 / np.tan(0.4)
        disc = np.hypot(x - W / 2, y - H / 2) < f * radius / np.sqrt(16 - radius**2)
        rgba = np.dstack([np.full((H, W), 200), np.full((H, W), 90), np.full((H, W), i), disc * 255])
        write_image(folder / "rgb" / f"{stem}.png", rgba.astype(np.uint8), force=True)
    (folder / "t.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames}))


def test_silhouettes_give_points_within_them(folder: Path) -> None:
    silhouettes(folder, 0.8)
    build_scene(config(folder, background=0.0), folder / "s.h5")
    with open_scene(folder / "s.h5") as scene:
        points, f = scene.points, scene.camera.K[0, 0]
        poses = [scene.view(stem, spikes=False).pose.cam_from_world for stem in STEMS]
    assert points is not None
    assert points.source == "given"
    assert len(points.xyz) == 20_000
    assert (points.rgb[:, :2] == [200, 90]).all(), "the mean of what the pictures show"
    assert np.median(np.linalg.norm(points.xyz, axis=1)) < 0.9
    judges = 0
    for pose in poses:  # wherever a picture frames a point, the point lies on its disc, to a pixel's diagonal
        x, y, z = pose[:, :3] @ points.xyz.T + pose[:, 3:]
        px, py = f * x / z, f * y / z
        framed = (z > 0) & (np.abs(px) < W / 2) & (np.abs(py) < H / 2)
        assert np.hypot(px, py)[framed].max() < f * 0.8 / np.sqrt(16 - 0.64) + 0.71
        judges = judges + framed
    assert judges.min() >= 3
    silhouettes(folder, 0.0)
    made = build_scene(config(folder, background=0.0), folder / "s.h5", force=True)
    assert made["points"] == 0
    assert "no points: nothing lies inside all silhouettes" in made["notes"]


def test_lens_distortion_is_refused_with_how_much_it_is(folder: Path) -> None:
    record = json.loads((folder / "t.json").read_text())
    (folder / "t.json").write_text(json.dumps({**record, "k1": 0.1}))
    with pytest.raises(DataError, match="lens distortion") as told:
        build_scene(config(folder), folder / "s.h5")
    f = W / 2 / np.tan(0.4)
    r = np.hypot(W / 2, H / 2)
    assert f"{r * 0.1 * (r / f) ** 2:.2f} pixels" in str(told.value)


def test_options_that_make_no_sense(folder: Path) -> None:
    for wrong in (
        {"colmap": folder},
        {"transforms": None},
        {"test_every": -2},
        {"size": (W, H)},
        {"background": 2.0},
        {"exposure_us": -1.0},
        {"rgb": folder / "nowhere"},
    ):
        with pytest.raises(UsageError):
            build_scene(config(folder, **wrong), folder / "s.h5")
    with pytest.raises(DataError, match="shorter than the exposure"):
        build_scene(config(folder, exposure_us=2000.0), folder / "s.h5")
    assert not list(folder.glob("s.h5*"))


def test_a_picture_that_breaks_off_leaves_nothing_behind(folder: Path) -> None:
    path = folder / "rgb" / "r_11.png"
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(DataError, match="damaged"):
        build_scene(config(folder), folder / "s.h5")
    assert not list(folder.glob("s.h5*"))


def test_a_colmap_model_gives_poses_and_points(folder: Path) -> None:
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(f"1 PINHOLE {W} {H} 30 31 10.5 6.5\n")
    images = "".join(f"{i} 1 0 0 0 {i} 0 5 1 {stem}.png\n\n" for i, stem in enumerate(STEMS))
    (model / "images.txt").write_text(images)
    (model / "points3D.txt").write_text("5 0.25 -1.5 3 255 128 0 0.7\n")
    made = build_scene(config(folder, transforms=None, colmap=folder), folder / "s.h5")
    assert (made["points"], made["points_source"]) == (1, "sfm")
    with open_scene(folder / "s.h5") as scene:
        np.testing.assert_array_equal(scene.camera.K, [[30, 0, 10.5], [0, 31, 6.5], [0, 0, 1]])
        np.testing.assert_array_equal(scene.view("r_10").pose.cam_from_world[:, 3], [3, 0, 5])


def test_from_the_command_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = f"data build --spikes {folder}/spikes --rgb {folder}/rgb --transforms {folder}/t.json -o {folder}/s.h5"
    assert run([*words.split(), "--json", "--test-every", "2"]) == 0
    made = json.loads(capsys.readouterr().out)
    assert (made["schema"], made["views"], made["status"]) == ("spikerig.data.build/1", 5, "complete")
    assert run(words.split()) == 2, "not overwritten unasked"
    assert "give --force" in capsys.readouterr().err
    assert run([*words.split(), "--force", "--background", "mauve"]) == 2
    capsys.readouterr()
    assert run(["data", "verify", f"{folder}/s.h5", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["findings"] == []
    data = bytearray((folder / "s.h5").read_bytes())
    data[len(data) // 2] ^= 1
    (folder / "s.h5").write_bytes(data)
    assert run(["data", "verify", f"{folder}/s.h5", "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert (found["ok"], found["findings"][0]["check"]) == (False, "checksum")
    assert set(found["findings"][0]) == {"check", "importance", "where", "message", "fix"}
    (folder / "s.h5").write_bytes(data[: len(data) // 2])
    assert run(["data", "verify", f"{folder}/s.h5", "--json"]) == 4
    assert json.loads(capsys.readouterr().out)["error"]["type"] == "DataError"
    assert run(["data", "verify", f"{folder}/none.h5"]) == 2


def test_natural_order() -> None:
    assert sorted(["r_10", "r_2", "a", "r_1b", "10", "9"], key=natural) == ["9", "10", "a", "r_1b", "r_2", "r_10"]
