"""A raw take on disk, as `rig record` leaves it: what it says of itself, its views, and any span of its spike bytes.

A take comes from a crash as often as from a good end, and may come from others: nothing in it is believed unchecked.
"""

from __future__ import annotations

import json
from bisect import bisect_right
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, RigError, UsageError
from spikerig.dataset.scene import Finding
from spikerig.dataset.segments import Chunk, Damage, scan
from spikerig.dataset.wire import WireProfile

FORMAT, VERSION = "spikerig-take", 1
READ_AT_MOST = 1 << 30  # bytes at once


@dataclass(frozen=True, slots=True)
class TakenView:
    """A viewpoint as recorded.

    Args:
        name: of the viewpoint.
        attempt: from 1; a retake counts up.
        start_ns, stop_ns: host time around the recording.
        epoch: of the spike stream when it ended.
        spikes: (epoch, first byte, byte past the last) of each unbroken piece of the stream.
        clips: names of files in rgb/, once they are there.
        checks: what the live checks said.
        kept: the operator (or the loop) took it.
        clip: what the RGB camera told of its recording: name, bytes, host times around start and stop; None without.
    """

    name: str
    attempt: int
    start_ns: int
    stop_ns: int
    spikes: tuple[tuple[int, int, int], ...]
    clips: tuple[str, ...] = ()
    checks: Mapping[str, Any] = field(default_factory=dict)
    kept: bool = True
    clip: Mapping[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class RawTake:
    """A take's own words: `take.json`, checked. `number` is in every chunk of its segments."""

    folder: Path
    status: str
    number: int
    plan: Mapping[str, Any]
    devices: tuple[Mapping[str, Any], ...]
    profile: WireProfile
    more: Mapping[str, Any]

    @property
    def segments(self) -> list[Path]:
        """The segment files, in order."""
        return sorted((self.folder / "spikes").glob("[0-9]*.seg"))

    def views(self) -> list[TakenView]:
        """The last word on each viewpoint, in the order they were first taken; a torn last line is left out.

        Raises:
            DataError: a line is no view.
        """
        last: dict[str, TakenView] = {}
        for number, told in read_lines(self.folder / "views.jsonl"):
            try:
                view = _view(told)
            except (KeyError, TypeError, ValueError) as error:
                raise DataError(
                    "a line of the views is no view", value=f"{self.folder / 'views.jsonl'}, line {number}: {error}"
                ) from error
            last[view.name] = view
        return list(last.values())


def open_take(folder: str | Path) -> RawTake:
    """A take's `take.json`.

    Raises:
        UsageError: the folder is not there or holds no take.
        DataError: it is damaged, or of a newer version.
    """
    folder = Path(folder)
    path = folder / "take.json"
    if not path.is_file():
        raise UsageError("this folder holds no take", value=folder, expected="a folder with take.json",
                         next="spikerig rig record PLAN.toml -o TAKE makes one")  # fmt: skip
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        if told["format"] != FORMAT or int(told["version"]) > VERSION:
            raise ValueError(f"format {told['format']!r}, version {told['version']!r}")
        wire = dict(told["wire"])
        names = {f.name for f in fields(WireProfile)}
        profile = WireProfile(**{k: v for k, v in wire.items() if k in names})
        take = RawTake(
            folder, str(told["status"]), int(told["number"]), dict(told["plan"]),
            tuple(dict(d) for d in told["devices"]), profile, told,
        )  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError, UsageError) as error:
        raise DataError("the take's own description is damaged", value=f"{path}: {error}",
                        expected=f"{FORMAT}, version {VERSION}") from error  # fmt: skip
    if not 0 <= take.number < 2**64 or take.profile.tick_bytes > 1 << 27:
        raise DataError("the take's own description is damaged", value=f"{path}: sizes out of range")
    return take


def read_lines(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """The JSON objects of a file, a line each, numbered from 1; a torn last line is left out, no file is no lines.

    Raises:
        DataError: a whole line is no JSON object.
    """
    if not path.exists():
        return
    with path.open("rb") as file:
        for number, line in enumerate(file, 1):
            if not line.endswith(b"\n"):
                return
            try:
                told = json.loads(line)
                if not isinstance(told, dict):
                    raise ValueError("not an object")
            except (ValueError, RecursionError) as error:
                raise DataError("a line is no JSON object", value=f"{path}, line {number}: {error}") from error
            yield number, told


def _view(told: dict[str, Any]) -> TakenView:
    spikes = tuple((int(e), int(a), int(b)) for e, a, b in told["spikes"])
    clips = tuple(str(c) for c in told["clips"])
    if any(Path(c).name != c for c in clips):
        raise ValueError(f"clips are file names, not {clips}")
    if any(not 0 <= a <= b for _, a, b in spikes):
        raise ValueError(f"spans of bytes run forward, not {spikes}")
    return TakenView(
        str(told["name"]), int(told["attempt"]), int(told["start_ns"]), int(told["stop_ns"]), spikes, clips,
        dict(told["checks"]), bool(told["kept"]), None if told.get("clip") is None else dict(told["clip"]),
    )  # fmt: skip


class WireBytes:
    """The spike bytes of a take by epoch and byte; payloads are read and checked when they are asked for.

    Raises:
        UsageError, HostError, DataError: as `segments.scan`.

    Cost:
        Opening reads 4 KiB a chunk; reading holds what was asked for and one chunk.
    """

    def __init__(self, take: RawTake) -> None:
        self.take = take
        self.damage: list[Damage] = []
        self.chunks: dict[int, list[Chunk]] = {}
        for path in take.segments:
            for found in scan(path, take=take.number, verify=False):
                if isinstance(found, Damage):
                    self.damage.append(found)
                else:
                    self.chunks.setdefault(found.head.epoch, []).append(found)
        for row in self.chunks.values():
            row.sort(key=lambda c: c.head.byte_index)
        self._starts = {e: [c.head.byte_index for c in row] for e, row in self.chunks.items()}
        self._held: tuple[Chunk, NDArray[np.uint8]] | None = None

    @property
    def profile(self) -> WireProfile:
        """Of the wire."""
        return self.take.profile

    def span(self, epoch: int) -> tuple[int, int]:
        """First byte, and byte past the last, that an epoch has on disk; (0, 0) where it has none."""
        row = self.chunks.get(epoch, [])
        return (row[0].head.byte_index, row[-1].head.byte_index + row[-1].head.payload) if row else (0, 0)

    def read(self, epoch: int, start: int, stop: int) -> tuple[NDArray[np.uint8], list[tuple[int, int]]]:
        """Bytes [start, stop) of an epoch, zero where there are none, and the half-open ranges that are missing."""
        if not 0 <= start <= stop or stop - start > READ_AT_MOST:
            raise UsageError("a span of bytes runs forward, at most 1 GiB", value=(start, stop))
        out = np.zeros(stop - start, np.uint8)
        missing: list[tuple[int, int]] = []
        at = start
        row = self.chunks.get(epoch, [])
        k = max(bisect_right(self._starts.get(epoch, []), start) - 1, 0)
        for chunk in row[k:]:
            first, last = chunk.head.byte_index, chunk.head.byte_index + chunk.head.payload
            if first >= stop:
                break
            if last <= at:
                continue
            data = self._payload(chunk)
            if data is None:
                continue
            if first > at:
                missing.append((at, first))
                at = first
            end = min(last, stop)
            out[at - start : end - start] = data[at - first : end - first]
            at = end
        if at < stop:
            missing.append((at, stop))
        return out, missing

    def suspect(self, epoch: int, start: int, stop: int) -> list[tuple[int, int]]:
        """Which of these bytes of an epoch may lie behind a loss that ended it."""
        end = self.span(epoch)[1]
        after = self.chunks.get(epoch + 1, [])
        bytes_ = after[0].head.suspect if after else 0
        first = max(start, end - bytes_)
        return [(first, min(stop, end))] if first < min(stop, end) else []

    def _payload(self, chunk: Chunk) -> NDArray[np.uint8] | None:
        if self._held is None or self._held[0] is not chunk:
            try:
                self._held = (chunk, chunk.read())
            except DataError:
                self.damage.append(Damage(chunk.path, chunk.offset, chunk.head.stored, "its bytes are damaged"))
                return None
        return self._held[1]


def verify_take(folder: str | Path) -> tuple[list[Finding], dict[str, Any]]:
    """Check every chunk of a take, and that no byte is missing unsaid.

    Returns:
        Findings ("error": damaged or missing unsaid; "warning": lost and said so; "note": not finished),
        and figures: chunks, bytes, epochs, lost bytes, views kept.

    Raises:
        UsageError, DataError: no take, or one whose description is damaged.
    """
    take = open_take(folder)
    told: list[Finding] = []
    figures = {"status": take.status, "chunks": 0, "bytes": 0, "epochs": 0, "lost_transport": 0, "lost_recorder": 0}
    if take.status != "complete":
        told.append(Finding("status", "note", "take.json", f"the take is '{take.status}'",
                            "spikerig rig record PLAN.toml -o TAKE --resume goes on with it"))  # fmt: skip
    last: Chunk | None = None
    for path in take.segments:
        for found in scan(path, take=take.number):
            if isinstance(found, Damage):
                told.append(Finding("chunk", "error", f"{path.name} at {found.offset}",
                                    f"{found.length} bytes: {found.why}"))  # fmt: skip
                continue
            told += _followed(last, found)
            figures["chunks"] += 1
            figures["bytes"] += found.head.payload
            figures["epochs"] += last is None or last.head.epoch != found.head.epoch
            figures["lost_transport"] += found.head.lost_transport
            figures["lost_recorder"] += found.head.lost_recorder
            last = found
    try:
        views = take.views()
        figures["views_kept"] = sum(v.kept for v in views)
    except RigError as error:
        told.append(Finding("views", "error", "views.jsonl", f"{error.what}: {error.value}"))
    return told, figures


def _followed(before: Chunk | None, chunk: Chunk) -> list[Finding]:
    """What is amiss between a chunk and the one before it."""
    head, where = chunk.head, f"{chunk.path.name}, chunk {chunk.head.number}"
    told = []
    if head.lost_transport or head.lost_recorder or (head.why and head.why != "start"):
        told.append(Finding("loss", "warning", where, f"{head.lost_transport} bytes lost on the link, "
                            f"{head.lost_recorder} in the recorder ({head.why or 'no reason told'})"))  # fmt: skip
    if before is None:
        if head.number:
            told.append(Finding("order", "error", where, f"{head.number} chunks before it are missing"))
        return told
    if head.number != before.head.number + 1:
        told.append(Finding("order", "error", where,
                            f"{head.number - before.head.number - 1} chunks before it are missing"))  # fmt: skip
    elif head.epoch == before.head.epoch:
        gap = head.byte_index - before.head.byte_index - before.head.payload
        said = head.lost_recorder + head.skipped
        if gap != said:
            told.append(Finding("gap", "error", where, f"{gap} bytes are missing before it, not {said}"))
    return told
