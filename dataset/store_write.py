"""Writing a scene file, a view at a time: it appears at its name complete, or not at all.

The file grows beside its target as NAME.partial with status "recording", flushed after each view. `close` sets
"complete", syncs and renames. An exception sets "aborted" and keeps the part if it holds a view (it may be the only
record of a capture), else removes it. A kill leaves status "recording". Reading either is a clear error unless asked.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import ArrayLike

from spikerig.dataset.clocktime import ClockModel
from spikerig.dataset.errors import HostError, NumericsError, UsageError
from spikerig.dataset.events import EventStream
from spikerig.dataset.hdf5_guard import remember
from spikerig.dataset.scene import Camera, Points, Scene, Trajectory, Truth, View
from spikerig.dataset.store import FORMAT, NAME, VERSION, row_of
from spikerig.dataset.store_events import put_events
from spikerig.dataset.store_seal import put_attr, seal
from spikerig.dataset.terminal import jsonable


@contextmanager
def disk_faults(path: Path) -> Iterator[None]:
    """Turn what HDF5 raises on a full or failing disk into one HostError."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        raise HostError("the scene cannot be written", value=f"{path}: {error}", cause="a full disk?") from error


class SceneWriter:
    """Write a scene in bounded memory; use it in a `with`, which closes it, or aborts it on an exception.

    Args:
        path: of the scene file.
        name, camera: of the scene.
        light_gain, info, points, clock, calibration: as in Scene; also settable as attributes until closing.
        truth: its clock, effects, seed and label (its mappings are written too); None for a real scene.
        force: replace an existing file, and an unfinished part of an earlier try.
        keep: keep the views that are whole when the `with` ends in an exception.

    Raises:
        UsageError: the file, or an unfinished part of it, exists.
        HostError: the folder cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        name: str,
        camera: Camera,
        *,
        light_gain: float | None = None,
        info: Mapping[str, Any] | None = None,
        points: Points | None = None,
        clock: ClockModel | None = None,
        calibration: Mapping[str, Any] | None = None,
        truth: Truth | None = None,
        force: bool = False,
        keep: bool = True,
    ) -> None:
        self.path, self.name, self.camera, self.truth = Path(path), name, camera, truth
        self.force, self.keep = force, keep
        self.light_gain, self.info, self.points = light_gain, dict(info or {}), points
        self.clock, self.calibration = clock, calibration
        self.part = self.path.with_name(self.path.name + ".partial")
        self.names: list[str] = []
        self._file = self._create()
        try:
            with disk_faults(self.path):
                self._start(self._file)
        except BaseException:
            self.abort()
            raise

    def _start(self, root: h5py.File) -> None:
        marks = {"format": FORMAT, "version": VERSION, "status": "recording", "name": self.name}
        for key, value in (marks | {"writer": f"spikerig {version('spikerig')}"}).items():
            put_attr(root, key, value)
        group = root.create_group("camera")
        for key in ("width", "height"):
            put_attr(group, key, getattr(self.camera, key))
        for key in ("K", "distortion"):
            put(group, key, getattr(self.camera, key))
        self._views = root.create_group("views")
        if self.truth is not None:
            self._put_truth(self.truth)
        root.flush()

    def _create(self) -> h5py.File:
        if self.path.is_dir() or (self.path.exists() and not self.force):
            raise UsageError("the scene exists already", value=self.path, next="give --force to replace it")
        if self.part.exists() and not self.force:
            raise UsageError(
                "an unfinished scene lies in the way",
                value=self.part,
                cause="an earlier run was killed or failed, or is still at work",
                next="give --force to replace it, or move it away",
            )
        try:
            self.part.unlink(missing_ok=True)
            return h5py.File(self.part, "x", libver=("v108", "v108"))  # checksummed metadata, readable after a kill
        except OSError as error:
            raise HostError("the scene cannot be written here", value=f"{self.path}: {error}") from error

    def add(
        self,
        view: View,
        *,
        light: ArrayLike | None = None,
        at_ns: int | None = None,
        trajectory: Trajectory | None = None,
        events: EventStream | None = None,
    ) -> None:
        """Write a view, and of a simulated one its truth: sharp linear light [H,W,3], its instant, the exact path.

        `events` are what an event camera saw of it; its size may differ from the camera's.

        Raises:
            UsageError: a name taken or not allowed, a size that is not the camera's, truth in a scene without.
            NumericsError: light or sensor rows that are not finite.
        """
        self._check(view, light is not None or at_ns is not None or trajectory is not None)
        with disk_faults(self.path):
            group = self._views.create_group(view.name)
            self._put_view(group, view)
            if events is not None:
                put_events(group, events)
            self._put_view_truth(view.name, light, at_ns, trajectory)
            seal(group)
            self.names.append(view.name)
            self._file.flush()

    def _put_view(self, group: h5py.Group, view: View) -> None:
        put_attr(group, "split", view.split)
        put_attr(group, "order", len(self.names))
        frame = view.frame
        pixels = put(group, "pixels", frame.pixels)
        for key in ("transfer", "start_ns", "exposure_ns", "row_ns", "clock"):
            put_attr(pixels, key, getattr(frame, key))
        if view.spikes is not None:
            spikes = put(group, "spikes", view.spikes.bits)
            for key in ("width", "rate_hz", "t0_ns", "clock"):
                put_attr(spikes, key, getattr(view.spikes, key))
            put(group, "lost", view.spikes.lost)
        put(group, "sensor_row", view.sensor_row)
        put(group, "valid", view.valid)
        put(group, "pose", view.pose.cam_from_world)
        if view.trajectory is not None:
            _put_trajectory(group, view.trajectory)

    def _check(self, view: View, truth: bool) -> None:
        size = (self.camera.height, self.camera.width)
        if not NAME.fullmatch(view.name) or view.name in self.names:
            raise UsageError(
                "this view's name is taken, or not a name",
                value=repr(view.name),
                expected="letters, digits, `-`, `_`, `.`; not starting with a dot; unique in the scene",
            )
        if view.frame.pixels.shape[:2] != size:
            raise UsageError("a frame must have the camera's size", value=view.frame.pixels.shape, expected=str(size))
        if truth and self.truth is None:
            raise UsageError(
                "truth of a view in a scene without truth", value=view.name, next="give SceneWriter truth="
            )
        if not np.isfinite(view.sensor_row).all():
            raise NumericsError("sensor rows must be finite", value=view.name)

    def _put_truth(self, truth: Truth) -> None:
        group = self._file.create_group("truth")
        put_attr(group, "seed", truth.seed)
        put_attr(group, "label", truth.label)
        put_json(group, "effects", truth.effects)
        _put_clock(group, truth.clock)
        self._true_views = group.create_group("views")

    def _put_view_truth(self, name: str, light: ArrayLike | None, at_ns: int | None, path: Trajectory | None) -> None:
        truth = self.truth
        if truth is None:
            return
        light = truth.light.get(name) if light is None else light
        at_ns = truth.at_ns.get(name) if at_ns is None else at_ns
        path = truth.trajectories.get(name) if path is None else path
        if light is None and at_ns is None and path is None:
            return
        group = self._true_views.create_group(name)
        put_attr(group, "at_ns", at_ns)
        if light is not None:
            array = np.asarray(light, np.float32)
            if array.shape != (self.camera.height, self.camera.width, 3):
                raise UsageError("true light is [H,W,3] of the camera's size", value=array.shape)
            if not np.isfinite(array).all():
                raise NumericsError("true light must be finite", value=name)
            put(group, "light", array)
        if path is not None:
            _put_trajectory(group, path)
        seal(group)

    def close(self) -> None:
        """Finish: everything sealed, status "complete", synced to disk, renamed to its name."""
        if not self._file:
            return
        try:
            with disk_faults(self.path):
                self._finish(self._file)
        except BaseException:
            self.abort()
            raise
        if self.path.exists() and not self.force:
            raise UsageError("the scene appeared while it was being written", value=self.path, next=f"see {self.part}")
        os.replace(self.part, self.path)
        _sync(self.path.parent)
        remember(self.path)

    def _finish(self, root: h5py.File) -> None:
        put_json(root, "info", self.info)
        if self.calibration is not None:
            put_json(root, "calibration", self.calibration)
        if self.clock is not None:
            _put_clock(root, self.clock)
        if self.points is not None:
            group = root.create_group("points")
            put_attr(group, "source", self.points.source)
            put(group, "xyz", self.points.xyz)
            put(group, "rgb", self.points.rgb)
        put_attr(root, "light_gain", self.light_gain)
        put_attr(root, "status", "complete")
        seal(root)
        root.close()
        _sync(self.part)

    def abort(self) -> None:
        """Stop: status "aborted"; the part is kept if it holds a view and `keep` was asked for, else removed."""
        if not self._file:
            return
        try:
            put_attr(self._file, "status", "aborted")
        except (OSError, RuntimeError, ValueError):
            pass  # the disk is full or gone: the part stays "recording", which is as clear
        try:
            self._file.close()
        except (OSError, RuntimeError):
            pass
        finally:
            if not (self.keep and self.names):
                self.part.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()


def write(path: str | Path, scene: Scene, force: bool) -> None:
    """What `store.write_scene` does."""
    truth = scene.truth
    if truth is not None:
        _no_strangers("truth", {*truth.light, *truth.at_ns, *truth.trajectories}, scene)
    _no_strangers("events", {*scene.events}, scene)
    more = {key: getattr(scene, key) for key in ("light_gain", "info", "points", "clock", "calibration")}
    with SceneWriter(path, scene.name, scene.camera, **more, truth=truth, force=force, keep=False) as out:
        for view in scene.views:
            out.add(view, events=scene.events.get(view.name))


def _no_strangers(what: str, known: set[str], scene: Scene) -> None:
    strangers = known - {view.name for view in scene.views}
    if strangers:
        raise UsageError(f"{what} of views that the scene does not have", value=sorted(strangers)[:8])


def put(parent: h5py.Group, name: str, values: ArrayLike) -> h5py.Dataset:
    """Store an array of the schema's type, contiguous and unfiltered."""
    row = row_of(f"{(parent.name or '').rstrip('/')}/{name}")
    if row is None:
        raise UsageError("not in the schema", value=f"{parent.name}/{name}")
    values = np.asarray(values)
    kind = values.dtype if values.dtype in row.dtypes else row.dtypes[0]
    return parent.create_dataset(name, data=np.ascontiguousarray(values, kind))


def put_json(parent: h5py.Group, name: str, record: Mapping[str, Any]) -> None:
    """Store a JSON object as its bytes."""
    text = json.dumps(jsonable(dict(record)), allow_nan=False, ensure_ascii=False)
    put(parent, name, np.frombuffer(text.encode(), np.uint8))


def _put_clock(parent: h5py.Group, clock: ClockModel) -> None:
    group = parent.create_group("clock")
    put_attr(group, "drift_ppm", clock.drift_ppm)
    for name in ("device_ns", "rig_ns", "sigma_ns"):
        put(group, name, getattr(clock, name))


def _put_trajectory(parent: h5py.Group, path: Trajectory) -> None:
    group = parent.create_group("trajectory")
    put(group, "at_ns", path.at_ns)
    put(group, "poses", path.poses)
    if path.cov is not None:
        put(group, "cov", path.cov)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
