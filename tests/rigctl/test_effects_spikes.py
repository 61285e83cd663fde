"""Pixels and rows that fail: hot, stuck, not read."""

import numpy as np
import pytest
from hard_sim import steady

from spikerig.dataset.kernels import count
from spikerig.rigctl.sim.effects import Effect
from spikerig.rigctl.sim.effects.hot import HotPixels
from spikerig.rigctl.sim.effects.phase import InitialPhase
from spikerig.rigctl.sim.effects.rownoise import RowNoise
from spikerig.rigctl.sim.effects.shot import ShotNoise
from spikerig.rigctl.sim.effects.stuck import StuckPixels
from spikerig.rigctl.sim.sensor import Light
from spikerig.rigctl.sim.simulate import Simulated, simulate
from spikerig.rigctl.sim.spec import Sensor

ONE = Sensor(gain=1.0, response=(1.0, 0.0, 0.0))


def run(light: Light, *effects: Effect, seed: int = 3, view: int = 0) -> Simulated:
    return simulate(light, ONE, effects, seed, view)


def pixels(seen: Simulated) -> np.ndarray:
    return np.unpackbits(seen.spikes.bits, axis=2, bitorder="little", count=seen.spikes.width)


def counts(seen: Simulated) -> np.ndarray:
    return count(seen.spikes.bits, seen.spikes.width, 0, seen.spikes.ticks).astype(int)


@pytest.mark.parametrize(
    "effect", [HotPixels(0.0, 0.5), HotPixels(1.0, 0.0), StuckPixels(0.0, 0.0), RowNoise(0.0), RowNoise(0.0, "drop")]
)
def test_the_limit_of_an_effect_is_its_absence(effect: Effect) -> None:
    light = steady(0.3, 70, 5, 13)
    a, b = run(light, InitialPhase(), effect), run(light, InitialPhase())
    assert np.array_equal(a.spikes.bits, b.spikes.bits)
    assert np.array_equal(a.left, b.left)


def test_hot_pixels_are_a_share_with_more_dark_current() -> None:
    seen = run(steady(0.0, 100, 100, 100), HotPixels(0.03, 0.25))
    assert set(np.unique(counts(seen))) == {0, 25}
    hot = (counts(seen) > 0).mean()
    assert abs(hot - 0.03) < 5 * np.sqrt(0.03 * 0.97 / 10_000)
    again = run(steady(0.0, 100, 100, 100), HotPixels(0.03, 0.25), view=5)
    assert np.array_equal(counts(seen), counts(again))
    other = run(steady(0.0, 100, 100, 100), HotPixels(0.03, 0.25), seed=4)
    assert not np.array_equal(counts(seen), counts(other))


def test_stuck_pixels_read_one_value() -> None:
    light = steady(0.3, 90, 101, 103)
    bare, seen = run(light, InitialPhase()), run(light, InitialPhase(), StuckPixels(0.05, 0.02))
    dead, lit = counts(seen) == 0, counts(seen) == 90
    assert np.array_equal(counts(seen)[~dead & ~lit], counts(bare)[~dead & ~lit])
    assert abs(dead.mean() - 0.05) < 5 * np.sqrt(0.05 / dead.size)
    assert abs(lit.mean() - 0.02 * 0.95) < 5 * np.sqrt(0.02 / lit.size)
    assert np.array_equal(bare.left, seen.left)  # what they read changes, not what they integrate
    assert np.array_equal(counts(run(light, StuckPixels(0.05, 0.02), view=4)) == 90, lit)
    padding = np.unpackbits(seen.spikes.bits, axis=2, bitorder="little")[:, :, 103:]
    assert not padding.any()


def test_all_dead_and_all_lit() -> None:
    light = steady(0.3, 9, 3, 11)
    assert not run(light, StuckPixels(1.0, 1.0)).spikes.bits.any()
    assert pixels(run(light, StuckPixels(0.0, 1.0))).all()


def test_a_row_that_repeats_is_the_row_last_read() -> None:
    light = steady(np.random.default_rng(0).uniform(0.1, 0.9, (40, 21)).astype(np.float32), 200, 40, 21)
    before, after = (pixels(run(light, InitialPhase(), *e)) for e in ([], [RowNoise(0.2)]))
    failed = 0
    for y in range(40):
        held = np.zeros(21, np.uint8)
        for t in range(200):
            fresh = np.array_equal(after[t, y], before[t, y])
            if not fresh:
                assert np.array_equal(after[t, y], held)
                failed += 1
            held = after[t, y]
    assert failed / 8000 == pytest.approx(0.2, abs=5 * np.sqrt(0.16 / 8000))


def test_a_row_that_drops_reads_zero() -> None:
    light = steady(1.0, 300, 40, 21)
    seen = pixels(run(light, RowNoise(0.1, "drop")))
    rows = seen.any(axis=2)
    assert np.array_equal(rows, seen.all(axis=2))
    assert (~rows).mean() == pytest.approx(0.1, abs=5 * np.sqrt(0.09 / rows.size))
    assert not run(light, RowNoise(1.0, "repeat")).spikes.bits.any()  # never read: zero from the start


def test_draws_do_not_depend_on_the_others() -> None:
    light = steady(1.0, 50, 20, 9)
    rows = [pixels(run(light, RowNoise(0.3, "drop"), *more)).any(axis=2) for more in ([], [ShotNoise(1e6)])]
    assert np.array_equal(rows[0], rows[1])
    assert not np.array_equal(rows[0], pixels(run(light, RowNoise(0.3, "drop"), view=1)).any(axis=2))


@pytest.mark.parametrize("ticks", [1, 2])
def test_one_tick(ticks: int) -> None:
    seen = run(steady(2.0, ticks, 1, 1), HotPixels(1.0, 1.0), StuckPixels(), RowNoise(0.0))
    assert pixels(seen).all()
