"""When a GoPro's frames and samples were: stamps of whole payloads spread to single frames and samples."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError
from spikerig.dataset.gpmf import Stream

_PACE = (0.5, 2.0)  # time between stamps over what the frame rate says: beyond it the stamps are no clock

Floats = NDArray[np.float64]


def bad_stamps(cause: str) -> DataError:
    """The one error for stamps that are no clock; the file is named by who reads it."""
    return DataError("the telemetry's times contradict themselves", cause=cause, next="copy the clip again")


def frame_times(cori: Sequence[Stream], skips: Sequence[Stream], grid_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Start of each frame, int64[max(N, stamps)] ns of the camera's media time; N of them are frames of the video.

    A payload's stamp is the start of its first frame; the frames between two stamps are spread evenly over the
    sensor's frames, of which MSKP tells how many were left out. Beyond the last stamp they go on at the last pace.

    Args:
        cori: the stamped streams of frames, a payload each.
        skips: MSKP of the same payloads, or empty.
        grid_ns: int64[N], the video's own times of the frames, for their number and nominal distance.

    Raises:
        DataError: stamps that step back, or run at less than half or more than double the nominal rate.
    """
    frames = len(grid_ns)
    counts = np.array([len(s.values) for s in cori])
    longest = max(frames, int(counts.sum()))
    sensor = np.arange(longest, dtype=np.float64)
    if skips:
        jumps = np.concatenate([s.values[:, 0] for s in skips])[:longest]
        if not np.all(np.isfinite(jumps)) or np.any(np.abs(jumps) > 1e6):
            raise bad_stamps("MSKP counts no frames")
        sensor[: len(jumps)] += np.cumsum(jumps)
        sensor[len(jumps) :] += jumps.sum()
        if np.any(np.diff(sensor) < 0):
            raise bad_stamps("MSKP repeats more frames than there are")
    nominal = float(grid_ns[-1] - grid_ns[0]) / 1e3 / max(frames - 1, 1) or 1e6 / 30
    first = np.cumsum(counts) - counts
    knots, stamps = sensor[np.minimum(first, longest - 1)], _stamps(cori)
    at_us = through("CORI", knots, stamps, sensor, nominal)
    return np.rint(at_us * 1e3).astype(np.int64)


def sample_times(
    key: str, held: Sequence[Stream], begun_us: Floats, lasts_us: Floats, frames: Sequence[NDArray[np.int64] | None]
) -> tuple[NDArray[np.int64], bool]:
    """Times of a stream's samples, int64 ns, and whether the camera's stamps gave them.

    Args:
        key: of the stream, for messages.
        held: the stream of each payload that has it.
        begun_us, lasts_us: float64[P], media time and duration of those payloads by the telemetry track.
        frames: starts of the frames of each of those payloads: as many samples as frames are one a frame.
    """
    counts = np.array([len(s.values) for s in held])
    first = (np.cumsum(counts) - counts).astype(np.float64)
    number = np.arange(counts.sum(), dtype=np.float64)
    if all(s.stamp_us is not None for s in held) and len(number):
        nominal = float(lasts_us.sum()) / len(number) or 1e6
        at_us = through(key, first, _stamps(held), number, nominal, strict=False)
        at_ns = np.rint(at_us * 1e3).astype(np.int64)
        for begin, many, starts in zip(first.astype(int), counts, frames, strict=True):
            if starts is not None and len(starts) == many:
                at_ns[begin : begin + many] = starts
        return at_ns, True
    steps = np.repeat(lasts_us / np.maximum(counts, 1), counts)
    at_us = np.repeat(begun_us, counts) + steps * (number - np.repeat(first, counts))
    return np.rint(at_us * 1e3).astype(np.int64), False


def through(key: str, knots: Floats, stamps: Floats, wanted: Floats, nominal: float, *, strict: bool = True) -> Floats:
    """Piecewise linear through (knots, stamps), going on at the last piece's pace; of one knot, at the nominal.

    Raises:
        DataError: the stamps do not increase; or `strict`, and a piece's pace is far off the nominal one.
    """
    keep = np.append(np.diff(knots) > 0, True)
    knots, stamps = knots[keep], stamps[keep]
    if len(knots) == 1:
        return stamps[0] + (wanted - knots[0]) * nominal
    pace = np.diff(stamps) / np.diff(knots)
    low, high = (_PACE[0] * nominal, _PACE[1] * nominal) if strict else (1e-9, np.inf)
    wrong = (pace < low) | (pace > high)
    if wrong.any():
        odd = float(pace[wrong][0])
        raise bad_stamps(f"stamps of {key} advance by {odd:.6g} us a sample; the frame rate says {nominal:.6g}")
    cell = np.clip(np.searchsorted(knots, wanted, side="right") - 1, 0, len(pace) - 1)
    return stamps[cell] + (wanted - knots[cell]) * pace[cell]


def nearest(at_ns: NDArray[np.int64], wanted_ns: NDArray[np.int64]) -> NDArray[np.intp]:
    """Index of the sample nearest in time to each wanted time; of two equally near the earlier. `at_ns` increases."""
    right = np.clip(np.searchsorted(at_ns, wanted_ns), 1, max(len(at_ns) - 1, 1))
    if len(at_ns) == 1:
        return np.zeros(len(wanted_ns), np.intp)
    left = right - 1
    return np.where(at_ns[right] - wanted_ns < wanted_ns - at_ns[left], right, left)


def _stamps(held: Sequence[Stream]) -> Floats:
    return np.array([s.stamp_us for s in held], np.float64)
