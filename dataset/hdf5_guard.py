"""HDF5 files from others are hostile: what is allowed in them, and the child process that finds out first.

Allowed: hard links to groups and datasets; integers, floats and fixed-length text; contiguous, compact or fully
written chunked storage inside the file; the filters deflate, shuffle and fletcher32. Refused: soft, external and
user-defined links, external storage, virtual datasets, other filters, variable-length and reference types, named
types, and any size the file's own bytes cannot back.

The HDF5 library can crash, hang or eat memory on a damaged file. So the first time a file is seen, a child process
with limits on time and memory walks it whole; this process opens it only when the child came back in good health.
Good health is remembered by (device, inode, size, times) in the user's cache folder: later opens cost nothing.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import signal
import stat
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
from h5py import h5a, h5d, h5g, h5l, h5o, h5s, h5t  # pyright: ignore[reportAttributeAccessIssue]

from spikerig.dataset.errors import DataError, HostError, RigError, UsageError

RULES = 1  # raise it when the rules change: files judged by older rules are judged again
FILTERS = {1: "deflate", 2: "shuffle", 3: "fletcher32"}
MAX_OBJECTS, MAX_DEPTH, MAX_ATTRIBUTES, MAX_TEXT = 500_000, 12, 64, 1 << 16
MAX_CHUNK = 1 << 26
MAX_INFLATION = 32  # of a filtered dataset over 64 MiB; below that, constant images may do better
PATIENCE_S = 15
_MEMORY = 2 << 30
_KEPT = 4096
_healthy: set[str] = set()
_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def refuse(path: object, cause: str) -> DataError:
    """The one error for a file, or a part of it, that breaks the rules."""
    return DataError(
        "this HDF5 file is damaged, or not one that this tool reads",
        value=path,
        cause=cause,
        next="get it again from its source; `spikerig data verify FILE` lists what is wrong",
    )


def printable(text: object) -> str:
    """A text from a file, safe to show: what could steer a terminal is escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "backslashreplace").decode() for c in str(text))


def spot(thing: h5py.Group | h5py.Dataset, name: str = "") -> str:
    """Where something is: the file, and the object (or a member of it) inside."""
    inside = f"{str(thing.name).rstrip('/')}/{name}" if name else thing.name
    return f"{thing.file.filename}: {printable(inside)}"


@contextmanager
def hdf5_faults(path: object) -> Iterator[None]:
    """Turn whatever reading a damaged file raises into one DataError that names the file."""
    try:
        yield
    except RigError as error:
        if isinstance(error, DataError) and str(path) in str(error.value):
            raise
        value = path if error.value is None else f"{path}: {error.value}"
        raise DataError(error.what, value=value, expected=error.expected, cause=error.cause, next=error.next) from error
    except MemoryError as error:
        raise refuse(path, "it asks for more memory than there is") from error
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, OverflowError) as error:
        raise refuse(path, f"HDF5: {str(error).strip() or type(error).__name__}"[:300]) from error


def check_plain(path: str | Path) -> os.stat_result:
    """Look at the file without the library: it exists, is a regular file and begins as HDF5 does.

    Raises:
        UsageError: there is no such file.
        DataError: it is a folder, a device, empty, or not HDF5.
        HostError: it may not be read.
    """
    try:
        found = os.stat(path)
        if not stat.S_ISREG(found.st_mode):
            raise DataError("not a file", value=path, expected="an HDF5 file")
        with open(path, "rb") as file:
            start = file.read(8)
    except FileNotFoundError as error:
        raise UsageError("there is no such file", value=path) from error
    except OSError as error:
        raise HostError("the file cannot be read", value=f"{path}: {error.strerror}") from error
    except ValueError as error:  # a NUL byte in the path
        raise UsageError("not a file name", value=repr(path)) from error
    if start != _SIGNATURE:
        what = "it is empty" if not found.st_size else "it does not begin as HDF5 does"
        raise DataError("not an HDF5 file", value=path, cause=what)
    return found


def open_file(path: str | Path) -> h5py.File:
    """Open a file for reading, after a child process has walked it whole and found it healthy.

    Raises:
        DataError: it breaks the rules, or it crashed, hung or starved the child.
        UsageError, HostError: as `check_plain`.

    Cost:
        Some 0.3 s the first time a file is seen (more for filtered data), then well under a millisecond.
    """
    key = _key(check_plain(path))
    if key not in _healthy and not (_cache() / key).exists():
        ask_child("probe", path)
    with hdf5_faults(path):
        file = h5py.File(os.fspath(path), "r")
    remember(path)
    return file


def remember(path: str | Path) -> None:
    """Note that this very file (device, inode, size, times) is healthy: walked by a child, or written by us."""
    key = _key(os.stat(path))
    if key in _healthy:
        return
    _healthy.add(key)
    folder = _cache()
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        (folder / key).touch(mode=0o600)
        known = sorted(folder.iterdir(), key=lambda p: p.stat().st_mtime)
        for old in known[: -_KEPT // 2] if len(known) > _KEPT else []:
            old.unlink(missing_ok=True)
    except OSError:
        return  # no cache folder: the next process probes again


def _cache() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "spikerig" / "probed"


def _key(s: os.stat_result) -> str:
    facts = (RULES, h5py.version.hdf5_version, s.st_dev, s.st_ino, s.st_size, s.st_mtime_ns, s.st_ctime_ns)
    return hashlib.sha256(repr(facts).encode()).hexdigest()[:32]


def linked(group: h5py.Group, name: str) -> h5py.Group | h5py.Dataset:
    """A member of a group by its plain name, a group or a dataset behind a hard link."""
    raw = name.encode()
    if not group.id.links.exists(raw):
        raise refuse(spot(group, name), "it is missing")
    if group.id.links.get_info(raw).type != h5l.TYPE_HARD:
        raise refuse(spot(group, name), "a soft, external or user-defined link: only hard links are followed")
    found = h5o.open(group.id, raw)
    if isinstance(found, h5g.GroupID):
        return h5py.Group(found)
    if not isinstance(found, h5d.DatasetID):
        raise refuse(spot(group, name), "neither a group nor a dataset")
    return h5py.Dataset(found)


def member(group: h5py.Group, name: str) -> h5py.Group | h5py.Dataset:
    """As `linked`, and a dataset passes `check_dataset`."""
    found = linked(group, name)
    if isinstance(found, h5py.Dataset):
        check_dataset(found)
    return found


def names(group: h5py.Group) -> list[str]:
    """Names of a group's members: UTF-8, and plain (HDF5 would walk a name with a slash as a path)."""
    found = [str(name) for name in group]
    for name in found:
        if "/" in name or name in ("", ".", "..") or any("\udc80" <= letter <= "\udcff" for letter in name):
            raise refuse(spot(group), f"a member's name is not a plain one: {printable(name)!r}")
    return found


def check_dataset(dataset: h5py.Dataset) -> None:
    """Refuse a dataset whose type, storage, filters or size are not allowed; nothing of its data is read.

    Cost: some 30 us, and 1 us a chunk.
    """
    plan, kind = dataset.id.get_create_plist(), dataset.id.get_type()
    if not isinstance(kind, h5t.TypeIntegerID | h5t.TypeFloatID):
        raise refuse(spot(dataset), f"type {type(kind).__name__}: only integers and floats are read")
    space = dataset.id.get_space()
    if space.get_simple_extent_type() != h5s.SIMPLE:
        raise refuse(spot(dataset), "a scalar or null dataspace")
    shape = dataset.id.shape
    size = math.prod(shape) * kind.get_size()
    layout = plan.get_layout()
    if layout == h5d.VIRTUAL or plan.get_external_count():
        raise refuse(spot(dataset), "its data lie in other files")
    codes = [plan.get_filter(i)[0] for i in range(plan.get_nfilters())]
    if any(code not in FILTERS for code in codes):
        raise refuse(spot(dataset), f"filter {codes}: allowed are {sorted(FILTERS.values())}")
    end = os.fstat(dataset.file.id.get_vfd_handle()).st_size
    if layout == h5d.CHUNKED:
        _check_chunks(dataset, size, bool(codes), end)
    elif dataset.id.get_storage_size() != size or (size and layout == h5d.CONTIGUOUS and _outside(dataset, end)):
        raise refuse(spot(dataset), f"claims {size} bytes of shape {shape} that the file does not hold")


def _outside(dataset: h5py.Dataset, end: int) -> bool:
    offset = dataset.id.get_offset()
    return offset is None or offset + dataset.id.get_storage_size() > end


def _check_chunks(dataset: h5py.Dataset, size: int, filtered: bool, end: int) -> None:
    chunk, shape = dataset.chunks or (1,), dataset.id.shape
    step = math.prod(chunk) * dataset.id.get_type().get_size()
    need = math.prod(-(-n // c) for n, c in zip(shape, chunk, strict=True))
    held = dataset.id.get_storage_size()
    if step > MAX_CHUNK or need > end or (filtered and size > max(MAX_CHUNK, held * MAX_INFLATION)):
        raise refuse(
            spot(dataset), f"claims {size} bytes of shape {shape} in chunks of {chunk} from {held} bytes stored"
        )
    if dataset.id.get_num_chunks() != need:
        raise refuse(spot(dataset), f"{dataset.id.get_num_chunks()} of {need} chunks are there")
    seen: list[str] = []

    def look(info: Any) -> None:
        bad = info.byte_offset is None or info.byte_offset + info.size > end
        if bad or info.size > 2 * step + 4096 or (not filtered and info.size != step):
            seen.append(f"chunk {info.chunk_offset} of {info.size} bytes at {info.byte_offset}")

    dataset.id.chunk_iter(look)
    if seen:
        raise refuse(spot(dataset), seen[0])


def walk(group: h5py.Group, depth: int = 0, seen: set[int] | None = None) -> Iterator[h5py.Group | h5py.Dataset]:
    """Every object below (and with) a group, each checked by the rules, parents first; no object may come twice."""
    seen = set() if seen is None else seen
    if depth > MAX_DEPTH:
        raise refuse(spot(group), f"groups nested deeper than {MAX_DEPTH}")
    _note(group, seen)
    yield group
    for name in names(group):
        found = member(group, name)
        if isinstance(found, h5py.Group):
            yield from walk(found, depth + 1, seen)
        else:
            _note(found, seen)
            yield found


def _note(thing: h5py.Group | h5py.Dataset, seen: set[int]) -> None:
    _check_attributes(thing)
    address = h5o.get_info(thing.id).addr
    if address in seen or len(seen) >= MAX_OBJECTS:
        raise refuse(spot(thing), "one object under two names" if address in seen else f"over {MAX_OBJECTS} objects")
    seen.add(address)


def _check_attributes(thing: h5py.Group | h5py.Dataset) -> None:
    count = h5a.get_num_attrs(thing.id)
    if count > MAX_ATTRIBUTES:
        raise refuse(spot(thing), f"{count} attributes")
    for i in range(count):
        check_attribute(thing, h5a.open(thing.id, index=i))


def check_attribute(thing: h5py.Group | h5py.Dataset, attribute: h5a.AttrID) -> None:
    """Refuse an attribute that is not one integer, float or fixed-length text of at most 64 KiB."""
    kind = attribute.get_type()
    fixed = isinstance(kind, h5t.TypeStringID) and not kind.is_variable_str()
    plain = fixed or isinstance(kind, h5t.TypeIntegerID | h5t.TypeFloatID)
    if not plain or attribute.get_space().get_simple_extent_type() != h5s.SCALAR or kind.get_size() > MAX_TEXT:
        raise refuse(spot(thing), f"attribute {attribute.name!r} is not one number or short text")


# ---- the child ------------------------------------------------------------------------------------------------------


def ask_child(task: str, path: str | Path) -> Any:
    """Run a task ("probe" or "verify") on a file in a child process with limits on memory, time and output.

    Returns:
        What the task found: None of "probe", a list of findings of "verify".

    Raises:
        DataError: the child refused the file, crashed, hung, or ran out of memory on it.
    """
    limit_s = PATIENCE_S + math.ceil(check_plain(path).st_size / 40e6)
    command = [sys.executable, "-P", "-m", "spikerig.dataset.hdf5_guard", task, os.path.abspath(path), str(limit_s)]
    env = os.environ | {"HDF5_PLUGIN_PRELOAD": "::", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(command, capture_output=True, timeout=limit_s, env=env, stdin=subprocess.DEVNULL)
    except subprocess.TimeoutExpired as error:
        raise refuse(path, f"reading it took more than {limit_s} s in the child process") from error
    if done.returncode < 0:
        died = signal.Signals(-done.returncode).name
        raise refuse(path, f"reading it killed the child process ({died})")
    try:
        answer = json.loads(done.stdout)
    except ValueError as error:
        last = done.stderr.decode(errors="replace").strip().rpartition("\n")[2][:200]
        raise refuse(path, f"reading it ended the child process ({done.returncode}) {last}") from error
    if fault := answer.get("fault"):
        kind = {"UsageError": UsageError, "HostError": HostError}.get(fault.pop("type"), DataError)
        raise kind(fault.pop("what"), **fault)
    return answer["found"]


def limit_itself(limit_s: int) -> None:
    """Bound this process's memory and CPU time; no core dump, no file written."""
    import resource

    for what, bound in (
        (resource.RLIMIT_AS, _MEMORY),
        (resource.RLIMIT_CPU, limit_s),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_FSIZE, 0),
    ):
        hard = resource.getrlimit(what)[1]
        bound = bound if hard == resource.RLIM_INFINITY else min(bound, hard)
        try:
            resource.setrlimit(what, (bound, bound))
        except (ValueError, OSError):
            continue  # a limit this system does not know


def _probe(path: str) -> None:
    with hdf5_faults(path), h5py.File(path, "r") as file:
        for thing in walk(file):
            if isinstance(thing, h5py.Dataset) and thing.id.get_create_plist().get_nfilters():
                for where in thing.iter_chunks():
                    thing[where]


def main(words: list[str]) -> int:
    """The child: limit itself, do the task, answer in JSON on stdout."""
    task, path, limit_s = words
    limit_itself(int(limit_s))
    answer: dict[str, Any] = {"found": None}
    try:
        if task == "verify":
            from spikerig.dataset.store_verify import verify_here

            answer["found"] = verify_here(path)
        else:
            _probe(path)
    except RigError as fault:
        told = fault.as_json() | {"type": type(fault).__name__}
        keep = ("type", "what", "value", "expected", "cause", "next")
        answer = {"fault": {k: told[k] or ("" if k != "value" else None) for k in keep}}
    except MemoryError:
        answer = {"fault": {"type": "DataError", "what": "the file asks for more memory than it may", "value": path}}
    sys.stdout.write(json.dumps(answer))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
