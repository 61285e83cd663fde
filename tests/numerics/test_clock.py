"""Clocks on hard marks: against longdouble least squares, integers, and emulated truth."""

from dataclasses import replace

import hard_clock
import numpy as np
import pytest

from spikerig.calib.clock import fit_clock, fit_rig
from spikerig.calib.clock_hull import hull_floor, lower_hull
from spikerig.calib.clock_probe import gate
from spikerig.calib.clock_resets import unwrap
from spikerig.calib.clock_sight import number_pulses
from spikerig.calib.clock_track import Pairs, Wander, _Grid, track, transition
from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.marks import Probe
from spikerig.rigctl.sim.emulate.clockworld import World
from spikerig.rigctl.sim.emulate.latency import Latency

LONG = np.longdouble
CASES = hard_clock.worlds()


def solved(a, b):
    """a @ x = b by elimination with pivots, longdouble."""
    a, b = a.astype(LONG), b.astype(LONG)
    n = len(a)
    for k in range(n):
        p = k + int(np.argmax(np.abs(a[k:, k])))
        a[[k, p]], b[[k, p]] = a[[p, k]], b[[p, k]]
        f = a[k + 1 :, k] / a[k, k]
        a[k + 1 :] -= f[:, None] * a[k]
        b[k + 1 :] -= f[:, None] * b[k]
    for k in range(n - 1, -1, -1):
        b[k] = (b[k] - a[k, k + 1 :] @ b[k + 1 :]) / a[k, k]
    return b


def oracle(cells_s, rows, of, rest, weight, wander, prior):
    """All states and the constants at once: the normal equations of prior, transitions and marks."""
    k, e = len(cells_s), len(prior)
    n = 3 * k + e
    info, told = np.zeros((n, n), LONG), np.zeros((n, 1), LONG)
    first = np.array([1e8, wander.ppm * 1e3, wander.drift * NS], LONG)
    info[range(3), range(3)] = 1 / first**2
    info[range(3 * k, n), range(3 * k, n)] = 1 / prior.astype(LONG) ** 2
    for i in range(1, k):
        step, noise = transition(cells_s[i] - cells_s[i - 1], wander)
        inverse, step = solved(noise, np.eye(3)), step.astype(LONG)
        a, b = slice(3 * i - 3, 3 * i), slice(3 * i, 3 * i + 3)
        info[a, a] += step.T @ inverse @ step
        info[a, b] -= step.T @ inverse
        info[b, a] -= inverse @ step
        info[b, b] += inverse
    for row, cell, y, w in zip(rows.astype(LONG), of, rest, weight, strict=True):
        at = [*range(3 * cell, 3 * cell + 3), *range(3 * k, n)]
        info[np.ix_(at, at)] += LONG(w) * row[:, None] * row
        told[at, 0] += LONG(w) * row * LONG(y)
    x, cov = solved(info, told), solved(info, np.eye(n))
    states = np.concatenate([x[: 3 * k].reshape(k, 3), np.tile(x[3 * k :].T, (k, 1))], 1)
    sd = np.sqrt(np.diag(cov))
    return states, np.concatenate([sd[: 3 * k].reshape(k, 3), np.tile(sd[3 * k :], (k, 1))], 1).astype(float)


@pytest.mark.parametrize("constants", [0, 2])
def test_the_smoother_is_least_squares(constants):
    rng = np.random.default_rng(constants)
    at = np.cumsum(np.repeat([0.01, 1.0, 0.6, 100.0, 3.0, 0.7, 5.0, 2.0, 0.9, 30.0], 2) * rng.uniform(0.9, 1.1, 20))
    wander = Wander(ramps=(2e-9,))
    extra = np.stack([rng.choice([-1.0, 1.0], 20), rng.uniform(0, 1000, 20)], 1)[:, :constants]
    prior = np.array([3e5, 400.0])[:constants]
    rest = 1e5 * rng.standard_normal(20)
    weight = 1 / rng.uniform(5e3, 5e4, 20) ** 2
    grid = _Grid(at, wander, extra)
    got, cov, _ = grid.smooth(rest, weight, prior)
    want, sd = oracle(grid.at_s, grid.rows, grid.of, rest, weight, wander, prior)
    assert np.abs((got - want) / sd).max() < 1e-4  # of a standard deviation
    np.testing.assert_allclose(np.sqrt(np.einsum("kii->ki", cov)), sd, rtol=1e-5)


def test_time_may_be_looked_at_backwards():
    forth, noise = transition(7.0, Wander())
    back, same = transition(-7.0, Wander())
    np.testing.assert_allclose(back @ forth, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(back @ noise @ back.T, same, rtol=1e-6)


def test_marks_far_off_are_named_and_change_nothing():
    rng = np.random.default_rng(0)
    x = np.sort(rng.integers(0, 100 * NS, 400))
    y = x + np.rint(1e4 * rng.standard_normal(400)).astype(np.int64)
    bad = rng.random(400) < 0.1
    spoiled = track(Pairs.plain(x, y + np.where(bad, 300_000, 0), np.full(400, 1e4)))
    np.testing.assert_array_equal(spoiled.used, ~bad)
    without = track(Pairs.plain(x[~bad], y[~bad], np.full(int((~bad).sum()), 1e4)))
    at = np.arange(1, 99) * NS
    assert np.abs(spoiled.model().rig_from_device(at) - without.model().rig_from_device(at)).max() < 500


@pytest.mark.parametrize(("x0", "y0"), [(2**62, -(2**61)), (1_700_000_000 * NS, 5), (0, 315_360_000 * NS)])
def test_the_origin_of_time_does_not_matter(x0, y0):
    rng = np.random.default_rng(0)
    x = np.sort(rng.integers(0, 100 * NS, 300))
    y = x + np.rint(x * 4e-5 + 1e4 * rng.standard_normal(300)).astype(np.int64)
    here, there = (track(Pairs.plain(x + a, y + b, np.full(300, 1e4))) for a, b in ((0, 0), (x0, y0)))
    at = np.arange(-10, 120) * NS
    low = here.model().rig_from_device(at)
    high = there.model(y0).rig_from_device(at + x0)
    assert np.abs(low - high).max() <= 2
    np.testing.assert_allclose(there.model().sigma_at(at + x0), here.model().sigma_at(at), rtol=1e-6)


def judged(world, clocks, clock, at):
    fit = clocks.fit(clock)
    off = world.off_ns(fit.model, clock, at, clocks.origin_ns) / 1e3
    return np.abs(off), fit.uncertainty_ns(world.at(clock, at)) / 1e3


@pytest.mark.parametrize("name", CASES)
def test_marks_that_went_wrong(name):
    world, marks, clock, bound = CASES[name]
    clocks = fit_rig(marks)
    at = np.linspace(1, hard_clock.SECONDS - 1, 400) * NS
    off, claimed = judged(world, clocks, clock, at.astype(np.int64))
    assert off.max() <= bound
    assert (off <= 1.5 * claimed).mean() >= 0.95  # one take: its errors go together. Over takes: docs/clock.md
    assert np.isfinite(claimed).all()


@pytest.mark.parametrize("by_ns", [500_000, 20_000_000, NS, -20_000_000])
def test_a_step_is_found_and_bridged(by_ns):
    world = World(13)
    marks = world.probes(hard_clock.SECONDS)
    middle = int(world.at("box", 60 * NS))
    pieces = fit_clock(hard_clock.stepped(marks, middle, by_ns), "host")
    assert len(pieces) == 2
    ends = [world.clocks["host"].true_from_device(np.array(p.track.valid_ns)) / NS for p in pieces]
    assert ends[0][1] <= 60.01
    assert ends[1][0] >= 59.99
    clocks = fit_rig(hard_clock.stepped(marks, middle, by_ns))
    assert any("step" in n for n in clocks.fit("host").notes)
    off, claimed = judged(world, clocks, "host", np.arange(1, 119) * NS)
    assert off.max() <= 100
    assert (off <= claimed).all()


def test_a_step_smaller_than_the_bound_stays_within_it():
    world = World(13)
    marks = hard_clock.stepped(world.probes(hard_clock.SECONDS), int(world.at("box", 60 * NS)), 60_000)
    clocks = fit_rig(marks)
    assert len(fit_clock(marks, "host")) == 1
    at = np.arange(1, 60) * NS
    off, claimed = judged(world, clocks, "host", at)
    assert (off <= claimed + 30).all()


@pytest.mark.parametrize("name", hard_clock.lone_marks())
def test_lone_marks_promise_little(name):
    marks = hard_clock.lone_marks()[name]
    clocks = fit_rig(marks)
    fit = clocks.fits[0]
    first, last = fit.valid_ns
    beside = fit.uncertainty_ns(np.array([first, last + 10 * NS, last + 1000 * NS]))
    assert np.isfinite(beside).all()
    if name == "one sight":
        return  # the spike camera is the rig itself
    assert beside[2] > beside[1] > beside[0] > 0
    if "hour" not in name:
        assert beside[1] > 1e6  # 100 ppm over 10 s


def test_counters_are_unwrapped():
    rng = np.random.default_rng(0)
    period = 2**32 * 1000
    true = np.sort(rng.integers(0, 40 * period, 300)) // 1000 * 1000
    true[10], true[100] = true[9], true[99]  # said twice
    host = true + 5 * 10**17 + rng.integers(-period // 4, period // 4, 300) // 2
    start = true[0] % period
    np.testing.assert_array_equal(unwrap(true % period, period, host) - start, true - true[0])
    edge = np.array([period - 1, 0, period - 1, 1])
    np.testing.assert_array_equal(
        unwrap(edge, period, np.array([0, 1, 2, 3])), [period - 1, period, period - 1, period + 1]
    )
    assert len(unwrap(np.zeros(0, np.int64), period, np.zeros(0, np.int64))) == 0
    with pytest.raises(UsageError):
        unwrap(edge, 0, edge)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("ppm", [-900.0, 0.0, 900.0])
def test_pulses_get_their_numbers(ppm, seed):
    rng = np.random.default_rng(seed)
    period = 10_000_000
    number = np.arange(3000)
    at = 10**18 + np.rint(number * period * (1 + ppm * 1e-6) + 20_000 * rng.standard_normal(3000)).astype(np.int64)
    keep = rng.random(3000) > 0.3
    keep[500:800] = False  # 3 s without a pulse
    strays = at[rng.integers(0, 3000, 100)] + rng.integers(4_000_000, 6_000_000, 100)
    doubled = at[keep][::7] + 30_000
    seen = np.concatenate([at[keep], strays, doubled])
    label = np.concatenate([number[keep], np.full(100, -1), number[keep][::7]])
    mixed = rng.permutation(len(seen))
    which, told = number_pulses(seen[mixed], period)
    true = label[mixed][which]
    assert (true >= 0).all()  # no stray
    np.testing.assert_array_equal(told, true - true[0])
    assert len(set(told.tolist())) == len(told) >= 0.99 * keep.sum()
    assert [len(v) for v in number_pulses(np.zeros(0, np.int64), period)] == [0, 0]
    assert [v.tolist() for v in number_pulses(np.array([5]), period)] == [[0], [0]]


def test_the_hull_is_below_everything():
    rng = np.random.default_rng(0)
    for x, y in (
        (np.arange(10.0), np.zeros(10)),
        (np.zeros(5), np.arange(5.0)[::-1]),
        (np.array([3.0]), np.array([1.0])),
        (rng.integers(0, 20, 60).astype(float), rng.integers(0, 20, 60).astype(float)),
        (rng.random(100_000), rng.exponential(size=100_000)),
    ):
        hull = lower_hull(x, y)
        assert (y - np.interp(x, x[hull], y[hull]) >= -1e-12).all()
        slope = np.diff(y[hull]) / np.diff(x[hull])
        assert (np.diff(slope) > 0).all()


@pytest.mark.parametrize("floor_us", [1, 100, 4000])
def test_the_floor_stays_within_its_bound(floor_us):
    world = World(3)
    stamps = world.stamps(60, link=Latency(floor_us, 100, 0, 0.05, 10))
    for asked in (True, False):
        probes = [p if asked else replace(p, sent_ns=None) for p in stamps]
        found = hull_floor(probes)
        assert found.proved == asked
        true = world.at("host", world.clocks["spike"].true_from_device(found.pairs.x_ns))
        late = found.pairs.y_ns - true
        assert (late >= 0).all()
        assert (late <= found.bias_ns + 30_000).all()
        assert floor_us * 1e3 <= found.bias_ns


def test_nonsense_is_refused():
    late = Probe("box", 0, 10, 5, 9)
    with pytest.raises(UsageError, match="before its question"):
        gate([late])
    with pytest.raises(UsageError, match="one-way"):
        gate([Probe("box", 0, None, 5, 9)])
    none = np.zeros(0, np.int64)
    with pytest.raises(DataError, match="no marks"):
        track(Pairs.plain(none, none, none.astype(float)))
    one = np.array([1])
    for sd in (np.array([np.nan]), np.array([0.0]), np.array([1.0, 2.0])):
        with pytest.raises(UsageError):
            track(Pairs.plain(one, one, sd))
    with pytest.raises(DataError, match="command"):
        hull_floor([Probe("spike", 0, 100, 0, 50), Probe("spike", 0, None, 10, 60)])


def test_six_hours():
    world = World(1, ramp_ppm_per_min=0.05)
    rng = np.random.default_rng(0)
    true = np.arange(0, 21_600, 10) * NS
    noise = np.rint(20_000 * rng.standard_normal(len(true))).astype(np.int64)
    done = track(Pairs.plain(world.at("spike", true), world.at("box", true) + noise, np.full(len(true), 2e4)))
    at = rng.integers(0, 21_590 * NS, 500)
    off = done.model().rig_from_device(world.at("spike", at)) - world.at("box", at)
    assert np.abs(off).max() <= 50_000
    assert np.percentile(np.abs(off), 99) <= 25_000
