"""The simulator on hard inputs, against closed forms and integer arithmetic."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hard_sim import hdr_light, small, steady

from spikerig.dataset.errors import NumericsError
from spikerig.dataset.kernels import count
from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.capture import take_view, view_path
from spikerig.rigctl.sim.caster.light import Stage
from spikerig.rigctl.sim.effects import Hooks, Site
from spikerig.rigctl.sim.effects.shot import ShotNoise
from spikerig.rigctl.sim.orbit import target_depth
from spikerig.rigctl.sim.sensor import Light, integrate
from spikerig.rigctl.sim.shake import path_px
from spikerig.rigctl.sim.simulate import simulate
from spikerig.rigctl.sim.spec import Sensor

GRAY = (0.25, 0.5, 0.25)  # exact in binary


def counts(bits: np.ndarray, width: int) -> np.ndarray:
    return count(bits, width, 0, len(bits))


def test_no_light() -> None:
    seen = simulate(steady(0.0, 50), Sensor(), [], 0)
    assert not seen.spikes.bits.any()
    assert not seen.left.any()
    assert not seen.clipped.any()
    assert not seen.frame.pixels.any()


def test_at_the_threshold() -> None:
    light = np.ones((1, 2, 9), np.float32)
    bits, left, clipped = integrate(light, np.array([0, 7]), np.zeros((2, 9)))
    assert (counts(bits, 9) == 7).all()
    assert not left.any()
    assert not clipped.any()


@pytest.mark.parametrize("hold", [True, False])
def test_charge_is_conserved(hold: bool) -> None:
    """in = fired + left + clipped, exactly: light in 2^-16 of a threshold, ramps with exact values at every tick."""
    rng = np.random.default_rng(3)
    knots = np.array([0, 64, 96, 224])
    levels = rng.integers(0, 4 * 65536, (3 if hold else 4, 6, 11)) * (rng.random((6, 11)) < 0.8)
    levels[:, 0] >>= 5
    light = (levels / 65536).astype(np.float32)
    start = rng.integers(0, 65536, (6, 11)) / 65536
    bits, left, clipped = integrate(light.copy(), knots, start)
    fired = counts(bits, 11)
    steps = np.diff(knots)
    exact = light.astype(np.float64)
    total = sum(n * (exact[k] if hold else (exact[k] + exact[k + 1]) / 2) for k, n in enumerate(steps))
    assert np.array_equal(total, fired + (left / 2.0**32 - start) + clipped)
    kept = integrate(light.copy(), knots, start, [Hooks(pixel={"carry": True})])
    assert np.array_equal(total, counts(kept[0], 11) + (kept[1] / 2.0**32 - start) + kept[2])
    assert not kept[2].any()
    assert (clipped > 0).any()
    assert (clipped == 0).any()


def test_saturation() -> None:
    light = steady(np.array([[0.1, 2.5, 7.0, 1e4, 2.4999]], np.float32), 64, 1, 5)
    seen = simulate(light, Sensor(gain=0.4, response=GRAY), [], 0)
    assert counts(seen.spikes.bits, 5)[0].tolist() == [2, 64, 64, 64, 63]
    assert (seen.frame.pixels[0, 1:] == 255).all()
    total = 64 * (light.rgb[0] @ np.array(GRAY) * np.float32(0.4)).astype(np.float64)
    back = counts(seen.spikes.bits, 5) + seen.left / 2.0**32 + seen.clipped
    assert np.allclose(back, total, rtol=2e-7, atol=0)


def test_two_million_dim_ticks() -> None:
    ticks, level = 2_000_000, np.array([[1, 3, 1000, 65535]]) / 2.0**20
    total = np.zeros((1, 4), np.int64)
    start = np.zeros((1, 4))
    for _ in range(4):  # half a million at a time: the charge is carried over
        bits, left, clipped = integrate(level[None].astype(np.float32), np.array([0, ticks // 4]), start)
        total += counts(bits, 4)
        start = left / 2.0**32
    assert total.tolist() == [[math.floor(Fraction(v) * ticks) for v in level[0]]]
    assert not clipped.any()


def test_integer_photons_step_by_step() -> None:
    """Eq. 5 and 6 in Python integers: A = (A + I) mod Omega, a spike where A + I >= Omega; bit for bit."""
    omega, ticks, rng = 256, 300, np.random.default_rng(11)
    photons = rng.integers(0, omega + 1, (ticks, 3, 10))
    charge = rng.integers(0, omega, (3, 10))
    bits, left, _ = integrate((photons / omega).astype(np.float32), np.arange(ticks + 1), charge / omega)
    expected = np.zeros((ticks, 3, 10), np.uint8)
    for y in range(3):
        for x in range(10):
            a = int(charge[y, x])
            for t in range(ticks):
                a += int(photons[t, y, x])
                if a >= omega:
                    expected[t, y, x] = 1
                    a -= omega
            assert left[y, x] == a << 24
    assert np.array_equal(np.unpackbits(bits, axis=2, bitorder="little", count=10), expected)
    held, _, _ = integrate(np.full((1, 3, 10), 77 / omega, np.float32), np.array([0, ticks]), charge / omega)
    assert np.array_equal(counts(held, 10), (charge + 77 * ticks) // omega)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 7), (2, 9), (5, 17)])
def test_odd_sizes(height: int, width: int) -> None:
    spec = small(camera__width=width, camera__height=height, points__count=3)
    taken = take_view(spec, 0)
    spikes = taken.view.spikes
    assert spikes is not None
    assert spikes.bits.shape == (40 + 2 * 16, height, (width + 7) // 8)
    padding = np.unpackbits(spikes.bits, axis=2, bitorder="little")[:, :, width:]
    assert not padding.any()
    assert taken.light.shape == taken.view.frame.pixels.shape == (height, width, 3)


def test_no_tick_and_one_tick() -> None:
    light, start = np.full((1, 2, 3), 0.5, np.float32), np.full((2, 3), 0.5)
    bits, left, clipped = integrate(light.copy(), np.array([4]), start)
    assert bits.shape == (0, 2, 1)
    assert (left == 2**31).all()
    assert not clipped.any()
    bits, left, _ = integrate(light.copy(), np.array([4, 5]), start)
    assert (bits == 0b111).all()
    assert (left == 0).all()


def test_hdr() -> None:
    light = hdr_light()
    seen = simulate(light, Sensor(gain=0.9, response=GRAY), [], 0)
    expected = light.rgb[0, :, :, 0].astype(np.float64) * 0.9 * 4000
    assert (np.abs(counts(seen.spikes.bits, 8) - expected) <= 1).all()
    assert seen.frame.pixels.max() == 255
    assert seen.frame.pixels.min() == 0


def test_fast_motion() -> None:
    spec = small(shake__path_px=[50, 50], camera__width=200, camera__height=125, exposure__sub_poses=3)
    path = view_path(spec, 1)
    camera = Camera.pinhole(200, 125, 60)
    assert path_px(path, camera, target_depth(spec.orbit)) == pytest.approx(50, rel=1e-6)
    assert np.isfinite(take_view(spec, 1).light).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, -1e-3])
def test_light_that_is_not_light(bad: float) -> None:
    rgb = np.full((2, 3, 4, 3), 0.5, np.float32)
    rgb[1, 2, 1] = bad
    with pytest.raises(NumericsError, match="not negative") as caught:
        simulate(Light(rgb, np.array([0, 10]), (0, 10), 1e4), Sensor(), [], 0)
    assert "1 of 24" in str(caught.value)


def test_rays_along_axes() -> None:
    """Cameras that look along an axis with a ray exactly on it; at edges and corners; from a hair off a wall."""
    spec = small(world__solids=[
        {"kind": "room", "lo": [-3, -3, -3], "hi": [3, 3, 3]},
        {"kind": "box", "centre": [0, 0, 0], "size": [1, 1, 1]},
        {"kind": "rect", "centre": [0, 2, 0], "right": [0.3, 0, 0], "up": [0, 0, 0.3]},
    ], orbit__radius=2.9)  # fmt: skip
    stage, camera = Stage(spec.world), Camera.pinhole(3, 3, 40)
    ahead_x = np.array([[0, 1, 0], [0, 0, -1], [-1, 0, 0]])
    for centre in ([2, 0, 0], [2.999999, 0, 0], [2, 0.5, 0.5], [2, 0.5, 0]):
        pose = np.concatenate([ahead_x, -(ahead_x @ np.array(centre))[:, None]], 1).astype(float)
        light, depth = stage.picture(camera, pose, 1), stage.depth(camera, pose)
        assert np.isfinite(light).all()
        assert (light > 0).all()
        assert np.isfinite(depth).all()
        assert depth[1, 1] == pytest.approx(centre[0] - 0.5, abs=1e-5) or centre[1] == 0.5


@pytest.mark.parametrize("mean", [0.02, 0.3, 1.12, 3.9, 4.1, 30.0, 224.0])
def test_shot_noise_is_poisson(mean: float) -> None:
    """What one tick brings to each of 400,000 pixels, in electrons."""
    electrons = 560.0
    hooks = ShotNoise(electrons).begin(Site(400, 1000, 0, 7))
    light = np.full((1, 400, 1000), mean / electrons, np.float32)
    bits, left, lost = integrate(light, np.array([0, 1]), np.zeros((400, 1000)), [hooks])
    n = (counts(bits, 1000) + left / 2.0**32 + lost) * electrons
    assert n.min() >= 0
    assert abs(n.mean() - mean) < 5 * np.sqrt(mean / n.size)
    assert n.var() == pytest.approx(mean, rel=0.02 if mean > 0.1 else 0.05)
    if mean < 8:
        assert np.abs(n - np.rint(n)).max() < 1e-3
        share = np.bincount(np.rint(n).astype(int).reshape(-1), minlength=3)[:3] / n.size
        exact = np.exp(-mean) * np.array([1, mean, mean**2 / 2])
        assert np.abs(share - exact).max() < 5e-3
