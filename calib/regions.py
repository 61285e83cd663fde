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
from spikerig.dataset.spikes import SpikeStream
from spikerig.dataset.texture import window_sum

Floats = NDArray[np.float64]
BIN = 16  # ticks that are counted together
BINS = 256  # at most, about the middle of the stream
SWING = 6  # counts a bin between on and off that a lamp has at least...
SHARE = 0.5  # ... and so much of what it counts when on
MIDDLE = 0.2  # share of bins that may lie between on and off
FLIPS = 6  # a lamp goes on and off so often at least
UNEVEN = 2  # bins by which its dwell times may differ
AREA = 6  # px, fewer are noise
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


def blinking(stream: SpikeStream) -> NDArray[np.bool_]:
    """Pixels whose light is a square wave, bool[H,W]: lamps that go on and off at an even pace.

    Args:
        stream: raw spikes, the camera still or moving; 1.5 ms or more for lamps of 0.4 ms on, 0.4 ms off.

    Edges:
        Lamps faster than two bins (0.8 ms at 40 kHz) look steady and are not found: a panel's slower ones show where it
        is. A pixel that an edge crosses, even to and fro, dwells unevenly. Bins with lost ticks are left out.

    Cost:
        0.15 s for 4096 ticks of 400x250.
    """
    bins = min(stream.ticks // BIN, BINS)
    first, lost = (stream.ticks - bins * BIN) // 2, stream.lost_before()
    starts = [t for t in range(first, first + bins * BIN, BIN) if lost[t] == lost[t + BIN]]
    found = np.zeros((stream.height, stream.width), bool)
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
    lit = c > (on + off) / 2
    for k in np.flatnonzero(lamp):
        flips = np.flatnonzero(lit[1:, k] != lit[:-1, k])
        lamp[k] = len(flips) >= FLIPS and np.ptp(np.diff(flips)) <= UNEVEN
    found[able] = lamp
    return found


def blinking_regions(stream: SpikeStream) -> tuple[Region, ...]:
    """Panels of lamps in a stream, each the hull of its lamps and a rim, in raw pixels of the spike arm.

    Edges:
        None where more than a quarter of the picture blinks: that is the light of the room.
    """
    import cv2

    here = blinking(stream)
    if here.mean() > LIGHT:
        return ()
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
