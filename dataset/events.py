"""Events in memory: when which pixel saw its light grow or fall by a threshold."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikerig.dataset.clocktime import frozen_array
from spikerig.dataset.errors import DataError, UsageError

MAX_SIDE = 1 << 16  # columns and rows are uint16


@dataclass(frozen=True, slots=True)
class EventStream:
    """Events of a time span, in the order of their times.

    Args:
        t_ns: int64[N], not decreasing, within [t0_ns, t1_ns).
        x, y: uint16[N], column and row, row 0 on top.
        polarity: int8[N], +1 for brighter, -1 for darker.
        height, width: of the sensor, pixels, at most 65536.
        t0_ns, t1_ns: the half-open span that was watched: no event inside says "no change", outside it says nothing.
        clock: name of the clock of all times.

    Raises:
        DataError: numbers that do not fit each other or the above.
    """

    t_ns: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    polarity: NDArray[np.int8]
    height: int
    width: int
    t0_ns: int
    t1_ns: int
    clock: str = "rig"

    def __post_init__(self) -> None:
        if not (1 <= self.height <= MAX_SIDE and 1 <= self.width <= MAX_SIDE):
            raise DataError("an event sensor has 1 to 65536 pixels a side", value=(self.height, self.width))
        for name, dtype in (("t_ns", np.int64), ("x", np.uint16), ("y", np.uint16), ("polarity", np.int8)):
            object.__setattr__(self, name, _column(getattr(self, name), name, dtype))
        sizes = [len(self.t_ns), len(self.x), len(self.y), len(self.polarity)]
        if len(set(sizes)) > 1:
            raise DataError("an event has a time, a column, a row and a polarity", value=sizes, expected="equally many")
        if self.t1_ns < self.t0_ns:
            raise DataError("a span ends no sooner than it starts", value=f"[{self.t0_ns}, {self.t1_ns}) ns")
        if len(self.t_ns):
            self._check_events()

    def _check_events(self) -> None:
        if np.any(self.t_ns[1:] < self.t_ns[:-1]):
            late = int(np.flatnonzero(self.t_ns[1:] < self.t_ns[:-1])[0]) + 1
            raise DataError(
                "events must be in the order of their times", value=f"event {late} is before event {late - 1}"
            )
        if self.t_ns[0] < self.t0_ns or self.t_ns[-1] >= self.t1_ns:
            raise DataError(
                "events outside the span that was watched",
                value=f"{self.t_ns[0]} to {self.t_ns[-1]} ns",
                expected=f"within [{self.t0_ns}, {self.t1_ns})",
            )
        if self.x.max() >= self.width or self.y.max() >= self.height:
            raise DataError(
                "events outside the picture",
                value=f"column {self.x.max()}, row {self.y.max()}",
                expected=f"within {self.width} x {self.height}",
                cause="columns and rows swapped, or the size of another sensor",
            )
        if np.any(np.abs(self.polarity) != 1):
            raise DataError("a polarity is +1 or -1", value=np.unique(self.polarity)[:8], cause="polarities of 0 and 1")

    def __len__(self) -> int:
        """N, how many."""
        return len(self.t_ns)

    def index_range(self, t0_ns: int, t1_ns: int) -> tuple[int, int]:
        """The half-open range of events in [t0_ns, t1_ns).

        Raises:
            UsageError: it ends before it starts.
        """
        if t1_ns < t0_ns:
            raise UsageError("a window ends no sooner than it starts", value=f"[{t0_ns}, {t1_ns}) ns")
        first, stop = np.searchsorted(self.t_ns, np.array([t0_ns, t1_ns], np.int64))
        return int(first), int(stop)

    def slice(self, t0_ns: int, t1_ns: int) -> EventStream:
        """Events in [t0_ns, t1_ns) as a stream of their own; shares memory; its span is the watched part of it."""
        first, stop = self.index_range(t0_ns, t1_ns)
        start = min(max(t0_ns, self.t0_ns), self.t1_ns)
        end = max(min(t1_ns, self.t1_ns), start)
        k = slice(first, stop)
        columns = self.t_ns[k], self.x[k], self.y[k], self.polarity[k]
        return EventStream(*columns, self.height, self.width, start, end, self.clock)

    def accumulate(self, t0_ns: int | None = None, t1_ns: int | None = None) -> NDArray[np.int32]:
        """Events up less events down a pixel in [t0_ns, t1_ns), by default all.

        Returns:
            int32[H,W].

        Edges:
            Time outside the watched span counts nothing.
        """
        start, end = self.t0_ns if t0_ns is None else t0_ns, self.t1_ns if t1_ns is None else t1_ns
        return self._sum(*self.index_range(start, end))

    def bins(self, edges_ns: ArrayLike) -> NDArray[np.int32]:
        """Events up less events down a pixel in each of B windows that follow each other.

        Args:
            edges_ns: B + 1 times that do not decrease; window b is [edges[b], edges[b + 1]).

        Returns:
            int32[B,H,W], the layout of E2NeRF's `events.pt`.

        Raises:
            UsageError: fewer than two edges, or edges that decrease or are not whole nanoseconds.

        Source:
            E2NeRF (ICCV 2023), event bins between the sub-poses of a view.
        """
        edges = np.asarray(edges_ns)
        if (
            edges.ndim != 1
            or len(edges) < 2
            or edges.dtype.kind not in "iu"
            or np.any(np.diff(edges.astype(np.int64)) < 0)
        ):
            raise UsageError("edges are two or more whole nanoseconds that do not decrease", value=edges)
        at = np.searchsorted(self.t_ns, edges.astype(np.int64)).tolist()
        return np.stack([self._sum(first, stop) for first, stop in pairwise(at)])

    def _sum(self, first: int, stop: int) -> NDArray[np.int32]:
        size = self.height * self.width
        pixel = self.y[first:stop].astype(np.int64) * self.width + self.x[first:stop]
        up = self.polarity[first:stop] > 0
        total = np.bincount(pixel[up], minlength=size) - np.bincount(pixel[~up], minlength=size)
        return total.astype(np.int32).reshape(self.height, self.width)


def _column(values: ArrayLike, name: str, dtype: type) -> NDArray:
    found = np.asarray(values)
    bounds = np.iinfo(dtype)
    if found.ndim != 1 or (found.dtype.kind not in "iu" and found.size):
        raise DataError(f"{name} of events is one row of whole numbers", value=f"{found.dtype}{found.shape}")
    if found.size and (int(found.min()) < bounds.min or int(found.max()) > bounds.max):
        raise DataError(
            f"{name} of events is out of range", value=f"{found.min()} to {found.max()}", expected=str(bounds)
        )
    return frozen_array(found, dtype)


def no_events(height: int, width: int, t0_ns: int, t1_ns: int, clock: str = "rig") -> EventStream:
    """A span in which nothing changed."""
    columns = np.zeros(0, np.int64), np.zeros(0, np.uint16), np.zeros(0, np.uint16), np.zeros(0, np.int8)
    return EventStream(*columns, height, width, t0_ns, t1_ns, clock)
