"""A folder of sub-frames with poses, read and checked: all faults of all views are told at once.

The layout is in docs/sim_frames.md.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, RigError, UsageError
from spikerig.dataset.images import image_head
from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.limits import Faults
from spikerig.rigctl.sim.schedule import Schedule, Track
from spikerig.rigctl.sim.sources.pictures import check_mending
from spikerig.rigctl.sim.spec import Settings, read_settings
from spikerig.rigctl.sim.take import Rig

OPENGL = np.diag([1.0, -1.0, -1.0])  # camera axes: y up and z back, to y down and z ahead
KEYS = {
    "": {"views", "camera_angle_x", "fl_x", "fl_y", "cx", "cy", "w", "h", "background", "points", "name", "layer"},
    "view": {"name", "split", "frames", "depth"},
    "frame": {"file", "transform_matrix", "phase"},
}


@dataclass(frozen=True, slots=True)
class Sequence:
    """One view of the folder: its pictures in the order of time, when they were cast, where the camera was."""

    name: str
    split: str
    files: tuple[Path, ...]
    plan: Schedule
    track: Track
    depth: Path | None


@dataclass(frozen=True, slots=True)
class Folder:
    """A folder read and checked, but for the pixels."""

    rig: Rig
    settings: Settings
    views: tuple[Sequence, ...]
    background: float | None
    points: Path | None
    layer: str = ""
    bad_values: str = "refuse"


def read_folder(
    folder: str | Path,
    settings: str | Path | None = None,
    *,
    protocol: str = "",
    seed: int | None = None,
    bad_values: str = "refuse",
) -> Folder:
    """Read transforms.json and the settings, and look at every file named.

    Args:
        folder: with transforms.json.
        settings: a TOML file with any of name, seed and the tables exposure, sensor, effects, events and points of a
            scene file; None takes capture.toml of the folder, and defaults where that is missing.
        protocol, seed: in place of the settings'.
        bad_values: what becomes of NaN, infinite and negative values: refuse, zero or clip (see `pictures.mend`).

    Raises:
        DataError: transforms.json is missing, not JSON, or any of what it says is wrong: all faults at once.
        UsageError: wrong settings.
    """
    root, bad_values = Path(folder), check_mending(bad_values)
    read = _settings(root, settings, protocol, seed)
    table = _transforms(root)
    faults = Faults("transforms.json", DataError, "the layout is in docs/sim_frames.md")
    _unknown(table, "", "", faults)
    camera = _camera(root, table, faults)
    rows = table.get("views")
    if not isinstance(rows, list) or not rows:
        faults.add("views", "is missing or empty, expected a list of views")
        rows = []
    views = [_sequence(root, row, f"views[{k}]", read, faults) for k, row in enumerate(rows)]
    names = [v.name for v in views if v is not None]
    for name in sorted({n for n in names if names.count(n) > 1}):
        faults.add("views", f"hold the name {name!r} more than once")
    if names and not any(v is not None and v.split == "train" for v in views):
        faults.add("views", "hold none with the split 'train'")
    points = _inside(root, table["points"], "points", faults) if "points" in table else None
    background = table.get("background")
    if background is not None and not (isinstance(background, int | float) and 0 <= background <= 1):
        faults.add("background", f"is {background!r}, expected a linear gray level, 0 to 1")
    layer = table.get("layer", "")
    if not isinstance(layer, str):
        faults.add("layer", f"is {layer!r}, expected the name of a layer of the EXR pictures")
    if camera is None and not faults.found:
        faults.add("views", "hold no picture that can be read")
    faults.raise_any()
    name = read.name or str(table.get("name") or root.resolve().name)
    rig = Rig(name, read.seed, cast(Camera, camera), read.exposure, read.sensor, read.effects, read.events)
    return Folder(rig, read, tuple(v for v in views if v is not None), background, points, layer, bad_values)


def settings_table(root: Path, file: str | Path | None = None) -> dict[str, Any]:
    """What the settings of a folder hold, not looked at yet: of the file given, or of capture.toml; else empty."""
    path = Path(file) if file is not None else root / "capture.toml"
    if file is None and not path.exists():
        return {}
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError("the settings cannot be read", value=f"{path}: {error}") from None


def _settings(root: Path, file: str | Path | None, protocol: str, seed: int | None) -> Settings:
    path, table = Path(file) if file is not None else root / "capture.toml", settings_table(root, file)
    if protocol:
        exposure = table.get("exposure", {})
        table["exposure"] = {**exposure, "protocol": protocol} if isinstance(exposure, dict) else exposure
    if seed is not None:
        table["seed"] = seed
    for key in ("sub_poses", "margin_ticks"):
        if isinstance(table.get("exposure"), dict) and key in table["exposure"]:
            raise UsageError(f"exposure.{key} is not for the settings of frames", value=path, cause="the frames say it")
    return read_settings(table, str(path) if table else "the settings")


def _transforms(root: Path) -> dict[str, Any]:
    path = root / "transforms.json"
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(
            "transforms.json cannot be read",
            value=f"{path}: {error.strerror}",
            expected="a folder laid out as in docs/sim_frames.md",
        ) from None
    except (ValueError, RecursionError) as error:
        raise DataError("transforms.json is not JSON", value=f"{path}: {error}") from None
    if not isinstance(table, dict):
        raise DataError("transforms.json is not a JSON object", value=path)
    return table


def _unknown(table: Mapping[str, Any], level: str, where: str, faults: Faults) -> None:
    for key in table:
        if key not in KEYS[level]:
            faults.unknown(f"{where}.{key}".strip("."), key, KEYS[level])


def _number(table: Mapping[str, Any], key: str, faults: Faults, lo: float, hi: float) -> float | None:
    value = table.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not lo < value < hi:
        faults.add(key, f"is {value!r}, expected a number between {lo:g} and {hi:g}")
        return None
    return float(value)


def _camera(root: Path, table: Mapping[str, Any], faults: Faults) -> Camera | None:
    """The pinhole; its size is that of the first picture that can be read."""
    size = None
    for row in table.get("views") or []:
        try:
            file = _inside(root, row["frames"][0]["file"], "", Faults(""))
            size = image_head(file) if file else None
        except (RigError, LookupError, TypeError):
            continue
        if size:
            break
    given = [_number(table, key, faults, 0, 16385) for key in ("w", "h")]
    if size is None:
        return None  # every view tells of its own missing picture
    width, height, _ = size
    for key, value, real in (("w", given[0], width), ("h", given[1], height)):
        if value is not None and value != real:
            faults.add(key, f"is {value:g}, but the first picture has {real}")
    fx, fy = _number(table, "fl_x", faults, 0, 1e6), _number(table, "fl_y", faults, 0, 1e6)
    angle = _number(table, "camera_angle_x", faults, 0, np.pi)
    if fx is None and angle is None:
        faults.add("camera_angle_x", "(or fl_x, in pixels) is missing")
        return None
    if fx is None:
        fx = width / 2 / np.tan((angle or 1.0) / 2)
    cx, cy = _number(table, "cx", faults, -1e6, 1e6), _number(table, "cy", faults, -1e6, 1e6)
    centre = (width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    K = np.array([[fx, 0, centre[0]], [0, fy or fx, centre[1]], [0, 0, 1]])
    return Camera(K, np.zeros(0), width, height)


def _inside(root: Path, name: Any, where: str, faults: Faults) -> Path | None:
    """A file of the folder by its name; nothing outside the folder is ever opened."""
    if not isinstance(name, str) or not name:
        faults.add(where, f"is {name!r}, expected the name of a file")
        return None
    path = root / name
    if Path(name).is_absolute() or not path.resolve().is_relative_to(root.resolve()):
        faults.add(where, f"is {name!r}, which leads out of the folder")
        return None
    if not path.is_file():
        faults.add(where, f"is {name!r}, and there is no such file")
        return None
    return path


def _sequence(root: Path, row: Any, where: str, settings: Settings, faults: Faults) -> Sequence | None:
    from spikerig.dataset.store import NAME

    before = len(faults.found)
    if not isinstance(row, Mapping):
        faults.add(where, f"is {row!r}, expected an object")
        return None
    _unknown(row, "view", where, faults)
    name, split = row.get("name"), row.get("split", "train")
    if not isinstance(name, str) or not NAME.fullmatch(name):
        faults.add(f"{where}.name", f"is {name!r}, expected letters, digits, `-`, `_`, `.`")
    if split not in ("train", "test"):
        faults.add(f"{where}.split", f"is {split!r}, expected train or test")
    frames = row.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(f, Mapping) for f in frames):
        faults.add(f"{where}.frames", "is missing or empty, expected a list of objects")
        return None
    files, poses = [], []
    for k, frame in enumerate(frames):
        spot = f"{where}.frames[{k}]"
        _unknown(frame, "frame", spot, faults)
        files.append(_inside(root, frame.get("file"), f"{spot}.file", faults))
        poses.append(_pose(frame.get("transform_matrix"), f"{spot}.transform_matrix", faults))
    plan = _plan(frames, where, settings, faults)
    depth = _inside(root, row["depth"], f"{where}.depth", faults) if "depth" in row else None
    if len(faults.found) > before or plan is None:
        return None
    return Sequence(str(name), split, tuple(f for f in files if f), plan, _track(plan, np.stack(poses)), depth)


def _track(plan: Schedule, poses: NDArray[np.float64]) -> Track:
    """The frames' poses within the exposure; where the light holds, so do the first and the last pose, to its ends."""
    if len(poses) == 1:
        return Track(np.array([0, plan.label, 1.0]), np.repeat(poses, 3, axis=0))
    within = (plan.phases >= 0) & (plan.phases <= 1)
    phases, poses = plan.phases[within], poses[within]
    if phases[0] > 0:
        phases, poses = np.concatenate([[0.0], phases]), np.concatenate([poses[:1], poses])
    if phases[-1] < 1:
        phases, poses = np.concatenate([phases, [1.0]]), np.concatenate([poses, poses[-1:]])
    return Track(phases, poses)


def _pose(matrix: Any, where: str, faults: Faults) -> NDArray[np.float64]:
    """cam_from_world [3,4] of an OpenGL camera-to-world matrix, 4x4 or 3x4."""
    try:
        m = np.array(matrix, np.float64)
    except (TypeError, ValueError):
        m = np.zeros(0)
    if m.shape not in ((4, 4), (3, 4)) or not np.all(np.isfinite(m)):
        faults.add(where, "is not 4x4 finite numbers")
        return np.eye(3, 4)
    turn = m[:3, :3]
    off = float(np.abs(turn @ turn.T - np.eye(3)).max())
    if off > 1e-4 or np.linalg.det(turn) < 0:
        faults.add(where, f"holds no rotation (R R^T differs from 1 by {off:.3g}): scaled, mirrored or transposed?")
        return np.eye(3, 4)
    u, _, vt = np.linalg.svd(turn)  # files often carry six digits
    R = (u @ vt @ OPENGL).T
    return np.concatenate([R, -(R @ m[:3, 3])[:, None]], 1)


def _plan(frames: list[Any], where: str, settings: Settings, faults: Faults) -> Schedule | None:
    """When the frames were cast: as their `phase` says, else evenly over the exposure."""
    exposure, n = settings.exposure, len(frames)
    given = [f["phase"] for f in frames if "phase" in f]
    hold = exposure.light == "hold"
    if given and (len(given) < n or hold):
        faults.add(
            f"{where}.frames", "have phases in part" if not hold else "have phases, but the light holds: leave them out"
        )
        return None
    if given and not all(isinstance(p, int | float) and -100 <= p <= 100 for p in given):
        faults.add(
            f"{where}.frames", f"have phases {given!r}, expected numbers: 0 to 1 is the exposure, -100 to 100 all"
        )
        return None
    if hold:
        knots = np.rint(np.linspace(0, exposure.ticks, n + 1)).astype(np.int64)
        phases = (knots[:-1] + knots[1:]) / 2 / exposure.ticks
    elif n == 1:
        knots, phases = np.array([0, exposure.ticks]), np.array([0.5, 0.5])
    else:
        phases = np.array(given, np.float64) if given else np.linspace(0, 1, n)
        knots = np.rint(phases * exposure.ticks).astype(np.int64)
        phases = knots / exposure.ticks
        if not {0, exposure.ticks} <= set(knots.tolist()):
            faults.add(
                f"{where}.frames", f"have phases {given!r}, expected 0 and 1 (the ends of the exposure) among them"
            )
            return None
    if np.any(np.diff(knots) <= 0):
        faults.add(f"{where}.frames", f"are {n}, too many for {exposure.ticks} ticks, or not in the order of time")
        return None
    wanted = 0.5 if exposure.label == "mid" else 0.0
    return Schedule(knots, phases, float(phases[np.argmin(np.abs(phases - wanted))]))
