"""A good scene, and ways to spoil it: for every check of `data check`, what must trip it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from hard_sim import small

from spikerig.calib.rig import RigCalibration, as_json
from spikerig.dataset.clocktime import ClockModel
from spikerig.dataset.scene import Camera, Points, Pose, Scene, Trajectory, View
from spikerig.dataset.spikes import SpikeStream
from spikerig.dataset.store import open_scene, write_scene
from spikerig.rigctl.sim.capture import capture

SIZE: dict[str, Any] = {"camera__width": 96, "camera__height": 60, "orbit__views": 7, "orbit__test": [3]}
TIME: dict[str, Any] = {"exposure__exposure_ms": 2.0, "exposure__sub_poses": 9, "exposure__margin_ticks": 256}
Change = Callable[[Scene], Scene]


def write_good(path: Path) -> Scene:
    """Seven views with everything that a check asks for: clock, calibration, records of alignment, points, paths."""
    raw = path.with_name("raw.h5")
    capture(small(**SIZE, **TIME, shake__path_px=[6, 8], effects=["threshold_fpn"]), raw, workers=1)
    with open_scene(raw) as file:
        scene = file.read()
    span = np.array([0, 10**12])
    rig = RigCalibration(scene.camera, scene.camera, Pose(np.eye(4)[:3]), "common", None, (1000.0, 5000.0))
    info = {**scene.info, "align": {"accepted": True, "calibration": rig.id}, "poses": {"accepted": True}}
    clock = ClockModel(span, span, np.array([900.0, 900.0]), 1.0)
    scene = replace(scene, info=info, clock=clock, calibration={**as_json(rig), "id": rig.id})
    write_scene(path, scene)
    return scene


def views(change: Callable[[View], View], *which: int) -> Change:
    """A change of some views, by number; of all, where none is given."""

    def spoil(scene: Scene) -> Scene:
        changed = tuple(change(v) if k in which or not which else v for k, v in enumerate(scene.views))
        return replace(scene, views=changed)

    return spoil


def frame(*which: int, **changes: Any) -> Change:
    return views(lambda v: replace(v, frame=replace(v.frame, **changes)), *which)


def pixels(make: Callable[[np.ndarray], np.ndarray], *which: int) -> Change:
    return views(lambda v: replace(v, frame=replace(v.frame, pixels=make(v.frame.pixels))), *which)


def spikes(change: Callable[[SpikeStream], SpikeStream | None], *which: int) -> Change:
    return views(lambda v: v if v.spikes is None else replace(v, spikes=change(v.spikes)), *which)


def bits(make: Callable[[np.ndarray], np.ndarray], *which: int) -> Change:
    """A change of the bits as bool[T,H,W]."""

    def changed(s: SpikeStream) -> SpikeStream:
        on = np.unpackbits(s.bits, axis=2, count=s.width, bitorder="little").astype(bool)
        return replace(s, bits=np.packbits(make(on), axis=2, bitorder="little"))

    return spikes(changed, *which)


def late(ticks: float, *which: int) -> Change:
    """Pictures that say they were taken later than they were; their paths and poses go with them."""
    return views(
        lambda v: replace(v, frame=replace(v.frame, start_ns=v.frame.start_ns + round(ticks * 25_000))), *which
    )


def pose(make: Callable[[np.ndarray], np.ndarray], *which: int) -> Change:
    return views(lambda v: replace(v, pose=Pose(make(np.array(v.pose.cam_from_world)))), *which)


def moved(m: np.ndarray, by: tuple[float, float, float]) -> np.ndarray:
    """A camera at another place, with the same view."""
    return np.column_stack([m[:, :3], m[:, 3] - m[:, :3] @ np.array(by)])


def turned_about(m: np.ndarray) -> np.ndarray:
    """A camera at the same place that looks back."""
    return np.diag([-1.0, 1.0, -1.0]) @ m


def path(make: Callable[[Trajectory], Trajectory], *which: int) -> Change:
    return views(lambda v: v if v.trajectory is None else replace(v, trajectory=make(v.trajectory)), *which)


def leaping(t: Trajectory) -> Trajectory:
    poses = np.array(t.poses)
    poses[len(poses) // 2 + 1] = moved(poses[len(poses) // 2 + 1], (1.5, 0, 0))
    return replace(t, poses=poses)


def info(**changes: Any) -> Change:
    return lambda s: replace(s, info={**s.info, **changes})


def dead(on: np.ndarray) -> np.ndarray:
    on = on.copy()
    on[:, 10:14, 20:24] = False
    return on


def hot(on: np.ndarray) -> np.ndarray:
    on = on.copy()
    on[:, 7::20, 5::16] = True
    return on


def alike(scene: Scene, change: Callable[[View, View], View]) -> Scene:
    """The second view as `change` makes it of itself and the first."""
    first, second, *others = scene.views
    return replace(scene, views=(first, change(second, first), *others))


def rolled(a: np.ndarray) -> np.ndarray:
    """A picture three pixels off."""
    return np.roll(a, 3, 1)


def two(slope: float) -> ClockModel:
    return ClockModel(np.array([0, 10**12]), np.array([0, round(10**12 * slope)]), np.array([9.0, 9.0]), 1.0)


# check -> ways to trip it, each with the importance it must have; "record" changes are made of a good scene in memory
SPOILED: dict[str, list[tuple[Change, str]]] = {
    "views-to-train-on": [(views(lambda v: replace(v, split="test")), "error")],
    "views-to-test-on": [(views(lambda v: replace(v, split="train"), 3), "note")],
    "spikes-are-there": [(spikes(lambda s: None, 1), "warning"), (spikes(lambda s: None), "note")],
    "spikes-fit-the-camera": [(spikes(lambda s: replace(s, bits=s.bits[:, :30]), 0), "error")],
    "pixels-are-valid": [
        (views(lambda v: replace(v, valid=np.zeros_like(v.valid)), 0), "error"),
        (views(lambda v: replace(v, valid=np.arange(v.valid.size).reshape(v.valid.shape) % 3 == 0), 0), "warning"),
    ],
    "pictures-show-something": [
        (pixels(np.zeros_like, 2), "error"),
        (pixels(lambda p: np.full_like(p, 77), 2), "error"),
        (pixels(lambda p: np.where(np.arange(p.shape[0])[:, None, None] < 20, np.uint8(255), p), 2), "warning"),
    ],
    "views-differ": [
        (lambda s: alike(s, lambda b, a: replace(b, frame=replace(b.frame, pixels=a.frame.pixels))), "error"),
        (lambda s: alike(s, lambda b, a: replace(b, spikes=replace(a.spikes, t0_ns=b.spikes.t0_ns))), "error"),
    ],
    "spikes-are-not-stuck": [(bits(np.zeros_like, 1), "error"), (bits(np.ones_like, 1), "error")],
    "light-fits-the-sensor": [
        (bits(lambda on: on | (np.arange(on.shape[1])[:, None] < 9), 1), "warning"),
        (bits(lambda on: on & (np.arange(len(on)) < 5)[:, None, None], 1), "warning"),
    ],
    "sensor-pixels-work": [(bits(dead), "warning"), (bits(hot), "warning")],
    "rate-is-known": [(spikes(lambda s: replace(s, rate_hz=None), 1), "error")],
    "rate-is-nominal": [
        (spikes(lambda s: replace(s, rate_hz=39_000.0), 1), "warning"),
        (lambda s: replace(s, clock=two(1.002)), "warning"),
    ],
    "spikes-cover-the-exposure": [(late(300, 1), "error"), (late(-257, 1), "error")],
    "margin-is-wide": [(late(20, 1), "note")],
    "no-ticks-lost-in-exposure": [
        (spikes(lambda s: replace(s, lost=np.array([[250, 260]])), 1), "warning"),
        (spikes(lambda s: replace(s, lost=np.array([[250, 300]])), 1), "error"),
    ],
    "exposures-are-equal": [(frame(1, exposure_ns=1_900_000), "warning"), (frame(1, exposure_ns=-5), "error"),
                            (frame(1, exposure_ns=0), "note")],
    "rows-are-timed": [
        (frame(1, row_ns=-3), "warning"),
        (frame(1, row_ns=3_000_000), "warning"),
        (views(lambda v: replace(v, frame=replace(v.frame, row_ns=9), sensor_row=v.sensor_row * 0), 1), "warning"),
    ],
    "exposures-do-not-overlap": [(lambda s: alike(s, lambda b, a: replace(b, frame=replace(
        b.frame, start_ns=a.frame.start_ns + 5))), "error")],
    "clocks-are-joined": [(lambda s: replace(spikes(lambda p: replace(p, clock="spike"), 1)(s), clock=None), "error")],
    "clock-is-certain": [
        (lambda s: replace(s, clock=ClockModel(s.clock.device_ns, s.clock.rig_ns, s.clock.sigma_ns * 40)), "warning"),
        (lambda s: replace(s, clock=ClockModel(s.clock.device_ns, s.clock.rig_ns, s.clock.sigma_ns * 400)), "error"),
    ],
    "frames-are-in-step": [(late(3.5), "warning"), (late(-12), "error"), (late(60), "error")],
    "brightness-agrees": [(pixels(lambda p: (p * 0.7).astype(np.uint8), 1), "warning"),
                          (lambda s: replace(s, light_gain=2 * s.light_gain), "warning")],
    "edges-lie-together": [(pixels(rolled), "error"), (pixels(rolled, 1), "warning")],
    "camera-is-plausible": [
        (lambda s: replace(s, camera=Camera(s.camera.K / [[100.0], [100], [1]], s.camera.distortion, 96, 60)), "error"),
        (lambda s: replace(s, camera=Camera(s.camera.K * [[1.0, 1, 3], [1, 1, 1], [1, 1, 1]], s.camera.distortion,
                                            96, 60)), "error"),
        (lambda s: replace(s, camera=Camera(s.camera.K * [[1.1], [1], [1]], s.camera.distortion, 96, 60)), "warning"),
    ],
    "rotations-are-exact": [(pose(lambda m: m * (1 + 1e-5), 1), "warning")],
    "cameras-moved": [
        (views(lambda v: replace(v, pose=Pose(np.eye(4)[:3]))), "error"),
        (lambda s: alike(s, lambda b, a: replace(b, pose=a.pose)), "error"),
        (lambda s: alike(s, lambda b, a: replace(b, pose=Pose(turned_about(a.pose.cam_from_world)))), "note"),
    ],
    "no-camera-stands-apart": [(pose(lambda m: moved(m, (40, 0, 0)), 1), "warning"),
                               (pose(turned_about, 1), "warning")],
    "views-see-the-points": [(pose(turned_about, 1), "error"), (pose(lambda m: moved(m, (0, 0, 9)), 1), "error")],
    "extent-fits-the-depth": [
        (lambda s: replace(s, points=replace(s.points, xyz=s.points.xyz + 1e4)), "warning"),
        (lambda s: replace(s, points=replace(s.points, xyz=np.r_[s.points.xyz[1:], [[0, 0, 1e6]]])), "warning"),
    ],
    "paths-cover-the-exposure": [
        (path(lambda t: Trajectory(t.at_ns[len(t.at_ns) // 2 :], t.poses[len(t.at_ns) // 2 :]), 1), "warning")],
    "paths-pass-through-the-poses": [
        (pose(lambda m: moved(m, (0.2, 0, 0)), 1), "error"), (pose(lambda m: moved(m, (0.03, 0, 0)), 1), "warning"),
        (path(lambda t: Trajectory(t.at_ns + 10**9, t.poses), 1), "error")],
    "paths-are-short": [(path(leaping, 1), "warning")],
    "nothing-was-forced": [
        (info(align={"forced": True, "reasons": ["edges <b>"]}), "warning"),
        (info(poses={"accepted": False}), "warning"),
        (lambda s: replace(s, calibration={**s.calibration, "forced": ["views"]}), "warning"),
    ],
    "calibration-is-the-one-used": [(info(align={"calibration": "another"}), "error")],
    "calibration-can-be-read": [(lambda s: replace(s, calibration={**s.calibration, "residual_px": 9.0}), "error"),
                                (lambda s: replace(s, calibration={"schema": "?"}), "error")],
    "points-are-there": [
        (lambda s: replace(s, points=None), "note"),
        (lambda s: replace(s, points=Points(s.points.xyz, s.points.rgb, "random")), "note"),
    ],
    "release-tells-its-origin": [
        (views(lambda v: replace(v, split="train"), 3), "warning"),
        (lambda s: replace(s, truth=None, info={}, calibration=None), "warning"),
        (lambda s: replace(s, truth=None, info={"align": {"a": 1}, "poses": {"a": 1}}, light_gain=None), "note"),
    ],
}  # fmt: skip


def nan_pose(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["/views/001/pose"][...] = np.nan


def no_pose(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["/views/001/pose"]


def bad_byte(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["/views/001/pixels"][3, 3, 0] ^= 1


def nan_rows(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["/views/001/sensor_row"][...] = np.nan


def far_future(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["/views/001/pixels"].attrs["start_ns"] = np.int64(2**63 - 1)


def unfinished(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file.attrs["status"] = np.bytes_(b"recording")


# changes of the file itself: `file-is-whole` must find them, and no other check may fall over them
DAMAGED: tuple[Callable[[Path], None], ...] = (nan_pose, no_pose, bad_byte, nan_rows, far_future, unfinished)
