"""`spikerig cost sim`: its sweeps measure what they say."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hard_sim import small

from spikerig.dataset.cli import run
from spikerig.dataset.cost import Setting
from spikerig.rigctl.cost import (
    arithmetic_settings,
    charge_of,
    dim_settings,
    effect_settings,
    light_of,
    rms,
    step_settings,
    stepped,
)
from spikerig.rigctl.sim.sensor import Light
from spikerig.rigctl.sim.spec import SceneSpec


def still(spec: SceneSpec) -> SceneSpec:
    return replace(spec, effects=(), exposure=replace(spec.exposure, margin_ticks=0))


def errors(settings: list[Setting]) -> dict[str, dict]:
    """{series: {value: error}}."""
    found: dict[str, dict] = {}
    for setting in settings:
        found.setdefault(setting.series, {})[setting.value] = setting.error(setting.run())
    return found


def test_light_is_that_of_the_simulated_view() -> None:
    spec = still(small())
    light = light_of(spec, 0, 5)
    assert light.knots.tolist() == [0, 10, 20, 30, 40]
    assert light.rgb.shape == (5, 18, 29, 3)


def test_charge_against_float64_ticks() -> None:
    spec = still(small(sensor__gain=12.0))  # some of it beyond one threshold a tick
    light = light_of(spec, 0, 9)
    truth = stepped(light, spec.sensor, np.float64)
    assert truth.max() == 40  # and clipped
    assert rms(charge_of(light, spec.sensor), truth) < 1e-5
    held = Light(light.rgb[:-1], light.knots, light.exposure, light.rate_hz)
    assert held.hold
    assert rms(charge_of(held, spec.sensor), stepped(held, spec.sensor, np.float64)) < 1e-5
    assert rms(charge_of(held, spec.sensor), truth) > 1e-3


def test_more_pictures_come_closer() -> None:
    spec = still(small())
    found = errors(step_settings(spec, 0, light_of(spec, 0, 41)))
    assert len(found) == 2
    for series in found.values():
        assert list(series) == [2, 3, 5, 9, 18, 33]  # 40 ticks have no room for more
        assert series[2] > 2 * series[9] > 4 * series[33]


def test_arithmetic_is_ranked() -> None:
    spec = still(small())
    for settings in (arithmetic_settings(light_of(spec, 0, 5), spec.sensor), dim_settings()):
        ((_, found),) = errors(settings).items()
        assert list(found) == ["fixed point", "float32 sums", "float64 sums"]
        assert found["float64 sums"] < 2 * found["fixed point"] < found["float32 sums"]
        assert found["fixed point"] < 1e-3


def test_a_setting_for_each_effect_and_output_it_reaches() -> None:
    spec = small()
    found = errors(effect_settings(light_of(still(spec), 0, 5), spec.sensor, spec.effects, spec.seed))
    spikes, frame = found.values()
    assert set(spikes) == {"none", *(e.name for e in spec.effects)} - {"read_noise"}
    assert set(frame) == {"none", "read_noise"}
    assert spikes.pop("none") == frame.pop("none") == 0
    assert min(spikes.values()) > 0
    assert frame["read_noise"] == pytest.approx(255 * spec.effects[-1].sd, rel=0.5)  # type: ignore[attr-defined]


def test_an_unknown_kind(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["cost", "sim", "--what", "tea"]) == 2
    assert "light, arithmetic, effects" in capsys.readouterr().err


def test_effects_of_a_scene_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["cost", "sim", "--scene", "chroma", "--what", "effects", "--repeats", "1", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["name"] == "sim_effects"
    assert document["rows"][0]["value"] == "none"
    assert document["rows"][0]["error"] == 0
