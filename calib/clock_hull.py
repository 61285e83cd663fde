"""One-way stamps: a message cannot come before it is sent, so the fastest ones lie on a lower hull. How far the hull
lies above the truth is the smallest latency, and that no stamp can tell: it comes as a bound, never as a correction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.clock_track import Floats, Int64, Pairs
from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DataError
from spikerig.dataset.marks import Probe

WINDOW_S = 20.0  # a hull is of straight lines: within this the clocks' wander is below a microsecond
ASSUMED_NS = 5_000_000  # the floor latency is believed to be below this where nothing bounds it


@dataclass(frozen=True, slots=True)
class Floor:
    """The stamps that lie on the hull.

    Args:
        pairs: device time and host time of arrival.
        bias_ns: the true host time lies between this much before the hull, and the hull.
        proved: the bound follows from marks (a command sent before a known device time); else it is assumed.
        number: which of the probes given they are.
    """

    pairs: Pairs
    bias_ns: float
    proved: bool
    number: Int64


def lower_hull(x: Floats, y: Floats) -> Int64:
    """Numbers of the points on the lower convex hull, by x. Of points with one x the lowest counts.

    Source: Andrew's monotone chain; as a clock estimator: Zhang, Liu, Xia, INFOCOM 2002.
    """
    order = np.lexsort((y, x))
    hull: list[int] = []
    for i in order.tolist():
        if hull and x[hull[-1]] == x[i]:
            continue
        while len(hull) > 1:
            a, b = hull[-2], hull[-1]
            if (y[b] - y[a]) * (x[i] - x[a]) < (y[i] - y[a]) * (x[b] - x[a]):
                break
            hull.pop()
        hull.append(i)
    return np.array(hull, np.int64)


def hull_floor(probes: Sequence[Probe], assumed_ns: float = ASSUMED_NS) -> Floor:
    """The fastest stamps of every 20 s, and how late even they may be.

    Args:
        probes: of one clock and epoch. Those with a `sent_ns` (a start command: the device's time began after it)
            bound the latency; all are used as arrivals.
        assumed_ns: bound where no probe has a `sent_ns`.

    Raises:
        DataError: an arrival lies before a command that caused it.
    """
    device = np.array([p.device_ns for p in probes], np.int64)
    host = np.array([p.received_ns for p in probes], np.int64)
    if not len(device):
        raise DataError("a clock has no stamps")
    start = (device.min(), host[np.argmin(device)])
    at_s = (device - start[0]).astype(np.float64) / NS
    late = ((host - start[1]) - (device - start[0])).astype(np.float64)
    window = np.floor(at_s / WINDOW_S).astype(np.int64)
    chosen, sd = [], []
    for k in np.unique(window).tolist():
        inside = np.flatnonzero(window == k)
        corner = inside[lower_hull(at_s[inside], late[inside])]
        above = late[inside] - np.interp(at_s[inside], at_s[corner], late[corner])
        # Of n exponential delays with mean m, the hull's corners lie about m * corners / n above the floor.
        tail = float(above.mean()) * max(len(corner), 2) / max(len(inside) - len(corner), 1)
        corner = corner[_inner(at_s[corner], late[corner], tail)]
        chosen.append(corner)
        sd.append(np.full(len(corner), max(tail, 1000.0)))
    number = np.concatenate(chosen)
    bias, proved = _bound(probes, at_s, late, start, assumed_ns)
    return Floor(Pairs.plain(device[number], host[number], np.concatenate(sd)), bias, proved, number)


def _inner(x: Floats, y: Floats, tail: float) -> NDArray[np.bool_]:
    """Corners of a hull that lie near its middle edge's line: those at the ends are only the first and last stamps."""
    if len(x) < 2:
        return np.ones(len(x), bool)
    k = min(int(np.searchsorted(x, (x[0] + x[-1]) / 2, side="right")), len(x) - 1)
    a, b = k - 1, k
    line = y[a] + (x - x[a]) * ((y[b] - y[a]) / (x[b] - x[a]))
    return y - line <= max(5 * tail, 5000.0)


def _bound(
    probes: Sequence[Probe], at_s: Floats, late: Floats, start: tuple[int, int], assumed_ns: float
) -> tuple[float, bool]:
    asked = [i for i, p in enumerate(probes) if p.sent_ns is not None]
    if not asked:
        return float(assumed_ns), False
    bound = np.inf
    for i in asked:
        near = np.abs(at_s - at_s[i]) <= WINDOW_S
        hull = np.flatnonzero(near)[lower_hull(at_s[near], late[near])]
        least = float(np.interp(at_s[i], at_s[hull], late[hull]))
        sent = float((probes[i].sent_ns - start[1]) - (probes[i].device_ns - start[0]))  # type: ignore[operator]
        bound = min(bound, least - sent)
    if bound < 0:
        raise DataError("a stamp arrived before the command that began its clock", value=f"{bound:.0f} ns")
    return float(bound), True
