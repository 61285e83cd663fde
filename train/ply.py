"""Splats as the standard 3DGS .ply that every viewer reads: binary, little endian, world units."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, HostError, UsageError
from spikerig.train.gauge import Gauge
from spikerig.train.splat import Splats

MAX_SPLATS = 50_000_000
MAX_HEADER = 65_536


def _names(rest: int) -> list[str]:
    return [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{k}" for k in range(rest)),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]


def export_ply(path: Path, splats: Splats, gauge: Gauge, *, force: bool = False) -> None:
    """Write splats in world units; the gauge is undone (no rotation in it, so colours carry over).

    Raises:
        UsageError: the file exists and `force` is not given.
        HostError: it cannot be written.
    """
    if path.exists() and not force:
        raise UsageError("the file exists", value=path, next="--force replaces it")
    sh = splats.sh.detach().numpy()
    n, rows = sh.shape[:2]
    columns = [
        gauge.world(splats.means.detach().numpy().astype(np.float64)),
        np.zeros((n, 3)),
        sh[:, 0],
        sh[:, 1:].transpose(0, 2, 1).reshape(n, 3 * (rows - 1)),  # all of red, then green, then blue
        splats.logit_opacities.detach().numpy()[:, None],
        splats.log_scales.detach().numpy() - np.float32(np.log(gauge.scale)),
        splats.quats.detach().numpy(),
    ]
    names = _names(3 * (rows - 1))
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    part = path.with_name(path.name + ".partial")
    try:
        with part.open("wb") as file:
            file.write("\n".join(header).encode("ascii"))
            file.write(np.ascontiguousarray(np.concatenate(columns, axis=1), "<f4").tobytes())
        os.replace(part, path)
    except OSError as error:
        raise HostError("the .ply could not be written", value=path, cause=str(error)) from error


def import_ply(path: Path, gauge: Gauge) -> Splats:
    """Splats of a 3DGS .ply, brought into a gauge.

    Raises:
        DataError: not such a file, truncated, too large, or with values that are not finite.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError("the .ply cannot be read", value=path, cause=str(error)) from error
    end = data[:MAX_HEADER].find(b"end_header\n")
    if not data.startswith(b"ply\n") or end < 0:
        raise DataError("not a .ply file", value=path)
    lines = data[:end].decode("ascii", "replace").split("\n")
    names = [line.split()[-1] for line in lines if line.startswith("property float ")]
    count = [line.split()[-1] for line in lines if line.startswith("element ")]
    rest = len([n for n in names if n.startswith("f_rest_")])
    degree_rows = {0: 1, 9: 4, 24: 9, 45: 16}.get(rest)
    if "format binary_little_endian 1.0" not in lines or len(count) != 1 or not count[0].isdigit():
        raise DataError("not a binary little-endian .ply of one element", value=path)
    n = int(count[0])
    body = data[end + len(b"end_header\n") :]
    if degree_rows is None or sorted(names) != sorted(_names(rest)) or n > MAX_SPLATS:
        raise DataError("not a .ply of Gaussian splats", value=path, expected="the properties of the 3DGS code")
    if len(body) != 4 * n * len(names):
        raise DataError("the .ply is cut off or too long", value=f"{len(body)} bytes", expected=f"{4 * n * len(names)}")
    table = dict(zip(names, np.frombuffer(body, "<f4").reshape(n, len(names)).T, strict=True))
    if not all(np.isfinite(column).all() for column in table.values()):
        raise DataError("the .ply holds values that are not finite", value=path)

    def take(*keys: str) -> NDArray[np.float32]:
        return np.stack([table[k] for k in keys], 1).astype(np.float32)

    sh = np.empty((n, degree_rows, 3), np.float32)
    sh[:, 0] = take("f_dc_0", "f_dc_1", "f_dc_2")
    if rest:
        sh[:, 1:] = take(*(f"f_rest_{k}" for k in range(rest))).reshape(n, 3, degree_rows - 1).transpose(0, 2, 1)
    return Splats(
        torch.from_numpy(gauge.inside(take("x", "y", "z").astype(np.float64)).astype(np.float32)),
        torch.from_numpy(take("rot_0", "rot_1", "rot_2", "rot_3")),
        torch.from_numpy(take("scale_0", "scale_1", "scale_2") + np.float32(np.log(gauge.scale))),
        torch.from_numpy(take("opacity")[:, 0].copy()),
        torch.from_numpy(sh),
    )
