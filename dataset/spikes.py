"""Spike streams and files of them: whatever a file is, open it; write a stream in any of the formats."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from spikerig.dataset.errors import DataError, HostError, UsageError
from spikerig.dataset.stream import SpikeFile as SpikeFile
from spikerig.dataset.stream import SpikeStream as SpikeStream


def open_spikes(
    path: str | Path,
    *,
    height: int | None = None,
    width: int | None = None,
    row_bits: int | None = None,
    axes: str | None = None,
    rate_hz: float | None = None,
    drop_tail: bool = False,
) -> SpikeFile:
    """Open a file of spikes; what it is shows in its bytes, not in its name.

    Args:
        path: HDF5 of our own, .npz, M1K40 blocks, or anything else as a raw Vidar raster.
        height, width, row_bits: layout of a raw raster (`vidar_dat.layout`); by default 250x400 and what fits.
        axes: "THW" or "HWT", order of the array of a foreign .npz.
        rate_hz: ticks a second; overrides what the file says.
        drop_tail: leave out an unfinished last tick of a raw raster instead of refusing it.

    Returns:
        A SpikeFile; use it in a `with` block.

    Raises:
        UsageError: there is no such file, or the bytes fit several layouts.
        DataError: the bytes fit none, or are damaged.

    Source:
        facts of the formats: docs/format.md.
    """
    source = Path(path)
    start = _first_bytes(source)
    raster = (height, width, row_bits) != (None, None, None)
    kind = "spikes-h5" if start.startswith(b"\x89HDF") else "npz" if start.startswith(b"PK\x03\x04") else "raw"
    if (raster and kind != "raw") or (axes and kind != "npz"):
        raise UsageError(
            "the file says its layout itself", value=source, next="leave out --height, --width, --row-bits and --axes"
        )
    if kind == "spikes-h5":
        from spikerig.dataset.spikes_h5 import open_h5

        return _with_rate(open_h5(source), rate_hz)
    if kind == "npz":
        from spikerig.dataset.spikes_npz import open_npz

        return _with_rate(open_npz(source, axes), rate_hz)
    from spikerig.dataset import m1k40, vidar_dat

    if not raster and (source.suffix.lower() == ".bin" or m1k40.looks_like(source)):
        return _with_rate(m1k40.open_m1k40(source), rate_hz)
    return _with_rate(vidar_dat.open_raster(source, height, width, row_bits, drop_tail), rate_hz)


def write_spikes(
    path: str | Path,
    stream: SpikeStream,
    *,
    format: str | None = None,
    row_bits: int | None = None,
    force: bool = False,
) -> None:
    """Write a stream to a file that `open_spikes` reads back exactly.

    Args:
        path: of the file; it appears whole or not at all.
        stream: what to write.
        format: "dat", "m1k40", "npz" or "spikes-h5"; by default by the ending: .dat .bin .npz .h5.
        row_bits: of a .dat: bits a row on disk, at least the width, which is the default (416 for a Vidar's dumps).
        force: replace an existing file.

    Raises:
        UsageError: unknown format, the file exists, or the format cannot hold the stream.

    Edges:
        .dat and .bin hold bits only: the rate and the start are not written, and a stream with lost ticks is refused.
    """
    from spikerig.dataset import m1k40, spikes_h5, spikes_npz, vidar_dat
    from spikerig.dataset.outfile import whole_file

    target = Path(path)
    endings = {".dat": "dat", ".bin": "m1k40", ".npz": "npz", ".h5": "spikes-h5", ".hdf5": "spikes-h5"}
    kind = format or endings.get(target.suffix.lower(), "")
    if kind not in endings.values():
        raise UsageError("no such spike format", value=kind or target.name, expected="dat, m1k40, npz or spikes-h5")
    if kind in ("dat", "m1k40") and len(stream.lost):
        raise UsageError(
            "this format cannot say which ticks were lost", value=f"{kind}, lost {stream.lost.tolist()[:4]}",
            next="write .h5 or .npz",
        )  # fmt: skip
    if row_bits is not None and kind != "dat":
        raise UsageError("only .dat has a choice of row bits", value=row_bits)
    with whole_file(target, force=force) as part:
        if kind == "dat":
            vidar_dat.write_raster(part, stream, row_bits or stream.width)
        elif kind == "m1k40":
            m1k40.write_m1k40(part, stream)
        elif kind == "npz":
            spikes_npz.write_npz(part, stream)
        else:
            with spikes_h5.H5Writer(part, stream) as out:
                out.append(stream)


def _with_rate(file: SpikeFile, rate_hz: float | None) -> SpikeFile:
    if rate_hz is None:
        return file
    if not (np.isfinite(rate_hz) and rate_hz > 0):
        file.close()
        raise UsageError("a tick rate must be positive and finite", value=rate_hz, expected="e.g. 40000")
    return replace(file, rate_hz=float(rate_hz))


def _first_bytes(path: Path) -> bytes:
    try:
        if path.is_dir():
            raise UsageError("this is a folder, not a file", value=path)
        with path.open("rb") as file:
            start = file.read(8)
    except FileNotFoundError as error:
        raise UsageError("there is no such file", value=path) from error
    except OSError as error:
        raise HostError("the file cannot be opened", value=f"{path}: {error.strerror}") from error
    if not start:
        raise DataError("the file is empty", value=path, cause="a recording that never began, or a failed copy")
    return start
