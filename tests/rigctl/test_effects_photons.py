"""Shot noise: electrons, in counts over many ticks."""

import numpy as np
import pytest
from hard_sim import steady

from spikerig.dataset.kernels import count
from spikerig.rigctl.sim.effects import Effect
from spikerig.rigctl.sim.effects.dark import DarkCurrent
from spikerig.rigctl.sim.effects.fpn import ThresholdFpn
from spikerig.rigctl.sim.effects.phase import InitialPhase
from spikerig.rigctl.sim.effects.shot import ShotNoise
from spikerig.rigctl.sim.sensor import Light
from spikerig.rigctl.sim.simulate import Simulated, simulate
from spikerig.rigctl.sim.spec import Sensor

ONE = Sensor(gain=1.0, response=(1.0, 0.0, 0.0))


def run(light: Light, *effects: Effect, seed: int = 3, view: int = 0) -> Simulated:
    return simulate(light, ONE, effects, seed, view)


def charge(seen: Simulated) -> np.ndarray:
    """What came in, thresholds [H,W]: fired + left - start + lost."""
    fired = count(seen.spikes.bits, seen.spikes.width, 0, seen.spikes.ticks)
    return fired + seen.left / 2.0**32 - seen.start + seen.clipped


@pytest.mark.parametrize(("level", "electrons"), [(0.3, 100.0), (0.002, 560.0), (0.9, 20.0)])
def test_charge_has_the_variance_of_its_electrons(level: float, electrons: float) -> None:
    """Mean light x ticks, variance light x ticks / electrons, whatever the light."""
    ticks = 150
    seen = charge(run(steady(level, ticks, 60, 80), ShotNoise(electrons), InitialPhase()))
    mean, variance = level * ticks, level * ticks / electrons
    assert abs(seen.mean() - mean) < 5 * np.sqrt(variance / seen.size)
    assert seen.var() == pytest.approx(variance, rel=5 * np.sqrt(2 / seen.size))


def test_it_does_not_hang_together() -> None:
    """Neighbours in space, in time and in views are independent."""
    first, second = (charge(run(steady(0.3, 60, 60, 80), ShotNoise(50.0), view=v)) for v in (0, 1))
    half = charge(run(steady(0.3, 30, 60, 80), ShotNoise(50.0)))  # the same draws, cut short
    for a, b in (
        (first[:, 1:], first[:, :-1]),
        (first[1:], first[:-1]),
        (first, second),
        (half, first - half),
    ):
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 5 / np.sqrt(a.size)


def test_dark_electrons_count() -> None:
    """Without light the dark current's electrons are as noisy as any."""
    seen = charge(run(steady(0.0, 200, 60, 80), ShotNoise(40.0), DarkCurrent(0.02)))
    assert seen.mean() == pytest.approx(4.0, rel=0.02)
    assert seen.var() == pytest.approx(0.1, rel=0.1)
    assert not charge(run(steady(0.0, 200), ShotNoise(40.0))).any()


def test_its_draws_stay_with_other_effects() -> None:
    """What shot noise adds is the same beside any other effect that leaves the light alone."""
    light = steady(0.3, 100, 20, 30)
    alone = charge(run(light, ShotNoise(100.0)))
    for other in (InitialPhase(), ThresholdFpn(0.0), DarkCurrent(0.0)):
        assert np.allclose(charge(run(light, ShotNoise(100.0), other)), alone, atol=1e-6)


@pytest.mark.parametrize(("height", "width", "ticks"), [(1, 1, 1), (3, 9, 1), (5, 17, 33)])
def test_odd_sizes_and_one_tick(height: int, width: int, ticks: int) -> None:
    seen = run(steady(0.5, ticks, height, width), ShotNoise(10.0), InitialPhase())
    assert seen.spikes.bits.shape == (ticks, height, (width + 7) // 8)
    assert not np.unpackbits(seen.spikes.bits, axis=2, bitorder="little")[:, :, width:].any()
    assert (charge(seen) >= 0).all()


def test_saturated_and_hdr() -> None:
    """1e6 to 1 in one frame with a saturated corner: finite, at most a spike a tick, the excess counted."""
    values = np.logspace(-6, 1, 64).reshape(8, 8).astype(np.float32)
    seen = run(steady(values, 500, 8, 8), ShotNoise(560.0))
    came = charge(seen)
    fired = count(seen.spikes.bits, 8, 0, 500)
    assert np.isfinite(came).all()
    assert (fired <= 500).all()
    assert fired[-1, -1] == 500
    sd = np.sqrt(values * 500 / 560)
    assert (np.abs(came - values * 500) < 5 * sd + 1 / 560).all()
