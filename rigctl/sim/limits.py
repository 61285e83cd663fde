"""Records read from TOML tables: ranges and units live in the field, all faults are told at once."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from spikerig.dataset.errors import RigError, UsageError

R = TypeVar("R")
VECTORS = {"Vec3": "tuple[float, float, float]"}  # annotations are text here, so aliases are told by name


def limits(
    default: Any = dataclasses.MISSING,
    lo: float = -math.inf,
    hi: float = math.inf,
    unit: str = "",
    choices: tuple[str, ...] = (),
) -> Any:
    """A dataclass field with a range (inclusive), a unit and, for words, the allowed choices."""
    metadata = {"lo": lo, "hi": hi, "unit": unit, "choices": choices}
    if isinstance(default, dict):
        return dataclasses.field(default_factory=lambda: dict(default), metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


class Faults:
    """Faults found so far, each with the path of the key; `raise_any` tells them all in one error.

    Args:
        source: what is faulty, for the first line.
        kind: of the error.
        next: what to do.
    """

    def __init__(
        self,
        source: str,
        kind: type[RigError] = UsageError,
        next: str = "the keys, their units and ranges are in docs/scenes.md",
    ) -> None:
        self.source, self.kind, self.next = source, kind, next
        self.found: list[str] = []

    def add(self, where: str, message: str) -> None:
        """Note one fault at a dotted path."""
        self.found.append(f"{where}: {message}" if where else message)

    def unknown(self, where: str, name: str, known: Iterable[str]) -> None:
        """Note a name that is not among those known, with the nearest one."""
        self.add(where, f"unknown key; {nearest(name, known)}")

    def raise_any(self) -> None:
        """Raise an error that lists every fault; nothing when there is none."""
        if not self.found:
            return
        count = "a fault" if len(self.found) == 1 else f"{len(self.found)} faults"
        shown = self.found[:50] + ([f"... and {len(self.found) - 50} more"] if len(self.found) > 50 else [])
        raise self.kind(f"{self.source} has {count}", value="\n            ".join(shown), next=self.next)


def nearest(name: str, known: Iterable[str]) -> str:
    """The words `did you mean 'x'?` for the closest known name, or the list of names when none is close."""
    names = sorted(known)
    close = difflib.get_close_matches(name, names, 1, 0.5)
    return f"did you mean '{close[0]}'?" if close else f"known: {', '.join(names)}"


def read_record(cls: type[R], table: Any, where: str, faults: Faults, defaults: Mapping[str, Any] | None = None) -> R:
    """A record of a dataclass from a TOML table; unknown keys, wrong types and ranges are noted as faults.

    Args:
        cls: a dataclass whose fields were made by `limits`.
        table: what the file holds there.
        where: dotted path, for messages.
        faults: where faults go; on a fault the field's default (or None) stands in, so that reading goes on.
        defaults: defaults that differ from the class's (a preset).

    Returns:
        An instance of `cls`; only meaningful when no fault was added.
    """
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    if not isinstance(table, Mapping):
        faults.add(where, f"is {table!r}, expected a table")
        table = {}
    for key in table:
        if key not in fields:
            faults.unknown(f"{where}.{key}".strip("."), str(key), fields)
    values: dict[str, Any] = {}
    for name, spec in fields.items():
        path = f"{where}.{name}".strip(".")
        if name in table:
            values[name] = _checked(table[name], spec, path, faults)
        elif defaults is not None and name in defaults:
            values[name] = defaults[name]
        elif spec.default is dataclasses.MISSING and spec.default_factory is dataclasses.MISSING:
            faults.add(path, f"is missing{_range(spec)}")
            values[name] = None
    return cls(**values)


def _range(spec: dataclasses.Field) -> str:
    meta = spec.metadata
    if meta.get("choices"):
        return f", expected one of {', '.join(filter(None, meta['choices']))}"
    unit = f" {meta['unit']}" if meta.get("unit") else ""
    lo, hi = meta.get("lo", -math.inf), meta.get("hi", math.inf)
    if lo == -math.inf and hi == math.inf:
        return f", expected a value in{unit}" if unit else ""
    return f", expected {lo:g} to {hi:g}{unit}"


def _checked(value: Any, spec: dataclasses.Field, path: str, faults: Faults) -> Any:
    kind = VECTORS.get(str(spec.type), str(spec.type))
    fallback = None if spec.default is dataclasses.MISSING else spec.default
    if kind.startswith("tuple[float"):
        size = 0 if "..." in kind else kind.count("float")
        if not isinstance(value, list) or (size and len(value) != size) or not all(_is_number(v) for v in value):
            faults.add(path, f"is {value!r}, expected {size or 'a list of'} numbers{_range(spec)}")
            return fallback
        for v in value:
            if not _inside(v, spec):
                faults.add(path, f"is {value!r}{_range(spec)}")
                return fallback
        return tuple(float(v) for v in value)
    if kind == "bool":
        good = isinstance(value, bool)
    elif kind == "int":
        good = isinstance(value, int) and not isinstance(value, bool)
    elif kind == "float":
        good = _is_number(value)
    elif kind == "str":
        good = isinstance(value, str)
    else:
        return value  # nested tables are read by their owner
    if not good:
        words = {"bool": "true or false", "int": "a whole number", "float": "a number", "str": "a word"}
        faults.add(path, f"is {value!r}, expected {words[kind]}{_range(spec)}")
        return fallback
    choices = spec.metadata.get("choices") or ()
    if choices and value not in choices:
        faults.add(path, f"is {value!r}; {nearest(str(value), choices)}{_range(spec)}")
        return fallback
    if kind in ("int", "float") and not _inside(value, spec):
        faults.add(path, f"is {value!r}{_range(spec)}")
        return fallback
    return float(value) if kind == "float" else value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _inside(value: float, spec: dataclasses.Field) -> bool:
    return spec.metadata.get("lo", -math.inf) <= value <= spec.metadata.get("hi", math.inf) and math.isfinite(value)
