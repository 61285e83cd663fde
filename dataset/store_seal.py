"""Checksums of a scene file: every object carries its own, a group's covers its members'."""

from __future__ import annotations

import hashlib
from typing import Any

import h5py
import numpy as np

from spikerig.dataset.errors import UsageError
from spikerig.dataset.hdf5_guard import MAX_TEXT, linked, names
from spikerig.dataset.store import DIGEST, row_of, stored_digest

_BLOCK = 1 << 24


def digest(thing: h5py.Group | h5py.Dataset) -> str:
    """SHA-256 (hex) of an object: its attributes by name, then a dataset's type, shape and bytes or a group's members.

    Edges:
        The attribute `sha256` itself is left out; a group's members enter by name and by their stored digests.
    """
    total = hashlib.sha256()
    for name in sorted(set(thing.attrs) - {DIGEST}):
        value: Any = thing.attrs[name]
        plain = value.decode() if isinstance(value, bytes) else value.hex() if hasattr(value, "hex") else int(value)
        total.update(f"@{name}={plain}\0".encode())
    if isinstance(thing, h5py.Group):
        for name in sorted(thing):
            total.update(f"{name}:{stored_digest(linked(thing, name))}\0".encode())
        return total.hexdigest()
    total.update(f"{thing.dtype.str}{thing.shape}\0".encode())
    rows = max(1, _BLOCK // max(1, thing.nbytes // max(1, thing.shape[0])))
    for k in range(0, thing.shape[0] if thing.size else 0, rows):
        total.update(np.ascontiguousarray(thing[k : k + rows]).data)
    return total.hexdigest()


def seal(thing: h5py.Group | h5py.Dataset) -> None:
    """Give an object, and everything below it that has none, its digest; members first."""
    if isinstance(thing, h5py.Group):
        for name in names(thing):
            below = linked(thing, name)
            if not stored_digest(below):
                seal(below)
    put_attr(thing, DIGEST, digest(thing))


def put_attr(thing: h5py.Group | h5py.Dataset, name: str, value: str | float | None) -> None:
    """Store an attribute by its kind in the schema; None leaves it out."""
    row = row_of(thing.name)
    kind = "text" if name == DIGEST else row.attrs[name].dtype if row else "text"
    if value is None:
        return
    if kind == "text":
        raw = str(value).encode()
        if len(raw) > MAX_TEXT or b"\0" in raw:
            raise UsageError("a text too long, or with a NUL, for an attribute", value=f"{thing.name}@{name}")
        stored: Any = np.array(raw, h5py.string_dtype("utf-8", max(len(raw), 1)))
    else:
        try:
            stored = np.int64(value) if kind == "int" else np.float64(value)
        except OverflowError as error:
            raise UsageError("a number beyond 64 bits", value=f"{thing.name}@{name} = {value}") from error
    thing.attrs[name] = stored
