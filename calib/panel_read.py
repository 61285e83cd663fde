"""The LED panel as the spike camera sees it: whose light it is by the slow bits, and when by counting spikes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.marks import Sight
from spikerig.dataset.panel import Panel, count_from_gray
from spikerig.dataset.stream import SpikeStream

Floats = NDArray[np.float64]
SMOOTH = 8  # ticks that are looked at together to tell on from off
REACH = 40  # ticks on either side of an edge that are counted, at most
CONTRAST = 0.02  # spikes a pixel and tick between on and off, below which an LED is not read


@dataclass(frozen=True, slots=True)
class Spot:
    """Where an LED lies in a camera's picture: its number on the panel, centre and radius in pixels (+0.5 centres)."""

    led: int
    x_px: float
    y_px: float
    radius_px: float = 3.0

    def disk(self, height: int, width: int) -> tuple[slice, slice, NDArray[np.bool_]]:
        """Rows, columns and the pixels in them.

        Raises:
            UsageError: the disk holds no pixel of the picture.
        """
        r = self.radius_px
        y0, y1 = max(int(self.y_px - r), 0), min(int(np.ceil(self.y_px + r)), height)
        x0, x1 = max(int(self.x_px - r), 0), min(int(np.ceil(self.x_px + r)), width)
        y, x = np.ogrid[y0 : max(y1, y0), x0 : max(x1, x0)]
        inside = (y + 0.5 - self.y_px) ** 2 + (x + 0.5 - self.x_px) ** 2 <= r * r
        if not inside.any():
            raise UsageError("an LED's spot lies outside the picture", value=self, expected=f"{width}x{height}")
        return slice(y0, y1), slice(x0, x1), inside


def read_spikes(
    stream: SpikeStream,
    panel: Panel,
    spots: Sequence[Spot],
    *,
    epoch: int = 0,
    ahead_ns: int = 0,
    block_s: float = 0.25,
) -> list[Sight]:
    """Sightings in a stream of spikes: an LED's edges of one direction within a block make one mark.

    Args:
        stream: with its rate; `t0_ns` is on the spike camera's clock.
        panel: what is in view.
        spots: where; LEDs without a spot are not read.
        epoch: of the camera's clock.
        ahead_ns: panel time minus the camera's, roughly (to half of the time after which the code repeats).
        block_s: time that is read together; the clocks' skew over it must stay far below a step of the panel.

    Raises:
        DataError: the stream has no rate, or no block shows the panel.

    Edges: blocks that touch lost ticks are read without them; blocks that cannot be read are left out.
    Cost: counting the spots' pixels, about 10 ns a pixel and tick.
    Source: expected counts of an integrate-and-fire pixel are exact over any window that starts at a random phase.
    """
    if not stream.rate_hz or not stream.ticks or not spots:
        raise DataError(
            "the panel cannot be read", value=f"{stream.ticks} ticks, {len(spots)} spots, rate {stream.rate_hz}"
        )
    reader = _Reader(stream, panel, spots)
    size = max(round(block_s * stream.rate_hz), 16 * SMOOTH)
    told: list[Sight] = []
    starts = range(0, max(stream.ticks - size // 2, 1), size)
    for start in starts:
        stop = stream.ticks if start == starts[-1] else start + size
        told += reader.block(start, stop, ahead_ns, epoch)
    if not told:
        raise DataError(
            "no block of the stream shows the panel", value=f"{len(starts)} blocks, {len(spots)} spots",
            cause="spots in the wrong place, a panel that is off, or LEDs too dim",
        )  # fmt: skip
    return told


class _Edges(NamedTuple):
    """Edges of one spot and direction: where they were seen (ticks of the stream), and when they were (panel)."""

    spot: int
    seen: Floats
    panel_ns: NDArray[np.int64]
    rising: bool


class _Reader:
    """Counts of the spots' spikes, and what they say."""

    def __init__(self, stream: SpikeStream, panel: Panel, spots: Sequence[Spot]) -> None:
        self.panel, self.spots, self.t0_ns = panel, spots, stream.t0_ns
        self.tick_ns = NS / float(stream.rate_hz or 1)
        where = [s.disk(stream.height, stream.width) for s in spots]
        self.pixels = np.array([inside.sum() for *_, inside in where])
        self.counts = np.stack([counted(stream, *w) for w in where], 1)  # [T, L]
        self.sums = np.concatenate([np.zeros((1, len(spots)), np.int64), np.cumsum(self.counts, 0, dtype=np.int64)])
        self.lost = np.zeros(stream.ticks + 1, np.int64)
        for a, b in stream.lost:
            self.lost[a + 1 : b + 1] = 1
        self.lost = np.cumsum(self.lost)
        self.bit = np.array([panel.leds[s.led].bit for s in spots])
        self.inverted = np.array([panel.leds[s.led].inverted for s in spots])
        # A bit is read by looking only where it stays put for several looks.
        self.coarse = next(
            (k for k in range(panel.bits) if (1 << k) * panel.step_ns >= 3 * SMOOTH * self.tick_ns), panel.bits - 1
        )

    def block(self, start: int, stop: int, ahead_ns: int, epoch: int) -> list[Sight]:
        """Sightings of one block; none where it cannot be read."""
        ahead = self.decode(start, stop, ahead_ns)
        if ahead is None:
            return []
        groups: list[_Edges] = []
        for least in (self.coarse, 0):  # the slow bits first: they need no good guess
            which = np.flatnonzero(self.bit >= least).tolist()
            groups = [g for k in which for g in self.edges(k, start, stop, ahead)]
            if not groups:
                return []
            late = [self._at(g) - (g.panel_ns - ahead - self.t0_ns) for g in groups]
            ahead -= round(float(np.median(np.concatenate(late))))
        told = [self._mean(g) for g in groups]
        usual = float(np.median([scatter for *_, scatter, n in told if n > 3] or [1.0]))
        return [self._sight(g, epoch, usual, *t) for g, t in zip(groups, told, strict=True)]

    def _at(self, group: _Edges) -> Floats:
        return group.seen * self.tick_ns

    def decode(self, start: int, stop: int, ahead_ns: int) -> int | None:
        """Panel time minus camera time from the slow bits, good to a fraction of their step."""
        rate = (self.sums[start + SMOOTH : stop + 1] - self.sums[start : stop + 1 - SMOOTH]) / (SMOOTH * self.pixels)
        rate = rate[:: SMOOTH // 2]
        whole = (self.lost[start + SMOOTH : stop + 1] == self.lost[start : stop + 1 - SMOOTH])[:: SMOOTH // 2]
        low, high = np.percentile(rate, (5, 95), axis=0) if len(rate) else (np.zeros(1), np.zeros(1))
        moving = (high - low > np.maximum(CONTRAST, 0.5 * np.max(high - low))) & (self.bit >= 0)
        if not moving.any():
            return None
        still = (float(np.median(low[moving])), float(np.median(high[moving])))
        low, high = np.where(moving, low, still[0]), np.where(moving, high, still[1])
        lit = (rate - low) / (high - low)
        words, bits = self._words(lit, whole)
        if not len(words):
            return None
        word_ns = self.panel.step_ns << self.coarse
        at_ns = (start + SMOOTH / 2 + np.arange(len(rate))[words[:, 0]] * (SMOOTH // 2)) * self.tick_ns
        count = count_from_gray(words[:, 1])
        wrap_ns = word_ns << bits
        off = (count * word_ns + word_ns // 2 - np.rint(at_ns).astype(np.int64)) - (ahead_ns + self.t0_ns)
        # The middle of the circle's arc that the looks fill: within a word they lie anywhere.
        turn = np.exp(2j * np.pi * (off % wrap_ns) / wrap_ns).mean()
        middle = int(np.angle(turn) / (2 * np.pi) * wrap_ns)
        off = (off - middle + wrap_ns // 2) % wrap_ns - wrap_ns // 2
        near = off[np.abs(off) <= word_ns]
        if len(near) < 0.8 * len(off):
            return None
        return ahead_ns + middle + round(float(np.percentile(near, (1, 99)).mean()))

    def _words(self, lit: Floats, whole: NDArray[np.bool_]) -> tuple[NDArray[np.int64], int]:
        """(look, Gray word of the slow bits) where every bit is told and its LEDs agree, and how many bits."""
        word, good, bits = np.zeros(len(lit), np.int64), whole.copy(), 0
        for bit in range(self.coarse, self.panel.bits):
            which = np.flatnonzero(self.bit == bit)
            if not len(which):
                break
            on = np.where(self.inverted[which], 1 - lit[:, which], lit[:, which])
            good &= (np.abs(on - 0.5) > 0.2).all(1) & ((on > 0.5).all(1) | (on < 0.5).all(1))
            word |= (on[:, 0] > 0.5).astype(np.int64) << bits
            bits += 1
        look = np.flatnonzero(good)
        return np.stack([look, word[look]], 1), bits

    def edges(self, k: int, start: int, stop: int, ahead_ns: int) -> list[_Edges]:
        """Edges of one spot, looked for where `ahead_ns` says, by direction."""
        begin = self.t0_ns + ahead_ns
        first, last = (begin + round(t * self.tick_ns) for t in (start, stop))
        edges = self.panel.edges(first, last, [self.spots[k].led])
        at = (edges.at_ns - begin).astype(np.float64) / self.tick_ns
        if not len(at):
            return []
        apart = float(np.diff(at).min()) if len(at) > 1 else float(REACH * 2)
        reach = min(apart / 2, REACH)
        if reach < 2:
            return []
        level = self._levels(k, start, stop, at, edges.rising, apart)
        inside = (at - reach >= start) & (at + reach <= stop)
        if level is None or not inside.any():
            return []
        at, rising, panel = at[inside], edges.rising[inside], edges.at_ns[inside]
        a, b = np.rint(at - reach).astype(np.int64), np.rint(at + reach).astype(np.int64)
        count = (self.sums[b, k] - self.sums[a, k]).astype(np.float64)
        share = (count - level[0] * (b - a)) / (level[1] - level[0])  # ticks of full light
        seen = np.where(rising, b - share, a + share)
        whole = self.lost[a] == self.lost[b]
        ways = [(way, whole & (rising == way)) for way in (True, False)]
        return [_Edges(k, seen[which], panel[which], way) for way, which in ways if which.any()]

    def _levels(
        self, k: int, start: int, stop: int, at: Floats, rising: NDArray[np.bool_], apart: float
    ) -> Floats | None:
        """Spikes a tick of the spot off and on, from ticks that no edge touches."""
        tick = np.arange(start, stop)
        nearest = np.searchsorted(at, tick + 0.5)
        before, after = np.clip(nearest - 1, 0, len(at) - 1), np.clip(nearest, 0, len(at) - 1)
        far = np.minimum(np.abs(tick + 0.5 - at[before]), np.abs(tick + 0.5 - at[after]))
        on = np.where(nearest > 0, rising[before], ~rising[after])
        clear = (far >= min(4.0, apart / 4)) & (np.diff(self.lost[start : stop + 1]) == 0)
        told = [self.counts[start:stop, k][clear & (on == way)] for way in (False, True)]
        if min(map(len, told)) < 2 * SMOOTH:
            return None
        level = np.array([t.mean(dtype=np.float64) for t in told])
        return level if level[1] - level[0] > CONTRAST * self.pixels[k] else None

    def _mean(self, group: _Edges) -> tuple[float, float, float, int]:
        """Of a group's edges: mean tick, mean panel time after the first edge's, scatter in ticks, how many.

        The means on both clocks make a pair that is exact whatever the clocks' skew is.
        """
        panel = (group.panel_ns - group.panel_ns[0]).astype(np.float64)
        off = group.seen - panel / self.tick_ns
        spread = max(1.4826 * float(np.median(np.abs(off - np.median(off)))), 0.3)
        keep = np.abs(off - np.median(off)) <= 4 * spread
        return float(group.seen[keep].mean()), float(panel[keep].mean()), float(off[keep].std()), int(keep.sum())

    def _sight(
        self, group: _Edges, epoch: int, usual: float, seen: float, panel_ns: float, scatter: float, n: int
    ) -> Sight:
        """A mark; few edges tell their own scatter badly, so that of the other groups stands in."""
        scatter = max(scatter, usual) if n > 3 else usual
        sd = float(np.hypot(max(scatter, 0.1) / np.sqrt(n), 0.02)) * self.tick_ns
        return Sight(
            "spike", epoch, self.t0_ns + round(seen * self.tick_ns), int(group.panel_ns[0]) + round(panel_ns), sd,
            group.rising, self.spots[group.spot].led,
        )  # fmt: skip


def counted(stream: SpikeStream, rows: slice, columns: slice, inside: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Spikes of a spot in every tick."""
    first, last = columns.start // 8, -(-columns.stop // 8)
    mask = np.zeros((inside.shape[0], (last - first) * 8), np.uint8)
    mask[:, columns.start - first * 8 : columns.stop - first * 8] = inside
    packed = np.packbits(mask, axis=1, bitorder="little")
    return np.bitwise_count(stream.bits[:, rows, first:last] & packed).sum((1, 2), dtype=np.int32)
