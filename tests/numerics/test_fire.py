"""The firing kernels on hard inputs, against integers and fractions."""

from fractions import Fraction

import numpy as np
import pytest
from hard_fire import UNIT, hdr, levels

from spikerig.dataset.kernels import count, fire, unpack
from spikerig.dataset.oracles import fixed_light
from spikerig.dataset.sim_kernels import fire_noisy
from spikerig.rigctl.sim.stream import opened, spike_blocks

KEY = (7, 11)


def counts(bits: np.ndarray, width: int) -> np.ndarray:
    return count(bits, width, 0, len(bits)).astype(np.int64)


def held(light: np.ndarray, ticks: int, start: np.ndarray | None = None, **options) -> tuple:
    start = np.zeros(light.shape, np.uint32) if start is None else start
    return fire(light[None].astype(np.float32), np.array([0, ticks]), start, hold=True, **options)


@pytest.mark.parametrize("ticks", [1, 5000])
def test_no_light(ticks: int) -> None:
    start = np.random.default_rng(0).integers(0, 2**32, (3, 41), dtype=np.uint32)
    dark, knots = np.zeros((2, 3, 41), np.float32), np.array([0, ticks])
    for bits, left, lost in (
        fire(dark, knots, start, hold=False),
        fire(dark, knots, start, hold=False, carry=True),
        fire_noisy(dark, knots, start, hold=False, shot=(560.0, KEY), reset_loss=0.5),
    ):
        assert not bits.any()
        assert np.array_equal(left, start)
        assert not lost.any()


def test_at_the_threshold() -> None:
    one = np.float32(1)
    below, above = np.nextafter(one, np.float32(0)), np.nextafter(one, np.float32(2))
    light = np.array([[below, one, above]])
    ticks = 2**24 + 5
    account, counted, before = opened(np.zeros((1, 3))), np.zeros(3, np.int64), np.zeros(3, np.int64)
    for block in spike_blocks([(0, light), (ticks, light)], account, hold=True, block_ticks=2**20):
        counted += counts(block, 3)[0]
        if account.ticks == 2**20:
            before = counted.copy()
    # a hair below misses the very first tick, and then one in 2^24
    assert before.tolist() == [2**20 - 1, 2**20, 2**20]
    assert counted.tolist() == [ticks - 2, ticks, ticks]
    assert account.lost[0].tolist() == [0, 0, ticks * 2.0**-23]
    assert account.charge[0].tolist() == [2**33 - ticks * 2**8, 0, 0]
    noisy = fire_noisy(light[None], np.array([0, 50]), np.zeros((1, 3), np.int64), hold=True, reset_loss=0.0)
    assert counts(noisy[0], 3)[0].tolist() == [49, 50, 50]


@pytest.mark.parametrize("hold", [False, True])
def test_far_above_the_threshold(hold: bool) -> None:
    rng = np.random.default_rng(1)
    knots = np.array([0, 1, 64, 65, 300])
    light = (2.0 ** rng.uniform(1, 18, (5, 4, 37))).astype(np.float32)
    start = rng.integers(0, 2**32, (4, 37), dtype=np.uint32)
    bits, left, clipped = fire(light, knots, start, hold=hold)
    assert (counts(bits, 37) == 300).all()
    assert np.array_equal(left, start)  # what counts of each tick is one threshold
    put_in = [[int(x) for x in row] for row in fixed_light(light, knots, hold=hold).astype(object).sum(0)]
    assert clipped.tolist() == [[float(Fraction(x - 300 * 2**32, 2**32)) for x in row] for row in put_in]


@pytest.mark.parametrize(("low", "high"), [(0.0, 2.0), (0.5, 1.5), (0.999, 1.001), (0.0, 1000.0), (1.0, 1.0)])
def test_a_ramp_through_the_threshold(low: float, high: float) -> None:
    """Up and down again, the tick of crossing anywhere in a stretch of 64: clipped is the integer sum above one."""
    for ticks in (1, 3, 64, 100, 517):
        rows = np.array([low, high, low], np.float32)[:, None, None] * np.ones((1, 1, 70), np.float32)
        knots, start = np.array([0, ticks, 2 * ticks]), np.arange(70, dtype=np.uint32)[None] << 25
        bits, left, clipped = fire(rows, knots, start, hold=False)
        every = fixed_light(rows, knots, hold=False)[:, 0, 0]
        above = every >= 2**32
        assert unpack(bits, 70)[above].all()
        assert (clipped == int((every - 2**32)[above].sum()) * UNIT).all()
        fired = (counts(bits, 70)[0] << 32) + left[0] - start[0]
        assert (fired == int(np.minimum(every, 2**32).sum())).all()


def test_saturation_clipped_and_carried() -> None:
    """A highlight of 3 thresholds a tick for 10 ticks, then dark."""
    light = np.array([3.0, 0.0], np.float32)[:, None, None] * np.ones((1, 2, 9), np.float32)
    knots, start = np.array([0, 10, 60]), np.full((2, 9), 2**31, np.uint32)
    bits, left, clipped = fire(light, knots, start, hold=True)
    seen = unpack(bits, 9)
    assert seen[:10].all()
    assert not seen[10:].any()
    assert (clipped == 20).all()
    assert (left == 2**31).all()
    for _, waiting, lost in (
        carried := fire(light, knots, start, hold=True, carry=True),
        noisy := fire_noisy(light, knots, start, hold=True, carry=True),
    ):
        assert (waiting == 2**31).all()
        assert not lost.any()
    for out in (carried, noisy):
        seen = unpack(out[0], 9)
        assert seen[:30].all()
        assert not seen[30:].any()


def test_two_million_dim_ticks() -> None:
    """The oracle is one multiplication of integers; a running float32 sum of the first is off by half."""
    ticks = 2_000_000
    light = np.array([[1e-8, 3e-7, 1e-5, 0.01, 0.37]], np.float32)
    units = np.rint(light.astype(np.float64) / UNIT).astype(np.int64)
    bits, left, clipped = held(light, ticks)
    total = units * ticks
    assert counts(bits, 5).tolist() == (total >> 32).tolist()
    assert left.tolist() == (total & 0xFFFFFFFF).tolist()
    assert not clipped.any()
    assert (np.abs(total * UNIT - light.astype(np.float64) * ticks) <= ticks * UNIT / 2).all()
    account, counted = opened(np.zeros((1, 5))), 0
    for block in spike_blocks([(0, light[0:1]), (ticks, light)], account, hold=False, block_ticks=100_003):
        counted = counted + counts(block, 5)
    assert np.array_equal(counted, counts(bits, 5))
    assert np.array_equal(account.charge, left)
    drifted = np.cumsum(np.full(ticks, light[0, 3], np.float32))[-1]
    assert abs(float(drifted) - ticks * float(light[0, 3])) > 10  # what this is not


@pytest.mark.parametrize("ends", [(0.0, 1e-9), (1e-7, 0.0), (0.3, 0.300001), (2.0, 0.0), (0.0, 1.0)])
def test_two_million_ticks_of_a_ramp(ends: tuple[float, float]) -> None:
    ticks = 2_000_000
    rows = np.array(ends, np.float32)[:, None, None]
    bits, left, clipped = fire(rows, np.array([0, ticks]), np.zeros((1, 1), np.uint32), hold=False)
    exact = (float(rows[0, 0, 0]) + float(rows[1, 0, 0])) / 2 * ticks
    got = counts(bits, 1)[0, 0] + left[0, 0] * UNIT + clipped[0, 0]
    assert exact - 1.25 * ticks * UNIT <= got <= exact + 0.25 * ticks * UNIT
    assert clipped[0, 0] == pytest.approx(ticks / 4 if ends[0] == 2 else 0.0, rel=1e-6)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 7), (2, 9), (5, 17), (1, 1025)])
def test_odd_sizes(height: int, width: int) -> None:
    """A pixel's spikes are the same in a picture of any size; padding bits are zero."""
    rng = np.random.default_rng(2)
    light = (1.3 * rng.random((3, height, width))).astype(np.float32)
    wide = np.zeros((3, height, width + 70), np.float32)
    wide[..., :width] = light
    knots = np.array([0, 50, 130])
    small = fire(light, knots, np.zeros((height, width), np.uint32), hold=False)
    large = fire(wide, knots, np.zeros((height, width + 70), np.uint32), hold=False)
    assert np.array_equal(unpack(small[0], width), unpack(large[0], width + 70)[..., :width])
    assert np.array_equal(small[2], large[2][:, :width])
    bits = fire_noisy(
        light, knots, np.zeros((height, width), np.int64), hold=False, shot=(9.0, KEY), comparator=(1.0, KEY)
    )[0]
    assert not np.unpackbits(bits, axis=2, bitorder="little")[..., width:].any()
    assert bits.any()


def test_no_tick_and_one_tick() -> None:
    light, start = np.full((1, 2, 3), 0.5, np.float32), np.full((2, 3), 2**31, np.uint32)
    for run, options in ((fire, {}), (fire, {"carry": True}), (fire_noisy, {"reset_loss": 0.1})):
        bits, left, lost = run(light, np.array([4]), start, hold=False, **options)
        assert bits.shape == (0, 2, 1)
        assert np.array_equal(left, start)
        assert not lost.any()
        bits, left, _ = run(light, np.array([4, 5]), start, hold=True, **options)
        assert (bits == 0b111).all()
        assert not left.any()


def test_float32_moves_only_crossings() -> None:
    """Light rounded to float32 against the same light in exact units: a boundary band.

    Sums differ by at most ticks * light * 2^-24, so a spike can only move where the exact charge, after the tick or
    the one before, is that close to a threshold; and counts differ only where the last charge is.
    """
    rng = np.random.default_rng(5)
    ticks, shape = 3000, (20, 100)
    exact = rng.random(shape) * 0.9
    units = np.rint(exact / UNIT).astype(np.int64)
    bits, left, _ = held(exact, ticks)
    every = (np.arange(1, ticks + 1)[:, None, None] * units) & 0xFFFFFFFF
    reference = np.diff((np.arange(ticks + 1)[:, None, None] * units) >> 32, axis=0)
    moved = unpack(bits, 100) != reference
    band = np.arange(1, ticks + 1)[:, None, None] * (np.maximum(units * 2.0**-24, 0) + 1)
    near = np.minimum(every, 2**32 - every) <= band
    near |= np.concatenate([near[:1], near[:-1]])
    assert moved.any()
    assert not (moved & ~near).any()
    off = counts(bits, 100) - reference.sum(0)
    assert np.abs(off).max() <= 1
    assert not off[~near[-1]].any()
    drift = (counts(bits, 100) << 32) + left.astype(np.int64) - ticks * units
    assert (np.abs(drift) <= band[-1]).all()


def test_light_that_float32_holds_is_exact() -> None:
    light = levels(np.random.default_rng(6), (7, 33), 24, 2**24)
    bits, left, _ = held(light, 777)
    total = np.rint(light / UNIT).astype(np.int64) * 777
    assert np.array_equal((counts(bits, 33) << 32) + left, total)


def test_hdr() -> None:
    light, ticks = hdr(12, 40), 40_000
    for bits in (
        held(light, ticks)[0],
        fire_noisy(
            light[None].astype(np.float32), np.array([0, ticks]), np.zeros(light.shape, np.int64), hold=True,
            shot=(1e12, KEY),
        )[0],
    ):  # fmt: skip
        assert (np.abs(counts(bits, 40) - light * ticks) <= 1).all()
    few = fire_noisy(
        light[None].astype(np.float32), np.array([0, ticks]), np.zeros(light.shape, np.int64), hold=True,
        shot=(560.0, KEY),
    )[0]  # fmt: skip
    off = counts(few, 40) - light * ticks
    assert (np.abs(off) <= 1 + 5 * np.sqrt(light * ticks / 560)).all()
    assert np.abs(off).max() > 3
