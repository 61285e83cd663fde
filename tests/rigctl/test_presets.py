"""Sensor presets: published numbers, maps from a file, and one real clip."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hard_sim import small, small_table, steady

from spikerig.dataset import cli
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.spikes import SpikeStream, open_spikes, write_spikes
from spikerig.rigctl.sim.capture import take_view
from spikerig.rigctl.sim.effects import Effect
from spikerig.rigctl.sim.effects.fpn import ThresholdFpn
from spikerig.rigctl.sim.effects.phase import InitialPhase
from spikerig.rigctl.sim.effects.shot import ShotNoise
from spikerig.rigctl.sim.presets import PRESETS, preset_names, sensor_effects
from spikerig.rigctl.sim.sensor import Light
from spikerig.rigctl.sim.simulate import simulate
from spikerig.rigctl.sim.spec import Sensor, load_scene_toml, read_scene
from spikerig.rigctl.sim.statistics import moved, smooth, statistics, twin

ONE = Sensor(gain=1.0, response=(1.0, 0.0, 0.0))


def run(light: Light, *effects: Effect, seed: int = 3) -> SpikeStream:
    return simulate(light, ONE, effects, seed).spikes


def table(**changes: object) -> dict:
    made = small_table(**changes)
    del made["effects"]
    return made


def test_every_preset_can_be_named() -> None:
    for name in preset_names("spike")[1:]:
        assert len(PRESETS[name].source) > 10
        if name != "vidar-map":
            assert [e.name for e in sensor_effects(name)][-1] == "initial_phase"
    assert read_scene(table(sensor={"preset": "vidar-ideal"})).effects == (InitialPhase(),)
    names = [e.name for e in read_scene(table(sensor={"preset": "vidar-scsim"})).effects]
    assert names == [
        "shot_noise", "prnu", "dark_current", "threshold_fpn", "reset_loss", "comparator_noise", "initial_phase"
    ]  # fmt: skip
    with pytest.raises(UsageError, match="vidar-ideal, vidar-scsim"):
        sensor_effects("vidar-x")


def test_the_numbers_of_scsim_follow_from_its_code() -> None:
    """Constants of v2s.py, to three digits; see the derivation in presets.py."""
    found = {t["name"]: t for t in PRESETS["vidar-scsim"].effects}
    swing, c, i_dark = 3.3 - 2.2 - 0.0076, 4.348, 0.4442
    threshold = c * swing
    for name, key, value in (
        ("dark_current", "rate", 0.05 * i_dark / threshold),
        ("dark_current", "sd", 0.05 * 0.1731 / threshold),
        ("threshold_fpn", "sd", np.hypot(0.0497 / swing, 0.0128 / c)),
        ("prnu", "sd", 0.0584 / 1.0128),
        ("comparator_noise", "sd", 0.00636 / swing),
        ("reset_loss", "loss", 1 - 0.998),
        ("shot_noise", "threshold_e", 5e4),
    ):
        assert found[name][key] == pytest.approx(value, rel=2e-3), name


def archive(path: Path, height: int = 30, width: int = 40) -> None:
    gain = np.random.default_rng(4).normal(1, 0.05, (height, width)).astype(np.float32)
    np.savez(path, gain=gain / gain.mean(), dark=np.full((height, width), 0.004, np.float32))


def test_a_map_lies_beside_the_scene_file(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "scenes").mkdir()
    archive(tmp_path / "scenes" / "mine.npz")
    text = '[sensor]\npreset = "vidar-map"\nmap = "mine.npz"\n[camera]\nwidth = 29\nheight = 18\n'
    text += '[[world.solids]]\nkind = "sphere"\ncentre = [0.0, 0.0, 0.0]\nradius = 1.0\n[orbit]\nradius = 3.0\n'
    (tmp_path / "scenes" / "s.toml").write_text(text)
    monkeypatch.chdir(tmp_path)
    spec = load_scene_toml("scenes/s.toml")
    assert [e.name for e in spec.effects] == ["sensor_map", "initial_phase"]
    listed = small(effects=[{"name": "sensor_map", "file": "scenes/mine.npz"}])
    bare = small(effects=[])
    a, b = (take_view(s, 0).view.spikes for s in (listed, bare))
    assert a is not None
    assert b is not None
    assert not np.array_equal(a.bits, b.bits)


def test_maps_and_presets_that_do_not_go_together(tmp_path) -> None:
    archive(tmp_path / "m.npz")
    file = str(tmp_path / "m.npz")
    for sensor, effects, says in (
        ({"preset": "vidar-map"}, None, "sensor.map"),
        ({"map": file}, None, "go together"),
        ({"preset": "vidar-scsim", "map": file}, None, "go together"),
        ({"preset": "vidar-map", "map": str(tmp_path / "no.npz")}, None, "No such file"),
        ({}, [{"name": "sensor_map", "file": file}, "prnu"], "count twice"),
        ({}, [{"name": "sensor_map", "file": file}, "threshold_fpn", "dark_current"], "dark_current"),
        ({}, ["sensor_map"], "no file"),
    ):
        made = table(sensor=sensor) if effects is None else small_table(sensor=sensor, effects=effects)
        with pytest.raises(UsageError) as caught:
            read_scene(made)
        assert says in str(caught.value), (sensor, effects)


def test_statistics_of_steady_light_without_noise() -> None:
    """Every interval regular, the count variance that of the phase alone, no pattern."""
    level = 0.0573
    seen = run(steady(level, 4100, 20, 24), InitialPhase())
    found = statistics(seen)
    part = 41 * level % 1
    assert found.rate == pytest.approx(level, rel=2e-3)
    assert found.regular == 1
    assert found.count_variance == pytest.approx(part * (1 - part), rel=0.05)
    assert found.phase_variance == pytest.approx(part * (1 - part), rel=0.05)
    assert found.fpn < 2e-3
    assert statistics(seen, flat=True).pixels == 480


def test_statistics_find_the_noise_that_was_put_in() -> None:
    bright = steady(0.3, 2000, 60, 64)
    assert statistics(run(bright, InitialPhase(), ThresholdFpn(0.05))).fpn == pytest.approx(0.05, rel=0.08)
    electrons, level = 20.0, 0.3
    seen = run(bright, InitialPhase(), ShotNoise(electrons))
    noisy, brief = statistics(seen), statistics(seen.slice(0, 123))
    mean = 41 * level
    # phase noise of both ends of a window is even once the charge spreads over more than a threshold
    assert noisy.count_variance == pytest.approx(mean / electrons + 1 / 6, rel=0.08)
    assert brief.count_variance == pytest.approx(mean / electrons + 1 / 6, rel=0.15)  # of three windows
    assert noisy.regular < 0.9


def test_statistics_pass_over_lost_ticks() -> None:
    seen = run(steady(0.1, 1000, 5, 9), InitialPhase())
    bits = seen.bits.copy()
    bits[200:300] = 0
    lossy = replace(seen, bits=bits, lost=np.array([[200, 300]]))
    assert statistics(lossy) == statistics(seen.slice(300, 1000))


def test_streams_without_statistics() -> None:
    with pytest.raises(DataError, match="too short"):
        statistics(run(steady(0.1, 81), InitialPhase()))
    with pytest.raises(DataError, match="no pixel"):
        statistics(run(steady(0.0, 200), InitialPhase()))
    with pytest.raises(DataError, match="too short"):
        twin(run(steady(0.1, 79), InitialPhase()), [])


def test_smoothing_and_moving() -> None:
    picture = np.random.default_rng(0).random((12, 15))
    assert smooth(picture)[5, 6] == pytest.approx(picture[1:10, 2:11].mean())
    assert smooth(np.full((3, 2), 0.7)) == pytest.approx(np.full((3, 2), 0.7))
    assert smooth(np.array([[0.4]])) == pytest.approx(0.4)
    assert np.array_equal(moved(picture, np.array([2, -3]))[4, 5], picture[2, 8])
    assert moved(picture, np.array([0.25, 0.0]))[4, 5] == pytest.approx(0.75 * picture[4, 5] + 0.25 * picture[3, 5])
    assert moved(np.array([[0.4]]), np.array([2.0, 1.0])) == pytest.approx(0.4)


def test_a_twin_follows_motion_and_keeps_the_rate() -> None:
    """A bar pattern that moves by 4 pixels: the twin's second half has moved as well."""
    y, x = np.mgrid[:64, :72]
    pictures = [0.12 + 0.08 * np.sin((y - 4 * s) / 4) * np.cos(x / 5) for s in np.linspace(0, 1, 9)]
    rgb = np.repeat(np.stack(pictures)[..., None], 3, axis=3).astype(np.float32)
    clip = run(Light(rgb, np.linspace(0, 400, 9).astype(np.int64), (0, 400), 4e4), InitialPhase())
    made = twin(clip, [InitialPhase()], 1)
    halves = [[s.slice(a, a + 80) for a in (0, 320)] for s in (clip, made)]
    (first, last), (first_, last_) = (
        [np.unpackbits(h.bits, axis=2, bitorder="little", count=72).mean(0) for h in pair] for pair in halves
    )
    inner = (slice(8, -8), slice(8, -8))
    likeness = np.corrcoef(last[inner].ravel(), last_[inner].ravel())[0, 1]
    assert likeness > 0.9
    assert likeness > np.corrcoef(last[inner].ravel(), first_[inner].ravel())[0, 1] + 0.2
    assert made.bits.shape == clip.bits.shape
    assert statistics(made).rate == pytest.approx(statistics(clip).rate, rel=0.01)
    assert first.shape == (64, 72)


def test_the_verb(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    write_spikes(tmp_path / "s.npz", run(steady(0.1, 200, 12, 16), InitialPhase()))
    assert cli.run(["sim", "statistics", str(tmp_path / "s.npz"), "--preset", "vidar-scsim", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["schema"] == "spikerig.sim.statistics/1"
    assert told["statistics"]["spikes"]["all"]["regular"] == 1
    assert told["statistics"]["vidar-scsim"]["all"]["fpn"] > 0.03
    assert cli.run(["sim", "statistics", str(tmp_path / "s.npz"), "--preset", "vidar-x"]) == 2


@pytest.mark.real
def test_scsim_reproduces_a_real_clip(shared_data) -> None:
    """The bounds of docs/sensor_statistics.md; and that they can fail."""
    with open_spikes(shared_data("spike/real_uhsr.npz"), axes="THW") as file:
        clip = file.read()
    effects = sensor_effects("vidar-scsim")
    made = twin(clip, effects)
    for flat in (False, True):
        real, twins = statistics(clip, flat), statistics(made, flat)
        assert twins.rate == pytest.approx(real.rate, rel=0.05 if flat else 0.02)
        assert twins.regular == pytest.approx(real.regular, abs=0.04)
        assert twins.count_variance == pytest.approx(real.count_variance, rel=0.1)
        assert twins.fpn == pytest.approx(real.fpn, rel=0.2)
    real = statistics(clip)
    assert statistics(twin(clip, sensor_effects("vidar-ideal"))).fpn < 0.4 * real.fpn
    coarse = [ShotNoise(560.0), *(e for e in effects if e.name != "shot_noise")]
    assert statistics(twin(clip, coarse)).regular < real.regular - 0.1
