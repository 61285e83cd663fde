"""What checks look at: a scene's own facts, and one view at a time, read when first asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import NS, ClockModel
from spikerig.dataset.scene import Camera, Frame, Points, View
from spikerig.dataset.stream import SpikeStream

if TYPE_CHECKING:
    from spikerig.dataset.store_read import SceneFile

T = TypeVar("T")
BLOCK_BYTES = 8 << 20


class Undecided(Exception):
    """A check cannot say; the message is why."""


@dataclass(frozen=True, slots=True)
class Survey:
    """All spikes of a view, summed up in bounded memory.

    Args:
        ticks, height, width, rate_hz, t0_ns, clock: of the stream.
        lost: int64[N,2] half-open ranges.
        counts: uint32[H,W] spikes a pixel; lost ticks count none.
        per_tick: int64[T] spikes a tick.
    """

    ticks: int
    height: int
    width: int
    rate_hz: float | None
    t0_ns: int
    clock: str
    lost: NDArray[np.int64]
    counts: NDArray[np.uint32]
    per_tick: NDArray[np.int64]

    @property
    def kept(self) -> int:
        """Ticks that were not lost."""
        gone = np.zeros(self.ticks + 1, bool)
        for a, b in self.lost:
            gone[a:b] = True
        return self.ticks - int(gone[: self.ticks].sum())


class _Kept:
    """Remembers what was made once."""

    def __init__(self) -> None:
        self._made: dict[str, Any] = {}

    def once(self, key: str, make: Callable[[], T]) -> T:
        """What `make` gives, made when first asked for under this key."""
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]


class SceneLook(_Kept):
    """A scene's own facts, without its views.

    Attributes:
        names, train, test, camera, light_gain, info, truth_label, writer: of the scene.
    """

    def __init__(self, file: SceneFile) -> None:
        super().__init__()
        self.file = file
        self.names, self.train, self.test = file.names, file.train, file.test
        self.camera: Camera = file.camera
        self.light_gain: float | None = file.light_gain
        self.info: dict[str, Any] = file.info
        self.truth_label: str = file.truth_label

    @cached_property
    def points(self) -> Points | None:
        """The sparse points."""
        return self.file.points

    @cached_property
    def clock(self) -> ClockModel | None:
        """The take's clock model."""
        return self.file.clock

    @cached_property
    def calibration(self) -> dict[str, Any] | None:
        """The rig's calibration record, as JSON."""
        return self.file.calibration


class ViewLook(_Kept):
    """One view; what was read is kept as long as this is."""

    def __init__(self, scene: SceneLook, name: str) -> None:
        super().__init__()
        self.scene, self.name = scene, name

    @cached_property
    def view(self) -> View:
        """The view without its spikes."""
        return self.scene.file.view(self.name, spikes=False)

    @property
    def frame(self) -> Frame:
        """Its picture."""
        return self.view.frame

    @cached_property
    def survey(self) -> Survey:
        """Its spikes, summed up; Undecided where it has none."""
        if not self.scene.file.has_spikes(self.name):
            raise Undecided("no spikes")
        return survey(self.scene.file, self.name)

    @cached_property
    def exposure_ticks(self) -> tuple[float, float]:
        """First and last instant, in ticks, at which any valid pixel of the picture was exposed."""
        frame, rows = self.frame, self.view.sensor_row[self.view.valid]
        if not rows.size:
            raise Undecided("no valid pixel")
        late = [frame.row_ns * float(rows.min()), frame.row_ns * float(rows.max())]
        first, last = (frame.start_ns + round(ns) for ns in (min(late), max(late) + frame.exposure_ns))
        return self.tick_at(first), self.tick_at(last)

    def tick_at(self, frame_ns: int) -> float:
        """The tick at a time on the frame's clock, by the scene's clock model where the two clocks differ."""
        s = self.survey
        if s.rate_hz is None:
            raise Undecided("the spikes have no rate")
        if s.clock != self.frame.clock:
            if self.scene.clock is None:
                raise Undecided("spikes and picture are on different clocks, and there is no clock model")
            frame_ns = int(self.scene.clock.device_from_rig(np.int64(frame_ns)))
        return (frame_ns - s.t0_ns) * s.rate_hz / NS

    def spikes(self, first: int, stop: int) -> SpikeStream:
        """Ticks [first, stop), cut to those that are there."""
        a = min(max(first, 0), self.survey.ticks)
        return self.scene.file.spikes(self.name, a, min(max(stop, a), self.survey.ticks))


def survey(file: SceneFile, name: str) -> Survey:
    """Sum a view's spikes up, block by block.

    Cost:
        Reads the spikes once, 8 MB at a time.
    """
    from spikerig.dataset.texture import window_sum

    head = file.spikes(name, 0, 0)
    ticks = file.ticks(name)
    step = max(1, BLOCK_BYTES // max(head.height * ((head.width + 7) // 8), 1))
    counts, per_tick = np.zeros((head.height, head.width), np.uint32), np.zeros(ticks, np.int64)
    lost: list[NDArray[np.int64]] = []
    for first in range(0, ticks, step):
        part = file.spikes(name, first, min(first + step, ticks))
        counts += window_sum(part, 0, part.ticks)
        per_tick[first : first + part.ticks] = np.bitwise_count(part.bits).sum((1, 2), dtype=np.int64)
        lost.append(part.lost + first)
    gone = np.concatenate([*lost, np.zeros((0, 2), np.int64)])
    return Survey(ticks, head.height, head.width, head.rate_hz, head.t0_ns, head.clock, gone, counts, per_tick)
