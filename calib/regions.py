"""What is not scene: the clock's LED panel and the like, as given, or found by its blinking."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.align import Region
from spikerig.calib.rig import Arm, RigCalibration
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.panel import Panel, two_rows
from spikerig.dataset.spikes import SpikeStream
from spikerig.dataset.texture import window_sum

Floats = NDArray[np.float64]
BIN = 16  # ticks that are counted together
BINS = 256  # at most, about the middle of the stream
SWING = 6  # counts a bin between on and off that a lamp has at least...
SHARE = 0.5  # ... and so much of what it counts when on
MIDDLE = 0.2  # share of bins that may lie between on and off
FLIPS = 4  # a lamp goes on and off so often at least
UNEVEN = 2  # bins by which its dwell times may differ
AREA = 6  # px, groups of fewer are noise
SPECK = 2  # px of one lamp at least
STRAY = 3.0  # px that lamps may lie off where the panel has them
GAP = 12  # px between lamps of one panel
RIM = 3.0  # px that a panel reaches beyond its lamps
LIGHT = 0.25  # of the picture: more than that blinking is the light, no panel


def panel_of(text: str, arm: Arm) -> Region:
    """A rectangle from a command line, "x0,y0,x1,y1" in raw pixels of an arm.

    Raises:
        UsageError: not four finite numbers, or no area.
    """
    try:
        x0, y0, x1, y1 = (float(part) for part in text.split(","))
    except ValueError:
        x0 = y0 = x1 = y1 = float("nan")
    if not (np.isfinite([x0, y0, x1, y1]).all() and x0 < x1 and y0 < y1):
        raise UsageError(
            "a panel is a rectangle of raw pixels", value=text, expected="x0,y0,x1,y1 with x0 < x1, y0 < y1"
        )
    return Region(arm, np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]))


def read_regions(path: Path) -> tuple[Region, ...]:
    """Polygons from a JSON file: [{"arm": "rgb", "polygon_px": [[x, y], ...]}, ...].

    Raises:
        DataError: the file cannot be read, or is something else.
    """
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
        return tuple(Region(_arm(row["arm"]), _polygon(row["polygon_px"])) for row in rows)
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise DataError("the regions cannot be read", value=f"{path}: {error}",
                        expected='[{"arm": "rgb", "polygon_px": [[x, y], ...]}]') from error  # fmt: skip


def _arm(name: Any) -> Any:
    if name not in ("spike", "rgb"):
        raise ValueError(f"{name!r} is no arm")
    return name


def _polygon(value: Any) -> Floats:
    corners = np.array(value, np.float64)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.isfinite(corners).all():
        raise ValueError(f"a polygon has three corners or more, this one is {corners.shape}")
    return corners


def check_regions(regions: Sequence[Region], calibration: RigCalibration) -> None:
    """Raise a UsageError for a region that lies wholly outside its arm's picture: pixels of another mode, perhaps."""
    for region in regions:
        camera = calibration.camera(region.arm)
        low, high = region.polygon_px.min(0), region.polygon_px.max(0)
        if (high <= 0).any() or (low >= [camera.width, camera.height]).any():
            raise UsageError("a region lies outside the picture", value=f"{region.arm} arm, {low} to {high} px",
                             expected=f"within {camera.width}x{camera.height} raw pixels")  # fmt: skip


def regions_json(regions: Sequence[Region]) -> list[dict[str, Any]]:
    """Regions as JSON-ready records, as `read_regions` reads them."""
    return [{"arm": r.arm, "polygon_px": r.polygon_px.tolist()} for r in regions]


def dwell_ticks(stream: SpikeStream) -> NDArray[np.float32]:
    """How long lamps stay on, or off: float32[H,W] ticks where a pixel's light is a square wave, 0 elsewhere.

    Args:
        stream: raw spikes, the camera still or moving.

    Edges:
        Lamps that dwell for less than two bins (0.8 ms at 40 kHz) look steady, or uneven; so do those that flip fewer
        than FLIPS times. A pixel that an edge crosses, even to and fro, dwells unevenly. Bins with lost ticks are left
        out.

    Cost:
        0.15 s for 4096 ticks of 400x250.
    """
    bins = min(stream.ticks // BIN, BINS)
    first, lost = (stream.ticks - bins * BIN) // 2, stream.lost_before()
    starts = [t for t in range(first, first + bins * BIN, BIN) if lost[t] == lost[t + BIN]]
    found = np.zeros((stream.height, stream.width), np.float32)
    if len(starts) <= FLIPS:
        return found
    counts = np.stack([window_sum(stream, t, t + BIN) for t in starts]).astype(np.int16)
    able = counts.max(0) - counts.min(0) >= SWING
    c = counts[:, able]
    if not c.size:
        return found
    off, on = (np.percentile(c, q, axis=0) for q in (10, 90))
    swing = on - off
    near = np.minimum(np.abs(c - off), np.abs(c - on)) <= np.maximum(0.2 * swing, 1)
    lamp = (swing >= SWING) & (swing >= SHARE * on) & (near.mean(0) >= 1 - MIDDLE)
    lit, dwell = c > (on + off) / 2, np.zeros(c.shape[1], np.float32)
    for k in np.flatnonzero(lamp):
        flips = np.flatnonzero(lit[1:, k] != lit[:-1, k])
        if len(flips) >= FLIPS and np.ptp(np.diff(flips)) <= UNEVEN:
            dwell[k] = BIN * np.diff(flips).mean()
    found[able] = dwell
    return found


def blinking_regions(stream: SpikeStream, panel: Panel | None = None) -> tuple[Region, ...]:
    """Where the clock's panel is, by its blinking lamps, in raw pixels of the spike arm.

    Args:
        stream: raw spikes.
        panel: what it shows; None: the usual one. Lamps that blink say where the others are, which do not in so short
            a stream: the lamps of two bits or more, in both rows, fix the whole panel.

    Returns:
        The whole panel where its lamps are recognised; else the hull of each group of lamps. Both with a rim.

    Edges:
        None where more than a quarter of the picture blinks: that is the light of the room.
    """
    dwell = dwell_ticks(stream)
    if not (0 < np.mean(dwell > 0) <= LIGHT):
        return ()
    whole = None if stream.rate_hz is None else _whole_panel(dwell, stream.rate_hz, panel or Panel())
    return _hulls(dwell > 0) if whole is None else (whole,)


def _whole_panel(dwell: NDArray[np.float32], rate_hz: float, panel: Panel) -> Region | None:
    """The panel of two rows that the lamps of known bits belong to; the affine map of its face is all that is fitted.

    A bit's lamp in one row and its complement in the other: their middles lie evenly spaced along the panel, bit by
    bit, and half their difference reaches from the middle to a row, whichever it is.
    """
    import cv2

    if panel.leds != two_rows(panel.bits):
        return None
    bits, middles, halves = [], [], []
    with np.errstate(divide="ignore"):
        exact = np.log2(dwell / (rate_hz * panel.step_ns * 1e-9)) - 1
    for bit in range(panel.bits - 1):
        here = np.abs(exact - bit) < 0.3
        _, _, stats, centres = cv2.connectedComponentsWithStats(here.astype(np.uint8))
        large = [k for k in np.argsort(-stats[1:, cv2.CC_STAT_AREA]) + 1 if stats[k, cv2.CC_STAT_AREA] >= SPECK]
        if len(large) == 2:
            bits.append(bit)
            middles.append((centres[large[0]] + centres[large[1]]) / 2 + 0.5)
            half = (centres[large[0]] - centres[large[1]]) / 2
            halves.append(half if not halves or half @ halves[0] > 0 else -half)
    if len(bits) < 2:
        return None
    terms = np.stack([np.ones(len(bits)), np.array(bits, np.float64)], -1)
    (start, along), *_ = np.linalg.lstsq(terms, np.array(middles), rcond=None)
    across = np.array(halves).mean(0)
    off = np.abs(terms @ np.stack([start, along]) - middles).max() + np.abs(halves - across).max()
    if off > STRAY or not np.linalg.norm(along) > 0:
        return None
    pitch, wide = float(np.linalg.norm(along)), float(np.linalg.norm(across))
    rim = 1.0 + RIM / pitch  # pitches: the board reaches beyond its lamps
    ends = start + along * (-1 - rim), start + along * (panel.bits + rim)
    out = across * (1 + rim * pitch / max(wide, RIM))
    return Region("spike", np.stack([ends[0] - out, ends[1] - out, ends[1] + out, ends[0] + out]))


def _hulls(here: NDArray[np.bool_]) -> tuple[Region, ...]:
    """Hulls of lamps that lie near each other."""
    import cv2

    reach = np.ones((GAP + 1, GAP + 1), np.uint8)
    count, labels = cv2.connectedComponents(cv2.dilate(here.astype(np.uint8), reach))
    found = []
    for k in range(1, count):
        y, x = np.nonzero(here & (labels == k))
        if len(x) < AREA:
            continue
        cells = np.concatenate([np.stack([x + i, y + j], -1) for i in (0, 1) for j in (0, 1)]).astype(np.float64)
        rim = np.concatenate([cells + RIM * np.array([i, j]) for i in (-1, 1) for j in (-1, 1)])
        hull = cv2.convexHull(rim.astype(np.float32))
        found.append(Region("spike", np.asarray(hull, np.float64).reshape(-1, 2)))
    return tuple(found)
