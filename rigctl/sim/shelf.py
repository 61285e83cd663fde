"""Finished views on disk, until the scene that gathers them is sealed: a killed run goes on where it was.

A view is one NPZ file: its arrays, and a JSON tree of the records they belong to. Nothing in it is ever executed:
no pickle, and only the records named here are made.
"""

from __future__ import annotations

import fcntl
import hashlib
import io
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from spikerig.dataset.errors import DataError, HostError, RigError, UsageError
from spikerig.dataset.events import EventStream
from spikerig.dataset.scene import Frame, Points, Pose, Trajectory, View
from spikerig.dataset.spikes import SpikeStream
from spikerig.dataset.terminal import jsonable
from spikerig.rigctl.sim.take import Taken

RECORDS = {
    record.__name__: record for record in (Taken, View, Frame, SpikeStream, EventStream, Pose, Trajectory, Points)
}
SOURCES = ("spikerig.rigctl.sim", "spikerig.dataset")


def dumps(taken: Taken) -> bytes:
    """A finished view as the bytes of an NPZ file."""
    arrays: dict[str, np.ndarray] = {}
    tree = json.dumps(_flat(taken, arrays), allow_nan=False).encode()
    file = io.BytesIO()
    np.savez(file, tree=np.frombuffer(tree, np.uint8), **arrays)  # type: ignore[arg-type]
    return file.getvalue()


def loads(data: bytes, source: str) -> Taken:
    """The view of `dumps`, equal to what went in.

    Args:
        data: of the file.
        source: its name, for messages.

    Raises:
        DataError: truncated, damaged, or not such a file.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as found:
            arrays = {name: found[name] for name in found.files}
        taken = _deep(json.loads(arrays.pop("tree").tobytes()), arrays)
    except (OSError, EOFError, ValueError, KeyError, TypeError, BadZipFile, RecursionError, RigError) as error:
        raise DataError("a finished view is damaged", value=f"{source}: {type(error).__name__}") from None
    if not isinstance(taken, Taken):
        raise DataError("a finished view is damaged", value=f"{source}: it holds something else")
    return taken


def _flat(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    if is_dataclass(value) and type(value).__name__ in RECORDS:
        return {"record": type(value).__name__} | {f.name: _flat(getattr(value, f.name), arrays) for f in fields(value)}
    if isinstance(value, np.ndarray):
        name = f"a{len(arrays)}"
        arrays[name] = value
        return {"array": name}
    if isinstance(value, bool | str) or value is None:
        return value
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return {"float": float(value).hex()}
    raise TypeError(f"a view holds a {type(value).__name__}: give it a place in shelf.RECORDS")


def _deep(tree: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        return arrays[tree["array"]]
    if "float" in tree:
        return float.fromhex(tree["float"])
    return RECORDS[tree["record"]](**{k: _deep(v, arrays) for k, v in tree.items() if k != "record"})


@cache
def fingerprint() -> dict[str, str]:
    """What the bits of a simulated view depend on beside its settings: our code, NumPy, and what the CPU offers it.

    NumPy's own sines and powers differ in the last bit between instruction sets, so bytes are promised where all of
    this is the same.
    """
    from spikerig import _native

    total = hashlib.sha256()
    for package in SOURCES:
        for path in sorted(Path(str(files(package))).rglob("*.py")):
            total.update(f"{path.name}\0".encode() + path.read_bytes())
    simd = np.show_config(mode="dicts")["SIMD Extensions"]  # type: ignore[index]
    return {
        "spikerig": version("spikerig"),
        "code": total.hexdigest()[:16],
        "numpy": np.__version__,
        "cpu": " ".join([*simd["baseline"], *simd.get("found", ())]),
        "kernels": _native.isa(),
    }


def differences(there: Mapping[str, Any], here: Mapping[str, Any], prefix: str = "") -> list[str]:
    """What differs between two records of settings, in words: `views: 30 there, 12 here`."""
    told = []
    for key in dict.fromkeys([*there, *here]):
        a, b = there.get(key), here.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            told += differences(a, b, f"{prefix}{key}.")
        elif a != b:
            told.append(f"{prefix}{key}: {json.dumps(jsonable(a))} there, {json.dumps(jsonable(b))} here")
    return told


def write_whole(path: Path, data: bytes) -> None:
    """A file that is there with all its bytes or not at all, also after a kill."""
    part = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        part.write_bytes(data)
        os.replace(part, path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise HostError("a file cannot be written", value=f"{path}: {error.strerror or error}") from error


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Make a folder and hold it for this process; a kill lets go of it. At the end it goes if it is empty.

    Raises:
        UsageError: another process holds it.
        HostError: it cannot be made.
    """
    lock = folder / ".lock"
    try:
        folder.mkdir(exist_ok=True)
        file = lock.open("w")
    except OSError as error:
        raise HostError("the folder cannot be made", value=f"{folder}: {error.strerror}") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise UsageError("another run is at work here", value=folder, next="wait for it, or end it") from None
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)
            if not any(folder.iterdir()):
                folder.rmdir()


class Shelf:
    """A folder of finished views of one scene; one process at a time uses it (see `alone`).

    Args:
        folder: it is made if need be; a file `made.json` in it says of what the views are.
        made: settings and fingerprint: views made with others are not mixed in.
        force: throw away views made with others.

    Raises:
        UsageError: there are views made with other settings.
        HostError: the folder cannot be made.
    """

    def __init__(self, folder: Path, made: Mapping[str, Any], force: bool = False) -> None:
        self.folder = folder
        key = folder / "made.json"
        text = json.dumps(jsonable(dict(made)), indent=1, sort_keys=True)
        try:
            if key.exists() and key.read_text(encoding="utf-8") != text:
                if not force:
                    raise UsageError(
                        "unfinished views of another run lie in the way",
                        value="\n            ".join([str(folder), *_differing(key, text)]),
                        next="give --force to throw them away, or the settings they were made with",
                    )
                self.clear()
            folder.mkdir(exist_ok=True)
            for part in folder.glob(".*.npz.*"):
                part.unlink()  # what a kill left half written
        except OSError as error:
            raise HostError("the folder cannot be made", value=f"{folder}: {error.strerror}") from error
        if not key.exists():
            write_whole(key, text.encode())

    def path(self, number: int) -> Path:
        """Where a view is, or will be."""
        return self.folder / f"{number:06d}.npz"

    def missing(self, count: int) -> list[int]:
        """Numbers below `count` of views that are not finished."""
        return [number for number in range(count) if not self.path(number).exists()]

    def get(self, number: int) -> Taken:
        """A finished view; DataError where it is damaged."""
        path = self.path(number)
        return loads(path.read_bytes(), str(path))

    def clear(self) -> None:
        """Remove the views, and the folder if nothing else is in it."""
        for path in [*self.folder.glob("*.npz"), self.folder / "made.json"]:
            path.unlink(missing_ok=True)
        if self.folder.is_dir() and not any(self.folder.iterdir()):
            self.folder.rmdir()


def _differing(key: Path, text: str) -> list[str]:
    try:
        return differences(json.loads(key.read_text(encoding="utf-8")), json.loads(text))
    except (OSError, ValueError):
        return ["its made.json is damaged"]
