"""Cameras and poses of pictures as others store them: NeRF and nerfstudio `transforms.json`."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from spikerig.dataset.errors import DataError, RigError, UsageError
from spikerig.dataset.scene import Camera, Points, Pose

MAX_BYTES = 1 << 28
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's camera (y up, z backward) to ours


@dataclass(frozen=True, slots=True)
class Posed:
    """One camera, the poses of pictures by their stems (names without folder and ending), and sparse points if any."""

    camera: Camera
    poses: Mapping[str, Pose]
    points: Points | None
    source: str


def stem_of(name: str) -> str:
    """The stem of a picture's name in somebody's file, whatever slashes it uses: "./train/r_0.png" -> "r_0".

    Edges:
        Only a known picture ending is cut, so that "frame.001" stays whole.
    """
    last = PurePosixPath(name.replace("\\", "/")).name
    head, dot, tail = last.rpartition(".")
    return head if dot and tail.lower() in ("png", "jpg", "jpeg", "exr", "tif", "tiff", "bmp") else last


def keep_apart(poses: dict[str, Pose], stem: str, pose: Pose, path: Path) -> None:
    """Add a pose; two pictures of one stem cannot be told apart."""
    if stem in poses:
        raise DataError("two pictures have the same stem", value=f"{path}: {stem!r}", next="rename one of them")
    poses[stem] = pose


def read_transforms(path: str | Path, width: int, height: int) -> Posed:
    """Read a NeRF or nerfstudio transforms.json.

    Args:
        path: of the file: frames of file_path and transform_matrix, an OpenGL camera-to-world 4x4.
        width, height: of the pictures, in pixels; the file's own w and h must agree.

    Returns:
        Camera (fl_x, fl_y, cx, cy, or camera_angle_x and the picture's centre), poses as cam_from_world.

    Raises:
        DataError: not such a file, several cameras, a fisheye, a matrix that is no pose.
        UsageError: there is no such file.

    Source: the layouts of NeRF's Blender scenes and of nerfstudio's data conventions.
    """
    source = Path(path)
    record = _load(source)
    frames = record.get("frames")
    if not isinstance(frames, list) or not frames:
        raise DataError("no frames in the transforms file", value=source, expected='a list "frames"')
    poses: dict[str, Pose] = {}
    cameras: list[Camera] = []
    for number, frame in enumerate(frames):
        try:
            stem = stem_of(frame["file_path"])
            matrix = np.asarray(frame["transform_matrix"], np.float64)
            if matrix.shape not in ((4, 4), (3, 4)):
                raise ValueError(f"a matrix of shape {matrix.shape}")
            keep_apart(poses, stem, pose_from_opengl(np.vstack([matrix[:3], [0, 0, 0, 1]])), source)
            cameras.append(_camera({**record, **frame}, width, height))
        except RigError as error:
            value = f"{source}, frame {number}: {error.value}"
            raise DataError(error.what, value=value, expected=error.expected, cause=error.cause) from error
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise DataError("a frame cannot be read", value=f"{source}, frame {number}", cause=repr(error)) from error
    first = cameras[0]
    for number, camera in enumerate(cameras):
        if not (np.allclose(camera.K, first.K) and np.array_equal(camera.distortion, first.distortion)):
            raise DataError("the frames have different cameras", value=f"{source}, frame {number}", expected="one")
    return Posed(first, poses, None, source.name)


def pose_from_opengl(world_from_camera: np.ndarray) -> Pose:
    """Our pose of an OpenGL camera-to-world 4x4; small drift from a rotation (float32 files) is taken out.

    Raises:
        DataError: it is no pose: scaled, mirrored, not finite.
    """
    if not np.isfinite(world_from_camera).all():
        raise DataError("a pose is not finite", value=world_from_camera.tolist())
    turned = world_from_camera @ _FLIP
    u, size, v = np.linalg.svd(turned[:3, :3])
    if np.abs(size - 1).max() > 1e-3 or np.linalg.det(turned[:3, :3]) < 0:
        raise DataError("a pose's matrix is not a rotation", value=f"singular values {size}", cause="a scaled scene?")
    rotation = (u @ v).T
    return Pose(np.column_stack([rotation, -rotation @ turned[:3, 3]]))


def _load(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise DataError("the transforms file is too large", value=path, expected=f"under {MAX_BYTES >> 20} MB")
        record = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise UsageError("there is no such file", value=path) from error
    except (OSError, ValueError, RecursionError) as error:
        raise DataError("the transforms file cannot be read", value=path, cause=str(error)) from error
    if not isinstance(record, dict):
        raise DataError("not a transforms file", value=path, expected="a JSON object")
    return record


def _camera(facts: Mapping[str, Any], width: int, height: int) -> Camera:
    w, h = int(facts.get("w", width)), int(facts.get("h", height))
    if (w, h) != (width, height):
        raise DataError("w and h are not the pictures' size", value=f"{w} x {h}", expected=f"{width} x {height}")
    if "FISHEYE" in str(facts.get("camera_model", "")).upper() or facts.get("is_fisheye"):
        raise DataError("a fisheye camera is not handled", value=facts.get("camera_model"), expected="PINHOLE, OPENCV")
    if "fl_x" in facts:
        fx = float(facts["fl_x"])
        fy = float(facts.get("fl_y", fx))
    else:
        fx = fy = width / 2 / math.tan(float(facts["camera_angle_x"]) / 2)
    cx, cy = float(facts.get("cx", width / 2)), float(facts.get("cy", height / 2))
    k = [float(facts.get(key, 0)) for key in ("k1", "k2", "p1", "p2", "k3")]
    if facts.get("k4"):
        raise DataError("distortion k4 is not handled", value=facts["k4"])
    return Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(k if any(k) else []), width, height)
