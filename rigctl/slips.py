"""Losses that time could not see: bytes that left a stream in its middle, told from where ticks begin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.framing import FEWEST, byte_counts, find_phase, find_shift, rates_at, seam_scores
from spikerig.dataset.wire import WireProfile

LOOK_TICKS, EVERY_TICKS = 32, 128  # of a look, and between two
SEAM_TICKS = 256  # of a stretch whose edges are looked at
LEAST_GAIN = 8.0  # nats by which the edges must have moved
MOST_STRETCHES = 16  # on each side
SURE = 0.999
MOST_TRIED = 3  # places

Spans = Sequence[tuple[int, int, int]]


class Stream(Protocol):
    """Wire bytes by epoch and byte, as `rawtake.WireBytes` has them."""

    @property
    def profile(self) -> WireProfile:
        """Of the wire."""
        ...

    def read(self, epoch: int, start: int, stop: int) -> tuple[NDArray[np.uint8], list[tuple[int, int]]]:
        """Bytes [start, stop) of an epoch, and the ranges of them that are missing."""
        ...


@dataclass(frozen=True, slots=True)
class Missing:
    """Bytes that are not in the stream though nothing said so.

    Args:
        epoch: of the stream.
        after, before: the loss lies between these bytes that came.
        lost: how many bytes, less whole ticks: those cannot be told.
    """

    epoch: int
    after: int
    before: int
    lost: int


def find_slips(wire: Stream, spans: Spans) -> list[Missing]:
    """Small losses within viewpoints, in order.

    Args:
        wire: the bytes as they came.
        spans: (epoch, first byte, byte past the last) of viewpoints.

    Edges:
        A picture that moves by a row looks like a loss of a row's bytes. So without tags a shift is believed only
        where it comes at once, within some 3 ms; and one of whole rows (a byte more or less) only where the picture's
        edges moved, too. Whole ticks that are lost move nothing: only time can tell them. Losses between viewpoints
        are not looked for: framing that differs between viewpoints is refused by `Framing`.

    Cost:
        A look of 32 ticks every 128: a quarter of the bytes is looked at, about 15 ms a look at 400x250.
    """
    found: list[Missing] = []
    size = wire.profile.tick_bytes
    for epoch, start, stop in sorted(set(spans)):
        begin = -(-start // size) * size
        looks = list(range(begin, stop - LOOK_TICKS * size, EVERY_TICKS * size))
        if len(looks) > 1:
            looks.append((stop // size - LOOK_TICKS) * size)
        after = begin
        for a, b in pairwise(looks):
            if a < after or not shift_between(wire, epoch, a, b):
                continue
            slip = narrow(wire, epoch, a, b)
            sure = None if slip is None else settled(wire, slip[0], spans, slip[1])
            if sure is not None:
                found.append(sure)
                after = sure.before
    return found


def shift_between(wire: Stream, epoch: int, first: int, second: int) -> int:
    """By how many bytes ticks surely begin later in a second look than in a first; 0 where it cannot be told."""
    profile = wire.profile
    room = LOOK_TICKS * profile.tick_bytes
    (one, gone), (two, lost) = (wire.read(epoch, at, at + room) for at in (first, second))
    if gone or lost:
        return 0
    if profile.framing == "m1k40":
        was, now = find_phase(one, profile), find_phase(two, profile)
        return (now.offset - was.offset) % profile.tick_bytes if min(was.confidence, now.confidence) > SURE else 0
    phase = find_phase(two, profile, like=rates_at(one, profile, 0))
    return phase.offset if phase.confidence > SURE else 0


def narrow(wire: Stream, epoch: int, first: int, second: int) -> tuple[Missing, int] | None:
    """The loss between two looks and its shift; None where the shift comes bit by bit: a moving picture.

    Args:
        wire: of the stream; it holds half a look more on either side.
        epoch: of the stream.
        first, second: bytes where the looks begin.
    """
    if wire.profile.framing == "m1k40":
        return _halved(wire, epoch, first, second)
    size, row = wire.profile.tick_bytes, wire.profile.row_bits // 8
    room = LOOK_TICKS * size
    begin, end = max(first - room // 2, 0), second + 3 * room // 2
    data, gone = wire.read(epoch, begin, end)
    if gone:
        return None
    half = [byte_counts(data[at : at + room // 2], size) for at in range(0, len(data) - room // 2 + 1, room // 2)]
    looks = [a + b for a, b in pairwise(half)]
    # two looks with one between them: a look in the loss itself would see both framings
    found = [(k, shift) for k in range(len(looks) - 4) if (shift := find_shift(looks[k + 4], looks[k], SURE))]
    found.sort(key=lambda one: not 1 < one[1] % row < row - 1)  # first what is not by whole rows, as motion is
    for k, _ in found[:MOST_TRIED]:
        at = begin + k * room // 2
        if shift := shift_between(wire, epoch, at, at + 2 * room):
            return Missing(epoch, at + room // 2, at + 5 * room // 2, size - shift), shift
    return None


def _halved(wire: Stream, epoch: int, first: int, second: int) -> tuple[Missing, int] | None:
    """The same by halves, where tags say where ticks begin and motion does nothing."""
    size = wire.profile.tick_bytes
    room = LOOK_TICKS * size
    while second - first > room:
        mid = first + (second - first) // (2 * size) * size
        first, second = (first, mid) if shift_between(wire, epoch, first, mid) else (mid, second)
    shift = shift_between(wire, epoch, max(first - room // 2, 0), second + room // 2)
    return (Missing(epoch, first, second + 3 * room // 2, size - shift), shift) if shift else None


def settled(wire: Stream, slip: Missing, spans: Spans, shift: int) -> Missing | None:
    """The loss with its size made sure by the picture's edges, which stay where they are when the picture moves.

    None where it may as well be a picture that moved by whole rows, one byte more or less.
    """
    profile = wire.profile
    size, row = profile.tick_bytes, profile.row_bits // 8
    if profile.framing == "m1k40":
        return slip
    if not 1 < shift % row < row - 1:
        return slip if edges_moved(wire, slip, spans, shift) else None
    mine = [(a, b) for e, a, b in sorted(set(spans)) if e == slip.epoch]
    first = _edges(wire, slip.epoch, [(a, min(b, slip.after)) for a, b in mine][::-1])
    second = _edges(wire, slip.epoch, [(max(a, slip.before), b) for a, b in mine])
    if not (first.any() and second.any()):
        return slip  # too little on one side to see edges
    likely = {by: float(np.max(first + np.roll(second, -by))) for by in (shift - row, shift, shift + row)}
    by = max(likely, key=likely.__getitem__)
    return replace(slip, lost=(size - by) % size)


def edges_moved(wire: Stream, slip: Missing, spans: Spans, shift: int) -> bool:
    """Whether the picture's edges surely went with a shift, in the nearest stretches on either side."""
    size = wire.profile.tick_bytes
    a, b = next((a, b) for e, a, b in spans if e == slip.epoch and a <= slip.after and slip.before <= b)
    room = (SEAM_TICKS + 1) * size
    first = _edges(wire, slip.epoch, [(max(a, slip.after - room), slip.after)])
    second = _edges(wire, slip.epoch, [(slip.before, min(b, slip.before + room))])
    return float(np.max(first + np.roll(second, -shift)) - np.max(first + second)) > LEAST_GAIN


def _edges(wire: Stream, epoch: int, spans: Sequence[tuple[int, int]]) -> NDArray[np.float64]:
    """Scores of every byte to begin a tick, over some stretches of one side of a loss."""
    profile = wire.profile
    size = profile.tick_bytes
    total = np.zeros(size)
    left = MOST_STRETCHES
    for start, stop in spans:
        for at in range(-(-start // size) * size, stop - FEWEST * size, SEAM_TICKS * size):
            data, missing = wire.read(epoch, at, min(at + SEAM_TICKS * size, stop))
            if left and not missing and len(data) >= FEWEST * size:
                total += seam_scores(data, profile)
                left -= 1
    return total
