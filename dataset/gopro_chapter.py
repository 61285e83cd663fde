"""One file of a GoPro clip, timed by itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import NS, frozen_array
from spikerig.dataset.errors import DataError
from spikerig.dataset.gopro_times import frame_times, sample_times
from spikerig.dataset.gpmf import Stream, header, streams
from spikerig.dataset.mp4_boxes import Movie, Track, damaged, read_movie, read_samples


@dataclass(frozen=True, slots=True)
class Samples:
    """One sensor's samples over a whole clip.

    Args:
        name, unit: as the camera tells them.
        at_ns: int64[N], the camera's media time of each sample, interpolated between the stamps.
        values: float64[N,C], scaled to the unit.
        stamped: times come from the camera's stamps (STMP); False: samples are spread evenly over each payload.
        extra: single numbers that came with the last payload, e.g. TMPC, the temperature in degrees Celsius.
    """

    name: str
    unit: str
    at_ns: NDArray[np.int64]
    values: NDArray[np.float64]
    stamped: bool
    extra: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "at_ns", frozen_array(self.at_ns, np.int64))
        object.__setattr__(self, "values", frozen_array(self.values, np.float64))


@dataclass
class Chapter:
    """One file, timed by itself."""

    path: Path
    video: Track
    settings: dict[str, Any]
    start_ns: NDArray[np.int64]
    source: str
    streams: dict[str, Samples]
    remarks: list[str]


def read_chapter(path: Path) -> Chapter:
    """Read one file's tables and telemetry.

    Raises:
        UsageError, DataError, HostError: as `read_movie`; no video in it; telemetry that contradicts itself.
    """
    movie = read_movie(path)
    video = next((t for t in movie.tracks if t.handler == "vide" and len(t.sizes)), None)
    if video is None:
        raise damaged(path, "there is no video in it")
    if not video.durations.sum() or not (video.width and video.height):
        raise damaged(path, "its video has no length or no size")
    grid_ns = np.rint((np.sort(video.pts) - video.pts.min()) * (NS / video.timescale)).astype(np.int64)
    try:
        told = header(movie.user.get("GPMF", b"")).get("1", {})
        payloads, track = _payloads(movie)
        stamps_ns, source, remarks = _frames(payloads, grid_ns)
        found = {
            key: _samples(key, payloads, track, stamps_ns) for key in dict.fromkeys(k for p in payloads for k in p)
        }
    except DataError as error:
        raise DataError(error.what, value=path, cause=error.cause, next=error.next) from error
    return Chapter(path, video, told, stamps_ns[: len(grid_ns)], source, found, remarks)


def _payloads(movie: Movie) -> tuple[list[dict[str, Stream]], Track | None]:
    """The streams of each payload by key, the first of each; and the track they lie in."""
    track = next((t for t in movie.tracks if t.format == "gpmd"), None)
    found: list[dict[str, Stream]] = []
    for payload in read_samples(movie.path, track) if track else ():
        by_key: dict[str, Stream] = {}
        for stream in streams(payload):
            by_key.setdefault(stream.key, stream)
        found.append(by_key)
    return found, track


def _frames(payloads: list[dict[str, Stream]], grid_ns: NDArray[np.int64]) -> tuple[NDArray[np.int64], str, list[str]]:
    if not payloads:
        return grid_ns, "pts", ["no telemetry: times are the video's own grid, exposures are not known"]
    cori = [p["CORI"] for p in payloads if "CORI" in p and p["CORI"].stamp_us is not None]
    if not cori:
        return grid_ns, "pts", ["no stamps of frames (CORI): times are the video's own grid"]
    remarks = []
    stamped = sum(len(s.values) for s in cori)
    if abs(stamped - len(grid_ns)) > 2:
        remarks.append(f"{stamped} stamps of frames (CORI) for {len(grid_ns)} frames")
    skips = [p["MSKP"] for p in payloads if "MSKP" in p]
    counted = sum(len(s.values) for s in skips)
    if skips and counted != stamped:
        remarks.append(f"{counted} counts of skipped frames (MSKP) for {stamped} frames: not used")
        skips = []
    start_ns = frame_times(cori, skips, grid_ns)
    odd = int(sum(np.abs(s.values[:, 0]).sum() for s in skips))
    if odd:
        remarks.append(f"{odd} frames skipped or repeated between sensor and encoder (MSKP)")
    return start_ns, "CORI", remarks


def _samples(key: str, payloads: list[dict[str, Stream]], track: Track | None, stamps_ns: NDArray[np.int64]) -> Samples:
    held = [(n, p[key]) for n, p in enumerate(payloads) if key in p]
    if track is None or len({s.values.shape[1] for _, s in held}) != 1:
        raise DataError("the telemetry contradicts itself", cause=f"{key} changes its number of columns")
    rows, unit_us = [n for n, _ in held], np.float64(1e6 / track.timescale)
    found = [s for _, s in held]
    many = [len(p["CORI"].values) if "CORI" in p and p["CORI"].stamp_us is not None else 0 for p in payloads]
    ends = np.cumsum(many).tolist()
    frames = [stamps_ns[ends[n] - many[n] : ends[n]] if many[n] else None for n in rows]
    at_ns, stamped = sample_times(key, found, track.dts[rows] * unit_us, track.durations[rows] * unit_us, frames)
    last = found[-1]
    return Samples(last.name, last.unit, at_ns, np.concatenate([s.values for s in found]), stamped, last.extra)
