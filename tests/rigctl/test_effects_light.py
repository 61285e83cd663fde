"""Light that changes by itself: mains flicker and a brightness ramp."""

from dataclasses import replace

import numpy as np
import pytest
from hard_effects_arms import drifting, run, same, still

from spikerig.dataset.kernels import count
from spikerig.rigctl.sim.effects import Site
from spikerig.rigctl.sim.effects.flicker import OFF, Flicker
from spikerig.rigctl.sim.effects.ramp import BrightnessRamp
from spikerig.rigctl.sim.sensor import Light, refined


def gray(ticks: int, value: float = 0.3, t0_ns: int = 0) -> Light:
    """Flat linear light with two knots."""
    rgb = np.full((2, 2, 9, 3), value, np.float32)
    return Light(rgb, np.array([0, ticks]), (0, ticks), 40_000.0, t0_ns)


@pytest.mark.parametrize("effect", [Flicker(depth=0.0), BrightnessRamp(0.0)], ids=lambda e: e.name)
def test_the_limit_is_absence(effect: Flicker | BrightnessRamp) -> None:
    assert same(run(drifting(), effect), run(drifting()))


@pytest.mark.parametrize("depth", [0.05, 0.5, 1.0])
@pytest.mark.parametrize("hz", [100.0, 120.0])
def test_the_mean_over_whole_periods_stays(hz: float, depth: float) -> None:
    light = gray(round(3 * 40_000 / hz))
    seen = run(light, Flicker(hz, depth, "random"))
    assert np.allclose(seen.blurry, 0.3, rtol=1e-5)
    assert np.abs(count(seen.spikes.bits, 9, 0, light.knots[-1]) - 0.3 * 0.4 * light.knots[-1]).max() <= 1


def test_part_of_a_period_gives_the_integral() -> None:
    """A quarter period from the crest: the mean of cos is 2 / pi, to the 0.1 % that sampling leaves."""
    seen = run(gray(100), Flicker(100.0, 0.4, "fixed", 0.0))
    assert np.allclose(seen.blurry, 0.3 * (1 + 0.4 * 2 / np.pi), rtol=OFF)
    half = run(gray(200), Flicker(100.0, 0.4, "fixed", -90.0))
    assert np.allclose(half.blurry, 0.3 * (1 + 0.4 * 2 / np.pi), rtol=OFF)


@pytest.mark.parametrize("depth", [0.01, 0.3, 1.0])
def test_lines_between_samples_follow_the_wave(depth: float) -> None:
    effect = Flicker(120.0, depth, "fixed", 33.0)
    hooks = effect.begin(Site(2, 9, 0, 1))
    light = refined(gray(4000, 1.0), hooks.step_s)
    hooks.radiance(light.rgb, light.at_s)  # type: ignore[misc]
    at = np.arange(4001)
    line = np.interp(at, light.knots, light.rgb[:, 0, 0, 0])
    wave = 1 + depth * np.cos(2 * np.pi * 120 * at / 40_000 + np.radians(33))
    assert np.abs(line - wave).max() <= OFF
    if depth == 1:
        assert np.abs(line - wave).max() > OFF / 4  # and no denser than that asks for
    assert len(light.knots) < 4000 / 2


def test_a_fixed_phase_runs_on_and_a_random_one_is_each_views_own() -> None:
    short = gray(40, t0_ns=0)
    later, whole = gray(40, t0_ns=2_500_000), gray(40, t0_ns=10_000_000)
    fixed = Flicker(100.0, 0.5, "fixed", 0.0)
    a, b, c = (run(light, fixed).blurry[0, 0, 0] for light in (short, later, whole))
    assert a == pytest.approx(0.3 * (1 + 0.5 * np.sinc(0.2)), rel=OFF)
    assert b == pytest.approx(0.3 * (1 - 0.5 * (1 - np.cos(0.2 * np.pi)) / (0.2 * np.pi)), rel=OFF)
    assert c == pytest.approx(a, rel=1e-5)
    means = [run(short, Flicker(100.0, 0.5), view=view).blurry[0, 0, 0] for view in range(24)]
    assert min(means) < 0.2 < 0.4 < max(means)


def test_draws_are_its_own() -> None:
    alone, more = (run(drifting(), *effects).blurry for effects in ([Flicker()], [Flicker(), BrightnessRamp(0.0)]))
    assert np.array_equal(alone, more)


def test_held_light_flickers_slot_by_slot() -> None:
    light = Light(np.full((4, 2, 3, 3), 0.5, np.float32), np.arange(5) * 100, (0, 400), 40_000.0)
    seen = run(light, Flicker(100.0, 1.0))
    assert np.allclose(seen.blurry, 0.5, rtol=1e-4)


def test_a_ramp_is_what_it_says() -> None:
    light = still(np.full((3, 4, 3), 0.2))
    at_1s = replace(light, t0_ns=10**9)
    assert np.allclose(run(at_1s, BrightnessRamp(0.5)).blurry, 0.2 * (1 + 0.5 * 1.005), rtol=1e-6)
    seen = run(gray(40_000), BrightnessRamp(2.0))  # from 0.3 to 0.9 over a second: the mean is 0.6
    assert np.allclose(seen.blurry, 0.6, rtol=1e-6)
    assert np.abs(count(seen.spikes.bits, 9, 0, 40_000) - 0.6 * 0.4 * 40_000).max() <= 1


def test_a_ramp_ends_at_zero() -> None:
    light = replace(still(np.full((3, 4, 3), 0.2)), t0_ns=3 * 10**9)
    seen = run(light, BrightnessRamp(-0.5))
    assert not seen.blurry.any()
    assert not seen.spikes.bits.any()
