"""Our own file of one spike stream: HDF5 with the group /spikes, appended to tick by tick in bounded memory.

/                format "spikerig-spikes", version "1.0", status "recording" or "complete"
/spikes          width, rate_hz (absent: not known), t0_ns, clock
/spikes/bits     uint8[T,H,ceil(W/8)], top row first, LSB first, padding bits zero, in chunks of about 1 MB
/spikes/lost     int64[N,2], half-open ranges of lost ticks
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.hdf5_guard import check_attribute, hdf5_faults, member, open_file, refuse, spot
from spikerig.dataset.stream import SpikeFile, SpikeStream

FORMAT, VERSION = "spikerig-spikes", "1.0"
_CHUNK = 1 << 20


class H5Writer:
    """Appends blocks of one stream to a new file; a context manager that marks the file complete on a clean end.

    Args:
        path: of the new file; use `outfile.whole_file` around it.
        like: a stream or file with the geometry, rate, start and clock of what will come.
    """

    def __init__(self, path: Path, like: SpikeStream | SpikeFile) -> None:
        row = (like.width + 7) // 8
        self.file = h5py.File(path, "w", libver=("v110", "v110"), rdcc_nbytes=16 << 20)
        self.file.attrs.update({k: np.bytes_(v) for k, v in _head("recording").items()})
        self.group = group = self.file.create_group("spikes")
        group.attrs["width"] = np.int64(like.width)
        group.attrs["t0_ns"] = np.int64(like.t0_ns)
        group.attrs["clock"] = np.bytes_(like.clock.encode())
        if like.rate_hz is not None:
            group.attrs["rate_hz"] = np.float64(like.rate_hz)
        self.bits = group.create_dataset(
            "bits",
            (0, like.height, row),
            np.uint8,
            maxshape=(None, like.height, row),
            chunks=(max(1, _CHUNK // max(like.height * row, 1)), like.height, row),
        )
        self.lost: list[NDArray[np.int64]] = []

    def append(self, block: SpikeStream) -> None:
        """The ticks that follow, with their own lost ranges."""
        if block.bits.shape[1:] != self.bits.shape[1:]:
            raise UsageError("a block of another size", value=block.bits.shape, expected=str(self.bits.shape[1:]))
        done = len(self.bits)
        self.bits.resize(done + block.ticks, 0)
        if block.ticks:
            self.bits[done:] = block.bits
        self.lost.append(block.lost + done)

    def __enter__(self) -> H5Writer:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            lost = np.concatenate([*self.lost, np.zeros((0, 2), np.int64)])
            self.group.create_dataset("lost", data=_joined(lost))
            self.file.attrs["status"] = np.bytes_("complete")
        self.file.close()


def _head(status: str) -> dict[str, str]:
    return {"format": FORMAT, "version": VERSION, "status": status}


def _joined(lost: NDArray[np.int64]) -> NDArray[np.int64]:
    """Ranges that touch, as blocks cut them, become one."""
    out: list[list[int]] = []
    for first, stop in lost.tolist():
        if out and out[-1][1] == first:
            out[-1][1] = stop
        else:
            out.append([first, stop])
    return np.array(out, np.int64).reshape(-1, 2)


def is_lone_stream(path: Path) -> bool:
    """Whether an HDF5 file is one of these (and not, say, a scene)."""
    with open_file(path) as file, hdf5_faults(path):
        return _attr(file, "format") == FORMAT


def open_h5(path: Path) -> SpikeFile:
    """Open a lone stream.

    Raises:
        DataError: another kind of HDF5 file, a damaged one, a newer major version, or a recording that never ended.
    """
    file = open_file(path)
    try:
        with hdf5_faults(path):
            return _describe(path, file)
    except BaseException:
        file.close()
        raise


def _describe(path: Path, file: h5py.File) -> SpikeFile:
    found = _attr(file, "format")
    if found != FORMAT:
        raise DataError(
            "this HDF5 file holds no lone spike stream", value=f"{path}: format {found!r}", expected=FORMAT,
            cause="a scene: its spikes belong to its views",
            next=f"spikerig data info {path}",
        )  # fmt: skip
    version = str(_attr(file, "version"))
    if version.split(".")[0] != VERSION.split(".")[0]:
        raise DataError("written by a newer version of this tool", value=version, expected=VERSION)
    if _attr(file, "status") != "complete":
        raise DataError("the recording never ended", value=f"{path}: status {_attr(file, 'status')!r}",
                        next="import it again from its source")  # fmt: skip
    group = member(file, "spikes")
    if not isinstance(group, h5py.Group):
        raise refuse(spot(file), "/spikes is not a group")
    bits, lost = member(group, "bits"), member(group, "lost")
    width, t0_ns, clock, rate = (_attr(group, k) for k in ("width", "t0_ns", "clock", "rate_hz"))
    if not isinstance(bits, h5py.Dataset) or not isinstance(lost, h5py.Dataset):
        raise refuse(spot(group), "bits and lost must be datasets")
    if not isinstance(width, int) or not isinstance(t0_ns, int) or not isinstance(clock, str) or width < 1:
        raise refuse(spot(group), "width, t0_ns or clock is missing or of a wrong kind")
    if bits.dtype != np.uint8 or bits.ndim != 3 or bits.shape[2] != (width + 7) // 8:
        raise refuse(spot(group), f"bits {bits.dtype}{bits.shape} do not fit a width of {width}")
    if rate is not None and not (isinstance(rate, float) and np.isfinite(rate) and rate > 0):
        raise refuse(spot(group), f"rate_hz is {rate!r}")
    ticks, height, _ = bits.shape
    ranges = np.asarray(lost[()], np.int64)
    if ranges.ndim != 2 or ranges.shape[1] != 2 or np.any(ranges[:, 0] >= ranges[:, 1]) or np.any(ranges < 0):
        raise refuse(spot(group), "lost is not a list of half-open ranges")
    if len(ranges) and ranges.max() > ticks:
        raise refuse(spot(group), "lost ticks after the end")

    def decode(t0: int, t1: int) -> NDArray[np.uint8]:
        with hdf5_faults(path):
            out = bits[t0:t1] if t1 > t0 else np.zeros((0, *bits.shape[1:]), np.uint8)
        if width % 8 and np.any(out[:, :, -1] >> (width % 8)):
            raise refuse(spot(group), "padding bits are set")
        return out

    return SpikeFile(path, "spikes-h5", ticks, height, width, decode, file.close, rate, t0_ns, clock, ranges)


def _attr(thing: h5py.Group, name: str) -> Any:
    if not h5py.h5a.exists(thing.id, name.encode()):
        return None
    check_attribute(thing, h5py.h5a.open(thing.id, name.encode()))
    value = thing.attrs[name]
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return value.item() if isinstance(value, np.generic) else value
