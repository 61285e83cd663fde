"""Raw marks of clocks: what was seen, not what was fitted. A take keeps them all, so that a fit can be redone."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, TypeAlias

from spikerig.dataset.errors import DataError, UsageError

CLOCKS = ("host", "box", "spike", "rgb")  # clocks a mark may name; the rig's time is the box's, else the spike camera's


@dataclass(frozen=True, slots=True)
class Probe:
    """A clock was asked, or spoke by itself.

    Args:
        clock: whose time `device_ns` is.
        epoch: of that clock; a reset or step begins a new one.
        sent_ns: host time before the question left; None: the device spoke by itself (one-way).
        device_ns: the device's stamp, unwrapped. Of the spike camera: bytes received / (bytes a tick * nominal rate).
        received_ns: host time after the answer came.
    """

    clock: str
    epoch: int
    sent_ns: int | None
    device_ns: int
    received_ns: int


@dataclass(frozen=True, slots=True)
class Sight:
    """A camera saw the LED panel at an edge.

    Args:
        clock: "spike" or "rgb", whose time `device_ns` is.
        epoch: of that clock.
        device_ns: when the edge was seen, the camera's own time; of a rolling shutter already at the LED's own row.
        panel_ns: the panel's (box's) time of that edge.
        sigma_ns: standard deviation of the sighting.
        rising: the LED went on; response errors of a camera have opposite signs for on and off.
        led: number of the LED on the panel.
        row: sensor row of the LED; NaN-free: 0.0 for a global shutter.
        predicted: the video's frame was coded as changes to another: its encoder may leave out part of the edge.
    """

    clock: str
    epoch: int
    device_ns: int
    panel_ns: int
    sigma_ns: float
    rising: bool
    led: int
    row: float = 0.0
    predicted: bool = False


@dataclass(frozen=True, slots=True)
class Reset:
    """A clock began anew: `epoch` is the new one, `host_ns` when it was noticed, `why` in a few words."""

    clock: str
    epoch: int
    host_ns: int
    why: str


Mark: TypeAlias = Probe | Sight | Reset
_KINDS: dict[str, type] = {"probe": Probe, "sight": Sight, "reset": Reset}


class MarkLog:
    """Marks appended to a file, a JSON object a line. What `sync` returned for survives a crash.

    Raises:
        UsageError: the file exists and `resume` was not asked for.
    """

    def __init__(self, path: str | Path, *, resume: bool = False) -> None:
        self.path = Path(path)
        if self.path.exists():
            if not resume:
                raise UsageError("marks are there already", value=self.path, next="go on with --resume")
            whole = self.path.read_bytes()
            torn = len(whole) - (whole.rfind(b"\n") + 1)
            if torn:  # a crash in the middle of a line: the line was never acknowledged
                os.truncate(self.path, len(whole) - torn)
        self._file = self.path.open("ab")

    def add(self, marks: Iterable[Mark]) -> None:
        """Append marks; buffered."""
        for mark in marks:
            kind = type(mark).__name__.lower()
            self._file.write(json.dumps({"kind": kind, **asdict(mark)}, allow_nan=False).encode() + b"\n")

    def sync(self) -> None:
        """Push everything to the disk."""
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Sync and close; may be called twice."""
        if not self._file.closed:
            self.sync()
            self._file.close()


def read_marks(path: str | Path) -> Iterator[Mark]:
    """The marks of a file, in order; a torn last line (no newline) is left out.

    Raises:
        DataError: a whole line is no mark; it names the line.
    """
    with open(path, "rb") as file:
        for number, line in enumerate(file, 1):
            if not line.endswith(b"\n"):
                return
            try:
                told = json.loads(line)
                yield _mark(_KINDS[told.pop("kind")], told)
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                raise DataError(
                    "a line of the marks is no mark",
                    value=f"{path}, line {number}: {line[:80]!r}",
                    expected="a JSON object of kind probe, sight or reset",
                    cause=str(error),
                ) from error


def _mark(kind: type, told: dict[str, Any]) -> Mark:
    wanted = {f.name: str(f.type) for f in fields(kind)}
    for name, value in told.items():
        right: tuple[type, ...] = {"str": (str,), "int": (int,), "float": (int, float), "bool": (bool,)}.get(
            wanted[name], (int, type(None))
        )
        if not isinstance(value, right) or (isinstance(value, bool) and wanted[name] != "bool"):
            raise TypeError(f"{name} is {value!r}")
    mark = kind(**told)
    if mark.clock not in CLOCKS:
        raise ValueError(f"no clock named {mark.clock!r}")
    return mark
