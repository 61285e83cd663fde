"""Scene files whose events were made to do harm: each function spoils those of the view v-01.x (hard_store)."""

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from spoil import _swap

EVENTS = "/views/v-01.x/events"


def _column(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """Store what `change` makes of a column instead of it."""

    def spoil(path: Path) -> None:
        with h5py.File(path) as file:
            made = change(file[f"{EVENTS}/{name}"][()])
        _swap(path, f"{EVENTS}/{name}", lambda group, last: group.create_dataset(last, data=made))

    return spoil


def _attribute(name: str, value: Any) -> Callable[[Path], None]:
    def spoil(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            file[EVENTS].attrs[name] = value

    return spoil


def a_dataset(path: Path) -> None:
    _swap(path, EVENTS, lambda g, n: g.create_dataset(n, data=np.zeros(3)))


def without_a_column(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file[f"{EVENTS}/y"]


def bomb(path: Path) -> None:
    """4 GB of zeros in 4 MB, every chunk honestly there."""
    zeros = zlib.compress(bytes(1 << 24), 9)

    def make(group: h5py.Group, name: str) -> None:
        made = group.create_dataset(name, (1 << 29,), "<i8", chunks=(1 << 21,), compression=9)
        for k in range(0, 1 << 29, 1 << 21):
            made.id.write_direct_chunk((k,), zeros)

    _swap(path, f"{EVENTS}/t_ns", make)


def garbled_chunk(path: Path) -> None:
    """The deflated bytes of a chunk, overwritten."""
    with h5py.File(path) as file:
        chunk = file[f"{EVENTS}/t_ns"].id.get_chunk_info(0)
    data = bytearray(path.read_bytes())
    data[chunk.byte_offset : chunk.byte_offset + chunk.size] = bytes(range(256)) * (chunk.size // 256 + 1)
    path.write_bytes(data[: path.stat().st_size])


def behind_a_link(path: Path) -> None:
    """To another column that is perfectly good."""
    _swap(path, f"{EVENTS}/x", lambda g, n: g.__setitem__(n, h5py.SoftLink(f"{EVENTS}/y")))


# What reading all of it says. The first four are unreadable as a whole; verifying the others, sealed anew so that their
# checksums fit, is a critical finding of the same words.
UNREADABLE: dict[str, tuple[Callable[[Path], None], str]] = {
    "bomb": (bomb, "claims 4294967296 bytes"),
    "garbled chunk": (garbled_chunk, "HDF5:"),
    "behind a link": (behind_a_link, "only hard links are followed"),
    "a size of text": (_attribute("width", "w" * 70_000), "not one number or short text"),
}
HOSTILE: dict[str, tuple[Callable[[Path], None], str]] = {
    "a dataset": (a_dataset, "group"),
    "a column missing": (without_a_column, "is missing"),
    "a column of floats": (_column("y", lambda v: v.astype("<f8")), "not what the schema says"),
    "a column of two axes": (_column("x", lambda v: v[:, None]), "not what the schema says"),
    "a shorter column": (_column("x", lambda v: v[:-1]), "columns of different lengths"),
    "times backwards": (_column("t_ns", lambda v: v[::-1]), "order of their times"),
    "one time late": (_column("t_ns", lambda v: np.where(np.arange(len(v)) == 99, v[-1], v)), "order of their times"),
    "times before the span": (_column("t_ns", lambda v: v - 2**50), "outside the span"),
    "times at its end": (_column("t_ns", lambda v: v - v[-1] + 2**60 + 20_000_000), "outside the span"),
    "columns beyond": (_column("x", lambda v: v + np.uint16(21)), "outside the picture"),
    "rows beyond": (_column("y", lambda v: v + np.uint16(13)), "outside the picture"),
    "polarity of zero": (_column("polarity", lambda v: v * np.int8(0)), "polarity is +1 or -1"),
    "a polarity of -128": (_column("polarity", lambda v: np.full_like(v, -128)), "polarity is +1 or -1"),
    "a negative size": (_attribute("width", np.int64(-1)), "1 to 65536 pixels"),
    "a size of 2^40": (_attribute("height", np.int64(1 << 40)), "1 to 65536 pixels"),
    "a backward span": (_attribute("t1_ns", np.int64(-(2**62))), "ends no sooner than it starts"),
    "a text for a time": (_attribute("t0_ns", np.bytes_(b"soon")), "where int belongs"),
}
