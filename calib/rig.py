"""The rig's calibration as a record: two cameras, the step between them, the mirror, and how it was come by."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, RigError, UsageError
from spikerig.dataset.outfile import whole_file
from spikerig.dataset.scene import Camera, Pose
from spikerig.dataset.terminal import jsonable

Arm = Literal["spike", "rgb"]
Model = Literal["common", "stereo"]
SCHEMA = "spikerig.calibration/1"
MAX_BYTES = 4 << 20
MAX_SIDE = 1 << 16


@dataclass(frozen=True, slots=True)
class RigCalibration:
    """How the two arms of a rig see.

    Args:
        spike, rgb: the cameras, of pictures that are no longer mirrored.
        spike_from_rgb: maps points from the RGB camera's axes into the spike camera's, in mm; no shift for "common".
        model: "common": one centre, so one homography holds at every depth; "stereo": it holds at one depth only.
        mirrored: the arm whose raw pictures are mirror pictures (left and right swapped), None where neither is.
        depth_mm: nearest and farthest board corner seen, along the spike camera's axis.
        residual_px: of the joint fit, over both arms' corners.
        sd: standard deviations by name, e.g. "spike.fx_px", "baseline_mm", "crop_px".
        response: the spike pixels' response to linear red, green and blue, None where not measured.
        split_ratio: spikes a tick at RGB white, None where not measured.
        flat: the flat field's file name and SHA-256, None where there is none.
        forced: why it was refused, if it was kept all the same.
        made_ns: when, Unix time; None where the record is to depend on its inputs alone.
    """

    spike: Camera
    rgb: Camera
    spike_from_rgb: Pose
    model: Model
    mirrored: Arm | None = None
    depth_mm: tuple[float, float] = (0.0, math.inf)
    residual_px: float = 0.0
    sd: Mapping[str, float] = field(default_factory=dict)
    response: tuple[float, float, float] | None = None
    split_ratio: float | None = None
    flat: Mapping[str, str] | None = None
    forced: tuple[str, ...] = ()
    made_ns: int | None = None

    @property
    def id(self) -> str:
        """SHA-256 (hex) of the record without `made_ns`: the same measurement has the same id."""
        content = {k: v for k, v in as_json(self).items() if k not in ("made_ns", "id")}
        return hashlib.sha256(json.dumps(content, sort_keys=True, allow_nan=False).encode()).hexdigest()

    @property
    def baseline_mm(self) -> float:
        """Distance of the two camera centres."""
        return float(np.linalg.norm(self.spike_from_rgb.cam_from_world[:, 3]))

    def camera(self, arm: Arm) -> Camera:
        """The camera of an arm."""
        return self.spike if arm == "spike" else self.rgb


def as_json(calibration: RigCalibration) -> dict[str, Any]:
    """The record as JSON-ready values; `id` is added by `write_calibration`."""
    far = calibration.depth_mm[1]
    return jsonable({
        "schema": SCHEMA,
        "spike": _camera_json(calibration.spike),
        "rgb": _camera_json(calibration.rgb),
        "spike_from_rgb": calibration.spike_from_rgb.cam_from_world,
        "model": calibration.model,
        "mirrored": calibration.mirrored,
        "depth_mm": [calibration.depth_mm[0], far if math.isfinite(far) else None],
        "residual_px": calibration.residual_px,
        "sd": dict(calibration.sd),
        "response": calibration.response,
        "split_ratio": calibration.split_ratio,
        "flat": None if calibration.flat is None else dict(calibration.flat),
        "forced": list(calibration.forced),
        "made_ns": calibration.made_ns,
    })  # fmt: skip


def _camera_json(camera: Camera) -> dict[str, Any]:
    return {"width": camera.width, "height": camera.height, "K": camera.K, "distortion": camera.distortion}


def write_calibration(
    path: str | Path, calibration: RigCalibration, report: Mapping[str, Any] | None = None, *, force: bool = False
) -> None:
    """Write a calibration as JSON, whole or not at all; `report` is kept beside the record for people.

    Raises:
        UsageError: the file exists and force is not given.
        HostError: the disk is full, or writing is not permitted.
    """
    document = {**as_json(calibration), "id": calibration.id}
    if report is not None:
        document["report"] = jsonable(report)
    with whole_file(path, force=force) as part:
        part.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_calibration(path: str | Path) -> RigCalibration:
    """Read a calibration file.

    Raises:
        UsageError: there is no such file.
        DataError: not JSON, too large, or not a calibration; all faults of the record at once.

    Edges:
        A record whose `id` is not that of its content was changed by hand and is refused; one without an id is taken.
    """
    source = Path(path)
    try:
        if source.stat().st_size > MAX_BYTES:
            raise DataError("a calibration is a small file", value=f"{source}: {source.stat().st_size} bytes")
        text = source.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise UsageError("there is no such calibration", value=source, next="spikerig calib board --help") from error
    except (OSError, UnicodeDecodeError) as error:
        raise DataError("the calibration cannot be read", value=f"{source}: {error}") from error
    try:
        table = json.loads(text, parse_constant=_no_constant, parse_int=_short_int)
    except (ValueError, RecursionError) as error:
        raise DataError(
            "the calibration is not valid JSON", value=f"{source}: {error or 'nested too deeply'}"
        ) from None
    return calibration_of(table, str(source))


def calibration_of(table: Any, source: str = "the calibration") -> RigCalibration:
    """A calibration from parsed JSON, for instance `Scene.calibration`; see `read_calibration`."""
    if not isinstance(table, dict) or table.get("schema") != SCHEMA:
        found = table.get("schema") if isinstance(table, dict) else type(table).__name__
        raise DataError("not a calibration of this tool", value=f"{source}: {str(found)[:80]}", expected=SCHEMA)
    read = _Reader(table)
    known = set(RigCalibration.__slots__) | {"schema", "id", "report"}
    read.faults += [f"{str(k)[:40]!r} is not a field of a calibration" for k in table if k not in known]
    near, far = read.numbers("depth_mm", (2,), none_ok=True)
    mirrored, model = read.choice("mirrored", (None, "spike", "rgb")), read.choice("model", ("common", "stereo"))
    response = None if table.get("response") is None else tuple(read.numbers("response", (3,)).tolist())
    made = {
        "spike": read.camera("spike"),
        "rgb": read.camera("rgb"),
        "spike_from_rgb": read.made("spike_from_rgb", lambda: Pose(read.numbers("spike_from_rgb", (3, 4)))),
        "model": model,
        "mirrored": mirrored,
        "depth_mm": (float(near), math.inf if math.isnan(far) else float(far)),
        "residual_px": read.number("residual_px"),
        "sd": {k: read.number(k, v) for k, v in read.mapping("sd").items()},
        "response": response,
        "split_ratio": None if table.get("split_ratio") is None else read.number("split_ratio"),
        "flat": None if table.get("flat") is None else {k: str(v)[:4096] for k, v in read.mapping("flat").items()},
        "forced": read.texts("forced"),
        "made_ns": None if table.get("made_ns") is None else int(read.number("made_ns")),
    }
    if read.faults:
        raise DataError("the calibration is damaged", value=f"{source}: " + "; ".join(read.faults[:20]))
    record = RigCalibration(**made)
    if model == "common" and record.baseline_mm > 0:
        raise DataError("a common centre has no baseline", value=f"{source}: {record.baseline_mm:g} mm")
    if "id" in table and table["id"] != record.id:
        raise DataError("the calibration was changed after it was made", value=source,
                        expected=f"id {record.id}", cause="edited by hand, or damaged",
                        next="calibrate again; or delete its id if the change is meant")  # fmt: skip
    return record


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not a number")


def _short_int(text: str) -> int:
    if len(text) > 20:
        raise ValueError("an integer of more than 20 digits")
    return int(text)


class _Reader:
    """Reads fields of a parsed record; faults are noted and stand-ins returned, so that all are told at once."""

    def __init__(self, table: Mapping[str, Any]) -> None:
        self.table, self.faults = table, []

    def number(self, key: str, value: Any = None) -> float:
        value = self.table.get(key) if value is None else value
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            self.faults.append(f"{str(key)[:40]!r} is {str(value)[:40]!r}, expected a finite number")
            return 0.0
        return value if isinstance(value, int) else float(value)

    def numbers(self, key: str, shape: tuple[int, ...], none_ok: bool = False) -> NDArray[np.float64]:
        found = _array(self.table.get(key), shape, none_ok)
        if found is None:
            self.faults.append(f"{key!r} is not {' x '.join(map(str, shape))} finite numbers")
            return np.zeros(shape)
        return found

    def mapping(self, key: str) -> Mapping[str, Any]:
        value = self.table.get(key)
        if not isinstance(value, dict) or len(value) > 1000:
            self.faults.append(f"{key!r} is not an object")
            return {}
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        value = self.table.get(key)
        if not isinstance(value, list) or not all(isinstance(v, str) for v in value) or len(value) > 1000:
            self.faults.append(f"{key!r} is not a list of texts")
            return ()
        return tuple(value)

    def choice(self, key: str, allowed: tuple[Any, ...]) -> Any:
        value = self.table.get(key)
        if isinstance(value, list | dict) or value not in allowed:
            self.faults.append(f"{key!r} is {str(value)[:40]!r}, expected one of {allowed}")
        return value

    def made(self, key: str, make: Any) -> Any:
        try:
            return make()
        except RigError as error:
            self.faults.append(f"{key!r}: {error.what}")
            return None

    def camera(self, key: str) -> Camera | None:
        inner = _Reader(self.mapping(key))
        size = [inner.number("width"), inner.number("height")]
        count = inner.table.get("distortion")
        n = len(count) if isinstance(count, list) else -1
        if n not in (0, 4, 5, 8):
            inner.faults.append("'distortion' is not 0, 4, 5 or 8 numbers")
            n = 0
        bends = inner.numbers("distortion", (n,)) if n else np.zeros(0)
        if not all(isinstance(s, int) and 1 <= s <= MAX_SIDE for s in size):
            inner.faults.append(f"'width' and 'height' are {size}, expected 1 to {MAX_SIDE}")
            size = [1, 1]
        made = inner.made("K", lambda: Camera(inner.numbers("K", (3, 3)), bends, int(size[0]), int(size[1])))
        self.faults += [f"{key}.{fault}" for fault in inner.faults]
        return made


def _array(value: Any, shape: tuple[int, ...], none_ok: bool) -> NDArray[np.float64] | None:
    """float64 of exactly that shape from nested lists of finite numbers; None becomes NaN where allowed."""
    if not shape:
        if value is None and none_ok:
            return np.array(np.nan)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:
            return None
        return np.array(float(value))
    if not isinstance(value, list) or len(value) != shape[0]:
        return None
    rows = [_array(v, shape[1:], none_ok) for v in value]
    return None if any(r is None for r in rows) else np.stack([r for r in rows if r is not None])
