"""Reading a scene file: light to open, views and windows of spikes on demand."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import ClockModel, ns_from_tick
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.events import EventStream
from spikerig.dataset.hdf5_guard import hdf5_faults, names, refuse, spot
from spikerig.dataset.scene import Camera, Frame, Points, Pose, Scene, Trajectory, Truth, View
from spikerig.dataset.spikes import SpikeStream
from spikerig.dataset.store import (
    FORMAT,
    NAME,
    ROWS,
    dataset_at,
    group_at,
    has,
    read_array,
    read_attr,
    read_clock,
    read_json,
    read_trajectory,
    stored_digest,
)
from spikerig.dataset.store_events import check_events, count_events, read_events


class SceneFile:
    """An open scene file: light to open, views and windows of spikes read on demand. Made by `open_scene`.

    Attributes:
        path, name, status, camera, light_gain, info: of the scene.
        names, train, test: view names, in the scene's order.
        has_truth, truth_label: whether there is truth, and which sub-pose it is ("" without truth).
    """

    def __init__(self, file: h5py.File, path: Path, partial: bool) -> None:
        self._file, self.path = file, path
        self.status: str = read_attr(file, "status")
        if self.status != "complete" and not partial:
            raise DataError(
                "this scene was not finished",
                value=f"{path}: status {self.status}",
                expected="status complete",
                cause="its writer was killed, failed, or is still at work",
                next="write it again; open_scene(path, partial=True) reads the views that are whole",
            )
        self.name: str = read_attr(file, "name")
        self.light_gain: float | None = read_attr(file, "light_gain")
        camera = group_at(file, "camera")
        size = read_attr(camera, "width"), read_attr(camera, "height")
        self.camera = Camera(read_array(camera, "K"), read_array(camera, "distortion"), *size)
        self.info: dict[str, Any] = read_json(file, "info") if has(file, "info") or not partial else {}
        views = group_at(file, "views")
        found: list[tuple[int, str, str]] = []
        for name in names(views):
            if not NAME.fullmatch(name):
                raise refuse(spot(views, repr(name)), "not a view's name")
            group = group_at(views, name)
            if self.status == "complete" or stored_digest(group):  # a view's digest is written last
                found.append((read_attr(group, "order"), name, read_attr(group, "split")))
        self.names = tuple(name for _, name, _ in sorted(found))
        splits = {name: split for _, name, split in found}
        self.train = tuple(name for name in self.names if splits[name] == "train")
        self.test = tuple(name for name in self.names if splits[name] == "test")
        self.has_truth = has(file, "truth")
        self.truth_label: str = read_attr(group_at(file, "truth"), "label") if self.has_truth else ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; reading afterwards is an error."""
        self._file.close()

    @property
    def sha256(self) -> str | None:
        """Checksum of the whole content, as stored; None in an unfinished file."""
        with hdf5_faults(self.path):
            return stored_digest(self._file) or None

    @property
    def points(self) -> Points | None:
        """The sparse points, None if there are none."""
        with hdf5_faults(self.path):
            if not has(self._file, "points"):
                return None
            group = group_at(self._file, "points")
            return Points(read_array(group, "xyz"), read_array(group, "rgb"), read_attr(group, "source"))

    @property
    def clock(self) -> ClockModel | None:
        """The take's clock model, None if there is none."""
        with hdf5_faults(self.path):
            return read_clock(group_at(self._file, "clock")) if has(self._file, "clock") else None

    @property
    def calibration(self) -> dict[str, Any] | None:
        """The rig's calibration record, None if there is none."""
        with hdf5_faults(self.path):
            return read_json(self._file, "calibration") if has(self._file, "calibration") else None

    def _group(self, name: str, truth: bool = False) -> h5py.Group:
        if name not in self.names:
            raise UsageError("no such view", value=name, expected=", ".join(self.names[:8]))
        with hdf5_faults(self.path):
            views = group_at(group_at(self._file, "truth"), "views") if truth else group_at(self._file, "views")
            return group_at(views, name)

    def view(self, name: str, spikes: bool = True) -> View:
        """A view whole, or without its spikes."""
        group = self._group(name)
        with hdf5_faults(self.path):
            shape = (self.camera.height, self.camera.width)
            pixels = read_array(group, "pixels", (*shape, 3))
            frame = dataset_at(group, "pixels")
            marks = [read_attr(frame, key) for key in ROWS["/views/{view}/pixels"].attrs]
            path = read_trajectory(group_at(group, "trajectory")) if has(group, "trajectory") else None
            return View(
                name,
                Frame(pixels, *marks),
                self._spikes(group, None, None) if spikes and has(group, "spikes") else None,
                read_array(group, "sensor_row", shape),
                read_array(group, "valid", shape) != 0,
                Pose(read_array(group, "pose")),
                path,
                read_attr(group, "split"),
            )

    def spikes(self, name: str, t0: int | None = None, t1: int | None = None) -> SpikeStream:
        """Ticks [t0, t1) of a view; only those are read.

        Raises:
            UsageError: no such view, no spikes in it, or ticks it does not have.
        """
        group = self._group(name)
        if not has(group, "spikes"):
            raise UsageError("this view has no spikes", value=name)
        with hdf5_faults(self.path):
            ticks = dataset_at(group, "spikes").shape[0]
        start, stop = 0 if t0 is None else int(t0), ticks if t1 is None else int(t1)
        if not 0 <= start <= stop <= ticks:
            raise UsageError("no such ticks", value=f"[{start}, {stop}) of {name}", expected=f"within [0, {ticks})")
        with hdf5_faults(self.path):
            return self._spikes(group, start, stop)

    def _spikes(self, group: h5py.Group, t0: int | None, t1: int | None) -> SpikeStream:
        found = dataset_at(group, "spikes")
        width, rate_hz, t0_ns, clock = (read_attr(found, key) for key in ROWS["/views/{view}/spikes"].attrs)
        bits = found[t0:t1]
        if width % 8 and bits.size and (bits[:, :, -1] >> (width % 8)).any():
            raise refuse(spot(found), "padding bits are set")
        lost = read_array(group, "lost")
        if lost.size and (np.any(lost[:, 0] >= lost[:, 1]) or lost.min() < 0 or lost.max() > found.shape[0]):
            raise refuse(spot(group, "lost"), "not ranges of ticks that are there")
        if t0:
            t0_ns = int(ns_from_tick(t0, rate_hz, t0_ns)) if rate_hz else t0_ns
        lost = np.clip(lost - (t0 or 0), 0, len(bits))
        return SpikeStream(bits, width, rate_hz, t0_ns, clock, lost[lost[:, 0] < lost[:, 1]])

    def has_spikes(self, name: str) -> bool:
        """Whether a view has spikes."""
        group = self._group(name)
        with hdf5_faults(self.path):
            return has(group, "spikes")

    def ticks(self, name: str) -> int:
        """How many ticks of spikes a view has; 0 without."""
        group = self._group(name)
        with hdf5_faults(self.path):
            return dataset_at(group, "spikes").shape[0] if has(group, "spikes") else 0

    def has_events(self, name: str) -> bool:
        """Whether an event camera saw this view too."""
        group = self._group(name)
        with hdf5_faults(self.path):
            return has(group, "events")

    def events(self, name: str, t0_ns: int | None = None, t1_ns: int | None = None) -> EventStream:
        """Events of a view in [t0_ns, t1_ns), by default all; only those are read.

        Raises:
            UsageError: no such view, no events in it, or a window that ends before it starts.

        Edges:
            A window that leaves the watched span gives the part inside.
        """
        group = self._events_group(name)
        if t0_ns is not None and t1_ns is not None and t1_ns < t0_ns:
            raise UsageError("a window ends no sooner than it starts", value=f"[{t0_ns}, {t1_ns}) ns")
        with hdf5_faults(self.path):
            return read_events(group, t0_ns, t1_ns)

    def check_events(self, name: str) -> None:
        """Read all events of a view in bounded memory; a DataError where they are none."""
        group = self._events_group(name)
        with hdf5_faults(self.path):
            check_events(group)

    def _events_group(self, name: str) -> h5py.Group:
        group = self._group(name)
        if not self.has_events(name):
            raise UsageError("this view has no events", value=name, cause="no event camera, or none simulated")
        with hdf5_faults(self.path):
            return group_at(group, "events")

    def has_true(self, name: str, key: str) -> bool:
        """Whether the truth knows the "light", the instant "at_ns" or the "trajectory" of a view."""
        self._group(name)
        with hdf5_faults(self.path):
            views = group_at(group_at(self._file, "truth"), "views") if self.has_truth else None
            if views is None or not has(views, name):
                return False
            group = group_at(views, name)
            return has(group, key) or key in group.attrs

    def _truth(self, name: str, key: str) -> h5py.Group:
        if not self.has_true(name, key):
            raise UsageError(f"there is no true {key} of this view", value=name, cause="not a simulated view")
        return self._group(name, truth=True)

    def truth_light(self, name: str) -> NDArray[np.float32]:
        """Sharp linear light of a view, float32[H,W,3], at `truth_at_ns`; a UsageError where there is none."""
        group = self._truth(name, "light")
        with hdf5_faults(self.path):
            return read_array(group, "light", (self.camera.height, self.camera.width, 3))

    def truth_at_ns(self, name: str) -> int:
        """The instant of `truth_light` and of the view's pose."""
        group = self._truth(name, "at_ns")
        with hdf5_faults(self.path):
            return read_attr(group, "at_ns")

    def truth_trajectory(self, name: str) -> Trajectory:
        """The exact path over the exposure."""
        group = self._truth(name, "trajectory")
        with hdf5_faults(self.path):
            return read_trajectory(group_at(group, "trajectory"))

    @property
    def truth(self) -> Truth | None:
        """The whole truth in memory, None if there is none."""
        if not self.has_truth:
            return None
        with hdf5_faults(self.path):
            group = group_at(self._file, "truth")
            return Truth(
                {name: self.truth_light(name) for name in self.names if self.has_true(name, "light")},
                {name: self.truth_at_ns(name) for name in self.names if self.has_true(name, "at_ns")},
                {name: self.truth_trajectory(name) for name in self.names if self.has_true(name, "trajectory")},
                read_clock(group_at(group, "clock")),
                read_json(group, "effects"),
                read_attr(group, "seed"),
                self.truth_label,
            )

    def describe(self) -> dict[str, Any]:
        """What a person asks first, JSON-ready: sizes, counts, names, what is there; nothing large is read."""
        ticks: dict[str, int] = {}
        events: dict[str, int] = {}
        with hdf5_faults(self.path):
            for name in self.names:
                group = self._group(name)
                ticks[name] = self.ticks(name)
                if has(group, "events"):
                    events[name] = count_events(group_at(group, "events"))
            points = self.points
            return {
                "format": f"{FORMAT} {read_attr(self._file, 'version')}",
                "writer": read_attr(self._file, "writer"),
                "status": self.status,
                "name": self.name,
                "width": self.camera.width,
                "height": self.camera.height,
                "views": len(self.names),
                "train": list(self.train),
                "test": list(self.test),
                "ticks": ticks,
                "events": events,
                "points": 0 if points is None else len(points.xyz),
                "points_source": None if points is None else points.source,
                "light_gain": self.light_gain,
                "truth": self.truth_label or None,
                "clock": self.clock is not None,
                "calibration": self.calibration is not None,
                "sha256": self.sha256,
                "info": self.info,
            }

    def read(self) -> Scene:
        """The whole scene in memory."""
        views = tuple(self.view(name) for name in self.names)
        events = {name: self.events(name) for name in self.names if self.has_events(name)}
        more = self.light_gain, self.info, self.clock, self.calibration, events
        return Scene(self.name, self.camera, views, self.points, self.truth, *more)
