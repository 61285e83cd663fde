"""Scenes with an event camera, and with a colour spike sensor: beside, and in place of, what they were."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hard_sim import small, small_table
from hard_store import same

from spikerig.dataset.bayer import Bayer, bayer_of, demosaic
from spikerig.dataset.errors import UsageError
from spikerig.dataset.images import write_image
from spikerig.dataset.store import open_scene, verify_scene
from spikerig.dataset.texture import tfp
from spikerig.rigctl.sim.capture import capture, rig_of, take_view
from spikerig.rigctl.sim.effects import Hooks
from spikerig.rigctl.sim.events import EventCamera, simulate_events
from spikerig.rigctl.sim.judge.survey import Look, survey
from spikerig.rigctl.sim.sensor import Light, spike_light
from spikerig.rigctl.sim.shelf import dumps, loads
from spikerig.rigctl.sim.simulate import simulate
from spikerig.rigctl.sim.spec import Exposure, Sensor, read_scene


def smooth_light(seed: int = 0, height: int = 14, width: int = 19) -> Light:
    rng = np.random.default_rng(seed)
    rgb = (10 ** rng.uniform(-1.5, 0, (4, height, width, 3))).astype(np.float32)
    return Light(rgb, np.array([0, 40, 120, 200]), (40, 120), 40_000.0, 777)


def test_an_event_camera_changes_nothing_else() -> None:
    spec = small()
    plain, beside = take_view(spec, 0), take_view(small(events={}), 0)
    assert plain.events is None
    assert beside.events is not None
    same(plain, replace(beside, events=None), "taken")
    same(beside.events, loads(dumps(beside), "a shelf").events, "events, put on a shelf and back")


def test_events_see_the_spikes_light() -> None:
    """Gray by the spike sensor's response, whatever its gain; over exposure and margins, on the same clock."""
    light = smooth_light()
    for sensor in (Sensor(), Sensor(gain=7.0), Sensor(colour="bayer", response=(0.299, 0.587, 0.114))):
        seen = simulate(light, sensor, [], 3, 1, events=EventCamera())
        gray = light.rgb @ np.array([0.299, 0.587, 0.114], np.float32)
        true = simulate_events(gray, light.knots, light.rate_hz, EventCamera(), t0_ns=777)
        assert seen.events is not None
        assert len(seen.events) == len(true) > 2000
        assert np.abs(seen.events.t_ns - true.t_ns).max() <= 25, "float32 sums of another order"
        assert (seen.events.t0_ns, seen.events.t1_ns) == (777, 777 + 200 * 25_000)
        assert seen.spikes.t0_ns == seen.events.t0_ns


def test_noise_is_another_in_each_view() -> None:
    light, noisy = smooth_light(), EventCamera(noise_hz=1e4)
    one, two, again = (simulate(light, Sensor(), [], 3, view, events=noisy).events for view in (1, 2, 1))
    assert one is not None
    assert two is not None
    same(one, again)
    assert one.t_ns.tolist() != two.t_ns.tolist()


class Dimmer:
    """Optics that halve the light, and a lamp that flickers before the arms part."""

    name, stage, per, source, vanishes, cost_ns = "dimmer", 1, "knot", "", "", 0.0

    def begin(self, site: Any) -> Hooks:
        def flicker(rgb: np.ndarray, at_s: np.ndarray) -> None:
            rgb *= (1 + np.arange(len(rgb), dtype=np.float32))[:, None, None, None]

        return Hooks(radiance=flicker, spike_optics=lambda pictures: pictures * np.float32(0.5))


def test_effects_on_light_and_optics_reach_the_event_camera() -> None:
    light = smooth_light()
    seen = simulate(light, Sensor(), [Dimmer()], 0, events=EventCamera())  # type: ignore[list-item]
    factor = 0.5 * (1 + np.arange(4, dtype=np.float32))[:, None, None]
    gray = light.rgb @ np.array([0.299, 0.587, 0.114], np.float32) * factor
    true = simulate_events(gray, light.knots, light.rate_hz, EventCamera(), t0_ns=777)
    assert seen.events is not None
    assert len(seen.events) == len(true)
    assert np.abs(seen.events.t_ns - true.t_ns).max() <= 25


def test_a_captured_scene_holds_its_events(tmp_path: Path) -> None:
    spec = small(events={"threshold_pos": 0.3, "noise_hz": 2.0})
    told = capture(spec, tmp_path / "s.h5")
    assert verify_scene(tmp_path / "s.h5") == []
    with open_scene(tmp_path / "s.h5") as file:
        assert [file.has_events(name) for name in file.names] == [True, True, False, True], "002 is held out"
        assert told["events"] == sum(file.describe()["events"].values()) > 1000
        same(take_view(spec, 3).events, file.events("003"))
        view = file.view("000")
        assert view.spikes is not None
        events = file.events("000", view.frame.start_ns, view.frame.start_ns + view.frame.exposure_ns)
        assert events.t1_ns - events.t0_ns == view.frame.exposure_ns, "the margins hold the exposure"
        assert 0 < len(events) < len(file.events("000"))
        assert file.info["events"]["threshold_pos"] == 0.3
        assert file.info["scene_file"]["events"]["noise_hz"] == 2.0


def test_pictures_from_elsewhere_have_events_too(tmp_path: Path) -> None:
    from spikerig.rigctl.sim.sources.folder import read_folder
    from spikerig.rigctl.sim.sources.frames import capture_folder

    frames = []
    for k in range(3):
        write_image(tmp_path / f"{k}.exr", np.full((6, 8, 3), [0.1, 0.8, 0.2][k], np.float32))
        frames.append({"file": f"{k}.exr", "transform_matrix": np.eye(4).tolist()})
    (tmp_path / "transforms.json").write_text(
        json.dumps({"camera_angle_x": 1.0, "views": [{"name": "a", "frames": frames}]})
    )
    (tmp_path / "capture.toml").write_text("[exposure]\nexposure_ms = 1\n[events]\nthreshold_pos = 0.5\neps = 1e-9\n")
    told = capture_folder(read_folder(tmp_path), tmp_path / "s.h5")
    with open_scene(tmp_path / "s.h5") as file:
        seen = file.events("a")
    up = int(np.log(8) / 0.5)  # 4, to a level of 2 above the start; the end lies log 2 above it
    assert told["events"] == len(seen) == 48 * (up + int((up * 0.5 - np.log(2)) / 0.2))
    assert (np.diff(seen.t_ns)[seen.polarity[1:] != seen.polarity[:-1]] > 0).all()


def test_workers_give_the_same_events(tmp_path: Path) -> None:
    spec = small(events={"threshold_sd": 0.03, "leak_hz": 5.0})
    for workers in (1, 2):
        capture(spec, tmp_path / f"{workers}.h5", workers=workers)
    assert (tmp_path / "1.h5").read_bytes() == (tmp_path / "2.h5").read_bytes()


def test_a_scene_without_the_table_says_nothing_of_events(tmp_path: Path) -> None:
    told = capture(small(), tmp_path / "s.h5")
    assert "events" not in told
    with open_scene(tmp_path / "s.h5") as file:
        assert "events" not in json.dumps(file.info)
        assert "sensor" not in file.info
        assert file.describe()["events"] == {}


def test_wrong_keys_of_the_tables_are_told_together() -> None:
    with pytest.raises(UsageError) as told:
        small(
            events={"treshold_pos": 0.3, "eps": 0},
            sensor={"pattern": "rgbg", "colour": "baier", "channel_gain": [1, 2]},
        )
    for words in (
        "events.treshold_pos: unknown key; did you mean 'threshold_pos'?", "events.eps: is 0, expected 1e-09 to 1000",
        "sensor.pattern: is 'rgbg'", "sensor.colour: is 'baier'; did you mean 'bayer'?", "sensor.channel_gain",
    ):  # fmt: skip
        assert words in str(told.value)
    with pytest.raises(UsageError, match="expected a table"):
        read_scene({**small_table(), "events": True})
    with pytest.raises(UsageError, match='is for colour = "bayer"'):
        small(sensor={"pattern": "bggr"})


# ---- colour


@pytest.mark.parametrize("pattern", ["rggb", "gbrg"])
def test_a_colour_sensors_pixel_sees_one_colour(pattern: str) -> None:
    """Steady light: the count of each pixel is gain x channel gain x its own colour."""
    rgb = np.random.default_rng(0).uniform(0.1, 0.9, (1, 7, 9, 3)).astype(np.float32)
    light = Light(rgb, np.array([0, 4000]), (0, 4000), 40_000.0)
    sensor = Sensor(gain=0.5, colour="bayer", pattern=pattern, channel_gain=(1.2, 1.0, 0.4))
    spikes = simulate(light, sensor, [], 0).spikes
    for y in range(7):
        for x in range(9):
            c = "rgb".index(pattern[2 * (y % 2) + x % 2])
            want = 4000 * 0.5 * (1.2, 1.0, 0.4)[c] * rgb[0, y, x, c]
            found = int(((spikes.bits[:, y, x // 8] >> (x % 8)) & 1).sum())
            assert abs(found - want) < 1.01, (y, x)


def test_optics_act_before_colours_part() -> None:
    """A blur of red light must not leak into green pixels."""
    rgb = np.zeros((1, 6, 8, 3), np.float32)
    rgb[..., 0] = 0.5
    light = Light(rgb, np.array([0, 100]), (0, 100), 40_000.0)

    class Blur(Dimmer):
        def begin(self, site: Any) -> Hooks:
            return Hooks(spike_optics=lambda p: (p + np.roll(p, 1, axis=2)) / 2)

    spikes = simulate(light, Sensor(gain=1.0, colour="bayer"), [Blur()], 0).spikes  # type: ignore[list-item]
    counts = np.unpackbits(spikes.bits, axis=2, bitorder="little")[:, :, :8].sum(0)
    assert (counts[::2, ::2] == 50).all()
    assert counts[::2, 1::2].sum() == counts[1::2].sum() == 0


def test_a_survey_of_a_colour_sensor_looks_at_each_colour_apart() -> None:
    """A steady red picture has no gradient for any of its pixels, though the mosaic is a checkerboard."""
    rgb = np.zeros((2, 12, 16, 3), np.float32)
    rgb[..., 0] = 0.5
    look = Look(Light(rgb, np.array([0, 100]), (0, 100), 40_000.0), 1.0)
    facts = survey([look], Sensor(colour="bayer"), Exposure(), focal_px=20.0, views=1)
    assert facts.light.max() == pytest.approx(0.2)
    assert not facts.gradient.any()
    assert not facts.bend.any()


def test_gray_is_what_it_was() -> None:
    rgb = np.random.default_rng(1).random((2, 5, 6, 3)).astype(np.float32)
    k = np.array([0.299, 0.587, 0.114], np.float32) * np.float32(0.4)
    want = rgb[..., 0] * k[0] + rgb[..., 1] * k[1] + rgb[..., 2] * k[2]
    assert np.array_equal(spike_light(rgb, Sensor()), want)


def test_a_colour_scene_says_so_and_gives_its_colours_back(tmp_path: Path) -> None:
    table = {"colour": "bayer", "pattern": "gbrg", "channel_gain": [1.5, 1.0, 2.0], "gain": 0.3, "response": [1, 1, 1]}
    spec = small(sensor=table, shake__path_px=[0, 0], effects=[], exposure__exposure_ms=40.0, exposure__period_ms=100.0)
    assert rig_of(spec).light_gain == 0.3
    capture(spec, tmp_path / "s.h5")
    with open_scene(tmp_path / "s.h5") as file:
        assert file.light_gain == 0.3
        assert file.info["sensor"] == {"bayer": "gbrg", "channel_gain": [1.5, 1.0, 2.0]}
        bayer = bayer_of(file.info)
        assert bayer == Bayer("gbrg", (1.5, 1.0, 2.0))
        spikes, light = file.spikes("000"), file.truth_light("000")
    found = demosaic(tfp(spikes, spikes.ticks // 2, 1600), bayer)
    assert found.known.all()
    error = found.light / 0.3 - light
    own = bayer.channels(*light.shape[:2])[:, :, None] == np.arange(3)
    dim = light * np.array([1.5, 1.0, 2.0]) * 0.3 < 1
    assert np.abs(error[own & dim]).max() < 1.01 / 1600 / 0.3
    assert np.median(np.abs(error[~own & dim])) < 0.05, "the others are bilinear"
