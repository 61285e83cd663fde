"""GoPro clips as they lie on disk: frames with their true times and exposures, and the camera's own telemetry.

Pictures are decoded elsewhere (gopro_pictures.py); here nothing but tables and telemetry is read, so it is quick and
needs no video library.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import NS, frozen_array
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.gopro_chapter import Chapter, Samples, read_chapter
from spikerig.dataset.gopro_times import nearest

CHAPTER = re.compile(r"(G[HXML])(\d\d)(\d{4})\.MP4", re.IGNORECASE)  # HEVC GX, AVC GH; chapter; number of the clip
LONGEST_S = 60.0  # an exposure or a read-out beyond it is no such thing


@dataclass(frozen=True, slots=True)
class GoProClip:
    """A clip, its chapters joined. Times are the camera's media time, which runs on its own crystal.

    Args:
        paths: of the chapters, in order; `chapter_frames[i]` frames lie in `paths[i]`.
        model, firmware, serial: from the header's MINF, FMWR, CASN; empty where it does not say.
        settings: the header's other keys (EISE, PRTN, EXPT, PIMX, PTWB, VFPS, VRES, ...).
        width, height: pixels.
        codec: of the pictures, as the file names it: "avc1", "hvc1".
        fps: frames a second by the video track.
        start_ns: int64[N], start of exposure of sensor row 0 of each frame, in the order shown.
        time_source: "CORI": the camera's stamps of frame starts; "pts": the video's own grid, where it has none.
        exposure_ns: int64[N], SHUT; None without.
        iso: float64[N], ISOE; None without.
        skipped: int64[N], sensor frames left out (positive) or shown twice (negative) just before each frame, MSKP.
        srot_ms: read-out time of the sensor, first row to last, SROT; None without.
        key: bool[N], frames coded by themselves; the others are predicted from them, and lag (docs/clock.md).
        streams: by key, e.g. "ACCL", "GYRO", "CORI".
        remarks: what was odd and how it was taken.
    """

    paths: tuple[Path, ...]
    chapter_frames: tuple[int, ...]
    model: str
    firmware: str
    serial: str
    settings: Mapping[str, Any]
    width: int
    height: int
    codec: str
    fps: float
    start_ns: NDArray[np.int64]
    time_source: str
    exposure_ns: NDArray[np.int64] | None
    iso: NDArray[np.float64] | None
    skipped: NDArray[np.int64]
    srot_ms: float | None
    key: NDArray[np.bool_]
    streams: Mapping[str, Samples]
    remarks: tuple[str, ...]

    def __post_init__(self) -> None:
        for name, kind in (("start_ns", np.int64), ("exposure_ns", np.int64), ("iso", float), ("skipped", np.int64),
                           ("key", bool)):  # fmt: skip
            if getattr(self, name) is not None:
                object.__setattr__(self, name, frozen_array(getattr(self, name), kind))

    @property
    def frames(self) -> int:
        """How many frames there are."""
        return len(self.start_ns)

    @property
    def duration_s(self) -> float:
        """Frames over the frame rate."""
        return self.frames / self.fps

    @property
    def row_ns(self) -> float | None:
        """Read-out time of one row of the picture, SROT / height; None where the camera does not say."""
        return None if self.srot_ms is None else self.srot_ms * 1e6 / self.height

    def frames_between(self, start_ns: int, end_ns: int) -> range:
        """Frames whose row 0 starts its exposure within [start_ns, end_ns), media time."""
        first, last = np.searchsorted(self.start_ns, [start_ns, end_ns])
        return range(int(first), int(last))


def chapters(path: str | Path) -> list[Path]:
    """The chapters of the clip that a file belongs to, in order, those that lie beside it: GX010042, GX020042, ...

    Raises:
        DataError: a chapter is missing between others.
    """
    target = Path(path)
    match = CHAPTER.fullmatch(target.name)
    if match is None or not target.parent.is_dir():
        return [target]
    found: dict[int, Path] = {}
    for other in target.parent.iterdir():
        m = CHAPTER.fullmatch(other.name)
        if m and (m[1].upper(), m[3]) == (match[1].upper(), match[3]):
            found[int(m[2])] = other
    numbers = sorted(found)
    if numbers and numbers != list(range(1, len(numbers) + 1)):
        missing = sorted(set(range(1, numbers[-1] + 1)) - set(numbers))
        raise DataError(
            "a chapter of the clip is missing", value=f"{target}: chapters {numbers}, missing {missing}",
            next="copy all chapters (same last four digits) from the card",
        )  # fmt: skip
    return [found[n] for n in numbers] or [target]


def open_gopro(path: str | Path | Sequence[str | Path]) -> GoProClip:
    """Read a clip: one file, or its chapters in order (see `chapters`).

    Raises:
        UsageError: no file given, or it does not exist.
        DataError: damaged, no video in it, telemetry that contradicts itself, chapters that do not belong together.
        HostError: a file may not be read.

    Cost:
        Some 10 ms and 1 ms a second of clip; the pictures are not read.
    """
    given = [Path(path)] if isinstance(path, str | Path) else [Path(p) for p in path]
    if not given:
        raise UsageError("a clip needs at least one file", value=[])
    parts = [read_chapter(p) for p in given]
    first = parts[0]
    for part in parts[1:]:
        same = [(p.video.width, p.video.height, p.video.format, p.settings.get("CASN")) for p in (first, part)]
        if same[0] != same[1]:
            raise DataError("chapters of different clips", value=part.path, expected=str(same[0]), cause=str(same[1]))
    remarks = [f"{p.path.name}: {r}" if len(parts) > 1 else r for p in parts for r in p.remarks]
    remarks += _follow(parts)
    start_ns = np.concatenate([p.start_ns for p in parts])
    lasting = sum(float(p.video.durations.sum()) / p.video.timescale for p in parts)
    exposure, iso, skipped = (_for_frames(parts, key) for key in ("SHUT", "ISOE", "MSKP"))
    settings = first.settings
    return GoProClip(
        paths=tuple(given),
        chapter_frames=tuple(len(p.start_ns) for p in parts),
        model=_said(settings, "MINF"),
        firmware=_said(settings, "FMWR"),
        serial=_said(settings, "CASN"),
        settings=settings,
        width=first.video.width,
        height=first.video.height,
        codec=first.video.format,
        fps=len(start_ns) / lasting,
        start_ns=start_ns,
        time_source="CORI" if all(p.source == "CORI" for p in parts) else "pts",
        exposure_ns=_exposures(first.path, exposure),
        iso=iso,
        skipped=np.zeros(len(start_ns), np.int64) if skipped is None else skipped.astype(np.int64),
        srot_ms=_srot(first.path, settings),
        key=np.concatenate([p.video.key[np.argsort(p.video.pts, kind="stable")] for p in parts]),
        streams=_joined(parts),
        remarks=tuple(remarks),
    )


def _follow(parts: list[Chapter]) -> list[str]:
    """Shift chapters whose stamps begin anew to follow the one before; tells which."""
    remarks = []
    for before, part in itertools.pairwise(parts):
        step = round(NS * float(part.video.durations[0]) / part.video.timescale)
        due = int(before.start_ns[-1]) + step
        if part.source == "CORI" and -step <= 2 * (int(part.start_ns[0]) - due) <= 2 * NS:
            continue  # the camera's stamps run through the chapters
        shift = due - int(part.start_ns[0])
        part.start_ns = part.start_ns + shift
        part.streams = {k: replace(s, at_ns=s.at_ns + shift) for k, s in part.streams.items()}
        remarks.append(f"{part.path.name}: its times begin anew; taken to follow the chapter before without a gap")
    return remarks


def _joined(parts: list[Chapter]) -> dict[str, Samples]:
    found: dict[str, Samples] = {}
    for key in dict.fromkeys(k for p in parts for k in p.streams):
        held = [p.streams[key] for p in parts if key in p.streams]
        if len({s.values.shape[1] for s in held}) != 1:
            raise DataError("chapters of different clips", cause=f"{key} changes its number of columns")
        values, at_ns = np.concatenate([s.values for s in held]), np.concatenate([s.at_ns for s in held])
        found[key] = replace(held[-1], values=values, at_ns=at_ns, stamped=all(s.stamped for s in held))
    return found


def _for_frames(parts: list[Chapter], key: str) -> NDArray[np.float64] | None:
    """The first column of a stream for each frame: the sample nearest in time, or by number without stamps."""
    if any(key not in p.streams or not len(p.streams[key].values) for p in parts):
        return None
    found = []
    for part in parts:
        samples, frames = part.streams[key], len(part.start_ns)
        if part.source == "CORI" and samples.stamped:
            rows = nearest(np.maximum.accumulate(samples.at_ns), part.start_ns)
        else:
            rows = ((np.arange(frames) + 0.5) * len(samples.values) / frames).astype(np.intp)
        found.append(samples.values[rows, 0])
    return np.concatenate(found)


def _exposures(path: Path, seconds: NDArray[np.float64] | None) -> NDArray[np.int64] | None:
    if seconds is None:
        return None
    wrong = ~((seconds > 0) & (seconds < LONGEST_S))  # catches NaN
    if wrong.any():
        raise DataError(
            "an exposure that cannot be", value=f"{path}: frame {int(np.argmax(wrong))}: {seconds[wrong][0]} s",
            expected=f"above 0, below {LONGEST_S:g} s", cause="damaged telemetry (SHUT)",
        )  # fmt: skip
    return np.rint(seconds * NS).astype(np.int64)


def _srot(path: Path, settings: Mapping[str, Any]) -> float | None:
    srot = settings.get("SROT")
    if srot is None:
        return None
    if not (isinstance(srot, float) and 0 < srot < 1e3 * LONGEST_S):
        raise DataError(
            "a read-out time that cannot be", value=f"{path}: SROT {srot}", expected="milliseconds above 0",
            cause="damaged telemetry header",
        )  # fmt: skip
    return srot


def _said(settings: Mapping[str, Any], key: str) -> str:
    said = settings.get(key, "")
    return said if isinstance(said, str) else ""
