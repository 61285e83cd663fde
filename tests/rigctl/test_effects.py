"""Effects: off is nothing, streams are their own, bounds hold, limits vanish."""

import subprocess
import sys
from dataclasses import fields

import numpy as np
import pytest
from hard_sim import small, steady

from spikerig.dataset.errors import UsageError
from spikerig.dataset.kernels import count
from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.effects import EFFECTS, Effect, Hooks, Site, Stage, effect_class, in_order
from spikerig.rigctl.sim.effects.dark import DarkCurrent
from spikerig.rigctl.sim.effects.fpn import ThresholdFpn
from spikerig.rigctl.sim.effects.phase import InitialPhase
from spikerig.rigctl.sim.effects.read import ReadNoise
from spikerig.rigctl.sim.effects.shot import ShotNoise
from spikerig.rigctl.sim.judge.survey import Look, survey
from spikerig.rigctl.sim.sensor import Light
from spikerig.rigctl.sim.simulate import Simulated, simulate
from spikerig.rigctl.sim.spec import Exposure, Sensor

ALL = [ShotNoise(), DarkCurrent(), ThresholdFpn(), InitialPhase(), ReadNoise()]


def scene_light(seed: int = 0, height: int = 21, width: int = 30) -> Light:
    rng = np.random.default_rng(seed)
    rgb = rng.uniform(0.02, 1.0, (4, height, width, 3)).astype(np.float32)
    return Light(rgb, np.array([0, 40, 100, 200]), (40, 200), 40_000.0)


def run(*effects: Effect, seed: int = 1, view: int = 0, light: Light | None = None) -> Simulated:
    return simulate(light or scene_light(), Sensor(), effects, seed, view)


def same(a: Simulated, b: Simulated) -> bool:
    return (
        np.array_equal(a.spikes.bits, b.spikes.bits)
        and np.array_equal(a.frame.pixels, b.frame.pixels)
        and np.array_equal(a.left, b.left)
        and np.array_equal(a.clipped, b.clipped)
    )


@pytest.mark.parametrize("effect", [DarkCurrent(0.0, 0.0), ThresholdFpn(0.0), ReadNoise(0.0)], ids=lambda e: e.name)
def test_the_limit_of_an_effect_is_its_absence(effect: Effect) -> None:
    assert same(run(effect), run())


def test_the_limit_of_shot_noise() -> None:
    counts = [count(s.spikes.bits, 30, 0, 200).astype(int) for s in (run(ShotNoise(1e12)), run())]
    assert np.abs(counts[0] - counts[1]).max() <= 1
    assert (counts[0] != counts[1]).mean() < 0.01


def test_an_effect_left_out_is_not_imported() -> None:
    """A scene of two effects, and a simulation without any, load those two modules and no other."""
    program = (
        "import sys, numpy as np\n"
        "from spikerig.rigctl.sim.spec import read_scene\n"
        "from spikerig.rigctl.sim.simulate import simulate\n"
        "root = 'spikerig.rigctl.sim.effects.'\n"
        "names = lambda: sorted(m.removeprefix(root) for m in sys.modules if m.startswith(root))\n"
        "solid = {'kind': 'sphere', 'centre': [0, 0, 0], 'radius': 1}\n"
        "table = {'world': {'solids': [solid]}, 'exposure': {'phase': 'zero'}}\n"
        "read_scene(table); print(names())\n"
        "read_scene(table | {'effects': ['read_noise', 'dark_current']}); print(names())\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[:2] == ["[]", "['dark', 'read']"]


def test_an_effect_left_out_is_not_called(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without an effect inside the pixel, the noisy kernel does not run."""
    import spikerig.rigctl.sim.sensor as sensor

    monkeypatch.setattr(sensor, "fire_noisy", lambda *a, **k: pytest.fail("the kernel that draws every tick"))
    run(DarkCurrent(), ThresholdFpn(), InitialPhase(), ReadNoise())
    with pytest.raises(BaseException, match="every tick"):
        run(ShotNoise())


def test_adding_one_leaves_the_others_draws() -> None:
    """Everything that does not depend on the added effect keeps its bits."""
    alone, more = run(InitialPhase(), ReadNoise()), run(*ALL)
    assert np.array_equal(alone.start, more.start)
    assert np.array_equal(alone.frame.pixels, more.frame.pixels)
    assert same(run(ShotNoise(), ThresholdFpn()), run(ShotNoise(), ThresholdFpn(), DarkCurrent(0.0)))
    assert same(run(ShotNoise(), ReadNoise()), run(DarkCurrent(0.0), ReadNoise(), ShotNoise()))
    assert same(run(ShotNoise()), run(ShotNoise(), ThresholdFpn(0.0)))


def test_noise_differs_by_view_and_seed_but_the_pattern_is_the_sensors() -> None:
    bright = steady(0.9, 4000, 20, 20)
    patterns = [
        count(run(ThresholdFpn(0.04), light=bright, seed=s, view=v).spikes.bits, 20, 0, 4000).astype(float)
        for s, v in ((1, 0), (1, 1), (2, 0))
    ]
    assert np.array_equal(patterns[0], patterns[1])
    assert abs(np.corrcoef(patterns[0].ravel(), patterns[2].ravel())[0, 1]) < 0.2
    assert patterns[0].std() / patterns[0].mean() == pytest.approx(0.04, rel=0.15)
    for effect in (ShotNoise(), InitialPhase(), ReadNoise()):
        one, other = run(effect, view=0), run(effect, view=1)
        assert not same(one, other), effect.name


def test_dark_current_is_charge_without_light() -> None:
    seen = run(DarkCurrent(0.01), light=steady(0.0, 1000))
    assert (count(seen.spikes.bits, 5, 0, 1000) == 10).all() or (count(seen.spikes.bits, 5, 0, 1000) == 9).all()
    spread = run(DarkCurrent(0.01, 0.004), light=steady(0.0, 20_000, 20, 20))
    rates = count(spread.spikes.bits, 20, 0, 20_000) / 20_000
    assert rates.mean() == pytest.approx(0.01, rel=0.05)
    assert rates.std() == pytest.approx(0.004, rel=0.15)


def test_read_noise_has_its_spread() -> None:
    light = steady(0.2, 10, 60, 60)
    pixels = run(ReadNoise(0.02), light=light).frame.pixels.astype(float)
    assert pixels.std() == pytest.approx(0.02 * 255, rel=0.05)
    assert pixels.mean() == pytest.approx(255 * (1.055 * 0.2 ** (1 / 2.4) - 0.055), abs=0.3)


def test_random_phase_is_even() -> None:
    start = run(InitialPhase(), light=steady(0.1, 5, 100, 100)).start
    assert np.abs(np.histogram(start, 10, (0, 1))[0] - 1000).max() < 150
    assert not run(light=steady(0.1, 5)).start.any()


@pytest.mark.parametrize("effect", ALL, ids=lambda e: e.name)
def test_the_bound_holds(effect: Effect) -> None:
    """With paired streams the output moves by no more than `magnitude` (and one for rounding) in 95 % of pixels."""
    light = scene_light(3, 40, 50)
    facts = survey([Look(light, 0.0)], Sensor(), Exposure(exposure_ms=4.0), focal_px=50.0, views=1)
    bound = effect.magnitude(facts)
    bare, with_it = run(light=light), run(effect, light=light)
    if effect.stage is Stage.RGB:
        moved = np.abs(with_it.frame.pixels.astype(int) - bare.frame.pixels.astype(int))
    else:
        a, b = (count(s.spikes.bits, 50, 40, 200).astype(int) for s in (bare, with_it))
        moved = np.abs(a - b)
        assert np.array_equal(with_it.frame.pixels, bare.frame.pixels)
    most = bound.dn if effect.stage is Stage.RGB else bound.spikes
    assert (moved > most + 1).mean() < 0.05
    assert len(bound.formula) > 3
    assert moved.max() > 0


def test_every_effect_says_what_it_is() -> None:
    for name in EFFECTS:
        effect = effect_class(name)()
        assert effect.name == name
        assert isinstance(effect.stage, Stage)
        assert effect.per in ("tick", "knot", "frame")
        for word in (effect.source, effect.vanishes, type(effect).__doc__):
            assert len(word) > 3
        for field in fields(effect):
            assert field.metadata["unit"], (name, field.name)
        hooks = effect.begin(Site(2, 3, 0, 0, camera=Camera.pinhole(3, 2, 60)))
        assert hooks != Hooks()


def test_order_is_physical_whatever_the_list() -> None:
    names = [e.name for e in in_order(reversed(ALL))]
    assert names == ["shot_noise", "dark_current", "threshold_fpn", "initial_phase", "read_noise"]
    assert same(run(*ALL), run(*reversed(ALL)))
    assert [e.name for e in small().effects] == names


def test_twice_the_same_effect_is_refused() -> None:
    with pytest.raises(UsageError, match="twice") as caught:
        run(DarkCurrent(), ThresholdFpn(), DarkCurrent(0.1))
    assert "dark_current" in str(caught.value)
