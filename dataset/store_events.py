"""The events of a view in a scene file: its group's writing, windowed reading and checking."""

from __future__ import annotations

from bisect import bisect_left

import h5py
import numpy as np

from spikerig.dataset.errors import UsageError
from spikerig.dataset.events import EventStream
from spikerig.dataset.hdf5_guard import MAX_CHUNK, MAX_INFLATION, refuse, spot
from spikerig.dataset.store import ROWS, dataset_at, read_attr, row_of
from spikerig.dataset.store_seal import put_attr

COLUMNS = ("t_ns", "x", "y", "polarity")
CHUNK = 1 << 16  # events: half a megabyte of times
BLOCK = 1 << 22  # events checked together


def put_events(view: h5py.Group, events: EventStream) -> None:
    """Store the events of a view, in chunks, shuffled and deflated: some 5 bytes an event instead of 13."""
    group = view.create_group("events")
    for key in ROWS["/views/{view}/events"].attrs:
        put_attr(group, key, getattr(events, key))
    for name in COLUMNS:
        _put_column(group, name, getattr(events, name))


def _put_column(group: h5py.Group, name: str, values: np.ndarray) -> None:
    row = row_of(f"{group.name}/{name}")
    if row is None:
        raise UsageError("not in the schema", value=f"{group.name}/{name}")
    array = np.ascontiguousarray(values, np.dtype("<" + row.dtype))
    packing = {"chunks": (min(CHUNK, len(array)),), "compression": "gzip", "compression_opts": 1, "shuffle": True}
    made = group.create_dataset(name, data=array, **(packing if len(array) else {}))
    if array.nbytes > max(MAX_CHUNK, made.id.get_storage_size() * MAX_INFLATION):
        del group[name]  # packed so well that a reader must take it for a bomb
        group.create_dataset(name, data=array)


def count_events(group: h5py.Group) -> int:
    """How many events a view's group of them holds."""
    sizes = {dataset_at(group, name).shape[0] for name in COLUMNS}
    if len(sizes) > 1:
        raise refuse(spot(group), f"columns of different lengths: {sorted(sizes)}")
    return sizes.pop()


def read_events(group: h5py.Group, t0_ns: int | None = None, t1_ns: int | None = None) -> EventStream:
    """Events in [t0_ns, t1_ns), by default all; only those are read, and some 20 times to find them."""
    total = count_events(group)
    times, start, end = dataset_at(group, "t_ns"), read_attr(group, "t0_ns"), read_attr(group, "t1_ns")
    first, stop = 0, total
    if t0_ns is not None:
        first, start = bisect_left(times, t0_ns), min(max(t0_ns, start), end)
    if t1_ns is not None:
        stop, end = bisect_left(times, t1_ns, first), max(min(t1_ns, end), start)
    return _read(group, first, stop, start, end)


def _read(group: h5py.Group, first: int, stop: int, t0_ns: int, t1_ns: int) -> EventStream:
    t, x, y, polarity = (dataset_at(group, name)[first:stop] for name in COLUMNS)
    height, width, clock = (read_attr(group, key) for key in ("height", "width", "clock"))
    return EventStream(t, x, y, polarity, height, width, t0_ns, t1_ns, clock)


def check_events(group: h5py.Group) -> None:
    """Read all events, block by block in bounded memory; each block begins with the last event of the one before.

    Raises:
        DataError: they are no events.
    """
    total = count_events(group)
    span = read_attr(group, "t0_ns"), read_attr(group, "t1_ns")
    for k in range(0, max(total, 1), BLOCK):
        _read(group, max(k - 1, 0), min(k + BLOCK, total), *span)
