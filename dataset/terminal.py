"""Speaking to people (stderr) and to programs (stdout, one JSON document)."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

T = TypeVar("T")


def jsonable(value: Any) -> Any:
    """Plain JSON values from numpy scalars, arrays, paths and tuples; NaN and infinities become null."""
    if isinstance(value, dict):
        return {str(k): jsonable(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set):
        return [jsonable(v) for v in value]
    if hasattr(value, "tolist"):  # numpy and torch, without importing either
        return jsonable(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return str(value)


def emit(schema: str, document: dict[str, Any]) -> None:
    """Print the one JSON document of a `--json` run to stdout; `schema` names its layout, as in `spikerig.info/1`."""
    text = json.dumps({"schema": schema, **jsonable(document)}, allow_nan=False, indent=1)
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def note(text: str) -> None:
    """Print a line for people, to stderr."""
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


class Progress:
    """A progress line with an ETA on a terminal, a line every ten seconds elsewhere.

    Args:
        label: what is going on, e.g. "rendering views".
        total: number of steps; 0 when unknown.
        unit: what a step is, e.g. "view".
    """

    def __init__(self, label: str, total: int, unit: str = "") -> None:
        self.label, self.total, self.unit = label, total, unit
        self.start = self.told = time.monotonic()
        self.tty = sys.stderr.isatty()
        self.done = 0

    def step(self, n: int = 1, extra: str = "") -> None:
        """Count `n` steps and redraw at most five times a second."""
        self.done += n
        now = time.monotonic()
        last = self.total and self.done >= self.total
        if not last and now - self.told < (0.2 if self.tty else 10.0):
            return
        self.told = now
        spent = now - self.start
        left = spent / max(self.done, 1) * max(self.total - self.done, 0)
        count = f"{self.done}/{self.total}" if self.total else f"{self.done}"
        eta = f", {left:.0f} s left" if self.total and not last else f", {spent:.1f} s"
        text = f"{self.label}: {count} {self.unit}{eta}{'  ' + extra if extra else ''}"
        if self.tty:
            sys.stderr.write("\r\x1b[2K" + text + ("\n" if last else ""))
        else:
            sys.stderr.write(text + "\n")
        sys.stderr.flush()


def progress(items: Sequence[T], label: str, unit: str = "") -> Iterator[T]:
    """Iterate over `items` with a progress line."""
    bar = Progress(label, len(items), unit)
    for item in items:
        yield item
        bar.step()
