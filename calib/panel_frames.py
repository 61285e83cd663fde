"""The LED panel as a rolling shutter sees it: in a frame at most one slow LED is half lit, and how far says when."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.panel_read import Spot
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.marks import Sight
from spikerig.dataset.panel import Panel, count_from_gray

Floats = NDArray[np.float64]
SURE = 0.1  # an LED lit for less than this share of the exposure counts as off, for more than 1 - this as on
CONTRAST = 0.02  # of white, between on and off
HELD = 4  # frames that must show a level before it is believed
FLOOR = 0.002  # deviation of a share below which nothing is believed: quantisation, stray light


class Look(NamedTuple):
    """A frame: when row 0 began to be exposed (camera time), for how long, its linear light [H,W], and whether the
    video codes it as changes to another."""

    start_ns: int
    exposure_ns: int
    light: NDArray
    predicted: bool = False


@dataclass(frozen=True, slots=True)
class Seen:
    """What of F frames is kept: int64[F] times, float64[F,L] light of the spots and its deviation, float64[L] the
    spots' middle rows (the first row of the picture is 0), bool[F] whether it was predicted."""

    start_ns: NDArray[np.int64]
    exposure_ns: NDArray[np.int64]
    light: Floats
    noise: Floats
    row: Floats
    predicted: NDArray[np.bool_]


def read_frames(
    looks: Iterable[tuple[int, int, NDArray] | Look],
    panel: Panel,
    spots: Sequence[Spot],
    row_ns: float,
    *,
    epoch: int = 0,
    ahead_ns: int = 0,
    block: int = 1200,
) -> list[Sight]:
    """Sightings in frames: each half-lit slow LED gives one.

    Args:
        looks: (start_ns, exposure_ns, light[H,W]) a frame, light linear; or `Look`s. Read once, one at a time.
        panel: what is in view; its bits from `slow` on are read.
        spots: where its LEDs are.
        row_ns: time from row to row as far as known (SROT / rows); an error of it is solved for in the fit.
        epoch: of the camera's clock: the clip.
        ahead_ns: panel time minus the camera's, roughly (to half of the time after which the code repeats).
        block: frames whose on and off levels are found together.

    Raises:
        UsageError: exposure and read-out of a row of LEDs are too long for the panel's slow bits.
        DataError: no frame shows the panel.

    Source: with the exposure [s, e) of the LED's own row, a rising edge at t leaves the share (e - t) / (e - s),
        a falling one (t - s) / (e - s).
    """
    told: list[Sight] = []
    frames = 0
    banks = _banks(spots, panel)
    for seen in blocks(looks, spots, block):
        frames += len(seen.start_ns)
        for which in banks:
            told += _bank(seen, panel, [spots[k] for k in which], which, row_ns, epoch, ahead_ns)
    if not told:
        raise DataError(
            "no frame shows an edge of the panel", value=f"{frames} frames, {len(spots)} spots",
            cause="spots in the wrong place, a panel that is off, or frames that are clipped",
        )  # fmt: skip
    return sorted(told, key=lambda s: s.device_ns)


def blocks(looks: Iterable[tuple[int, int, NDArray] | Look], spots: Sequence[Spot], size: int) -> Iterator[Seen]:
    """What is kept of frames, `size` of them at a time; see `read_frames` for the arguments."""
    rows: list[tuple[int, int, Floats, Floats, bool]] = []
    disks: list[tuple[slice, slice, NDArray[np.bool_]]] = []
    for told in looks:
        start, exposure, light, predicted = told if isinstance(told, Look) else Look(*told)
        disks = disks or [s.disk(*light.shape[:2]) for s in spots]
        values = [np.asarray(light[r, c][inside], np.float64) for r, c, inside in disks]
        noise = np.array([v.std() / np.sqrt(len(v)) for v in values])
        rows.append((int(start), int(exposure), np.array([v.mean() for v in values]), noise, bool(predicted)))
        if len(rows) == size:
            yield _seen(rows, disks)
            rows.clear()
    if rows:
        yield _seen(rows, disks)


def _seen(
    rows: list[tuple[int, int, Floats, Floats, bool]], disks: Sequence[tuple[slice, slice, NDArray[np.bool_]]]
) -> Seen:
    start, exposure, light, noise, predicted = zip(*rows, strict=True)
    middle = np.array([r.start + np.nonzero(inside)[0].mean() for r, _, inside in disks])
    return Seen(
        np.array(start, np.int64), np.array(exposure, np.int64), np.stack(light), np.stack(noise), middle,
        np.array(predicted, bool),
    )  # fmt: skip


def _banks(spots: Sequence[Spot], panel: Panel) -> list[list[int]]:
    """Spots by rows of LEDs that each show every slow bit by themselves; one bank where they do not."""
    bits = [panel.leds[s.led].bit for s in spots]
    slow = sorted((k for k in range(len(spots)) if bits[k] >= panel.slow), key=lambda k: spots[k].y_px)
    if not slow:
        raise UsageError("no spot shows a slow bit", value=len(spots), expected=f"bits from {panel.slow} on")
    gaps = np.diff([spots[k].y_px for k in slow])
    cut = int(np.argmax(gaps)) + 1 if len(gaps) else 0
    halves = [slow[:cut], slow[cut:]]
    whole = set(range(panel.slow, max(bits) + 1))
    if all({bits[k] for k in half} == whole for half in halves):
        return halves
    return [slow]


def _bank(
    seen: Seen, panel: Panel, spots: list[Spot], which: list[int], row_ns: float, epoch: int, ahead_ns: int
) -> list[Sight]:
    """Sightings of one bank in one block."""
    rows = seen.row[which]
    word_ns = panel.step_ns << panel.slow
    if int(seen.exposure_ns.max()) + float(np.ptp(rows)) * row_ns > word_ns:
        raise UsageError(
            "the exposure is too long for the panel: two LEDs may change in it",
            value=f"{seen.exposure_ns.max() / 1e3:.0f} us and {np.ptp(rows) * row_ns / 1e3:.0f} us between rows",
            expected=f"at most {word_ns / 1e3:.0f} us",
            next="a shorter shutter, or a panel whose slow bits start later",
        )  # fmt: skip
    found = shares(seen.light[:, which])
    if found is None:
        return []
    share, contrast, sure = found
    bit = np.array([panel.leds[s.led].bit for s in spots]) - panel.slow
    inverted = np.array([panel.leds[s.led].inverted for s in spots])
    code = np.where(inverted, 1 - share, share)
    half = (code > SURE) & (code < 1 - SURE)
    sd = np.hypot(seen.noise[:, which] / contrast, FLOOR)
    told = []
    for frame in np.flatnonzero((half & sure).any(1) & _single(half, bit)).tolist():
        at = int(seen.start_ns[frame])
        edge = _edge(code[frame], half[frame], bit, word_ns, at + ahead_ns)
        if edge is None:
            continue
        panel_ns, bit_on = edge
        for k in np.flatnonzero(half[frame] & sure).tolist():
            rising = bit_on ^ bool(inverted[k])
            into = 1 - share[frame, k] if rising else share[frame, k]
            length = float(seen.exposure_ns[frame])
            told.append(
                Sight("rgb", epoch, at + round(rows[k] * row_ns + into * length), panel_ns,
                      float(sd[frame, k]) * length, rising, spots[k].led, float(rows[k]),
                      bool(seen.predicted[frame]))
            )  # fmt: skip
    return told


def _single(half: NDArray[np.bool_], bit: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Frames in which all half-lit LEDs show the same bit."""
    low = np.where(half, bit, 99).min(1)
    high = np.where(half, bit, -1).max(1)
    return low == high


def shares(light: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]] | None:
    """Light [F,L] as a share between each LED's off and on; None where none blinks.

    Returns:
        shares [F,L]; on minus off [L]; bool[L], LEDs that show both levels themselves, in several frames each. Those of
        the others are those of the rest: enough to tell on from off, not to tell how far.
    """
    low, high = np.percentile(light, (2, 98), axis=0)
    moving = high - low > max(CONTRAST, 0.5 * float((high - low).max(initial=0)))
    sure = np.zeros(len(low), bool)
    for k in np.flatnonzero(moving).tolist():  # medians of what is clearly off or on: extremes would be noise
        middle, span = (low[k] + high[k]) / 2, high[k] - low[k]
        off, on = light[:, k][light[:, k] < middle - 0.4 * span], light[:, k][light[:, k] > middle + 0.4 * span]
        low[k] = np.median(off) if len(off) else low[k]
        high[k] = np.median(on) if len(on) else high[k]
        sure[k] = all(
            (np.abs(row - level) <= 0.1 * span).sum() >= HELD for row, level in ((off, low[k]), (on, high[k]))
        )
    known = sure if sure.any() else moving
    if not known.any():
        return None
    low = np.where(known, low, np.median(low[known]))
    high = np.where(known, high, np.median(high[known]))
    return (light - low) / (high - low), high - low, sure


def _edge(
    code: Floats, half: NDArray[np.bool_], bit: NDArray[np.int64], word_ns: int, near_ns: int
) -> tuple[int, bool] | None:
    """Panel time of the one edge in a frame, nearest to `near_ns`, and whether its bit went on; None: not a code."""
    words = [0, 0]
    turning = int(bit[half][0])
    bits = int(bit.max()) + 1
    for b in range(bits):
        lit = code[bit == b]
        if not len(lit):
            return None
        if b == turning:
            words[1] |= 1 << b
        elif (lit > 0.5).all():
            words = [w | 1 << b for w in words]
        elif (lit > 0.5).any():
            return None  # an LED and its complement contradict each other
    off, on = (int(v) for v in count_from_gray(words))
    wrap = 1 << bits
    if (on - off) % wrap not in (1, wrap - 1):
        return None  # no neighbours: something was misread
    bit_on = (on - off) % wrap == 1
    at = (on if bit_on else off) * word_ns
    turns = round((near_ns - at) / (wrap * word_ns))
    return at + turns * wrap * word_ns, bit_on
