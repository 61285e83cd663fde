"""The native spike kernels equal their oracles, on every instruction set and for any number of threads."""

import itertools

import numpy as np
import pytest

from spikerig import _native
from spikerig.dataset import kernels, oracles
from spikerig.dataset.errors import NumericsError, UsageError

# widths around bytes, vectors of 8/16/32/64 pixels and kernel sections of 64..1024 bytes; heights to match
SHAPES = [
    (0, 3, 5), (1, 1, 1), (2, 1, 8), (7, 3, 13), (41, 10, 400), (300, 5, 250), (600, 3, 67), (9, 33, 1003),
    (3, 40, 1000), (17, 2, 4099), (250, 2, 64),
]  # fmt: skip


@pytest.fixture(autouse=True)
def _restore_isa_and_threads():
    isa, threads = _native.isa(), _native.threads()
    yield
    _native.set_isa(isa)
    _native.set_threads(threads)


@pytest.fixture(params=_native.isas())
def isa(request):
    """Every instruction set this CPU has, forced in turn."""
    _native.set_isa(request.param)
    return request.param


def spikes(shape, seed=0):
    """Spikes with rates from 0 to 1/2 by pixel, some pixels dark and some firing every tick."""
    rng = np.random.default_rng(seed)
    rate = rng.random(shape[1:]) ** 2 / 2
    rate[rng.random(rate.shape) < 0.05] = 0
    rate[rng.random(rate.shape) < 0.05] = 1
    return (rng.random(shape) < rate).astype(np.uint8)


@pytest.mark.parametrize("shape", SHAPES)
def test_unpack(isa, shape):
    pixels = spikes(shape)
    assert np.array_equal(kernels.unpack(oracles.pack(pixels), shape[2]), pixels)


@pytest.mark.parametrize("shape", SHAPES)
def test_count(isa, shape):
    ticks, _, width = shape
    bits = oracles.pack(spikes(shape))
    for t0, t1 in {(0, ticks), (0, 0), (ticks, ticks), (ticks // 3, ticks // 2), (ticks // 2, ticks), (0, ticks // 7)}:
        assert np.array_equal(kernels.count(bits, width, t0, t1), oracles.count(bits, width, t0, t1)), (t0, t1)


@pytest.mark.parametrize("ticks", [247, 248, 249, 255, 256, 496, 497, 1000])
def test_count_of_a_spike_every_tick_fills_and_empties_the_planes(isa, ticks):
    bits = oracles.pack(np.ones((ticks, 2, 70), np.uint8))
    assert np.all(kernels.count(bits, 70, 0, ticks) == ticks)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("before", "after"), [(1, 1), (2, 1), (1, 3), (3, 2)])
def test_tfi_at(isa, shape, before, after):
    ticks, _, width = shape
    bits = oracles.pack(spikes(shape))
    for tick in {0, 1 if ticks else 0, ticks // 2, ticks}:
        mine = kernels.tfi_at(bits, width, tick, before=before, after=after)
        true = oracles.tfi_at(bits, width, tick, before=before, after=after)
        assert np.array_equal(mine[0], true[0]), tick
        assert np.array_equal(mine[1], true[1]), tick


@pytest.mark.parametrize("shape", [s for s in SHAPES if s[0] < 300])
def test_tfi_all(isa, shape):
    bits = oracles.pack(spikes(shape))
    assert np.array_equal(kernels.tfi_all(bits, shape[2]), oracles.tfi_all(bits, shape[2]))


def test_tfi_all_saturates_at_65535(isa):
    for gap in (65534, 65535, 65536, 70000):
        pixels = np.zeros((gap + 2, 1, 35), np.uint8)
        pixels[[0, gap]] = 1
        found = kernels.tfi_all(oracles.pack(pixels), 35)
        assert not found[0].any()
        assert not found[gap + 1].any()
        assert np.all(found[1 : gap + 1] == min(gap, 65535)), gap


def light_rows(k, shape, top, seed=0):
    """Light up to `top` with rows of exact zeros, ones, and the last float below one."""
    rng = np.random.default_rng(seed)
    light = (rng.random((k, *shape)) * top).astype(np.float32)
    for value in (0, 1, np.nextafter(np.float32(1), np.float32(0)), top):
        light[rng.random(light.shape) < 0.07] = value
    return light


KNOTS = {
    "one tick": [5, 6],
    "one tick each": [0, 1, 2, 3],
    "uneven": [-3, -2, 8, 72, 73, 137, 402],
    "long": [10, 1500],
}


@pytest.mark.parametrize("hold", [False, True])
@pytest.mark.parametrize("knots", KNOTS.values(), ids=KNOTS.keys())
@pytest.mark.parametrize(("shape", "top"), [((3, 13), 0.9), ((2, 400), 1.0), ((5, 129), 3.0), ((1, 1029), 1000.0)])
def test_fire_equals_its_closed_form(isa, shape, top, knots, hold):
    knots = np.array(knots)
    light = light_rows(len(knots), shape, np.float32(top))
    charge = np.random.default_rng(1).integers(0, 2**32, shape, dtype=np.uint32)
    before = charge.copy()
    mine = kernels.fire(light, knots, charge, hold=hold)
    true = oracles.fire(light, knots, charge, hold=hold)
    for a, b in zip(mine, true, strict=True):
        assert a.dtype == b.dtype
        assert np.array_equal(a, b)
    assert np.array_equal(charge, before)  # the caller's charge is left as it is


def test_fire_conserves_charge_in_integers(isa):
    light = light_rows(6, (4, 77), np.float32(2.5))
    knots = np.array([0, 7, 40, 41, 300, 417])
    charge = np.random.default_rng(2).integers(0, 2**32, (4, 77), dtype=np.uint32)
    bits, left, clipped = kernels.fire(light, knots, charge, hold=False)
    put_in = oracles.fixed_light(light, knots, hold=False).sum(0) + charge.astype(np.int64)
    fired = kernels.count(bits, 77, 0, 417).astype(np.int64)
    excess = clipped * 2.0**32
    assert np.array_equal(excess, np.rint(excess))
    assert np.array_equal(put_in, (fired << 32) + left + excess.astype(np.int64))
    assert clipped.max() > 1  # the case is not empty


def step_form(light, charge):
    """The paper's step form, a tick at a time in Python's integers: add, fire at a threshold, keep the surplus."""
    unit, one = [], 2**32
    for row in light:
        fired = []
        for i, x in enumerate(row):
            charge[i] += min(int(x), one)
            fired.append(charge[i] >= one)
            charge[i] -= one * fired[-1]
        unit.append(fired)
    return np.array(unit), charge


def test_fire_equals_the_step_form(isa):
    light = light_rows(4, (1, 29), np.float32(1.5))
    knots = np.array([0, 30, 31, 120])
    charge = np.random.default_rng(3).integers(0, 2**32, (1, 29), dtype=np.uint32)
    bits, left, _ = kernels.fire(light, knots, charge, hold=False)
    every = oracles.fixed_light(light, knots, hold=False)
    fired, expect = step_form(every[:, 0], [int(c) for c in charge[0]])
    assert np.array_equal(kernels.unpack(bits, 29)[:, 0], fired)
    assert [int(c) for c in left[0]] == expect


def test_a_ramp_is_evaluated_at_the_middle_of_each_tick():
    light = np.array([[[0.0]], [[0.5]]], np.float32)
    every = oracles.fixed_light(light, np.array([0, 10]), hold=False)[:, 0, 0] / 2.0**32
    assert np.allclose(every, 0.05 * (np.arange(10) + 0.5), atol=2**-32)


@pytest.mark.parametrize("level", [2.0**-32, 2.0**-25, 2.0**-20])
def test_a_long_ramp_never_falls_below_zero(isa, level):
    """Rounding a slope of nearly nothing a million times must not make light negative, which would read as bright."""
    light, knots = np.array([[[level]], [[0.0]]], np.float32), np.array([0, 1_000_000])
    bits, left, clipped = kernels.fire(light, knots, np.full((1, 1), 5, np.uint32), hold=False)
    assert not bits[:500_000].any()
    assert kernels.count(bits, 1, 0, 1_000_000) + left / 2.0**32 == pytest.approx(level * 500_000, abs=2.5e-4)
    assert not clipped.any()


@pytest.mark.parametrize("hold", [False, True])
def test_fire_carries_what_is_beyond_a_spike(isa, hold):
    knots = np.array([0, 3, 67, 100, 190])
    light = light_rows(5, (3, 141), np.float32(2.5))
    light[3:] *= np.float32(0.1)
    charge = np.random.default_rng(4).integers(0, 2**34, (3, 141))
    mine = kernels.fire(light, knots, charge, hold=hold, carry=True)
    true = oracles.fire(light, knots, charge, hold=hold, carry=True)
    for a, b in zip(mine, true, strict=True):
        assert a.dtype == b.dtype
        assert np.array_equal(a, b)
    assert not mine[2].any()
    put_in = oracles.fixed_light(light, knots, hold=hold).sum(0)
    assert np.array_equal(put_in, (kernels.count(mine[0], 141, 0, 190).astype(np.int64) << 32) + mine[1] - charge)
    assert mine[1].max() > 2**32  # some still wait


def test_fire_carries_no_more_than_fits(isa):
    light, knots = np.full((1, 1, 3), 2.0**18, np.float32), np.array([0, 70])
    charge = np.array([[2**62 - 2**52, 2**62 - 1, 0]])
    bits, left, clipped = kernels.fire(light, knots, charge, hold=True, carry=True)
    true = oracles.fire(light, knots, charge, hold=True, carry=True)
    assert np.array_equal(clipped, true[2])
    assert np.array_equal(left, true[1])
    assert clipped[0, 0] > 0
    assert clipped[0, 2] == 0
    assert kernels.count(bits, 3, 0, 70).tolist() == [[70, 70, 70]]


@pytest.mark.parametrize("carry", [False, True])
@pytest.mark.parametrize("hold", [False, True])
@pytest.mark.parametrize("cuts", [[-5, -5, 0, 1, 63, 64, 200, 300], [-5, 150, 300], [-5, 299, 300]])
def test_fire_in_spans_gives_the_bits_of_the_whole(isa, hold, carry, cuts):
    light, knots = light_rows(5, (3, 141), np.float32(1.4)), np.array([-5, 0, 70, 71, 300])
    start = np.random.default_rng(5).integers(0, 2**32, (3, 141), dtype=np.uint32)
    whole = kernels.fire(light, knots, start, hold=hold, carry=carry)
    charge, parts, clipped = start, [], np.zeros((3, 141))
    for span in itertools.pairwise(cuts):
        mine = kernels.fire(light, knots, charge, hold=hold, span=span, carry=carry)
        true = oracles.fire(light, knots, charge, hold=hold, span=span, carry=carry)
        assert all(np.array_equal(a, b) for a, b in zip(mine, true, strict=True))
        parts.append(mine[0])
        charge, clipped = mine[1], clipped + mine[2]
    assert np.array_equal(np.concatenate(parts), whole[0])
    assert np.array_equal(charge, whole[1])
    assert np.allclose(clipped, whole[2], rtol=1e-14)


def test_fire_refuses_spans_outside_the_knots():
    light, start = np.full((1, 2, 9), 0.5, np.float32), np.zeros((2, 9), np.uint32)
    for span in ((-1, 3), (2, 1), (0, 5)):
        with pytest.raises(UsageError, match="span"):
            kernels.fire(light, np.array([0, 4]), start, hold=True, span=span)


def test_fire_needs_no_last_row_to_hold():
    light = light_rows(2, (3, 9), np.float32(0.5))
    charge = np.zeros((3, 9), np.uint32)
    short = kernels.fire(light, np.array([0, 20, 30]), charge, hold=True)
    three = kernels.fire(np.concatenate([light, light[:1] + 7]), np.array([0, 20, 30]), charge, hold=True)
    for a, b in zip(short, three, strict=True):
        assert np.array_equal(a, b)


def test_fire_of_no_ticks_changes_nothing(isa):
    charge = np.arange(10, dtype=np.uint32).reshape(2, 5)
    bits, left, clipped = kernels.fire(np.ones((1, 2, 5), np.float32), np.array([4]), charge, hold=False)
    assert bits.shape == (0, 2, 1)
    assert np.array_equal(left, charge)
    assert not clipped.any()


def test_every_instruction_set_and_team_gives_the_same_bits():
    shape, knots = (37, 413), np.array([0, 3, 90, 150])
    light = light_rows(4, shape, np.float32(1.2))
    charge = np.zeros(shape, np.uint32)
    seen = set()
    for isa in _native.isas():
        for threads in (1, 2, 3):
            _native.set_isa(isa)
            _native.set_threads(threads)
            bits, left, clipped = kernels.fire(light, knots, charge, hold=False)
            parts = [bits, left, clipped, kernels.count(bits, 413, 3, 141), *kernels.tfi_at(bits, 413, 70)]
            parts += [kernels.tfi_all(bits, 413), kernels.unpack(bits, 413)]
            seen.add(b"".join(np.ascontiguousarray(p).tobytes() for p in parts))
    assert len(_native.isas()) * 3 >= 3
    assert len(seen) == 1


@pytest.mark.parametrize("bad", [-1e-9, np.nan, np.inf, 2.0**19])
def test_fire_refuses_light_that_is_none(bad):
    light = np.full((2, 2, 9), 0.5, np.float32)
    light[1, 1, 8] = bad
    with pytest.raises(NumericsError, match="light must be"):
        kernels.fire(light, np.array([0, 10]), np.zeros((2, 9), np.uint32), hold=False)


@pytest.mark.parametrize("knots", [[0, 0], [5, 3], [0], [0, 1, 2, 3], []])
def test_fire_refuses_knots_that_do_not_fit(knots):
    with pytest.raises(UsageError, match="knots"):
        kernels.fire(np.zeros((2, 2, 9), np.float32), np.array(knots, int), np.zeros((2, 9), np.uint32), hold=False)


def test_fire_refuses_other_shapes_and_types():
    light = np.zeros((2, 2, 9), np.float32)
    with pytest.raises(UsageError):
        kernels.fire(light, np.array([0, 4]), np.zeros((2, 8), np.uint32), hold=False)
    with pytest.raises(UsageError):
        kernels.fire(light, np.array([0, 4]), np.zeros((2, 9), np.int64), hold=False)
    for charge in (-1, 2**62):
        with pytest.raises(NumericsError, match="charge"):
            kernels.fire(light, np.array([0, 4]), np.full((2, 9), charge), hold=False, carry=True)


def test_kernels_refuse_what_is_not_packed():
    bits = np.zeros((4, 2, 2), np.uint8)
    for call in (
        lambda: kernels.unpack(bits, 17),
        lambda: kernels.unpack(bits, 8),
        lambda: kernels.unpack(bits.astype(np.int8), 16),
        lambda: kernels.count(bits, 16, 0, 5),
        lambda: kernels.count(bits, 16, 3, 2),
        lambda: kernels.count(bits, 16, -1, 2),
        lambda: kernels.tfi_at(bits, 16, 5),
        lambda: kernels.tfi_at(bits, 16, -1),
        lambda: kernels.tfi_at(bits, 16, 1, before=0),
        lambda: kernels.tfi_all(bits[0], 16),
    ):
        with pytest.raises(UsageError):
            call()


def test_kernels_take_any_memory_layout():
    pixels = spikes((20, 6, 30))
    bits = oracles.pack(pixels)
    flipped, strided = bits[:, ::-1], np.repeat(bits, 2, axis=0)[::2]
    assert np.array_equal(kernels.unpack(flipped, 30), pixels[:, ::-1])
    assert np.array_equal(kernels.count(strided, 30, 2, 17), oracles.count(bits, 30, 2, 17))
