"""Spikes on their way to a file, block by block in bounded memory: .dat, .npz or .h5."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import UsageError
from spikerig.dataset.outfile import whole_file
from spikerig.dataset.stream import SpikeStream

Bits = NDArray[np.uint8]
ENDINGS = (".dat", ".npz", ".h5", ".hdf5")
_STEP = 256  # ticks turned at once


def check_ending(path: Path) -> None:
    """Raise a UsageError where a path does not end like a file of spikes."""
    if path.suffix.lower() not in ENDINGS:
        raise UsageError("spikes are written as .dat, .npz or .h5", value=path)


@contextmanager
def spike_sink(path: Path, height: int, width: int, rate_hz: float, *, force: bool = False) -> Iterator[Callable]:
    """A function that appends packed ticks uint8[n,H,ceil(W/8)]; the file appears whole, or not at all.

    Args:
        path: ends in .dat (bits alone), .npz or .h5.
        height, width, rate_hz: of the stream, which starts at 0 ns.
        force: replace an existing file.

    Raises:
        UsageError: another ending, or the file exists. HostError: the disk is full.
    """
    check_ending(path)
    like = SpikeStream(np.zeros((0, height, (width + 7) // 8), np.uint8), width, rate_hz)
    writer = {".dat": _dat, ".npz": _npz}.get(path.suffix.lower(), _h5)
    with whole_file(path, force=force) as part, writer(part, like) as append:
        yield append


@contextmanager
def _h5(path: Path, like: SpikeStream) -> Iterator[Callable]:
    from spikerig.dataset.spikes_h5 import H5Writer

    with H5Writer(path, like) as out:
        yield lambda bits: out.append(SpikeStream(bits, like.width, like.rate_hz))


@contextmanager
def _dat(path: Path, like: SpikeStream) -> Iterator[Callable]:
    from spikerig.dataset.vidar_dat import Raster, pack_rows

    raster = Raster(like.height, like.width, like.width)
    with path.open("wb") as file:

        def append(bits: Bits) -> None:
            for first in range(0, len(bits), _STEP):
                file.write(pack_rows(bits[first : first + _STEP], raster))

        yield append


@contextmanager
def _npz(path: Path, like: SpikeStream) -> Iterator[Callable]:
    """An archive says its size first, so the bits wait in a file beside it."""
    from spikerig.dataset.spikes_npz import OURS

    raw = path.with_name(path.name + ".bits")
    try:
        with raw.open("wb") as file:
            yield lambda bits: file.write(np.ascontiguousarray(bits).data)
        small = {
            "format": np.array(OURS), "width": np.array(like.width), "rate_hz": np.array(like.rate_hz),
            "t0_ns": np.array(0), "clock": np.array(like.clock), "lost": like.lost,
        }  # fmt: skip
        tick = like.height * like.bits.shape[2]
        shape = (raw.stat().st_size // tick, like.height, like.bits.shape[2])
        with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            for name, value in small.items():
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, value, allow_pickle=False)
            with archive.open("bits.npy", "w", force_zip64=True) as member, raw.open("rb") as file:
                header = {"descr": "|u1", "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(member, header)
                shutil.copyfileobj(file, member, 1 << 22)
    finally:
        raw.unlink(missing_ok=True)
