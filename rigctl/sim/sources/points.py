"""Coloured points from a PLY file (ASCII or little-endian binary), as COLMAP and most viewers write them."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from spikerig.dataset.errors import DataError
from spikerig.dataset.scene import Points

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
    "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4",
    "double": "<f8", "float64": "<f8",
}  # fmt: skip
MAX_HEADER = 1 << 16


def read_points(path: str | Path) -> Points:
    """Vertices with x, y, z and red, green, blue (uchar) of a PLY file; their source is "given".

    Raises:
        DataError: not a PLY file, truncated, big-endian, without colours, or with points that are not finite.

    Edges:
        Elements after the vertices (faces) are ignored.
    """
    path = Path(path)
    try:
        size = os.path.getsize(path)
        with path.open("rb") as file:
            raw = file.read(MAX_HEADER)
            end = raw.find(b"end_header\n")
            if not raw.startswith(b"ply\n") or end < 0:
                raise DataError("not a PLY file", value=path, expected="ply ... end_header, lines ending in \\n")
            kind, count, layout = _header(path, raw[:end].decode("ascii", "replace"))
            start = end + len(b"end_header\n")
            file.seek(start)
            if kind == "ascii":
                lines = file.read().decode("ascii", "replace").splitlines()[:count]
                table = _from_text(path, lines, count, layout)
            else:
                if count * layout.itemsize > size - start:
                    raise DataError("the PLY file is truncated", value=path, expected=f"{count} vertices")
                table = np.frombuffer(file.read(count * layout.itemsize), layout)
    except OSError as error:
        raise DataError("the points cannot be read", value=f"{path}: {error.strerror}") from None
    xyz = np.stack([table[k].astype(np.float64) for k in "xyz"], 1)
    if not np.all(np.isfinite(xyz)):
        raise DataError("points that are not finite", value=f"{path}: {int((~np.isfinite(xyz)).any(1).sum())}")
    return Points(xyz, np.stack([table[k] for k in ("red", "green", "blue")], 1), "given")


def _header(path: Path, text: str) -> tuple[str, int, np.dtype]:
    kind, count, fields, element = "", -1, [], ""
    for words in (line.split() for line in text.splitlines()):
        if words[:1] == ["format"] and len(words) > 1:
            kind = words[1]
        elif words[:1] == ["element"] and len(words) == 3:
            if count < 0 and words[1] != "vertex":
                raise DataError("the PLY file does not begin with its vertices", value=path)
            element, count = words[1], int(words[2]) if words[1] == "vertex" and words[2].isdigit() else count
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in TYPES:
                raise DataError("a PLY property that is not a plain number", value=f"{path}: {' '.join(words)}")
            fields.append((words[2], TYPES[words[1]]))
    names = [name for name, _ in fields]
    if kind not in ("ascii", "binary_little_endian"):
        raise DataError("a PLY file of another kind", value=f"{path}: {kind}", expected="ascii or little-endian")
    missing = [n for n in ("x", "y", "z", "red", "green", "blue") if n not in names]
    if count < 0 or missing or len(set(names)) < len(names):
        raise DataError("the PLY file lacks what points need", value=f"{path}: {', '.join(missing) or 'vertices'}")
    colours = {dict(fields)[n] for n in ("red", "green", "blue")}
    if colours != {"u1"}:
        raise DataError("the PLY file's colours are not uchar", value=path)
    return kind, count, np.dtype(fields)


def _from_text(path: Path, lines: list[str], count: int, layout: np.dtype) -> np.ndarray:
    try:
        rows = np.array([line.split() for line in lines], np.float64).reshape(len(lines), -1)
        if len(lines) != count or (count and rows.shape[1] != len(layout.names or ())):
            raise ValueError
    except ValueError:
        raise DataError("the PLY file's vertices do not fit its header", value=f"{path}: {count} promised") from None
    table = np.zeros(count, layout)
    for k, name in enumerate(layout.names or ()):
        table[name] = rows[:, k]
    return table
