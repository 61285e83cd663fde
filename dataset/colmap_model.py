"""COLMAP's sparse models as they lie on disk, text or binary: cameras, images, points3D. Read by ourselves, small."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from spikerig.dataset.errors import DataError, RigError, UsageError
from spikerig.dataset.posed import MAX_BYTES, Posed, keep_apart, stem_of
from spikerig.dataset.scene import Camera, Points, Pose

MODELS = {0: "SIMPLE_PINHOLE", 1: "PINHOLE", 2: "SIMPLE_RADIAL", 3: "RADIAL", 4: "OPENCV"}
PARAMETERS = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8}


def read_colmap(folder: str | Path) -> Posed:
    """Read a COLMAP model.

    Args:
        folder: with cameras, images and (if any) points3D, .bin or .txt; or one with `sparse/0` or `sparse` in it.

    Returns:
        The one camera of all images, their poses by stem, and the points as source "sfm".

    Raises:
        DataError: damaged, several cameras, a camera model that is not handled.
        UsageError: there is no model in the folder.

    Source: COLMAP's documentation, "Output format"; pixel centres at +0.5 as here, world-to-camera poses.
    """
    root, kind = _find(Path(folder))
    read = (_cameras_bin, _images_bin, _points_bin) if kind == ".bin" else (_cameras_txt, _images_txt, _points_txt)
    cameras = _guarded(root / f"cameras{kind}", read[0])
    poses: dict[str, Pose] = {}
    used: dict[int, str] = {}
    for name, camera, turn, shift in _guarded(root / f"images{kind}", read[1]):
        keep_apart(poses, stem_of(name), Pose(np.column_stack([rotation(turn), shift])), root / f"images{kind}")
        used.setdefault(camera, name)
    if not poses:
        raise DataError("no image is registered in this model", value=root)
    missing = sorted(used.keys() - cameras.keys())
    if missing:
        raise DataError("images of cameras that the model does not have", value=f"{root}: {missing}")
    first, *others = (cameras[number] for number in used)
    for other in others:
        if not (np.array_equal(other.K, first.K) and np.array_equal(other.distortion, first.distortion)):
            raise DataError(
                "the images have different cameras",
                value=f"{root}: {len(used)} cameras",
                expected="one",
                next="run COLMAP with --ImageReader.single_camera 1",
            )
    cloud = root / f"points3D{kind}"
    points = _guarded(cloud, read[2]) if cloud.exists() else []
    xyz = np.array([p[0] for p in points], np.float64).reshape(-1, 3)
    rgb = np.array([p[1] for p in points], np.uint8).reshape(-1, 3)
    return Posed(first, poses, Points(xyz, rgb, "sfm") if points else None, "COLMAP")


def rotation(wxyz: np.ndarray) -> np.ndarray:
    """Rotation matrix [3,3] of a quaternion w x y z, normalised first."""
    size = np.linalg.norm(wxyz)
    if not (np.isfinite(size) and size > 1e-6):
        raise DataError("a quaternion is not one", value=wxyz.tolist())
    w, x, y, z = wxyz / size
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _find(folder: Path) -> tuple[Path, str]:
    for root in (folder, folder / "sparse" / "0", folder / "sparse"):
        for kind in (".bin", ".txt"):
            if all((root / f"{name}{kind}").is_file() for name in ("cameras", "images")):
                return root, kind
    raise UsageError("no COLMAP model here", value=folder, expected="cameras and images, .bin or .txt")


def _guarded(path: Path, read):
    """What `read` makes of the file's bytes; anything that goes wrong in it is one DataError with the file's name."""
    try:
        if path.stat().st_size > 8 * MAX_BYTES:
            raise DataError("too large a model", value=path)
        return read(path.read_bytes())
    except RigError as error:
        value = path if error.value is None else f"{path}: {error.value}"
        raise DataError(error.what, value=value, expected=error.expected, next=error.next) from error
    except OSError as error:
        raise DataError("the model cannot be read", value=path, cause=str(error)) from error
    except (struct.error, ValueError, IndexError, KeyError, OverflowError) as error:
        raise DataError("the COLMAP model is damaged", value=path, cause=repr(error)[:200]) from error


def _camera(model: str, width: int, height: int, p: list[float]) -> Camera:
    if model not in PARAMETERS:
        raise DataError("this COLMAP camera model is not handled", value=model, expected=", ".join(PARAMETERS))
    if len(p) != PARAMETERS[model]:
        raise DataError("a camera has the wrong number of parameters", value=f"{model}: {len(p)}")
    one = model.startswith("SIMPLE") or model == "RADIAL"
    fx, fy, cx, cy = (p[0], *p[:3]) if one else p[:4]
    rest = p[3:] if one else p[4:]  # k | k1 k2 | k1 k2 p1 p2
    distortion = [*rest, 0.0, 0.0, 0.0, 0.0][:4] if any(rest) else []
    return Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(distortion), width, height)


def _lines(data: bytes) -> list[str]:
    return [line for line in data.decode("utf-8").splitlines() if not line.startswith("#")]


def _cameras_txt(data: bytes) -> dict[int, Camera]:
    found: dict[int, Camera] = {}
    for line in filter(str.strip, _lines(data)):
        number, model, width, height, *params = line.split()
        found[int(number)] = _camera(model, int(width), int(height), [float(p) for p in params])
    return found


def _images_txt(data: bytes) -> Iterator[tuple[str, int, np.ndarray, np.ndarray]]:
    found = []
    lines = _lines(data)
    while lines and not lines[-1].strip():
        lines.pop()
    for line in lines[::2]:  # every second line lists the image's 2D points, and may be empty
        _, *numbers, camera, name = line.strip().split(" ", 9)
        values = np.array([float(n) for n in numbers])
        if len(values) != 7:
            raise ValueError(f"not an image: {line[:80]!r}")
        found.append((name, int(camera), values[:4], values[4:]))
    return iter(found)


def _points_txt(data: bytes) -> list[tuple[tuple[float, ...], tuple[int, ...]]]:
    words = [line.split() for line in filter(str.strip, _lines(data))]
    return [(tuple(map(float, w[1:4])), tuple(map(int, w[4:7]))) for w in words]


class _Cursor:
    """Takes numbers off a block of bytes; running off its end is a struct.error."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, form: str) -> tuple:
        values = struct.unpack_from("<" + form, self.data, self.at)
        self.at += struct.calcsize("<" + form)
        return values

    def skip(self, size: int) -> None:
        self.at += size
        if self.at > len(self.data):
            raise ValueError("breaks off")

    def count(self, least: int) -> int:
        """A number of records to come, each of at least so many bytes."""
        (n,) = self.take("Q")
        if n * least > len(self.data) - self.at:
            raise ValueError(f"claims {n} records that are not there")
        return n

    def text(self) -> str:
        end = self.data.index(b"\0", self.at)
        found = self.data[self.at : end].decode("utf-8")
        self.at = end + 1
        return found


def _cameras_bin(data: bytes) -> dict[int, Camera]:
    cursor, found = _Cursor(data), {}
    for _ in range(cursor.count(24)):
        number, model, width, height = cursor.take("iiQQ")
        name = MODELS.get(model, f"number {model}")
        found[number] = _camera(name, width, height, list(cursor.take(f"{PARAMETERS.get(name, 0)}d")))
    return found


def _images_bin(data: bytes) -> Iterator[tuple[str, int, np.ndarray, np.ndarray]]:
    cursor, found = _Cursor(data), []
    for _ in range(cursor.count(72)):
        _, *values, camera = cursor.take("i7di")
        name = cursor.text()
        cursor.skip(24 * cursor.take("Q")[0])
        found.append((name, camera, np.array(values[:4]), np.array(values[4:])))
    return iter(found)


def _points_bin(data: bytes) -> list[tuple[tuple[float, ...], tuple[int, ...]]]:
    cursor, found = _Cursor(data), []
    for _ in range(cursor.count(51)):
        _, *xyz, r, g, b, _ = cursor.take("Q3d3Bd")
        cursor.skip(8 * cursor.take("Q")[0])
        found.append((tuple(xyz), (r, g, b)))
    return found
