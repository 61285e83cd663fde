"""The spike camera's clock: what the pixels see, and the truth that is kept."""

import numpy as np
import pytest
from hard_sim import small_table, steady

from spikerig.dataset.errors import UsageError
from spikerig.dataset.kernels import count
from spikerig.dataset.store import open_scene
from spikerig.rigctl.sim.capture import capture, rig_of
from spikerig.rigctl.sim.effects import Effect, Site
from spikerig.rigctl.sim.effects.clock import (
    ClockJitter,
    ClockOffset,
    ClockReset,
    ClockSkew,
    ClockWander,
    walk,
)
from spikerig.rigctl.sim.schedule import start_ns
from spikerig.rigctl.sim.sensor import Light
from spikerig.rigctl.sim.simulate import Simulated, simulate
from spikerig.rigctl.sim.spec import Sensor, read_scene
from spikerig.rigctl.sim.take import true_clock

ONE = Sensor(gain=1.0, response=(1.0, 0.0, 0.0))
RATE = 40_000.0
OFF = [
    ClockOffset(0.0, 0.0),
    ClockSkew(0.0),
    ClockWander(0.0),
    ClockJitter(0.0, 0.0),
    ClockReset(0, 0.0),
    ClockReset(7, 500.0),
]


def step(at: int = 400, ticks: int = 800) -> Light:
    """Dark, then one spike a tick from tick `at` on."""
    rgb = np.zeros((2, 2, 3, 3), np.float32)
    rgb[1] = 1
    return Light(rgb, np.array([0, at, ticks]), (0, ticks), RATE, 2_000_000_000)


def run(light: Light, *effects: Effect, seed: int = 3, view: int = 2) -> Simulated:
    return simulate(light, ONE, effects, seed, view)


def first_spike(seen: Simulated) -> int:
    return int(np.argmax(seen.spikes.bits[:, 0, 0] & 1))


def ahead_us(effect: Effect, at_s: float, view: int = 0, seed: int = 3) -> float:
    clock = effect.begin(Site(2, 3, view, seed)).clock_ns
    assert clock is not None
    return float(clock(np.array([round(at_s * 1e9)]))[0]) / 1e3


@pytest.mark.parametrize("effect", OFF, ids=lambda e: e.name)
def test_the_limit_of_an_effect_is_its_absence(effect: Effect) -> None:
    a, b = run(step(), effect), run(step())
    assert np.array_equal(a.spikes.bits, b.spikes.bits)
    assert np.array_equal(a.left, b.left)
    assert a.frame.start_ns == b.frame.start_ns


def test_a_clock_that_is_ahead_stamps_light_late() -> None:
    """2 s into the take: 250 us are 10 ticks, 100 ppm of 2 s are 8 (and 1 us of the view itself)."""
    assert first_spike(run(step())) == 400
    assert first_spike(run(step(), ClockOffset(250.0))) == 410
    assert first_spike(run(step(), ClockOffset(-250.0))) == 390
    assert first_spike(run(step(), ClockSkew(100.0))) == 408
    assert first_spike(run(step(), ClockReset(2, 250.0))) == 410
    assert first_spike(run(step(), ClockReset(2, 250.0), view=1)) == 400
    assert first_spike(run(step(), ClockOffset(250.0), ClockSkew(100.0))) == 418
    seen = run(step(), ClockOffset(250.0))
    assert seen.spikes.t0_ns == run(step()).spikes.t0_ns  # stamps stay, light moves
    assert seen.frame.start_ns == run(step()).frame.start_ns


def test_the_other_camera_has_a_clock_too() -> None:
    bare, seen = run(step()), run(step(), ClockOffset(0.0, 1500.0))
    assert seen.frame.start_ns - bare.frame.start_ns == 1_500_000
    assert np.array_equal(seen.frame.pixels, bare.frame.pixels)
    assert np.array_equal(seen.spikes.bits, bare.spikes.bits)
    late = [run(step(), ClockJitter(0.0, 100.0), view=v).frame.start_ns - bare.frame.start_ns for v in range(300)]
    assert np.std(late) == pytest.approx(100_000, rel=0.2)


def test_steady_light_does_not_care() -> None:
    light = steady(0.3, 500)
    a, b = run(light), run(light, *OFF[:-1])
    assert np.array_equal(a.spikes.bits, b.spikes.bits)
    moved = run(light, ClockOffset(5000.0), ClockSkew(500.0), ClockWander(100.0), ClockJitter(900.0))
    assert np.array_equal(a.spikes.bits, moved.spikes.bits)


def test_jitter_is_normal_and_its_own_in_each_view() -> None:
    values = np.array([ahead_us(ClockJitter(25.0), 1.0, view=v) for v in range(1000)])
    assert abs(values.mean()) < 5 * 25 / np.sqrt(1000)
    assert values.std() == pytest.approx(25, rel=5 / np.sqrt(2000))
    assert ahead_us(ClockJitter(25.0), 1.0, view=3) == ahead_us(ClockJitter(25.0), 500.0, view=3)


def test_a_random_walk_is_one_path() -> None:
    """Variance grows with time, steps apart are independent, and every view sees the same path."""
    times = [1.0, 2.0, 4.0, 64.0]
    paths = np.array([[walk(seed, t) for t in times] for seed in range(400)])
    tight = 5 * np.sqrt(2 / 400)
    assert paths.var(axis=0) == pytest.approx(times, rel=tight)
    assert np.diff(paths).var(axis=0) == pytest.approx(np.diff(times), rel=tight)
    assert abs(np.corrcoef(paths[:, 0], paths[:, 1] - paths[:, 0])[0, 1]) < 0.25
    bends = np.array(
        [[walk(s, t) + walk(s, t + 1) - 2 * walk(s, t + 0.5) for t in (4.0, 5.0, 6.0)] for s in range(100)]
    )
    assert np.abs(np.corrcoef(bends.T) - np.eye(3)).max() < 0.5
    assert walk(1, 0.0) == 0
    assert ahead_us(ClockWander(2.0), 4.0, view=0) == ahead_us(ClockWander(2.0), 4.0, view=9) == 2 * walk(3, 4.0)
    assert abs(walk(1, 1.0) - walk(1, 1.0 + 1e-6)) < 0.02
    assert walk(1, 2.0**23) == walk(1, 2.0**22)  # beyond its span it stands still


CLOCKS = [
    {"name": "clock_offset", "offset_us": 300.0},
    {"name": "clock_skew", "ppm": 40.0},
    {"name": "clock_wander", "sd_us": 5.0},
    {"name": "clock_jitter", "sd_us": 30.0},
    {"name": "clock_reset", "view": 2, "jump_us": -700.0},
]


def test_the_truth_is_in_the_file(tmp_path) -> None:
    """The true map gives back how far the clock was ahead at every view, held-out ones included."""
    spec = read_scene(small_table(effects=CLOCKS))
    capture(spec, tmp_path / "s.h5")
    scene = open_scene(tmp_path / "s.h5")
    assert scene.truth is not None
    assert scene.truth.effects["clock_reset"]["jump_us"] == -700
    clock = scene.truth.clock
    for number in range(4):
        rig = start_ns(spec.exposure, number) + 500_000  # the middle of 1 ms
        ahead = sum(ahead_us(e, rig * 1e-9, number, spec.seed) for e in spec.effects if e.name.startswith("clock"))
        assert abs(ahead) > 1
        device = rig + round(ahead * 1e3)
        assert abs(int(clock.rig_from_device(device)) - rig) <= 1
        assert abs(int(clock.device_from_rig(rig)) - device) <= 1
    none = small_table(effects=[])
    capture(read_scene(none), tmp_path / "n.h5")
    plain = open_scene(tmp_path / "n.h5").truth
    assert plain is not None
    assert plain.clock.device_ns.tolist() == plain.clock.rig_ns.tolist() == [0]


def test_the_light_of_a_view_is_where_the_truth_says() -> None:
    """A lamp that goes on at a rig time is stamped with the device time that the true clock gives for it."""
    table = small_table(effects=CLOCKS)
    rig = rig_of(read_scene(table))
    clock = true_clock(rig, 4)
    clocks = [e for e in rig.effects if e.name.startswith("clock")]
    t0_ns = start_ns(rig.exposure, 3) - round(16 * rig.exposure.tick_ns)
    light = step(36, 72)
    light = Light(light.rgb, light.knots, light.exposure, RATE, t0_ns)
    seen = simulate(light, ONE, clocks, rig.seed, 3)
    on_ns = t0_ns + round(36 * rig.exposure.tick_ns)
    stamped = t0_ns + first_spike(seen) * rig.exposure.tick_ns
    assert abs(stamped - int(clock.device_from_rig(on_ns))) <= rig.exposure.tick_ns


def test_a_clock_that_steps_back_into_the_view_before(tmp_path) -> None:
    effects = [{"name": "clock_reset", "view": 2, "jump_us": -30_000}]
    spec = read_scene(small_table(effects=effects, exposure__period_ms=5.0))
    with pytest.raises(UsageError, match="increase strictly"):
        capture(spec, tmp_path / "s.h5")
    assert not list(tmp_path.iterdir())


def test_one_tick() -> None:
    seen = run(steady(1.0, 1), ClockOffset(1e5), ClockSkew(-1e4), ClockWander(100.0))
    assert (count(seen.spikes.bits, 5, 0, 1) == 1).all()
