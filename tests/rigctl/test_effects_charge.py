"""What pixels do with their charge: gains, thresholds, resets, comparators, saturation, maps from calibration."""

import numpy as np
import pytest
from hard_sim import hdr_light, steady

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.kernels import count
from spikerig.rigctl.sim.effects import Effect, Site
from spikerig.rigctl.sim.effects.comparator import ComparatorNoise
from spikerig.rigctl.sim.effects.dark import DarkCurrent
from spikerig.rigctl.sim.effects.fpn import ThresholdFpn
from spikerig.rigctl.sim.effects.maps import SensorMap
from spikerig.rigctl.sim.effects.phase import InitialPhase
from spikerig.rigctl.sim.effects.prnu import Prnu
from spikerig.rigctl.sim.effects.reset import ResetLoss
from spikerig.rigctl.sim.effects.saturation import Saturation
from spikerig.rigctl.sim.effects.shot import ShotNoise
from spikerig.rigctl.sim.sensor import Light
from spikerig.rigctl.sim.simulate import Simulated, simulate
from spikerig.rigctl.sim.spec import Sensor

ONE = Sensor(gain=1.0, response=(1.0, 0.0, 0.0))
PIXEL = [ShotNoise(300.0), ResetLoss(0.01), ComparatorNoise(0.02)]


def run(light: Light, *effects: Effect, seed: int = 3, view: int = 0) -> Simulated:
    return simulate(light, ONE, effects, seed, view)


def counts(seen: Simulated) -> np.ndarray:
    return count(seen.spikes.bits, seen.spikes.width, 0, seen.spikes.ticks).astype(float)


def charge(seen: Simulated) -> np.ndarray:
    """What came in, thresholds [H,W]: fired + left - start + lost."""
    return counts(seen) + seen.left / 2.0**32 - np.floor(seen.start * 2.0**32) / 2.0**32 + seen.clipped


def same(a: Simulated, b: Simulated) -> bool:
    arrays = [(x.spikes.bits, x.frame.pixels, x.left, x.clipped) for x in (a, b)]
    return all(np.array_equal(*pair) for pair in zip(*arrays, strict=True))


@pytest.mark.parametrize(
    "effect",
    [Prnu(0.0), ResetLoss(0.0), ComparatorNoise(0.0), Saturation("clip"), SensorMap()],
    ids=lambda e: e.name,
)
def test_the_limit_of_an_effect_is_its_absence(effect: Effect) -> None:
    light = steady(np.linspace(0, 1.6, 77).reshape(7, 11).astype(np.float32), 60, 7, 11)
    assert same(run(light, InitialPhase(), effect), run(light, InitialPhase()))


def test_carrying_differs_from_clipping_only_beyond_a_spike_a_tick() -> None:
    dim = steady(np.linspace(0, 1, 77).reshape(7, 11).astype(np.float32), 60, 7, 11)
    a, b = run(dim, InitialPhase(), Saturation()), run(dim, InitialPhase())
    assert np.array_equal(a.spikes.bits, b.spikes.bits)
    assert np.array_equal(a.left, b.left)


def test_a_highlight_that_is_carried_fires_on() -> None:
    """Four ticks of 3 thresholds, then none: clipped 4 spikes and 8 lost; carried 12 spikes and none lost."""
    rgb = np.zeros((2, 2, 3, 3), np.float32)
    rgb[0] = 3
    light = Light(rgb, np.array([0, 4, 30]), (0, 30), 4e4)
    clip, carry = run(light), run(light, Saturation())
    assert (counts(clip) == 4).all()
    assert (clip.clipped == 8).all()
    assert (counts(carry) == 12).all()
    assert not carry.clipped.any()
    fired = np.unpackbits(carry.spikes.bits, axis=2, bitorder="little", count=3)[:, 0, 0]
    assert fired[:12].all()
    assert not fired[12:].any()


def test_prnu_scales_light_but_not_the_dark_current() -> None:
    seen = charge(run(steady(0.4, 500, 60, 80), Prnu(0.05)))
    assert seen.mean() == pytest.approx(200, rel=5 * 0.05 / 69)
    assert seen.std() / seen.mean() == pytest.approx(0.05, rel=0.05)
    dark = charge(run(steady(0.0, 500, 60, 80), Prnu(0.05), DarkCurrent(0.01)))
    assert np.ptp(dark) < 1e-4
    again = charge(run(steady(0.4, 500, 60, 80), Prnu(0.05), view=9))
    assert np.array_equal(seen, again)
    thresholds = charge(run(steady(0.4, 500, 60, 80), ThresholdFpn(0.05)))
    assert abs(np.corrcoef(seen.ravel(), thresholds.ravel())[0, 1]) < 5 / np.sqrt(seen.size)


@pytest.mark.parametrize("level", [0.25, 0.7, 1.0])
def test_a_reset_costs_its_share_of_the_next_tick(level: float) -> None:
    """Conserved: what is lost is loss x light for every spike but one in the last tick."""
    loss, ticks = 0.125, 401
    seen = run(steady(level, ticks, 4, 6), ResetLoss(loss), InitialPhase())
    assert np.allclose(charge(seen), level * ticks, rtol=1e-6)
    last = np.unpackbits(seen.spikes.bits[-1], axis=1, bitorder="little", count=6)
    assert np.allclose(seen.clipped, (counts(seen) - last) * loss * level, rtol=1e-5)
    assert counts(seen).mean() == pytest.approx(ticks * level / (1 + loss * level), abs=1)


def test_comparator_noise_moves_spikes_and_keeps_the_charge() -> None:
    """No charge comes or goes; an interval of 20 ticks has another length with chance 2 sd / (sqrt(pi) light).

    A look passes by chance Q(d / sd), d what is missing, even over one tick's light; two ends differ by 2 Q (1 - Q).
    """
    level, sd, ticks = 0.05, 0.004, 4000
    seen = run(steady(level, ticks, 20, 30), ComparatorNoise(sd), InitialPhase())
    assert np.allclose(charge(seen), level * ticks, rtol=1e-6)
    assert np.abs(counts(seen) - counts(run(steady(level, ticks, 20, 30), InitialPhase()))).max() <= 1
    pixel, tick = np.nonzero(np.unpackbits(seen.spikes.bits, axis=2, bitorder="little", count=30).reshape(ticks, -1).T)
    intervals = np.diff(tick)[pixel[1:] == pixel[:-1]]
    assert intervals.mean() == pytest.approx(20, abs=0.01)
    assert np.mean(intervals != 20) == pytest.approx(2 * sd / (np.sqrt(np.pi) * level), rel=0.08)
    assert np.abs(intervals - 20).max() <= 2


def test_all_inside_the_pixel_conserve_charge() -> None:
    """in = fired + left + lost with every effect at once; shot noise gives its own `in`, seen alone."""
    light = steady(np.linspace(0, 1.5, 60).reshape(6, 10).astype(np.float32), 300, 6, 10)
    shot = charge(run(light, InitialPhase(), ShotNoise(300.0)))
    assert np.allclose(charge(run(light, InitialPhase(), *PIXEL)), shot, atol=1e-6)
    assert np.allclose(charge(run(light, InitialPhase(), *PIXEL, Saturation())), shot, atol=1e-6)


def test_draws_do_not_depend_on_the_others() -> None:
    """Shot noise brings the same charge with and without a comparator; a comparator is its own in each view."""
    light = steady(0.3, 200, 6, 10)
    a, b = (charge(run(light, *e)) for e in ([ShotNoise(50.0)], [ShotNoise(50.0), ComparatorNoise(0.05)]))
    assert np.allclose(a, b, atol=1e-6)
    assert not same(run(light, ComparatorNoise(0.05)), run(light, ComparatorNoise(0.05), view=1))


@pytest.mark.parametrize("ticks", [1, 2])
def test_no_light_and_few_ticks(ticks: int) -> None:
    seen = run(steady(0.0, ticks, 3, 9), *PIXEL, Prnu(), Saturation())
    assert not seen.spikes.bits.any()
    assert not charge(seen).any()
    some = run(steady(2.0, ticks, 3, 9), *PIXEL, Prnu(), Saturation())
    assert (counts(some) == ticks).all()


def test_hdr() -> None:
    seen = run(hdr_light(), InitialPhase(), ResetLoss(), ComparatorNoise(), Prnu(0.0))
    assert np.abs(counts(seen) - hdr_light().rgb[0, :, :, 0] * 4000).max() <= 1 + 0.002 * 4000


def archive(path, height: int = 8, width: int = 10, **changes: np.ndarray) -> str:
    rng = np.random.default_rng(4)
    gain = rng.normal(1, 0.05, (height, width)).astype(np.float32)
    arrays = {"gain": gain / gain.mean(), "dark": rng.uniform(0, 0.01, (height, width)).astype(np.float32)}
    np.savez(path, allow_pickle=True, **(arrays | changes))
    return str(path)


def test_a_map_is_gain_and_dark(tmp_path) -> None:
    file = archive(tmp_path / "m.npz")
    maps = np.load(file)
    seen = charge(run(steady(0.3, 1000, 8, 10), SensorMap(file)))
    assert np.allclose(seen, (0.3 * maps["gain"] + maps["dark"]) * 1000, rtol=1e-5)
    middle = charge(run(steady(0.3, 1000, 3, 5), SensorMap(file)))  # rows from (8 - 3) // 2, columns from (10 - 5) // 2
    assert np.allclose(middle, seen[2:5, 2:7], rtol=1e-6)
    noisy = archive(tmp_path / "n.npz", noise=np.full((8, 10), 0.05, np.float32))
    a, b = run(steady(0.3, 1000, 8, 10), SensorMap(noisy)), run(steady(0.3, 1000, 8, 10), SensorMap(file))
    assert np.allclose(charge(a), charge(b), rtol=1e-6)
    assert not np.array_equal(a.spikes.bits, b.spikes.bits)


def test_a_map_smaller_than_the_picture(tmp_path) -> None:
    with pytest.raises(DataError, match="smaller than the picture") as caught:
        SensorMap(archive(tmp_path / "m.npz")).begin(Site(9, 10, 0, 0))
    assert "10x8" in str(caught.value)


def test_two_comparators_contradict(tmp_path) -> None:
    file = archive(tmp_path / "m.npz", noise=np.full((8, 10), 0.01, np.float32))
    with pytest.raises(UsageError, match="comparator"):
        run(steady(0.3, 10, 8, 10), SensorMap(file), ComparatorNoise())


F32 = np.float32


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"gain": np.ones((8, 10))}, "float64"),
        ({"gain": np.ones((8, 9), F32)}, "sizes differ"),
        ({"gain": np.full((8, 10), 2, F32)}, "mean 1"),
        ({"dark": np.full((8, 10), np.nan, F32)}, "not finite"),
        ({"dark": np.full((8, 10), -0.1, F32)}, "0 to 1"),
        ({"noise": np.full((8, 10), 0.5, F32)}, "0 to 0.2"),
        ({"dark": np.zeros((8, 10, 1), F32)}, "(8, 10, 1)"),
        ({"dark": np.zeros((0, 10), F32)}, "(0, 10)"),
        ({"gain": np.array([{"a": 1}], dtype=object)}, "object"),
    ],
)
def test_maps_that_cannot_be_used(tmp_path, changes: dict, says: str) -> None:
    with pytest.raises(DataError, match="cannot be used") as caught:
        SensorMap(archive(tmp_path / "m.npz", **changes)).begin(Site(4, 4, 0, 0))
    assert says in str(caught.value)


def test_map_files_that_are_none(tmp_path) -> None:
    (tmp_path / "text.npz").write_text("gain = 1")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "x.npz").read_bytes()[:300] if archive(tmp_path / "x.npz") else b"")
    np.savez(tmp_path / "only.npz", gain=np.ones((3, 3), F32))
    for name, says in (
        ("missing.npz", "No such file"),
        ("text.npz", "not a NumPy archive"),
        ("cut.npz", "not a NumPy archive"),
        ("only.npz", "'dark' is missing"),
    ):
        with pytest.raises(DataError, match="cannot be used") as caught:
            SensorMap(str(tmp_path / name)).begin(Site(2, 2, 0, 0))
        assert says in str(caught.value), name
