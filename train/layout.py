"""The folder that `spikerig sim frames` reads: pictures, and a transforms.json with when and where they were cast."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError
from spikerig.dataset.posed import pose_from_opengl
from spikerig.dataset.rigid import inverse
from spikerig.dataset.scene import Camera, Floats

FILE = "transforms.json"


class Layout(NamedTuple):
    """A layout somebody wrote: its camera, its document, and every picture it asks for.

    Args:
        camera: of all pictures.
        document: as it was read.
        pictures: (file, cam_from_world) of each picture.
        depths: (file, cam_from_world) of each depth, at its view's label.
    """

    camera: Camera
    document: dict[str, Any]
    pictures: list[tuple[str, Floats]]
    depths: list[tuple[str, Floats]]


def label_of(phases: Sequence[float] | NDArray[np.floating]) -> int:
    """Number of the frame nearest to mid-exposure, the earlier of two."""
    return int(np.argmin(np.round(np.abs(np.asarray(phases) - 0.5), 9)))


def frame_row(file: str, cam_from_world: Floats) -> dict[str, Any]:
    """A frame's row: its file and its OpenGL camera-to-world matrix."""
    world_from_cam = np.vstack([inverse(cam_from_world), [0, 0, 0, 1]])
    world_from_cam[:3, 1:3] *= -1  # OpenCV's y down and z forward to OpenGL's y up and z backward
    return {"file": file, "transform_matrix": world_from_cam.tolist()}


def write_layout(out: Path, camera: Camera, views: list[dict[str, Any]]) -> str:
    """Write transforms.json for views into the folder of their pictures; returns its name."""
    document = {
        "fl_x": camera.K[0, 0], "fl_y": camera.K[1, 1], "cx": camera.K[0, 2], "cy": camera.K[1, 2],
        "w": camera.width, "h": camera.height, "views": views,
    }  # fmt: skip
    (out / FILE).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    return FILE


def is_layout(record: Any) -> bool:
    """Whether a parsed transforms.json is a layout of views (and not NeRF's list of frames)."""
    return isinstance(record, dict) and isinstance(record.get("views"), list)


def read_layout(path: Path, record: Mapping[str, Any], camera: Camera) -> Layout:
    """A layout whose pictures shall be drawn.

    Args:
        path: of the file, for messages.
        record: its JSON.
        camera: stands in for a size or a lens that the file does not give.

    Raises:
        DataError: a row that lacks its file or pose, a file outside the folder, numbers that are none.
    """
    pictures: list[tuple[str, Floats]] = []
    depths: list[tuple[str, Floats]] = []
    try:
        for row in record["views"]:
            frames = row["frames"]
            poses = [pose_from_opengl(_square(f["transform_matrix"])).cam_from_world for f in frames]
            pictures += [(_inside(f["file"]), pose) for f, pose in zip(frames, poses, strict=True)]
            if "depth" in row:
                phases = [float(f.get("phase", k / max(len(frames) - 1, 1))) for k, f in enumerate(frames)]
                depths.append((_inside(row["depth"]), poses[label_of(phases)]))
        seen = _camera(record, camera)
    except DataError as error:
        raise DataError(error.what, value=f"{path}: {error.value}", cause=error.cause) from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError("a layout that cannot be read", value=path, cause=repr(error)) from error
    if not pictures:
        raise DataError("a layout without frames", value=path)
    return Layout(seen, dict(record), pictures, depths)


def _square(matrix: Any) -> Floats:
    values = np.asarray(matrix, np.float64)
    if values.shape not in ((4, 4), (3, 4)):
        raise DataError("a pose is 4x4", value=values.shape)
    return np.vstack([values[:3], [0, 0, 0, 1]])


def _inside(name: Any) -> str:
    """A file's name that stays inside the folder and ends like a picture."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or path.suffix.lower() not in (".exr", ".png"):
        raise DataError("a file outside the folder, or no picture", value=name)
    return str(path)


def _camera(record: Mapping[str, Any], camera: Camera) -> Camera:
    width, height = int(record.get("w", camera.width)), int(record.get("h", camera.height))
    if not (1 <= width <= 16384 and 1 <= height <= 16384):
        raise DataError("no such size", value=(width, height))
    K = camera.K * np.array([[width / camera.width], [height / camera.height], [1]])
    if "fl_x" in record or "camera_angle_x" in record:
        angle = float(record.get("camera_angle_x", 1))
        if not 0 < angle < np.pi:
            raise DataError("camera_angle_x is between 0 and pi", value=angle)
        fx = float(record["fl_x"]) if "fl_x" in record else width / 2 / np.tan(angle / 2)
        fy = float(record.get("fl_y", fx))
        K = np.array(
            [[fx, 0, float(record.get("cx", width / 2))], [0, fy, float(record.get("cy", height / 2))], [0, 0, 1]]
        )
    if not np.all(np.isfinite(K)) or min(K[0, 0], K[1, 1]) <= 0:
        raise DataError("a camera without a focal length", value=K.tolist())
    return Camera(K, np.zeros(0), width, height)
