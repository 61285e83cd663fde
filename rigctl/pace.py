"""Bytes against time: the rate of a stream that carries no clock, and losses that nobody reports."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import NS

_KNOWN_S = 2.0  # of pairs' distances together, from which a rate is told
_BIN_BLOCKS = 4  # blocks of which the most punctual one speaks
_BINS = 64  # kept
_SETTLED = 4  # late blocks that must agree before a loss is told,
_WINDOW = 16  # or so many that waited in a row, whatever they say
_PUNCTUAL_NS = 200_000  # scatter of a host not known yet, and the most that is believed
_LEVEL = 10  # late blocks that are compared
_DOUBT_NS = 2_000_000_000  # without one block in time: no memory bridges that
_LASTING_NS = 100_000_000  # that it must last: a host that is slow for a moment catches up
_QUICK = 0.9  # of the time in which the camera makes a block's bytes
_ODD = 1e-3  # no crystal is so far off: a rate like that is not taken over
_SPREAD = 64  # blocks of which the scatter is known


@dataclass(frozen=True, slots=True)
class Rate:
    """Bytes a second as measured.

    Args:
        bytes_s: of the host's clock.
        sigma_bytes_s: its standard deviation.
        span_s: of the fit.
        ppm: off the nominal rate.
    """

    bytes_s: float
    sigma_bytes_s: float
    span_s: float
    ppm: float


@dataclass(frozen=True, slots=True)
class Lapse:
    """A loss seen from the time: about `bytes` are missing, somewhere in the last `suspect` bytes."""

    bytes: int
    suspect: int


class Pace:
    """Watches one epoch after the other.

    A block that came back late is behind the rate, but later ones make up for it; bytes that were lost stay missing.
    So the smallest lag of a few blocks is compared with what the epoch has shown so far.

    Args:
        nominal: bytes a second.
        tolerance_ppm: how far a camera's crystal may be off before it has been measured.

    Edges:
        A loss below the scatter of the host's stamps (some bytes when emulated, a few kB on a busy host) is not seen:
        the tick phase shows it (`framing.find_phase`). A camera that is slower than the tolerance allows is reported as
        losing all the time, and one that is faster hides losses: `measured` tells, and the profile is wrong.
    """

    def __init__(self, nominal: float, tolerance_ppm: float = 200.0) -> None:
        self.nominal, self.tolerance = float(nominal), tolerance_ppm * 1e-6
        self._rate = self.nominal
        self._drift = self.tolerance  # of the rate in use, relative
        self._rate_told: Rate | None = None
        self._piece = 0  # of the record that is whole: between losses
        self._bins: list[tuple[int, int, int]] = []  # piece, time, bytes
        self._jumps: list[float] = []  # of the lag from block to block: how punctual the host is
        self.begin()

    def begin(self, at_ns: int | None = None) -> None:
        """A new epoch; the rate and the host's punctuality stay known.

        Args:
            at_ns: when nothing waited any more: from then on bytes are counted. None: from the first block's end.
        """
        # the most punctual moment: time and bytes
        self._at: tuple[int, int] | None = None if at_ns is None else (at_ns, 0)
        self._lag: float | None = None  # of the block before
        self._row = self._late_ns = 0
        self._late: list[float] = []  # lags of blocks that waited for the camera and yet were late
        self._piece += 1
        self._bin: list[tuple[float, int, int]] = []
        self.sure_bytes = 0  # of this epoch: all before was in time
        self.total = 0

    def split(self, lapse: Lapse) -> None:
        """A new epoch right after a loss that was seen from the time: expectations go on, less what is missing."""
        at, total = self._at, self.total
        self.begin()
        if at is not None:
            self._at = (at[0], at[1] - total - lapse.bytes)

    def lag(self, now_ns: int, total: int) -> float:
        """Bytes that should have come by now and did not."""
        if self._at is None:
            return 0.0
        return self._rate * (now_ns - self._at[0]) / NS - (total - self._at[1])

    def add(self, before_ns: int, after_ns: int, count: int, delay_ns: int = 0) -> Lapse | None:
        """A block came with `count` bytes.

        Args:
            before_ns: when it was asked for.
            after_ns: when it came back: late where the host was, and never early.
            count: bytes.
            delay_ns: what of the time between is known to be the host's own delay, before or after the transfer.

        Returns:
            A loss, once it is certain; the caller then goes on with `split`.
        """
        self.total += count
        if self._at is None:
            self._at, self.sure_bytes = (after_ns, self.total), self.total
        lag = self.lag(after_ns, self.total)
        if lag < 0:  # more punctual than ever
            self._at = (after_ns, self.total)
            lag = 0.0
        allowed = self._allowed(after_ns)
        if lag <= allowed:
            self.sure_bytes = self.total
            if self._lag is not None:
                self._jumps = [*self._jumps[1 - _SPREAD :], abs(lag - self._lag)]
        self._lag = lag
        self._fit(lag, after_ns, lag <= allowed)
        took = after_ns - before_ns - delay_ns
        if lag <= allowed or not self._late_ns:
            self._late, self._row, self._late_ns = [], 0, after_ns
        elif took * self._rate < _QUICK * count * NS:  # faster than they are made: a backlog is read off
            self._row = 0
        else:
            self._late, self._row = [*self._late[1 - _LEVEL :], lag], self._row + 1
        lowest = min(self._late, default=0.0)
        agree = sum(each <= lowest + 64 + self._scatter() for each in self._late)
        # a loss has a sharp floor, a backlog comes and goes; and who loses all the time is late all the time
        lasted = after_ns - self._late_ns
        if (agree < _SETTLED and self._row < _WINDOW and lasted < _DOUBT_NS) or lasted < _LASTING_NS or not lowest:
            return None
        if self._late[-1] < self._late[0] - max(allowed / 4, 0.02 * count):  # read off on a link that is hardly faster
            return None
        return Lapse(round(lowest), self.total - self.sure_bytes)

    def doubtful(self) -> int:
        """Bytes at the end that came late and have not been made up for: a loss, or a backlog."""
        return self.total - self.sure_bytes

    def measured(self) -> Rate | None:
        """The rate as fitted; None before about half a second."""
        return self._rate_told

    def _allowed(self, now_ns: int) -> float:
        """Lag that is no loss: scatter of the stamps, and what the rate may be off since the punctual moment."""
        since_ns = self._at[0] if self._at else now_ns
        return 64 + 6 * self._scatter() + self._drift * self._rate * (now_ns - since_ns) / NS

    def _scatter(self) -> float:
        """Bytes by which one block's stamp differs from the next one's."""
        most = self._rate * _PUNCTUAL_NS / NS
        return min(float(np.quantile(self._jumps, 0.75)), most) if len(self._jumps) >= 8 else most

    def _fit(self, lag: float, after_ns: int, in_time: bool) -> None:
        if in_time:
            self._bin.append((lag, after_ns, self.total))
        if len(self._bin) < _BIN_BLOCKS:
            return
        _, at, total = min(self._bin)
        self._bin = []
        self._bins = [*self._bins[1 - _BINS :], (self._piece, at, total)]
        piece, when, count = np.array(self._bins, np.int64).T
        t, y = (when - when[0]) / NS, (count - count[0]).astype(np.float64)
        i, j = np.triu_indices(len(t), 1)
        use = (piece[i] == piece[j]) & (t[j] - t[i] > 0.02)
        if np.sum((t[j] - t[i])[use]) < _KNOWN_S:
            return
        slope = _weighted_median(((y[j] - y[i]) / (t[j] - t[i] + 1e-12))[use], (t[j] - t[i])[use] ** 2)
        rest, lever = y - slope * t, np.zeros(len(t))
        for k in np.unique(piece):
            mine = piece == k
            rest[mine] -= np.median(rest[mine])
            lever[mine] = t[mine] - t[mine].mean()
        sigma = (1.5 * float(np.median(np.abs(rest))) + 1.0) / float(np.sqrt(np.sum(lever**2)))
        if 4 * sigma > _ODD * slope:
            return
        self._rate_told = Rate(slope, sigma, float(t[-1]), (slope / self.nominal - 1) * 1e6)
        if abs(slope / self.nominal - 1) < _ODD:
            self._rate, self._drift = slope, min(max(4 * sigma / slope, 0.02e-6), self.tolerance)
            mine = np.flatnonzero(piece == self._piece)
            k = mine[np.argmax((y - slope * t)[mine])]  # the most punctual one by the new rate
            self._at = (int(when[k]), int(count[k]))


def _weighted_median(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    order = np.argsort(values)
    reach = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(reach, reach[-1] / 2)])
