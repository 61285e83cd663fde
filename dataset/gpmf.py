"""GPMF, GoPro's telemetry format: key, type, size, repeat, payload; nested; aligned to four bytes; big-endian."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError

MAX_ITEMS, MAX_DEPTH = 200_000, 6
_NUMBERS = {
    "b": ">i1", "B": ">u1", "s": ">i2", "S": ">u2", "l": ">i4", "L": ">u4", "j": ">i8", "J": ">u8",
    "f": ">f4", "d": ">f8", "q": ">i4", "Q": ">i8",
}  # fmt: skip
_FIXED = {"q": 2.0**-16, "Q": 2.0**-32}  # fixed point: what one unit is worth
_TEXT = {"c": 1, "U": 16, "F": 4, "G": 16}


@dataclass(frozen=True, slots=True)
class Item:
    """One key with its payload as it lies in the file; of a nested one, the bytes of its children."""

    key: str
    kind: str
    size: int
    repeat: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class Stream:
    """What one payload (about a second) holds of one sensor.

    Args:
        key: four letters, e.g. "SHUT".
        name, unit: as the camera tells them.
        values: float64[N,C], scaled to the unit, on the axes that ORIO names (Z, X, Y for a GoPro's motion sensors).
        stamp_us: camera time of the first sample (STMP); None where the camera gives none.
        total: samples since the clip's start, these included (TSMP); None likewise.
        extra: single numbers that came with it (TMPC, ...).
    """

    key: str
    name: str
    unit: str
    values: NDArray[np.float64]
    stamp_us: int | None
    total: int | None
    extra: dict[str, float] = field(default_factory=dict)


def broken(cause: str) -> DataError:
    """The one error for GPMF that breaks the rules; the file is named by who reads it."""
    return DataError("the telemetry (GPMF) is damaged", cause=cause, next="copy the clip again from the card")


def items(data: bytes) -> Iterator[Item]:
    """The items of one level; zero bytes after the last one are padding.

    Raises:
        DataError: an item claims more bytes than there are.
    """
    at, end = 0, len(data)
    while end - at >= 8:
        key, kind, size, repeat = struct.unpack_from(">4sBBH", data, at)
        if key == b"\0\0\0\0":
            if any(data[at:end]):
                raise broken(f"an item without a name, {end - at} bytes before the end")
            return
        length = size * repeat
        if length > end - at - 8:
            raise broken(f"{_text(key)} claims {size} x {repeat} bytes, {end - at - 8} are left")
        yield Item(_text(key), chr(kind), size, repeat, data[at + 8 : at + 8 + length])
        at += 8 + (length + 3) // 4 * 4
    if at < end and any(data[at:end]):
        raise broken(f"{end - at} stray bytes")


def value(item: Item) -> Any:
    """The value of a plain item: text, a number, a list of numbers, or rows of numbers; None of what is not known.

    Raises:
        DataError: its size does not fit its type.
    """
    if item.kind == "c" and item.size > 1 and item.repeat > 1:
        cells = [item.payload[i * item.size : (i + 1) * item.size] for i in range(item.repeat)]
        return [_text(cell).split("\0")[0].strip() for cell in cells]
    if item.kind in _TEXT:
        return _text(item.payload).split("\0")[0].strip() if item.kind in "cU" else _text(item.payload)
    if item.kind not in _NUMBERS:
        return None
    rows = numbers(item, item.kind)
    flat = rows[:, 0].tolist() if rows.shape[1] == 1 else rows.tolist()
    exact = item.kind in "bBsSlLjJ"
    flat = [_whole(v) if exact else v for v in flat]
    return flat[0] if len(flat) == 1 else flat


def numbers(item: Item, kinds: str, scale: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """The samples of an item as float64[N,C].

    Args:
        item: with `repeat` samples of `size` bytes.
        kinds: one type letter for all columns, or one a column (of a complex item).
        scale: what the raw numbers are divided by, one for all columns or one a column.
    """
    if any(k not in _NUMBERS for k in kinds) or not kinds:
        raise broken(f"{item.key} is of type {item.kind!r} {kinds!r}, not numbers")
    if len(kinds) == 1:
        step = np.dtype(_NUMBERS[kinds]).itemsize
        if item.size % step or (item.repeat and not item.size):
            raise broken(f"{item.key}: samples of {item.size} bytes of type {kinds!r}")
        columns = max(item.size // step, 1)
        rows = np.frombuffer(item.payload, _NUMBERS[kinds]).astype(np.float64).reshape(-1, columns)
        rows = rows * _FIXED.get(kinds, 1.0)
    else:
        kind = np.dtype([(f"c{i}", _NUMBERS[k]) for i, k in enumerate(kinds)])
        if item.size != kind.itemsize:
            raise broken(f"{item.key}: samples of {item.size} bytes, its types take {kind.itemsize}")
        table = np.frombuffer(item.payload, kind)
        columns_ = [table[f"c{i}"].astype(np.float64) * _FIXED.get(k, 1.0) for i, k in enumerate(kinds)]
        rows = np.stack(columns_, axis=1)
    if scale is None:
        return rows
    if len(scale) not in (1, rows.shape[1]) or not np.all(np.isfinite(scale)) or np.any(scale == 0):
        raise broken(f"{item.key}: SCAL {scale.tolist()} for {rows.shape[1]} columns")
    return rows / scale


def streams(payload: bytes) -> list[Stream]:
    """The streams of one payload of the telemetry track; those of text or mixed types are left out."""
    found: list[Stream] = []
    for count, device in enumerate(items(payload)):
        if count > MAX_ITEMS:
            raise broken(f"more than {MAX_ITEMS} items")
        if device.key == "DEVC" and device.kind == "\0":
            found += [s for item in items(device.payload) if item.key == "STRM" and (s := _stream(item)) is not None]
    return found


def header(data: bytes) -> dict[str, dict[str, Any]]:
    """The settings in `moov/udta/GPMF`: by device ("1" are the camera's global settings), by key."""
    found: dict[str, dict[str, Any]] = {}
    for device in items(data):
        if device.key != "DEVC" or device.kind != "\0":
            continue
        told = {item.key: value(item) for item in items(device.payload) if item.kind != "\0"}
        found.setdefault(str(told.get("DVID", "?")), told)
    return found


def _stream(strm: Item) -> Stream | None:
    inside = list(items(strm.payload))
    if not inside or inside[-1].kind in ("\0", *_TEXT):
        return None
    told = {i.key: i for i in inside[:-1]}
    last = inside[-1]
    kinds = last.kind
    if kinds == "?":
        kinds = _spread(str(value(told["TYPE"]))) if "TYPE" in told else ""
        if not kinds or any(k not in _NUMBERS for k in kinds):
            return None
    scale = numbers(told["SCAL"], told["SCAL"].kind).ravel() if "SCAL" in told else None
    parts = [numbers(i, kinds, scale) for i in inside if i.key == last.key]
    if len(parts) > 1 and len({p.shape for p in parts}) == 1:
        parts = [p.reshape(1, -1) for p in parts]  # a key that comes again and again: each time one sample
    if len({p.shape[1] for p in parts}) != 1:
        raise broken(f"{last.key} changes its number of columns")
    rows = _turned(np.concatenate(parts), told.get("MTRX"))
    units = next((value(told[k]) for k in ("SIUN", "UNIT") if k in told and told[k].kind == "c"), "")
    unit = ",".join(units) if isinstance(units, list) else units
    extra = {
        k: float(v) for k, i in told.items() if i.kind in _NUMBERS and isinstance(v := value(i), int | float)
    }  # fmt: skip
    name = str(value(told["STNM"])) if "STNM" in told else ""
    stamp, total = _count(told.get("STMP")), _count(told.get("TSMP"))
    return Stream(last.key, name, unit, rows, stamp, total, extra)


def _turned(rows: NDArray[np.float64], matrix: Item | None) -> NDArray[np.float64]:
    """Channels as the sensor is mounted to the camera's axes (those that ORIO names), where the camera tells how."""
    columns = rows.shape[1]
    if matrix is None or matrix.kind != "f" or len(matrix.payload) != 4 * columns**2:
        return rows
    turn = numbers(matrix, "f").reshape(columns, columns)
    if not np.all(np.abs(turn) <= 1):  # catches NaN
        raise broken("MTRX is no rotation")
    return rows @ turn.T


def _count(item: Item | None) -> int | None:
    if item is None:
        return None
    if item.kind not in "LJ" or item.repeat != 1 or item.size not in (4, 8):
        raise broken(f"{item.key} is no count: type {item.kind!r}, {item.size} x {item.repeat} bytes")
    found = int.from_bytes(item.payload, "big")
    if found > 10**13:  # 115 days in microseconds
        raise broken(f"{item.key} is {found}")
    return found


def _spread(kinds: str) -> str:
    """Types of a complex sample with counts written out: "f[3]L" is "fffL"."""
    out = ""
    while kinds:
        if kinds[0] == "[":
            many, _, kinds = kinds[1:].partition("]")
            if not many.isascii() or not many.isdigit() or int(many) > 64 or not out:
                raise broken("TYPE with a bad count")
            out += out[-1] * (int(many) - 1)
        else:
            out, kinds = out + kinds[0], kinds[1:]
        if len(out) > 255:
            raise broken("TYPE names more than 255 columns")
    return out


def _text(raw: bytes) -> str:
    return raw.decode("latin-1")


def _whole(v: Any) -> Any:
    return [int(x) for x in v] if isinstance(v, list) else int(v)
