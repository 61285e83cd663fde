"""Clocks that step, wrap, stutter or lie for a while: where a series of comparisons breaks, and what to leave out."""

from __future__ import annotations

import copy
from collections.abc import Hashable, Iterable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.clock_follow import CONFIRM, Follower
from spikerig.calib.clock_track import Int64, Pairs, Wander, middle_line
from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import UsageError

T = TypeVar("T", bound=Hashable)
BURST_S = 60.0  # marks that return to the old course within this were a burst, not a step
CELL_S = 0.5


@dataclass(frozen=True, slots=True)
class Part:
    """Comparisons between two breaks: their numbers, and by how much y - x jumped at the start (0: the first)."""

    number: Int64
    step_ns: float


def unwrap(stamps: Int64, period_ns: int, host_ns: Int64) -> Int64:
    """Undo the roll-over of a counter, by the host's time between stamps.

    Args:
        stamps: int64[N] device ns in [0, period_ns), in the order they were taken.
        period_ns: after which the counter begins anew: 2**32 counts.
        host_ns: int64[N], good to a third of the period.

    Returns:
        int64[N], rising with the host's time; the first stamp as it is.

    Edges: any number of turns may have passed between two stamps; duplicates stay duplicates.
    """
    if period_ns <= 0:
        raise UsageError("a counter's period is positive", value=period_ns)
    if not len(stamps):
        return np.zeros(0, np.int64)
    went = np.diff(stamps)
    turns = np.rint((np.diff(host_ns) - went).astype(np.float64) / period_ns).astype(np.int64)
    return stamps[0] + np.concatenate([[0], np.cumsum(went + turns * np.int64(period_ns))])


def once(marks: Iterable[T]) -> list[T]:
    """Marks without exact repetitions, in the order they came first."""
    return list(dict.fromkeys(marks))


def parts(pairs: Pairs, wander: Wander | None = None, least_ns: float = 50_000.0) -> tuple[list[Part], NDArray]:
    """Where y - x steps, and which pairs belong to bursts that contradict the marks around them.

    Args:
        pairs: in any order of x; what their constants do is taken off first, roughly.
        wander: what the clocks may do.
        least_ns: smaller steps are not told from noise; they are found when larger than this and 6 deviations.

    Returns:
        (parts, burst): at least one part where there are pairs; bool[N], pairs that are in none.

    Edges:
        A level that lasts less than 4 cells of 0.5 s, or that returns within 60 s, is a burst.
    """
    n = len(pairs.x_ns)
    burst = np.zeros(n, bool)
    cells = _cells(pairs)
    if not cells:
        return [], burst
    pairs = _without_constants(pairs)
    found: list[tuple[list[int], float]] = [([], 0.0)]
    follower = Follower(wander or Wander(), least_ns)
    follower.add(*_beginning(pairs, cells, least_ns))
    k = 0
    while k < len(cells):
        before = copy.deepcopy(follower)
        verdict = follower.add(*_middle(pairs, cells[k]))
        if verdict == "used":
            found[-1][0].append(k)
        elif verdict == "step":
            first = k - CONFIRM + 1
            back = _returns(pairs, cells, k, before, follower)
            if back:
                follower, k = before, back
                follower.far.clear()
                continue
            found[-1] = ([c for c in found[-1][0] if c < first], found[-1][1])
            found.append((list(range(first, k + 1)), follower.stepped_ns))
        k += 1
    inside = {c for held, _ in found for c in held}
    for c, which in enumerate(cells):
        if c not in inside:
            burst[which] = True
    told = [Part(np.sort(np.concatenate([cells[c] for c in held])), step) for held, step in found if held]
    return told, burst


def _cells(pairs: Pairs) -> list[Int64]:
    order = np.argsort(pairs.x_ns, kind="stable")
    if not len(order):
        return []
    number = (pairs.x_ns[order] - pairs.x_ns[order[0]]) // round(CELL_S * NS)
    return np.split(order, np.flatnonzero(np.diff(number)) + 1)


def _without_constants(pairs: Pairs) -> Pairs:
    """Pairs whose constants are fitted to what differs among neighbours, and taken off."""
    if not pairs.extra.shape[1]:
        return pairs
    order = np.argsort(pairs.x_ns, kind="stable")
    at_s = (pairs.x_ns - pairs.x_ns[order[0]]).astype(np.float64) / NS
    ahead = ((pairs.y_ns - pairs.y_ns[0]) - (pairs.x_ns - pairs.x_ns[0])).astype(np.float64)
    line, _ = middle_line(at_s, ahead, pairs.sd_ns)
    rows, rest = pairs.extra.copy(), ahead - line[1] * at_s
    for which in np.array_split(order, max(len(order) // max(12, len(order) // 500), 1)):
        rows[which] -= rows[which].mean(0)
        rest[which] -= np.median(rest[which])
    found = np.zeros(rows.shape[1])
    weight = np.diag(1 / pairs.prior**2) * float(np.median(pairs.sd_ns)) ** 2
    for _ in range(4):
        off = np.abs(rest - rows @ found)
        use = off <= 4 * max(1.4826 * float(np.median(off)), 1.0)
        found = np.linalg.solve(rows[use].T @ rows[use] + weight, rows[use].T @ rest[use])
    return replace(pairs, y_ns=pairs.y_ns - np.rint(pairs.extra @ found).astype(np.int64))


def _middle(pairs: Pairs, which: Int64) -> tuple[int, int, float]:
    """A cell as one mark: of its best pairs the one with the middle offset, and the deviation of a median."""
    best = which[pairs.sd_ns[which] <= 1.5 * pairs.sd_ns[which].min()]
    ahead = pairs.y_ns[best] - pairs.x_ns[best]
    at = best[np.argsort(ahead, kind="stable")[(len(best) - 1) // 2]]
    sd = float(np.median(pairs.sd_ns[best])) * 1.25 / np.sqrt(len(best))
    return int(pairs.x_ns[at]), int(pairs.y_ns[at]), max(sd, 500.0)


def _beginning(pairs: Pairs, cells: list[Int64], least_ns: float) -> tuple[int, int, float]:
    """The first cell that the next ones do not all contradict: a stray at the very start must not set the course."""
    heads = [_middle(pairs, c) for c in cells[: 2 * CONFIRM + 1]]
    for x, y, sd in heads:
        off = [abs((b - y) - (a - x)) <= least_ns + 2e-4 * abs(a - x) for a, b, _ in heads]
        if 2 * sum(off) > len(off):
            return x, y, max(sd, least_ns)
    return heads[0]


def _returns(pairs: Pairs, cells: list[Int64], k: int, before: Follower, after: Follower) -> int:
    """The first of several cells in a row, within a minute, that go on as before; 0 where there is none."""
    run = 0
    for c in range(k + 1, len(cells)):
        x, y, sd = _middle(pairs, cells[c])
        if x - before.last_ns > BURST_S * NS:
            return 0
        told, sigma = before.predict(x)
        near = abs(y - told) <= max(before.least_ns / 2, 3 * float(np.hypot(sigma, sd)))
        run = run + 1 if near and abs(y - told) < abs(y - after.predict(x)[0]) / 2 else 0
        if run == CONFIRM - 1:
            return c - run + 1
    return 0
