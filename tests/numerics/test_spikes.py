"""Spike kernels and textures on the named hard inputs, against integer arithmetic."""

import numpy as np
import pytest
from hard_spikes import LIGHTS, STREAMS

from spikerig.dataset import kernels, oracles, texture

METHODS = {
    "tfp 1": lambda s, at: texture.tfp(s, at, 1),
    "tfp 6": lambda s, at: texture.tfp(s, at, 6),
    "tfp 1001": lambda s, at: texture.tfp(s, at, 1001),
    "tfi": texture.tfi,
    "tfi 4": lambda s, at: texture.tfi(s, at, intervals=4),
    "tfi causal": lambda s, at: texture.tfi(s, at, causal=True),
    "adaptive": texture.tfp_adaptive,
}


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS.keys())
@pytest.mark.parametrize("stream", STREAMS.values(), ids=STREAMS.keys())
def test_textures_are_finite_and_honest(stream, method):
    pixels = oracles.unpack(stream.bits, stream.width)
    for at in {0, 0.5, stream.ticks // 2, max(stream.ticks - 1, 0), stream.ticks}:
        if at > stream.ticks:
            continue
        made = method(stream, at)
        assert made.light.shape == made.known.shape == pixels.shape[1:]
        assert np.isfinite(made.light).all()
        assert made.light.min(initial=0) >= 0
        assert made.light.max(initial=0) <= 1
        assert not made.light[~made.known].any()
        if made.method.startswith("tfi"):  # light from a spike that is not there would be made up
            assert np.all(made.light[made.known] > 0)
            assert not made.known[:, pixels.sum((0, 1)) == 0].any() if stream.ticks else not made.known.any()


@pytest.mark.parametrize("stream", STREAMS.values(), ids=STREAMS.keys())
def test_kernels(isa, stream):
    bits, width, ticks = stream.bits, stream.width, stream.ticks
    assert np.array_equal(kernels.unpack(bits, width), oracles.unpack(bits, width))
    assert np.array_equal(kernels.count(bits, width, 0, ticks), oracles.count(bits, width, 0, ticks))
    assert np.array_equal(kernels.tfi_all(bits, width), oracles.tfi_all(bits, width))
    for tick in {0, ticks // 2, ticks}:
        for mine, true in zip(kernels.tfi_at(bits, width, tick), oracles.tfi_at(bits, width, tick), strict=True):
            assert np.array_equal(mine, true)


def test_count_of_a_long_window(isa):
    bits = np.broadcast_to(np.uint8(0xFF), (70_000, 1, 2)).copy()
    bits[12_345] = 0
    assert np.all(kernels.count(bits, 16, 0, 70_000) == 69_999)


@pytest.mark.parametrize("ticks", [1, 2, 63, 64, 65, 1000])
@pytest.mark.parametrize("ends", LIGHTS.values(), ids=LIGHTS.keys())
def test_fire_conserves_charge_at_the_extremes(isa, ends, ticks):
    light = np.broadcast_to(np.array(ends, np.float32)[:, None, None], (2, 2, 70)).copy()
    light[1, 0, 3] = 0.5  # and neighbours of another kind in the same vector
    charge = np.array([0, 1, 2**31, 2**32 - 1], np.uint32)[np.arange(140) % 4].reshape(2, 70)
    knots = np.array([0, ticks])
    bits, left, clipped = kernels.fire(light, knots, charge, hold=False)
    every = oracles.fixed_light(light, knots, hold=False)
    fired = oracles.count(bits, 70, 0, ticks).astype(object)
    put_in = every.astype(object).sum(0) + charge.astype(object)
    for total, spikes, rest, excess in zip(put_in.flat, fired.flat, left.flat, clipped.flat, strict=True):
        excess = int(excess * 2.0**32)
        off = total - spikes * 2**32 - int(rest) - excess
        assert off == 0 if excess < 2**53 else abs(off) <= excess >> 53  # as exact as a float64 can say it
    for mine, true in zip((bits, left, clipped), oracles.fire(light, knots, charge, hold=False), strict=True):
        assert np.array_equal(mine, true)
    if min(ends) >= 1:
        assert np.array_equal(left[1], charge[1])  # saturated: a spike every tick, the charge stays
        assert np.all(fired[1] == ticks)


def test_the_sun_for_a_long_time(isa):
    light = np.full((1, 1, 9), 2.0**18, np.float32)
    _, left, clipped = kernels.fire(light, np.array([0, 100_000]), np.full((1, 9), 7, np.uint32), hold=True)
    assert np.all(left == 7)
    assert np.all(clipped == 100_000 * (2.0**18 - 1))  # 2^66 units: more than an int64 holds


def test_a_unit_of_charge_counts(isa):
    light = np.full((1, 1, 9), 2.0**-32, np.float32)
    charge = np.full((1, 9), 2**32 - 1000, np.uint32)
    bits, left, _ = kernels.fire(light, np.array([0, 1000]), charge, hold=True)
    assert np.all(left == 0)
    assert oracles.unpack(bits, 9).sum((1, 2)).nonzero()[0].tolist() == [999]


@pytest.mark.parametrize("light", [1 / 3, 0.1, 0.7, 1e-3])
def test_fire_does_not_drift(isa, light):
    value = np.float32(light)
    ticks = 1_000_000
    rows = np.full((2, 1, 9), value)
    for hold in (True, False):
        bits, left, clipped = kernels.fire(rows, np.array([0, ticks]), np.zeros((1, 9), np.uint32), hold=hold)
        exact = int(np.rint(float(value) * 2**32)) * ticks
        assert kernels.count(bits, 9, 0, ticks).tolist() == [[exact >> 32] * 9]
        assert left.tolist() == [[exact & (2**32 - 1)] * 9]
        assert not clipped.any()


def test_a_long_ramp_has_the_area_of_its_triangle(isa):
    ticks = 1_000_000
    light = np.array([[[0.0] * 9], [[0.9] * 9]], np.float32)
    bits, _, _ = kernels.fire(light, np.array([0, ticks]), np.full((1, 9), 2**31, np.uint32), hold=False)
    area = float(np.float32(0.9)) * ticks / 2
    assert np.abs(kernels.count(bits, 9, 0, ticks) - area).max() <= 1


@pytest.mark.parametrize("width", [*range(1, 18), 31, 33, 63, 65, 127, 129, 511, 513, 1023, 1025])
def test_every_width(isa, width):
    rng = np.random.default_rng(width)
    light = rng.random((3, 3, width)).astype(np.float32) * 1.3
    charge = rng.integers(0, 2**32, (3, width), dtype=np.uint32)
    knots = np.array([0, 5, 71])
    bits, left, clipped = kernels.fire(light, knots, charge, hold=False)
    for mine, true in zip((bits, left, clipped), oracles.fire(light, knots, charge, hold=False), strict=True):
        assert np.array_equal(mine, true)
    padding = np.unpackbits(bits, axis=2, bitorder="little")[:, :, width:]
    assert not padding.any()
    assert np.array_equal(kernels.unpack(bits, width), oracles.unpack(bits, width))
    assert np.array_equal(kernels.count(bits, width, 3, 70), oracles.count(bits, width, 3, 70))
    assert np.array_equal(kernels.tfi_all(bits, width), oracles.tfi_all(bits, width))
    for mine, true in zip(kernels.tfi_at(bits, width, 30), oracles.tfi_at(bits, width, 30), strict=True):
        assert np.array_equal(mine, true)
