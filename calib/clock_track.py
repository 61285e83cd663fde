"""A clock followed through noisy comparisons: a Kalman smoother on offset, skew and drift, with robust weights."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import NS, ClockModel
from spikerig.dataset.errors import DataError, UsageError

Floats = NDArray[np.float64]
Int64 = NDArray[np.int64]
HOLD_S = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0)  # knots of the hold-over on either side
HUBER, FAR = 2.0, 5.0  # in standard deviations: where weights begin to fall, and where a mark is left out
GAP_S, GAP_KNOTS = 5.0, 4000


@dataclass(frozen=True, slots=True)
class Wander:
    """What two clocks may do against each other.

    Args:
        walk: random walk of the relative frequency, 1/sqrt(s). Two ordinary crystals: 1e-8 each.
        ramps: random walk of its drift, 1/s/sqrt(s): lets a warming crystal begin to drift at any time. The first
            is taken unless the marks speak clearly for another.
        ppm: standard deviation of the frequency before anything is known.
        drift: of the drift before anything is known, 1/s; 1 ppm/min is 1.7e-8.
        skew_ppm: the frequency's middle before anything is known; None: that of the marks' own middle line.
        cell_s: comparisons within this time are joined: the wander inside it is far below any of them.
    """

    walk: float = 1.5e-8
    ramps: tuple[float, ...] = (5e-10, 2e-9, 8e-9)
    ppm: float = 100.0
    drift: float = 3e-8
    cell_s: float = 0.5
    skew_ppm: float | None = None

    @property
    def ramp(self) -> float:
        """The one that is taken."""
        return self.ramps[0]


@dataclass(frozen=True, slots=True)
class Pairs:
    """The same instants on two clocks.

    Args:
        x_ns, y_ns: int64[N], an instant on the one clock and on the other.
        sd_ns: float64[N], standard deviation of y - x.
        extra: float64[N,E], factors of constants that are solved for too, e.g. +1 rising and -1 falling edges.
        prior: float64[E], standard deviation of those constants (ns a unit of the factor) before anything is known.
    """

    x_ns: Int64
    y_ns: Int64
    sd_ns: Floats
    extra: Floats
    prior: Floats

    @staticmethod
    def plain(x_ns: Int64, y_ns: Int64, sd_ns: Floats) -> Pairs:
        """Pairs without constants."""
        return Pairs(x_ns, y_ns, sd_ns, np.zeros((len(x_ns), 0)), np.zeros(0))

    def take(self, which: NDArray) -> Pairs:
        """Some of the pairs, by mask or number."""
        return replace(
            self, x_ns=self.x_ns[which], y_ns=self.y_ns[which], sd_ns=self.sd_ns[which], extra=self.extra[which]
        )


@dataclass(frozen=True, slots=True)
class Track:
    """How y - x went: knots over the marks and the hold-over beside them.

    Args:
        x_ns, y_ns: int64[K], the same instants on both clocks.
        sigma_ns: float64[K], of y, noise and wander; no bias.
        valid_ns: first and last mark, on x.
        skew_ppm: of y against x at the last mark.
        skew_sd_ppm: its standard deviation.
        constants, constants_sd: float64[E], see `Pairs.extra`.
        used: bool[N], marks not left out as outliers.
        scale: factor by which the claimed deviations were too small; 1 where they were not.
        residual_ns: weighted rms of the marks used. Not the accuracy: a bias leaves no residual.
        hold_ppm: growth of sigma after the last knot.
    """

    x_ns: Int64
    y_ns: Int64
    sigma_ns: Floats
    valid_ns: tuple[int, int]
    skew_ppm: float
    skew_sd_ppm: float
    constants: Floats
    constants_sd: Floats
    used: NDArray[np.bool_]
    scale: float
    residual_ns: float
    hold_ppm: float

    def off_ns(self, pairs: Pairs) -> Floats:
        """How far pairs lie from the track, float64[N] ns of y, its constants taken off."""
        model = ClockModel(self.x_ns, self.y_ns, self.sigma_ns)
        return (pairs.y_ns - model.rig_from_device(pairs.x_ns)).astype(np.float64) - pairs.extra @ self.constants

    def model(self, origin_ns: int = 0, bias_ns: float = 0.0) -> ClockModel:
        """As a clock model of y - origin; `bias_ns` is a bound on a bias that no residual shows.

        Twice the model's sigma is what the map is good to: the bound enters as a uniform deviation, bound/sqrt(3).
        """
        sigma = np.sqrt(self.sigma_ns**2 + bias_ns**2 / 3)
        return ClockModel(self.x_ns, self.y_ns - np.int64(origin_ns), sigma, self.hold_ppm)


def transition(dt_s: float, wander: Wander) -> tuple[Floats, Floats]:
    """How offset (ns), skew (ns/s) and drift (ns/s^2) go over `dt_s`, and the covariance that is added."""
    t = dt_s
    step = np.array([[1, t, t * t / 2], [0, 1, t], [0, 0, 1]])
    q, r = (wander.walk * NS) ** 2, (wander.ramp * NS) ** 2
    t = abs(t)
    noise = q * np.array([[t**3 / 3, t**2 / 2, 0], [t**2 / 2, t, 0], [0, 0, 0]])
    noise += r * np.array([[t**5 / 20, t**4 / 8, t**3 / 6], [t**4 / 8, t**3 / 3, t**2 / 2], [t**3 / 6, t**2 / 2, t]])
    if dt_s < 0:  # the same walk, looked at backwards
        flip = np.array([1.0, -1.0, 1.0])
        noise = noise * flip[:, None] * flip
    return step, noise


def track(pairs: Pairs, wander: Wander | None = None, rounds: int = 8) -> Track:
    """Follow y - x through the pairs.

    Args:
        pairs: at least one, in any order; times int64, differences are formed before any float.
        wander: what the clocks may do.
        rounds: of fits, at most: with Huber weights until they settle, then without marks beyond 5 deviations.

    Raises:
        DataError: no pairs.
        UsageError: arrays that do not fit, deviations that are not positive.

    Edges: one pair gives its offset; the skew is then known to `wander.ppm` only, and sigma grows by it.
    Cost: two 3..5-square solves a cell of 0.5 s and round: 600 cells take about 0.3 s in all.
    Source: Rauch, Tung, Striebel 1965; state offset, skew, drift with white noise on the last two's rates.
    """
    wander = wander or Wander()
    _check(pairs)
    origin = (int(pairs.x_ns[np.argmin(pairs.x_ns)]), int(pairs.y_ns[np.argmin(pairs.x_ns)]))
    at_s = (pairs.x_ns - origin[0]).astype(np.float64) / NS
    ahead = ((pairs.y_ns - origin[1]) - (pairs.x_ns - origin[0])).astype(np.float64)
    line, near = middle_line(at_s, ahead, pairs.sd_ns, wander.skew_ppm)
    rest = ahead - (line[0] + line[1] * at_s)
    grid = _Grid(at_s, wander, pairs.extra)
    found = _settled(grid, rest, pairs, near, rounds)
    # The marks choose how steadily the crystals warm, where they can tell: twice e^2 as likely, or the steadiest.
    told = [grid.smooth(rest, found[2], pairs.prior, ramp)[2] for ramp in wander.ramps]
    best = next((k for k in range(len(told)) if told[k] >= max(told) - 3), 0)
    if best:
        wander = replace(wander, ramps=(wander.ramps[best],))
        grid.wander = wander
        found = _settled(grid, rest, pairs, near, rounds)
    state, cov, _, keep, scale = found
    weight, off = found[2], rest - grid.told(state)
    residual = float(np.sqrt((weight * off**2).sum() / weight.sum()))
    return _told(grid, state, cov, line, origin, wander, keep, scale, residual, at_s)


def _settled(
    grid: _Grid, rest: Floats, pairs: Pairs, near: NDArray[np.bool_], rounds: int
) -> tuple[Floats, Floats, Floats, NDArray[np.bool_], float]:
    """States, covariances, weights, which marks are kept and how much wider they scatter than they claim."""
    keep, weight, hard, scale = near, near / pairs.sd_ns**2, False, 1.0
    state, cov, _ = grid.smooth(rest, weight, pairs.prior)
    for _ in range(rounds):
        off = rest - grid.told(state)
        z = np.abs(off) / pairs.sd_ns
        scale = max(1.0, 1.4826 * float(np.median(z[keep])), grid.lumps(off, weight))
        keep = near & (z <= FAR * scale) if hard else near
        weight = keep * np.minimum(1.0, HUBER * scale / np.maximum(z, 1e-9)) / (pairs.sd_ns * scale) ** 2
        before = state
        state, cov, _ = grid.smooth(rest, weight, pairs.prior)
        if (np.abs(state[:, 0] - before[:, 0]) <= 0.02 * np.sqrt(cov[:, 0, 0])).all():
            if hard:
                break
            hard = True
    return state, cov, weight, keep, scale


def _check(pairs: Pairs) -> None:
    n = len(pairs.x_ns)
    if n == 0:
        raise DataError("a clock has no marks", expected="at least one comparison with another clock")
    good = np.isfinite(pairs.sd_ns).all() and (pairs.sd_ns > 0).all() and np.isfinite(pairs.extra).all()
    if len(pairs.y_ns) != n or len(pairs.sd_ns) != n or pairs.extra.shape != (n, len(pairs.prior)) or not good:
        raise UsageError("pairs are x[N], y[N], positive sd[N] and extra[N,E] with prior[E], all finite")


def middle_line(
    at_s: Floats, ahead: Floats, sd: Floats, skew_ppm: float | None = None
) -> tuple[Floats, NDArray[np.bool_]]:
    """A line through the middle of the marks (medians of bins, median of slopes), and which lie anywhere near it."""
    order = np.argsort(at_s, kind="stable")
    bins = np.array_split(order, min(len(order), 60))
    t, y = (np.array([np.median(v[b]) for b in bins]) for v in (at_s, ahead))
    i, j = np.triu_indices(len(t), 1)
    apart = t[j] - t[i]
    far = apart > 0.1 * max(float(np.ptp(t)), 1e-9)
    slope = float(np.median((y[j] - y[i])[far] / apart[far])) if far.any() else 0.0
    slope = slope if skew_ppm is None else skew_ppm * 1e3
    start = float(np.median(y - slope * t))
    off = np.abs(ahead - start - slope * at_s)
    return np.array([start, slope]), off <= max(30 * float(np.median(off)), 1e6, 10 * float(np.median(sd)))


class _Grid:
    """Cells of time that hold marks, with empty ones in long gaps; offsets are measured from their own middles."""

    def __init__(self, at_s: Floats, wander: Wander, extra: Floats) -> None:
        self.wander = wander
        self.order = np.argsort(at_s, kind="stable")
        number = np.floor((at_s[self.order] - at_s.min()) / wander.cell_s).astype(np.int64)
        self.starts = np.flatnonzero(np.diff(number, prepend=-1))
        counts = np.diff(self.starts, append=len(at_s))
        middle = np.add.reduceat(at_s[self.order], self.starts) / counts
        self.at_s, self.cell = _with_gaps(middle)
        self.of = np.empty(len(at_s), np.int64)
        self.of[self.order] = np.repeat(self.cell, counts)
        tau = at_s - self.at_s[self.of]
        self.rows = np.concatenate([np.stack([np.ones_like(tau), tau, tau**2 / 2], 1), extra], 1)

    def told(self, state: Floats) -> Floats:
        """What the states say of each mark."""
        return np.einsum("ij,ij->i", self.rows, state[self.of])

    def lumps(self, off: Floats, weight: Floats) -> float:
        """How much further cells' means scatter than their weights say: noise that does not average out."""
        w = np.add.reduceat(weight[self.order], self.starts)
        mean = np.add.reduceat((weight * off)[self.order], self.starts)
        held = w > 0
        return float(np.sqrt(np.median(mean[held] ** 2 / w[held]) / 0.455)) if held.sum() >= 10 else 1.0

    def smooth(
        self, rest: Floats, weight: Floats, prior: Floats, ramp: float | None = None
    ) -> tuple[Floats, Floats, float]:
        """States [K,m] and covariances [K,m,m] at the cells, and how likely the marks are (log, up to a constant).

        With a `ramp` only the last is wanted: states and covariances are those of the forward pass.
        """
        m, k = self.rows.shape[1], len(self.at_s)
        likely, wander = 0.0, self.wander if ramp is None else replace(self.wander, ramps=(ramp,))
        rows = self.rows[self.order]
        heavy = rows * weight[self.order, None]
        info, told = np.zeros((k, m, m)), np.zeros((k, m))
        info[self.cell] = np.add.reduceat(heavy[:, :, None] * rows[:, None, :], self.starts)
        told[self.cell] = np.add.reduceat(heavy * rest[self.order, None], self.starts)
        x = np.zeros(m)
        p = np.diag(np.concatenate([[1e8, self.wander.ppm * 1e3, self.wander.drift * NS], prior]) ** 2)
        xs, ps, ahead, steps = np.zeros((k, m)), np.zeros((k, m, m)), np.zeros((k, m, m)), np.zeros((k, m, m))
        for i in range(k):
            if i:
                step, noise = _step(self.at_s[i] - self.at_s[i - 1], m, wander)
                x, p = step @ x, step @ p @ step.T + noise
                steps[i] = step
            ahead[i] = p
            if info[i, 0, 0] > 0:
                room, news = np.eye(m) + p @ info[i], told[i] - info[i] @ x
                p = np.linalg.solve(room, p)
                p = (p + p.T) / 2
                # Of the innovations: log determinant, and squares less those that do not depend on the ramp.
                likely += 0.5 * (news @ p @ news + 2 * x @ told[i] - x @ info[i] @ x) - 0.5 * np.linalg.slogdet(room)[1]
                x = x + p @ news
            xs[i], ps[i] = x, p
        if ramp is not None:
            return xs, ps, float(likely)
        for i in range(k - 2, -1, -1):
            gain = np.linalg.solve(ahead[i + 1], steps[i + 1] @ ps[i]).T
            xs[i] += gain @ (xs[i + 1] - steps[i + 1] @ xs[i])
            ps[i] += gain @ (ps[i + 1] - ahead[i + 1]) @ gain.T
        return xs, ps, float(likely)


def _step(dt_s: float, m: int, wander: Wander) -> tuple[Floats, Floats]:
    step, noise = np.eye(m), np.zeros((m, m))
    step[:3, :3], noise[:3, :3] = transition(dt_s, wander)
    return step, noise


def _with_gaps(middle: Floats) -> tuple[Floats, Int64]:
    """Middles with empty cells put into long gaps, and where the full ones went."""
    gaps = np.diff(middle)
    long = max(GAP_S, float(gaps.sum()) / GAP_KNOTS) if len(gaps) else GAP_S
    more = np.maximum(np.ceil(gaps / long).astype(np.int64) - 1, 0)
    where = np.concatenate([[0], np.cumsum(more + 1)]).astype(np.int64)
    return np.interp(np.arange(where[-1] + 1), where, middle), where


def _told(
    grid: _Grid, state: Floats, cov: Floats, line: Floats, origin: tuple[int, int], wander: Wander,
    keep: NDArray[np.bool_], scale: float, residual_ns: float, at_s: Floats,
) -> Track:  # fmt: skip
    first, last = float(at_s[keep].min()), float(at_s[keep].max())
    times, values, spread = [grid.at_s], [state[:, 0]], [np.sqrt(cov[:, 0, 0])]
    for side, end in ((-1, 0), (1, -1)):
        for hold in (0.0, *HOLD_S):
            at = (last if side > 0 else first) + side * hold
            if (at - grid.at_s[end]) * side < 1e-6:
                continue
            step, noise = transition(at - grid.at_s[end], wander)
            times.append(np.array([at]))
            values.append((step @ state[end, :3])[:1])
            spread.append(np.sqrt((step @ cov[end, :3, :3] @ step.T + noise)[:1, 0]))
    t, y, s = (np.concatenate(v) for v in (times, values, spread))
    x_ns = np.rint(t * NS).astype(np.int64)
    x_ns, at = np.unique(x_ns, return_index=True)
    y = y[at] + line[0] + line[1] * (x_ns / NS)
    y_ns = x_ns + np.rint(y).astype(np.int64)
    hold = (s[at][-1] - s[at][-2]) / ((x_ns[-1] - x_ns[-2]) * 1e-6)
    return Track(
        x_ns + origin[0], y_ns + origin[1], s[at],
        (origin[0] + round(first * NS), origin[0] + round(last * NS)),
        float(line[1] + state[-1, 1]) * 1e-3, float(np.sqrt(cov[-1, 1, 1])) * 1e-3,
        state[-1, 3:], np.sqrt(np.diagonal(cov[-1])[3:]), keep, scale, residual_ns, float(hold),
    )  # fmt: skip
