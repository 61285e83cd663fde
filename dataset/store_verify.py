"""Checking a scene file against the schema and all its checksums. Runs in the child of `hdf5_guard`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from spikerig.dataset.errors import RigError
from spikerig.dataset.hdf5_guard import hdf5_faults, printable, walk
from spikerig.dataset.scene import ERROR, NOTE, WARNING, Finding
from spikerig.dataset.store import (
    DIGEST,
    ROWS,
    Row,
    check_shape,
    check_version,
    dataset_at,
    group_at,
    has,
    read_attr,
    read_clock,
    read_json,
    row_of,
    stored_digest,
)
from spikerig.dataset.store_read import SceneFile
from spikerig.dataset.store_seal import digest

_TICKS = 1 << 24  # bytes of spikes looked at together


def verify_here(path: str) -> list[dict[str, Any]]:
    """Findings of a scene file as records; a DataError if it cannot be read at all.

    Edges:
        A file that breaks the rules of `hdf5_guard` anywhere is unreadable as a whole.
    """
    with hdf5_faults(path), h5py.File(path, "r") as file:
        check_version(file)
        status = read_attr(file, "status")
        found: list[Finding] = []
        if status != "complete":
            fix = "write it again; open_scene(path, partial=True) reads the views that are whole"
            found.append(Finding("status", ERROR, "/", f"status {status}: its writer did not finish", fix))
        for thing in walk(file):
            found += _check(thing, sealed=status == "complete")
        if not any(f.importance == ERROR for f in found):
            found += _check_records(file, path)
        return [asdict(f) for f in found]


def _check(thing: h5py.Group | h5py.Dataset, sealed: bool) -> Iterator[Finding]:
    where = printable(thing.name)
    row = row_of(thing.name)
    if row is None:
        yield Finding("schema", NOTE, where, "not in the schema: not read", "is the file of a newer version?")
    else:
        yield from _check_row(thing, row, where)
    stored = stored_digest(thing)
    if not stored and (sealed or where == "/views"):
        yield Finding("checksum", WARNING, where, "no checksum", "written by another program?")
    elif stored and stored != digest(thing):
        what = "data or attributes" if isinstance(thing, h5py.Dataset) else "attributes or members"
        fix = "get the file again from its source"
        yield Finding("checksum", ERROR, where, f"its {what} are not those that were written", fix)


def _check_row(thing: h5py.Group | h5py.Dataset, row: Row, where: str) -> Iterator[Finding]:
    fix = "get the file again from its source"
    for name in row.attrs:
        try:
            read_attr(thing, name)
        except RigError as error:
            yield Finding("schema", ERROR, where, error.cause or error.what, fix)
    for name in sorted(set(thing.attrs) - set(row.attrs) - {DIGEST}):
        yield Finding("schema", NOTE, where, f"the attribute {name!r} is not in the schema: not read")
    if (row.dtype == "group") != isinstance(thing, h5py.Group):
        yield Finding("schema", ERROR, where, f"not the {row.dtype} that belongs there", fix)
    elif isinstance(thing, h5py.Group):
        prefix = row.path.rstrip("/") + "/"
        members = [r for p, r in ROWS.items() if p.startswith(prefix) and "/" not in p[len(prefix) :] and p != "/"]
        for below in members:
            if below.required and not has(thing, below.path[len(prefix) :]):
                yield Finding("schema", ERROR, where, f"{below.path[len(prefix) :]} is missing", fix)
    else:
        try:
            check_shape(thing)
        except RigError as error:
            yield Finding("schema", ERROR, where, error.cause or error.what, fix)
        else:
            if thing.dtype.kind == "f" and not np.isfinite(thing[()]).all():
                yield Finding("finite", ERROR, where, "values that are not finite")


def _check_records(file: h5py.File, path: str) -> Iterator[Finding]:
    """Read everything as the records it stands for; what they refuse is a finding."""
    try:
        scene = SceneFile(file, Path(path), partial=True)
    except RigError as error:
        yield _told("/", error)
        return
    for read in (lambda: scene.points, lambda: scene.clock, lambda: scene.calibration):
        yield from _try("/", read)
    for name in scene.names:
        where = f"/views/{name}"
        yield from _try(where, lambda name=name: scene.view(name, spikes=False))
        group = group_at(group_at(file, "views"), name)
        if has(group, "spikes") != has(group, "lost"):
            yield Finding("schema", ERROR, where, "spikes without lost, or lost without spikes")
        elif has(group, "spikes"):
            spikes = dataset_at(group, "spikes")
            yield from _try(where, lambda name=name, spikes=spikes: _read_spikes(scene, name, spikes))
        if has(group, "events"):
            yield from _try(f"{where}/events", lambda name=name: scene.check_events(name))
    if scene.has_truth:
        truth = group_at(file, "truth")
        yield from _try("/truth", lambda: (read_clock(group_at(truth, "clock")), read_json(truth, "effects")))
    for name in scene.names if scene.has_truth else ():
        for key, read in (("light", scene.truth_light), ("trajectory", scene.truth_trajectory)):
            if scene.has_true(name, key):
                yield from _try(f"/truth/views/{name}", lambda name=name, read=read: read(name))


def _read_spikes(scene: SceneFile, name: str, spikes: h5py.Dataset) -> None:
    ticks, step = spikes.shape[0], max(1, _TICKS // max(1, spikes.nbytes // max(1, spikes.shape[0])))
    for k in range(0, max(ticks, 1), step):
        scene.spikes(name, k, min(k + step, ticks))


def _try(where: str, read: Any) -> Iterator[Finding]:
    try:
        read()
    except RigError as error:
        yield _told(where, error)


def _told(where: str, error: RigError) -> Finding:
    return Finding("record", ERROR, where, f"{error.what} {error.cause}".strip())
