"""Firing with noise: the native kernel against its oracle, and the physics of each effect."""

import itertools

import numpy as np
import pytest

from spikerig import _native
from spikerig.dataset import kernels, oracles, sim_kernels, sim_oracles
from spikerig.dataset.errors import NumericsError, UsageError

KNOTS = {
    "one tick": [5, 6],
    "one tick each": [0, 1, 2, 3, 4, 5],
    "uneven": [-3, -2, 8, 72, 73, 137, 210],
}
EFFECTS = {
    "none": {},
    "carry": {"carry": True},
    "shot": {"shot": (560.0, (1, 2))},
    "few electrons": {"shot": (7.0, (3, 2)), "carry": True},
    "comparator": {"comparator": (0.02, (5, 6))},
    "loud comparator": {"comparator": (0.7, (2**32 - 1, 6)), "carry": True},
    "loss": {"reset_loss": 0.3},
    "deaf": {"reset_loss": 1.0},
    "all": {"shot": (40.0, (1, 2)), "comparator": (0.1, (2, 1)), "reset_loss": 0.002, "first_tick": 2**40 + 3},
}


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


def light_rows(k, shape, top, seed=0):
    """Light up to `top`, much of it dim, with exact zeros and ones."""
    rng = np.random.default_rng(seed)
    light = (rng.random((k, *shape)) ** 3 * top).astype(np.float32)
    for value in (0, 1, 1e-4):
        light[rng.random(light.shape) < 0.07] = value
    return light


def starts(shape):
    return np.random.default_rng(1).integers(-(2**31), 2**33, shape)


@pytest.mark.parametrize("effects", EFFECTS.values(), ids=EFFECTS.keys())
@pytest.mark.parametrize("knots", KNOTS.values(), ids=KNOTS.keys())
@pytest.mark.parametrize("hold", [False, True])
def test_equals_its_definition(isa, hold, knots, effects):
    for shape, top in (((3, 13), 0.9), ((5, 129), 3.0), ((1, 1029), 1000.0)):
        light, charge = light_rows(len(knots), shape, top), starts(shape)
        before = np.random.default_rng(2).integers(0, 256, (shape[0], (shape[1] + 7) // 8), dtype=np.uint8)
        given = charge.copy()
        mine = sim_kernels.fire_noisy(light, np.array(knots), charge, hold=hold, before=before, **effects)
        true = sim_oracles.fire_noisy(light, np.array(knots), charge, hold=hold, before=before, **effects)
        for a, b in zip(mine, true, strict=True):
            assert a.dtype == b.dtype
            assert np.array_equal(a, b)
        assert np.array_equal(charge, given)


@pytest.mark.parametrize("carry", [False, True])
def test_without_noise_it_is_fire(isa, carry):
    light, knots = light_rows(4, (7, 75), 2.5), np.array([0, 3, 90, 150])
    charge = np.random.default_rng(3).integers(0, 2**32, (7, 75), dtype=np.uint32)
    plain = kernels.fire(light, knots, charge, hold=False, carry=carry)
    noisy = sim_kernels.fire_noisy(light, knots, charge, hold=False, carry=carry)
    for a, b in zip(plain, noisy, strict=True):
        assert np.array_equal(a, b)


@pytest.mark.parametrize("cuts", [range(-10, 51), [-10, -3, 10, 50], [-10, 49, 50], [-10, -6, 50]])
def test_spans_of_any_length_give_the_same_bits(isa, cuts):
    light, charge, knots = light_rows(4, (4, 70), 1.5), starts((4, 70)), np.array([-10, 1, 22, 50])
    effects = {"shot": (40.0, (1, 2)), "comparator": (0.1, (2, 1)), "reset_loss": 0.1}
    whole = sim_kernels.fire_noisy(light, knots, charge, hold=False, **effects)
    bits, before, lost = [], None, 0.0
    for span in itertools.pairwise(cuts):
        part, charge, gone = sim_kernels.fire_noisy(
            light, knots, charge, hold=False, span=span, before=before, **effects
        )
        bits.append(part)
        before, lost = part[-1], lost + gone
    assert np.array_equal(np.concatenate(bits), whole[0])
    assert np.array_equal(charge, whole[1])
    assert np.allclose(lost, whole[2], rtol=1e-15)


def test_threads_do_not_matter():
    light, charge = light_rows(3, (40, 133), 1.5), starts((40, 133))
    seen = set()
    for threads in (1, 2, 3):
        _native.set_threads(threads)
        out = sim_kernels.fire_noisy(light, np.array([0, 30, 61]), charge, hold=False, **EFFECTS["all"])
        seen.add(b"".join(a.tobytes() for a in out))
    assert len(seen) == 1


def total_charge(bits, width, after, charge, lost):
    fired = kernels.count(bits, width, 0, len(bits)).astype(np.int64)
    return (fired << 32) + after - charge + np.rint(lost * 2.0**32).astype(np.int64)


@pytest.mark.parametrize("carry", [False, True])
def test_charge_is_conserved(carry):
    """What comes in (the light; noise of decisions adds none) is fired, left or lost, to the last unit."""
    light, charge = light_rows(3, (6, 50), 2.0), starts((6, 50))
    knots = np.array([0, 100, 321])
    bits, after, lost = sim_kernels.fire_noisy(
        light, knots, charge, hold=False, comparator=(0.2, (1, 2)), reset_loss=0.01, carry=carry
    )
    put_in = oracles.fixed_light(light, knots, hold=False).sum(0)
    assert np.array_equal(total_charge(bits, 50, after, charge, lost), put_in)
    assert lost.max() > (0 if carry else 1)


def test_shot_noise_of_counts():
    """Mean and variance of the electrons of many ticks, as Poisson's, for few electrons a tick and for many."""
    height, width, ticks = 60, 100, 400
    start = np.zeros((height, width), np.int64)
    for level, electrons in ((0.3, 560.0), (0.3, 10.0), (0.002, 100.0), (0.9, 1e6)):
        light = np.full((1, height, width), level, np.float32)
        _, after, lost = out = sim_kernels.fire_noisy(
            light, np.array([0, ticks]), start, hold=True, shot=(electrons, (7, 8)), carry=True
        )
        got = total_charge(out[0], width, after, start, lost) / 2.0**32 * electrons
        expected = float(light[0, 0, 0]) * electrons * ticks
        sd = np.sqrt(expected)
        assert got.mean() == pytest.approx(expected, abs=4 * sd / np.sqrt(got.size))
        assert got.var() == pytest.approx(expected, rel=4 * np.sqrt(2 / got.size))


def test_electrons_of_each_pixel():
    rng = np.random.default_rng(4)
    electrons = rng.uniform(20, 900, (3, 50)).astype(np.float32)
    light, start, knots = light_rows(1, (3, 50), 0.9), np.zeros((3, 50), np.int64), np.array([0, 40])
    many = sim_kernels.fire_noisy(light, knots, start, hold=True, shot=(electrons, (1, 9)))
    for y, x in ((0, 0), (2, 31), (1, 49)):
        one = sim_kernels.fire_noisy(light, knots, start, hold=True, shot=(float(electrons[y, x]), (1, 9)))
        assert np.array_equal(kernels.unpack(one[0], 50)[:, y, x], kernels.unpack(many[0], 50)[:, y, x])


def test_shot_noise_vanishes_with_many_electrons():
    light, start, knots = light_rows(2, (5, 40), 0.9), np.zeros((5, 40), np.int64), np.array([0, 300])
    ideal = sim_kernels.fire_noisy(light, knots, start, hold=False)
    noisy = sim_kernels.fire_noisy(light, knots, start, hold=False, shot=(1e12, (1, 9)))
    off = total_charge(noisy[0], 40, noisy[1], start, noisy[2]) - total_charge(ideal[0], 40, ideal[1], start, ideal[2])
    assert 0 < np.abs(off).max() / 2**32 < 6 * np.sqrt(300 * 0.9 / 1e12)


def test_comparator_noise_jitters_spikes_and_is_not_kept():
    """Spikes come early or late, some sd/light ticks; counts do not drift, and nothing is lost."""
    light, knots = np.full((1, 50, 80), 0.02, np.float32), np.array([0, 5000])
    start = np.random.default_rng(6).integers(0, 2**32, (50, 80))
    bits, after, lost = sim_kernels.fire_noisy(light, knots, start, hold=True, comparator=(0.05, (3, 1)))
    counted = kernels.count(bits, 80, 0, 5000)
    assert not lost.any()
    assert counted.mean() == pytest.approx(100, abs=0.1)
    assert counted.std() < 0.5
    assert -0.3 < after.min() / 2**32 < -0.05
    gaps = np.diff(np.nonzero(kernels.unpack(bits, 80)[:, 7, 7])[0])
    assert gaps.mean() == pytest.approx(50, abs=0.1)
    assert 1 < gaps.std() < 4
    ideal = kernels.fire(light, knots, start.astype(np.uint32), hold=True)[0]
    none = sim_kernels.fire_noisy(light, knots, start, hold=True, comparator=(0.0, (3, 1)))[0]
    assert np.array_equal(none, ideal)


def test_reset_loss_takes_its_share_of_ticks_after_spikes():
    light, start = np.full((1, 1, 9), 0.5, np.float32), np.zeros((1, 9), np.int64)
    bits, after, lost = sim_kernels.fire_noisy(light, np.array([0, 4000]), start, hold=True, reset_loss=0.25)
    fired = int(kernels.count(bits, 9, 0, 4000)[0, 0])
    assert lost[0, 0] == (fired - int(bits[-1, 0, 0] & 1)) * 0.125
    assert after[0, 0] / 2**32 == 2000 - fired - lost[0, 0]
    assert fired == 1777  # 2000 / (1 + 1/8)
    bright = sim_kernels.fire_noisy(light * 4, np.array([0, 10]), start, hold=True, reset_loss=0.25)
    assert bright[2][0, 0] == 10  # 1.5 of 2 left after a reset: still one threshold counts, one is clipped or lost


def test_what_is_refused():
    light, knots, start = np.full((1, 2, 9), 0.5, np.float32), np.array([0, 3]), np.zeros((2, 9), np.int64)
    for bad in (
        {"reset_loss": 1.01},
        {"reset_loss": -0.1},
        {"reset_loss": np.nan},
        {"comparator": (1.5, (1, 2))},
        {"comparator": (-0.1, (1, 2))},
        {"comparator": (0.1, (1, 2**32))},
        {"shot": (0.5, (1, 2))},
        {"shot": (np.nan, (1, 2))},
        {"shot": (1e13, (1, 2))},
        {"shot": (100.0, (-1, 2))},
        {"shot": (np.full((3, 9), 100.0), (1, 2))},
        {"before": np.zeros((2, 1), np.uint8)},
    ):
        with pytest.raises(UsageError):
            sim_kernels.fire_noisy(light, knots, start, hold=True, **bad)
    with pytest.raises(UsageError, match="charge"):
        sim_kernels.fire_noisy(light, knots, start.astype(float), hold=True)
    with pytest.raises(NumericsError, match="charge"):
        sim_kernels.fire_noisy(light, knots, start + 2**62, hold=True)
    with pytest.raises(NumericsError, match="light"):
        sim_kernels.fire_noisy(light - 1, knots, start, hold=True)
