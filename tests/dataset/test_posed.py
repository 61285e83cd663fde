"""Other people's cameras and poses: transforms.json and COLMAP models, by independent encoders and by pycolmap."""

import json
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spikerig.dataset.colmap_model import read_colmap, rotation
from spikerig.dataset.errors import DataError, RigError, UsageError
from spikerig.dataset.posed import read_transforms, stem_of


def looking(centre: list[float], angle: float) -> np.ndarray:
    """OpenGL camera-to-world: at `centre`, turned about the world's y by `angle`; unturned it looks along -z, y up."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s, centre[0]], [0, 1, 0, centre[1]], [-s, 0, c, centre[2]], [0, 0, 0, 1]])


def transforms(path: Path, frames: list[dict[str, Any]], **facts: Any) -> Path:
    path.write_text(json.dumps({**facts, "frames": frames}))
    return path


def frame(name: str = "./train/r_0", matrix: np.ndarray | None = None, **more: Any) -> dict[str, Any]:
    matrix = looking([0, 0, 0], 0) if matrix is None else matrix
    return {"file_path": name, "transform_matrix": matrix.tolist(), **more}


def test_an_opengl_camera_sees_what_it_should(tmp_path: Path) -> None:
    """Looking along -z with y up: a point 5 ahead, 1 right and 1 up lies right of the centre and above it."""
    file = transforms(tmp_path / "t.json", [frame(matrix=looking([1, 2, 3], 0))], camera_angle_x=np.pi / 2)
    posed = read_transforms(file, 400, 250)
    pose = posed.poses["r_0"].cam_from_world
    seen = pose @ [1 + 1, 2 + 1, 3 - 5, 1]
    np.testing.assert_allclose(seen, [1, -1, 5], atol=1e-12)
    np.testing.assert_allclose(posed.poses["r_0"].centre, [1, 2, 3], atol=1e-12)
    np.testing.assert_allclose(posed.camera.K, [[200, 0, 200], [0, 200, 125], [0, 0, 1]], atol=1e-9)
    np.testing.assert_allclose((posed.camera.K @ seen)[:2] / seen[2], [240, 85])


def test_nerfstudio_intrinsics_and_per_frame_ones(tmp_path: Path) -> None:
    facts = {"fl_x": 310.5, "fl_y": 311.5, "cx": 199.25, "cy": 126.0, "w": 400, "h": 250, "k1": 0.1, "p2": -0.01}
    posed = read_transforms(transforms(tmp_path / "t.json", [frame()], **facts), 400, 250)
    np.testing.assert_array_equal(posed.camera.K, [[310.5, 0, 199.25], [0, 311.5, 126], [0, 0, 1]])
    assert posed.camera.distortion.tolist() == [0.1, 0, 0, -0.01, 0]
    own = [frame("a.png", **facts), frame("b.png", **facts)]
    assert read_transforms(transforms(tmp_path / "u.json", own), 400, 250).poses.keys() == {"a", "b"}
    own[1]["fl_x"] = 400
    with pytest.raises(DataError, match="different cameras"):
        read_transforms(transforms(tmp_path / "u.json", own), 400, 250)


def test_float32_drift_is_taken_out_and_worse_is_refused(tmp_path: Path) -> None:
    turned = looking([1, 2, 3], 0.7)
    file = transforms(tmp_path / "t.json", [frame(matrix=turned.astype(np.float32))], camera_angle_x=1.0)
    R = read_transforms(file, 40, 30).poses["r_0"].cam_from_world[:, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    scaled, mirrored, nan = turned.copy(), turned.copy(), turned.copy()
    scaled[:3, :3] *= 1.01
    mirrored[:3, 0] *= -1
    nan[0, 0] = np.nan
    for bad in (scaled, mirrored, nan, turned[:2], np.eye(4)[:, :2]):
        with pytest.raises(DataError, match=r"rotation|finite|cannot be read") as told:
            read_transforms(transforms(tmp_path / "t.json", [frame(matrix=bad)], camera_angle_x=1.0), 40, 30)
        assert "t.json" in str(told.value)


@pytest.mark.parametrize(
    ("content", "match"),
    [
        ("", "cannot be read"),
        ("[]", "not a transforms file"),
        ("{}", "no frames"),
        ('{"frames": []}', "no frames"),
        ('{"frames": [3]}', "a frame cannot be read"),
        ('{"frames": [{"file_path": 3}]}', "a frame cannot be read"),
        ('{"frames": [{"file_path": "a", "transform_matrix": "x"}]}', "a frame cannot be read"),
        ('{"frames": [{"file_path": "a"}]}', "a frame cannot be read"),
        ("[" * 100_000, "cannot be read"),
        ("\xff\xfe", "not a transforms file|cannot be read"),
    ],
)
def test_what_is_no_transforms_file_is_a_data_error(tmp_path: Path, content: str, match: str) -> None:
    (tmp_path / "t.json").write_bytes(content.encode("latin-1"))
    with pytest.raises(DataError, match=match):
        read_transforms(tmp_path / "t.json", 40, 30)


def test_other_refusals_of_transforms(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such file"):
        read_transforms(tmp_path / "none.json", 40, 30)
    twice = transforms(tmp_path / "t.json", [frame("a/x.png"), frame("b/x.png")], camera_angle_x=1.0)
    with pytest.raises(DataError, match="same stem"):
        read_transforms(twice, 40, 30)
    with pytest.raises(DataError, match="not the pictures' size"):
        read_transforms(transforms(tmp_path / "t.json", [frame()], camera_angle_x=1.0, w=41, h=30), 40, 30)
    with pytest.raises(DataError, match="fisheye"):
        read_transforms(
            transforms(tmp_path / "t.json", [frame()], camera_angle_x=1.0, camera_model="OPENCV_FISHEYE"), 40, 30
        )


def test_stems() -> None:
    assert [stem_of(n) for n in ("./train/r_0", "a\\b\\x.PNG", "frame.001", "../../etc/passwd", "v.1.jpg")] == [
        "r_0",
        "x",
        "frame.001",
        "passwd",
        "v.1",
    ]


# ---- COLMAP ---------------------------------------------------------------------------------------------------------

TURN, SHIFT = np.array([0.5, -0.5, 0.5, 0.5]), np.array([1.0, 2.0, 3.0])
IDS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "FOV": 7}


def text_model(folder: Path, model: str = "PINHOLE", params: str = "300 301 200.5 125") -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "cameras.txt").write_text(f"# list\n1 {model} 400 250 {params}\n")
    pose = " ".join(str(v) for v in (*TURN, *SHIFT))
    images = f"# two lines an image\n7 {pose} 1 rgb/a b.png\n10 20 -1 30 40 5\n9 {pose} 1 c.png\n\n"
    (folder / "images.txt").write_text(images)
    (folder / "points3D.txt").write_text("# id\n5 0.25 -1.5 3 255 128 0 0.7 7 0 9 1\n6 1 2 3 1 2 3 0.1\n")
    return folder


def binary_model(folder: Path, model: str = "PINHOLE", params: tuple[float, ...] = (300, 301, 200.5, 125)) -> Path:
    folder.mkdir(exist_ok=True)
    camera = struct.pack("<QiiQQ", 1, 1, IDS[model], 400, 250) + struct.pack(f"<{len(params)}d", *params)
    (folder / "cameras.bin").write_bytes(camera)
    one = struct.pack("<7di", *TURN, *SHIFT, 1)
    first = struct.pack("<i", 7) + one + b"rgb/a b.png\0" + struct.pack("<Qddqddq", 2, 10, 20, -1, 30, 40, 5)
    (folder / "images.bin").write_bytes(
        struct.pack("<Q", 2) + first + struct.pack("<i", 9) + one + b"c.png\0" + struct.pack("<Q", 0)
    )
    points = struct.pack("<Q", 2) + struct.pack("<Q3d3BdQ4i", 5, 0.25, -1.5, 3, 255, 128, 0, 0.7, 2, 7, 0, 9, 1)
    (folder / "points3D.bin").write_bytes(points + struct.pack("<Q3d3BdQ", 6, 1, 2, 3, 1, 2, 3, 0.1, 0))
    return folder


@pytest.mark.parametrize("make", [text_model, binary_model])
def test_colmap_models_of_either_kind(tmp_path: Path, make: Callable[[Path], Path]) -> None:
    posed = read_colmap(make(tmp_path / "m"))
    assert list(posed.poses) == ["a b", "c"]
    # (1, -1, 1, 1)/2 turns by 120 degrees about (-1, 1, 1), by Rodrigues' formula: x -> -z, y -> -x, z -> y
    want = np.array([[0, -1, 0, 1], [0, 0, 1, 2], [-1, 0, 0, 3]])
    np.testing.assert_allclose(posed.poses["c"].cam_from_world, want, atol=1e-15)
    np.testing.assert_array_equal(posed.camera.K, [[300, 0, 200.5], [0, 301, 125], [0, 0, 1]])
    assert (posed.camera.width, posed.camera.height, posed.camera.distortion.tolist()) == (400, 250, [])
    assert posed.points is not None
    assert posed.points.source == "sfm"
    assert posed.points.xyz.tolist() == [[0.25, -1.5, 3], [1, 2, 3]]
    assert posed.points.rgb.tolist() == [[255, 128, 0], [1, 2, 3]]


@pytest.mark.parametrize(
    ("model", "params", "focal", "distortion"),
    [
        ("SIMPLE_PINHOLE", (300, 200, 125), (300, 300), []),
        ("SIMPLE_RADIAL", (300, 200, 125, 0.1), (300, 300), [0.1, 0, 0, 0]),
        ("SIMPLE_RADIAL", (300, 200, 125, 0), (300, 300), []),
        ("RADIAL", (300, 200, 125, 0.1, -0.2), (300, 300), [0.1, -0.2, 0, 0]),
        ("OPENCV", (300, 310, 200, 125, 0.1, -0.2, 1e-3, 2e-3), (300, 310), [0.1, -0.2, 1e-3, 2e-3]),
    ],
)
def test_colmap_camera_models(
    tmp_path: Path, model: str, params: tuple[float, ...], focal: tuple[float, ...], distortion: list[float]
) -> None:
    for posed in (
        read_colmap(text_model(tmp_path / "t", model, " ".join(map(str, params)))),
        read_colmap(binary_model(tmp_path / "b", model, params)),
    ):
        assert (posed.camera.K[0, 0], posed.camera.K[1, 1]) == focal
        assert posed.camera.distortion.tolist() == distortion


def test_a_model_under_sparse_0_is_found_and_none_is_told(tmp_path: Path) -> None:
    (tmp_path / "sparse").mkdir()
    binary_model(tmp_path / "sparse" / "0")
    assert len(read_colmap(tmp_path).poses) == 2
    with pytest.raises(UsageError, match="no COLMAP model"):
        read_colmap(tmp_path / "nothing")


def test_damaged_colmap_models_end_in_data_errors(tmp_path: Path) -> None:
    """Cut anywhere, or claiming billions of records."""
    for make, kind in ((binary_model, "bin"), (text_model, "txt")):
        for name in ("cameras", "images", "points3D"):
            folder = make(tmp_path / f"{kind}{name}")
            path = folder / f"{name}.{kind}"
            whole = path.read_bytes()
            if kind == "bin":
                for size in range(0, len(whole), 5):
                    path.write_bytes(whole[:size])
                    with pytest.raises(DataError, match=r"COLMAP model is damaged|no image|wrong number"):
                        read_colmap(folder)
                path.write_bytes(struct.pack("<Q", 1 << 62) + whole[8:])
                with pytest.raises(DataError, match="damaged"):
                    read_colmap(folder)
            path.write_bytes(b"1 what is this\n")
            with pytest.raises(DataError) as told:
                read_colmap(folder)
            assert path.name in str(told.value)


def test_what_colmap_models_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="not handled"):
        read_colmap(text_model(tmp_path / "a", "OPENCV_FISHEYE", "1 1 1 1 0 0 0 0"))
    with pytest.raises(DataError, match="not handled"):
        read_colmap(binary_model(tmp_path / "b", "FOV"))
    folder = text_model(tmp_path / "c")
    (folder / "cameras.txt").write_text("1 PINHOLE 400 250 1 1 1 1\n2 PINHOLE 400 250 2 2 1 1\n")
    images = (folder / "images.txt").read_text()
    (folder / "images.txt").write_text(images.replace(" 1 c.png", " 2 c.png"))
    with pytest.raises(DataError, match="different cameras"):
        read_colmap(folder)
    (folder / "images.txt").write_text(images.replace(" 1 c.png", " 3 c.png"))
    with pytest.raises(DataError, match="does not have"):
        read_colmap(folder)
    with pytest.raises(RigError, match="quaternion"):
        rotation(np.zeros(4))


PYCOLMAP = """
import zlib, numpy, sys  # in this order: pycolmap's own zlib breaks what is loaded after it
import pycolmap
folder = sys.argv[1]
model = pycolmap.Reconstruction()
camera = pycolmap.Camera.create_from_model_name(1, "OPENCV", 300.0, 400, 250)
camera.params = [300.0, 301.0, 200.5, 125.0, 0.1, -0.2, 0.001, 0.002]
model.add_camera_with_trivial_rig(camera)
pose = pycolmap.Rigid3d(pycolmap.Rotation3d([-0.5, 0.5, 0.5, 0.5]), [1.0, 2.0, 3.0])
model.add_image_with_trivial_frame(pycolmap.Image(name="c.png", camera_id=1, image_id=7), pose)
model.add_point3D([0.25, -1.5, 3.0], pycolmap.Track(), [255, 128, 0])
print(pose.matrix().tolist())
model.write_text(folder + "/t"); model.write_binary(folder + "/b")
"""


def test_models_that_colmap_itself_wrote(tmp_path: Path) -> None:
    for name in "tb":
        (tmp_path / name).mkdir()
    done = subprocess.run([sys.executable, "-c", PYCOLMAP, str(tmp_path)], capture_output=True, timeout=120)
    assert done.returncode == 0, done.stderr.decode()
    for name in "tb":
        posed = read_colmap(tmp_path / name)
        want = np.array(json.loads(done.stdout))  # the pose as COLMAP itself sees it
        np.testing.assert_allclose(posed.poses["c"].cam_from_world, want, atol=1e-12)
        assert posed.camera.distortion.tolist() == [0.1, -0.2, 0.001, 0.002]
        assert posed.points is not None
        assert posed.points.xyz.tolist() == [[0.25, -1.5, 3.0]]


@pytest.mark.real
def test_the_poses_of_nerfs_mic_look_at_the_middle(shared_data: Callable[[str], Path]) -> None:
    """Blender's cameras stand 4.03 from the origin and look at it, picture upright: z up in the world is up in it."""
    posed = read_transforms(shared_data("nerf_mic/transforms_train.json"), 800, 800)
    assert len(posed.poses) == 100
    assert posed.camera.K[0, 0] == pytest.approx(400 / np.tan(0.6911112070083618 / 2))
    for pose in posed.poses.values():
        middle = pose.cam_from_world @ [0, 0, 0, 1]
        assert middle[2] == pytest.approx(4.0311, abs=1e-3)
        np.testing.assert_allclose(middle[:2], 0, atol=1e-3)
        assert (pose.cam_from_world @ [0, 0, 0.1, 1])[1] < 1e-6, "up in the world is up in the picture"
