"""Bounds of the effects on photons, charge, spikes, wire and clock: they hold, and they are not loose."""

from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from spikerig.dataset.kernels import count
from spikerig.rigctl.sim.capture import camera_of, view_path
from spikerig.rigctl.sim.caster.light import stage_of
from spikerig.rigctl.sim.effects import effect_class
from spikerig.rigctl.sim.effects.phase import InitialPhase
from spikerig.rigctl.sim.judge.facts import PART, SLACK, Facts, surplus
from spikerig.rigctl.sim.judge.survey import Look, survey
from spikerig.rigctl.sim.schedule import schedule, start_ns
from spikerig.rigctl.sim.sensor import Light
from spikerig.rigctl.sim.simulate import simulate
from spikerig.rigctl.sim.spec import SceneSpec, load_scene_toml

WIDTH, HEIGHT = 80, 50
# gain, pixels of motion, exposure ms, margin ticks
SCENES = {
    "dim, still": (0.05, 0.05, 8.0, 256),
    "bright, still": (0.9, 0.05, 8.0, 256),
    "fast": (0.4, 10.0, 8.0, 256),
    "bright, fast": (1.5, 12.0, 8.0, 128),
    "saturated, fast": (4.0, 12.0, 8.0, 256),
    "dim, fast": (0.05, 10.0, 8.0, 256),
    "short": (0.4, 2.0, 0.5, 0),
}
CASES: list[tuple[str, dict[str, Any]]] = [
    ("shot_noise", {"threshold_e": 560.0}),
    ("shot_noise", {"threshold_e": 20.0}),
    ("prnu", {}),
    ("dark_current", {"rate": 1e-4}),
    ("dark_current", {"rate": 0.0047, "sd": 0.0018}),
    ("threshold_fpn", {"sd": 0.04}),
    ("threshold_fpn", {"sd": 0.002}),
    ("reset_loss", {}),
    ("reset_loss", {"loss": 0.1}),
    ("comparator_noise", {}),
    ("comparator_noise", {"sd": 0.1}),
    ("saturation", {}),
    ("hot_pixels", {"share": 0.1}),
    ("stuck_pixels", {"dead": 0.1, "lit": 0.01}),
    ("row_noise", {"chance": 0.02}),
    ("row_noise", {"chance": 0.02, "mode": "drop"}),
    ("bit_flips", {"chance": 1e-3}),
    ("lost_blocks", {"chance": 3e-3}),
    ("wide_rows", {}),
    ("clock_offset", {"offset_us": 25.0}),
    ("clock_offset", {"offset_us": 1000.0}),
    ("clock_skew", {"ppm": 100.0}),
    ("clock_wander", {"sd_us": 50.0}),
    ("clock_jitter", {"sd_us": 500.0}),
    ("clock_reset", {"view": 0}),
]


@lru_cache(maxsize=1)
def demo() -> SceneSpec:
    spec = load_scene_toml("demo")
    return replace(spec, lens=replace(spec.lens, width=WIDTH, height=HEIGHT, samples=1), effects=())


def light_of(spec: SceneSpec, number: int) -> Light:
    plan, path, stage = schedule(spec.exposure), view_path(spec, number), stage_of(spec.world)
    rgb = np.stack([stage.picture(camera_of(spec), pose, 1) for pose in path.poses(plan.phases)])
    first, exposure = int(plan.knots[0]), spec.exposure
    t0_ns = start_ns(exposure, number) + round(first * exposure.tick_ns)
    return Light(rgb, plan.knots - first, (-first, exposure.ticks - first), exposure.rate_hz, t0_ns)


@lru_cache(maxsize=1)
def cases() -> list[tuple[str, str, float, float]]:
    """(scene, effect, bound, 95th percentile of the change) of everything above, with paired streams."""
    found = []
    for scene, (gain, path, ms, margin) in SCENES.items():
        spec = demo()
        exposure = replace(spec.exposure, exposure_ms=ms, margin_ticks=margin, sub_poses=9)
        sensor, shake = replace(spec.sensor, gain=gain), replace(spec.shake, path_px=(path, path))
        spec = replace(spec, exposure=exposure, sensor=sensor, shake=shake)
        lights = [light_of(spec, k) for k in (0, 1)]
        looks = [Look(light, path) for light in lights]
        facts = survey(looks, sensor, exposure, focal_px=float(camera_of(spec).K[0, 0]), views=2)

        def counts(*effects: Any, lights: list[Light] = lights, spec: SceneSpec = spec) -> np.ndarray:
            seen = [simulate(light, spec.sensor, [InitialPhase(), *effects], 1, v) for v, light in enumerate(lights)]
            return np.stack([count(s.spikes.bits, WIDTH, *lights[0].exposure) for s in seen]).astype(int)

        bare = counts()
        for name, values in CASES:
            effect = effect_class(name)(**values)
            moved = np.abs(counts(effect) - bare)
            actual = float(np.percentile(moved, PART, method="inverted_cdf"))
            found.append((scene, f"{name} {values}", effect.magnitude(facts).spikes, actual))
    return found


def test_bounds_hold() -> None:
    """The bound is at least the 95th percentile; below 1 it says that nothing changes."""
    broken = [c for c in cases() if c[2] < c[3]]
    assert not broken


def test_bounds_are_not_loose() -> None:
    """Median of bound over actual 1.2 of all cases, and no effect's above 2.5; each scene alone below 8."""
    ratios = [bound / actual for _, _, bound, actual in cases() if actual > 0]
    assert len(ratios) > 80
    assert np.median(ratios) < 1.4
    assert max(ratios) < 8
    for name in {effect for _, effect, _, _ in cases()}:
        own = [bound / actual for _, effect, bound, actual in cases() if actual > 0 and effect == name]
        assert not own or np.median(own) <= 2.5, name
    idle = [bound for _, _, bound, actual in cases() if actual == 0]
    assert np.mean(np.array(idle) <= 1) > 0.9


@pytest.mark.parametrize("change", [0.01, 0.04, 0.3, -0.3, 0.9, 1.0, 2.6, -7.2])
@pytest.mark.parametrize("before", [0.0, 0.02, 0.7, -0.4, 3.3])
def test_counts_of_charge_with_even_phases(change: float, before: float) -> None:
    """What `counted` computes is what drawing the phases gives."""
    rng = np.random.default_rng(7)
    phases = rng.random((2, 400_000))
    start = SLACK * before
    moved = np.abs(np.floor(phases[0] + start + SLACK * change) - np.floor(phases[1] + start))
    nobody: Any = SimpleNamespace(size=(10**9, 10**9))  # so many pixels that shares do not scatter
    got = Facts.counted(nobody, np.full(9, change), np.full(9, before))
    if got < 1:
        assert np.mean(moved > 0) / 0.05 == pytest.approx(got, abs=0.02)
    else:
        assert np.mean(moved > got) <= 0.052
        assert np.mean(moved > got - 1) > 0.048


def test_a_share_that_changes() -> None:
    nobody: Any = SimpleNamespace(size=(10**9, 10**9))  # so many pixels that shares do not scatter
    change = np.full(10, 3.0)
    assert Facts.counted(nobody, change, share=0.2) == 4  # 3.75 with the slack: three or four
    assert Facts.counted(nobody, change, share=0.01) == pytest.approx(0.2)
    assert Facts.counted(nobody, change, share=0.0) == 0
    assert Facts.counted(nobody, np.zeros(0)) == 0


def test_light_beyond_a_spike_a_tick() -> None:
    """Even from 0.5 to 1.5 an eighth is beyond one; steady light its excess; short peaks no more than they hold."""
    got = surplus(np.array([1.0, 0.4, 1.7, 0.1, 2.0]), np.array([1.5, 0.4, 1.7, 10.0, 3.0]))
    assert got == pytest.approx([0.125, 0, 0.7, 0.1 * 0.81, 1.0])


def test_shares_of_a_small_picture_scatter() -> None:
    """Three standard deviations of how many of its pixels change; more where they change together, as rows do."""
    small: Any = SimpleNamespace(size=(64, 100))
    share = 0.0005
    once = Facts.counted(small, np.ones(10), share=share)
    assert once == pytest.approx((share + 3 * np.sqrt(share / 6400)) / 0.05)
    rng = np.random.default_rng(2)
    assert np.mean(rng.binomial(6400, share, 10_000) / 6400 / 0.05 > once) < 0.01
    assert Facts.counted(small, np.ones(10), share=share, together=16) > 2 * once
