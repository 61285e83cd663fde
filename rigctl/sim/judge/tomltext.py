"""TOML as text: the standard library reads it, but does not write it."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from typing import Any

from spikerig.dataset.errors import UsageError

BARE = re.compile(r"[A-Za-z0-9_-]+")


def toml_text(table: Mapping[str, Any]) -> str:
    """A table as `tomllib` would read it back: values first, then its tables, lists of tables as `[[...]]`.

    Raises:
        UsageError: a value that TOML does not know.
    """
    return "\n".join(_table(table, ())).strip() + "\n"


def _table(table: Mapping[str, Any], path: tuple[str, ...]) -> list[str]:
    lines, later = [], []
    for key, value in table.items():
        if isinstance(value, Mapping):
            later += ["", f"[{_name((*path, key))}]", *_table(value, (*path, key))]
        elif isinstance(value, list | tuple) and value and path and all(isinstance(v, Mapping) for v in value):
            for row in value:
                later += ["", f"[[{_name((*path, key))}]]", *_flat(row)]
        else:
            lines.append(f"{_name((key,))} = {_value(value)}")
    return lines + later


def _flat(table: Mapping[str, Any]) -> list[str]:
    return [f"{_name((key,))} = {_value(value)}" for key, value in table.items()]


def _name(path: tuple[str, ...]) -> str:
    return ".".join(key if BARE.fullmatch(key) else json.dumps(key) for key in path)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else {math.inf: "inf", -math.inf: "-inf"}.get(value, "nan")
    if isinstance(value, Mapping):
        return "{ " + ", ".join(_flat(value)) + " }" if value else "{}"
    if isinstance(value, list | tuple):
        if value and all(isinstance(v, Mapping) for v in value):
            return "[\n" + "".join(f"  {_value(v)},\n" for v in value) + "]"
        return "[" + ", ".join(_value(v) for v in value) + "]"
    raise UsageError("TOML has no such value", value=repr(value))
