"""What a scene is made of: cameras, poses, frames, views. Frozen records, arrays read-only.

Conventions (docs/conventions.md): a camera looks along +z with x right and y down; pixel centres lie at +0.5;
`cam_from_world` maps world points into the camera; time is int64 nanoseconds; `pixels` are encoded, `light` is linear.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import ClockModel, frozen_array
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.events import EventStream
from spikerig.dataset.spikes import SpikeStream

Floats = NDArray[np.float64]
Split = Literal["train", "test"]
PointSource = Literal["sfm", "simulator", "given", "random"]
ERROR, WARNING, NOTE = "error", "warning", "note"  # how grave a Finding is


def _set(record: object, name: str, dtype: type) -> None:
    object.__setattr__(record, name, frozen_array(getattr(record, name), dtype))


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera with OpenCV distortion.

    Args:
        K: float64[3,3] in pixels, for pixel centres at +0.5.
        distortion: float64[0], [4], [5] or [8] (k1 k2 p1 p2 k3 ...), OpenCV's order; empty = none.
        width, height: in pixels.
    """

    K: Floats
    distortion: Floats
    width: int
    height: int

    def __post_init__(self) -> None:
        _set(self, "K", np.float64)
        _set(self, "distortion", np.float64)
        if self.K.shape != (3, 3) or not np.all(np.isfinite(self.K)) or self.K[0, 0] <= 0 or self.K[1, 1] <= 0:
            raise DataError("a camera matrix must be finite, 3x3, with positive focal lengths", value=self.K)
        if self.width < 1 or self.height < 1:
            raise DataError("a camera needs at least one pixel", value=(self.width, self.height))

    @staticmethod
    def pinhole(width: int, height: int, fov_x_deg: float) -> Camera:
        """A distortion-free camera with square pixels, centred, of a horizontal field of view in degrees."""
        if not 0 < fov_x_deg < 180:
            raise UsageError("a field of view lies between 0 and 180 degrees", value=fov_x_deg)
        f = width / 2 / np.tan(np.radians(fov_x_deg) / 2)
        return Camera(np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]]), np.zeros(0), width, height)


@dataclass(frozen=True, slots=True)
class Pose:
    """Where a camera is: `cam_from_world` float64[3,4], rotation | translation."""

    cam_from_world: Floats

    def __post_init__(self) -> None:
        _set(self, "cam_from_world", np.float64)
        check_poses(self.cam_from_world[None])

    @property
    def centre(self) -> Floats:
        """Camera centre in the world, float64[3]."""
        return -self.cam_from_world[:, :3].T @ self.cam_from_world[:, 3]


def check_poses(poses: Floats) -> None:
    """Refuse poses [K,3,4] that are not finite or whose left part is not a rotation (to 1e-4)."""
    if poses.ndim != 3 or poses.shape[1:] != (3, 4) or not np.all(np.isfinite(poses)):
        raise DataError("poses must be finite and of shape [K,3,4]", value=poses.shape)
    R = poses[:, :, :3]
    drift = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0)
    if drift > 1e-4 or np.any(np.linalg.det(R) < 0):
        raise DataError(
            "a pose's rotation is not a rotation",
            value=f"R R^T differs from 1 by {drift:.3g}",
            expected="an orthonormal matrix with determinant +1",
            cause="a scaled, mirrored or transposed matrix",
        )


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses over time: at_ns int64[K] increasing, poses float64[K,3,4] cam_from_world, cov float64[K,6,6] or None."""

    at_ns: NDArray[np.int64]
    poses: Floats
    cov: Floats | None = None

    def __post_init__(self) -> None:
        _set(self, "at_ns", np.int64)
        _set(self, "poses", np.float64)
        check_poses(self.poses)
        if len(self.at_ns) != len(self.poses) or np.any(np.diff(self.at_ns) <= 0):
            raise DataError("a trajectory needs one strictly increasing time a pose", value=len(self.at_ns))


@dataclass(frozen=True, slots=True)
class Frame:
    """An RGB picture and when it was exposed.

    Args:
        pixels: uint8[H,W,3] encoded by `transfer`; or uint16, full scale 65535, from a camera of more than 8 bits.
        transfer: "srgb" or "linear".
        start_ns: start of exposure of sensor row 0.
        exposure_ns: > 0; 0 for an instantaneous (simulated sharp) picture.
        row_ns: read-out time of one sensor row; 0 for a global shutter.
        clock: name of the clock of `start_ns`.
    """

    pixels: NDArray[np.uint8] | NDArray[np.uint16]
    transfer: str = "srgb"
    start_ns: int = 0
    exposure_ns: int = 0
    row_ns: int = 0
    clock: str = "rig"

    def __post_init__(self) -> None:
        _set(self, "pixels", np.uint16 if self.pixels.dtype == np.uint16 else np.uint8)
        if self.pixels.ndim != 3 or self.pixels.shape[2] != 3:
            raise DataError("a frame is uint8[H,W,3] or uint16[H,W,3]", value=self.pixels.shape)
        if self.transfer not in ("srgb", "linear"):
            raise DataError("unknown transfer of a frame", value=self.transfer, expected="srgb or linear")

    @property
    def full(self) -> int:
        """The pixel value of full scale."""
        return int(np.iinfo(self.pixels.dtype).max)

    @property
    def pixels8(self) -> NDArray[np.uint8]:
        """The pixels in 8 bits, rounded where they have more."""
        return (
            np.rint(self.pixels / 257).astype(np.uint8) if self.full > 255 else self.pixels.astype(np.uint8, copy=False)
        )


@dataclass(frozen=True, slots=True)
class Points:
    """Sparse surface points: xyz float64[N,3], rgb uint8[N,3] (sRGB), and where they come from."""

    xyz: Floats
    rgb: NDArray[np.uint8]
    source: PointSource

    def __post_init__(self) -> None:
        _set(self, "xyz", np.float64)
        _set(self, "rgb", np.uint8)
        if self.xyz.ndim != 2 or self.xyz.shape[1] != 3 or self.rgb.shape != self.xyz.shape:
            raise DataError("points are xyz[N,3] with rgb[N,3]", value=(self.xyz.shape, self.rgb.shape))


@dataclass(frozen=True, slots=True)
class View:
    """One synchronised look: the picture, the spikes under it, where each pixel was read, and the camera's pose.

    Args:
        name: unique in its scene; letters, digits, `-`, `_`, `.`; no path.
        frame: RGB on the scene's pinhole camera (already aligned to the spike arm).
        spikes: raw spikes covering the exposure plus a margin; None for a view without (a held-out picture).
        sensor_row: float32[H,W], row of the RGB sensor each pixel was read at.
        valid: bool[H,W], pixels both arms see.
        pose: the spike camera at mid-exposure of the middle row.
        trajectory: poses over the exposure, None where unknown.
        split: "train" or "test".
    """

    name: str
    frame: Frame
    spikes: SpikeStream | None
    sensor_row: NDArray[np.float32]
    valid: NDArray[np.bool_]
    pose: Pose
    trajectory: Trajectory | None
    split: Split = "train"

    def __post_init__(self) -> None:
        _set(self, "sensor_row", np.float32)
        _set(self, "valid", np.bool_)
        shape = self.frame.pixels.shape[:2]
        if self.sensor_row.shape != shape or self.valid.shape != shape:
            raise DataError("sensor_row and valid must have the frame's size", value=self.name, expected=str(shape))
        if self.split not in ("train", "test"):
            raise DataError("a view is for train or test", value=self.split)

    @property
    def middle_row(self) -> float:
        """The sensor row that the picture's middle row was read at, which a crop or a lens moves.

        Edges:
            Where a warp bends rows it is the median over the middle row's valid pixels; over all valid ones where that
            row has none; the picture's own middle where nothing is valid.
        """
        middle = len(self.sensor_row) // 2
        for rows, valid in ((self.sensor_row[middle], self.valid[middle]), (self.sensor_row, self.valid)):
            if valid.any():
                return float(np.median(rows[valid]))
        return float(middle)

    @property
    def mid_ns(self) -> int:
        """Mid-exposure of the picture's middle row, on the frame's clock."""
        return self.instant_ns(0.5)

    def instant_ns(self, phase: float) -> int:
        """Nanoseconds at a fraction of the exposure of the picture's middle row (a global shutter's every row)."""
        f = self.frame
        late = f.row_ns * self.middle_row if f.row_ns else 0.0
        return f.start_ns + round(late + phase * f.exposure_ns)


@dataclass(frozen=True, slots=True)
class Truth:
    """What only a simulator knows.

    Args:
        light: view name -> float32[H,W,3], linear sharp light at `at_ns` (1.0 = display white).
        at_ns: view name -> the instant of `light` and of View.pose.
        trajectories: view name -> the exact path over the exposure.
        clock: the exact device-to-rig map.
        effects: effect name -> its parameters, as simulated.
        seed: of the whole simulation.
        label: which sub-pose is the ground truth, e.g. "mid".
    """

    light: Mapping[str, NDArray[np.float32]]
    at_ns: Mapping[str, int]
    trajectories: Mapping[str, Trajectory]
    clock: ClockModel
    effects: Mapping[str, Any]
    seed: int
    label: str = "mid"


@dataclass(frozen=True, slots=True)
class Scene:
    """A packaged RS-3D scene: one camera, views of it, sparse points, and (simulated scenes only) the truth.

    `light_gain` is the texture value (spikes a tick) of RGB white (linear 1.0): known for simulated scenes, measured
    by calibration for real ones, None where unknown. `info` is free provenance, JSON-ready. `clock` is the take's map
    of the spike camera's time to the rig's, `calibration` the rig's as a JSON-ready record; None where there is none.
    `events` are those of the views that an event camera saw too, by view name.
    """

    name: str
    camera: Camera
    views: tuple[View, ...]
    points: Points | None = None
    truth: Truth | None = None
    light_gain: float | None = None
    info: Mapping[str, Any] = field(default_factory=dict)
    clock: ClockModel | None = None
    calibration: Mapping[str, Any] | None = None
    events: Mapping[str, EventStream] = field(default_factory=dict)

    def view(self, name: str) -> View:
        """The view of that name."""
        for view in self.views:
            if view.name == name:
                return view
        raise UsageError("no such view", value=name, expected=", ".join(v.name for v in self.views[:8]))


@dataclass(frozen=True, slots=True)
class Finding:
    """What a check found: its name, importance (error, warning, note), where, the message, and the fix."""

    check: str
    importance: str
    where: str
    message: str
    fix: str = ""
