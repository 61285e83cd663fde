"""The clock's LED panel: given as a rectangle, or found by its blinking; never valid."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hard_sim import small

from spikerig.calib.align import Region, warp_of, within_polygon
from spikerig.calib.regions import blinking_regions, check_regions, dwell_ticks, panel_of, read_regions, regions_json
from spikerig.calib.rig import RigCalibration, write_calibration
from spikerig.dataset import cli
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.panel import Panel
from spikerig.dataset.scene import Pose
from spikerig.dataset.spikes import SpikeStream
from spikerig.dataset.store import SceneWriter, open_scene
from spikerig.rigctl.sim.capture import capture
from spikerig.rigctl.sim.emulate.panel_light import PanelInView, with_panel

H, W, TICKS = 60, 96, 960
LAMPS = {(20, 30): 32, (20, 38): 48, (20, 46): 64, (26, 30): 96, (26, 38): 4, (26, 46): 0}  # at y, x: half a period


def fired(rate: np.ndarray, seed: int = 0) -> np.ndarray:
    """Integrate and fire of [T,H,W] or [1,H,W] light, phases at random: bool[T,H,W]."""
    start = np.random.default_rng(seed).random(rate.shape[1:])
    charge = np.cumsum(np.broadcast_to(rate, (TICKS, *rate.shape[1:])), 0) + start
    return np.diff(np.floor(charge), axis=0, prepend=np.floor(start)[None]) > 0


def panel(bright: float = 0.8) -> np.ndarray:
    """What a panel of 3x3 px lamps adds: float[T,H,W]; one is too fast to see, one is always on."""
    light = np.zeros((TICKS, H, W))
    t = np.arange(TICKS)
    for (y, x), half in LAMPS.items():
        light[:, y : y + 3, x : x + 3] = (bright * ((t // half) % 2 if half else np.ones(TICKS)))[:, None, None]
    return light


def scene_light(speed_px: float, shake: bool = False) -> np.ndarray:
    """Blocks of 7 px that move sideways over the stream, [T,H,W]."""
    t = np.arange(TICKS)
    at = speed_px * (np.sin(2 * np.pi * 2.3 * t / TICKS) + 0.4 * np.sin(7 * t / TICKS) if shake else t / TICKS)
    x = np.arange(W) - at[:, None]
    rows = (np.arange(H) // 7) % 2
    return 0.05 + 0.6 * (((np.floor(x / 7).astype(int)[:, None] + rows[:, None]) % 2) > 0)


def stream_of(light: np.ndarray) -> SpikeStream:
    return SpikeStream.from_pixels(fired(np.clip(light, 0, 1)), 40_000.0)


@pytest.mark.parametrize(("speed", "shake"), [(0.0, False), (12.0, False), (6.0, True)])
def test_lamps_are_found_and_scenes_are_not(speed: float, shake: bool) -> None:
    base = scene_light(speed, shake)
    assert blinking_regions(stream_of(base)) == ()
    lit = base.copy()
    lit[:, 17:32, 27:52] = 0.03 + panel()[:, 17:32, 27:52]  # a dark box with lamps
    found = dwell_ticks(stream_of(lit)) > 0
    slow = [(y, x) for (y, x), half in LAMPS.items() if half >= 32]
    assert all(found[y : y + 3, x : x + 3].all() for y, x in slow)
    outside = found.copy()
    for y, x in slow:
        outside[y : y + 3, x : x + 3] = False
    assert not outside.any()
    (region,) = blinking_regions(stream_of(lit))
    assert region.arm == "spike"
    low, high = region.polygon_px.min(0), region.polygon_px.max(0)
    np.testing.assert_allclose([*low, *high], [27, 17, 52, 32], atol=0.01)  # the hull of the slow lamps, and 3 px


@pytest.mark.parametrize("rate_hz", [20_000.0, 40_000.0])
def test_the_lamps_that_blink_say_where_the_whole_panel_is(rate_hz: float) -> None:
    """The box's own panel, 26 bits in two rows, seen askew for 17 ms: most of its lamps do not blink meanwhile."""
    usual = Panel()
    mm = np.array([[led.x_mm, led.y_mm] for led in usual.leds])
    at = [150, 40] + mm @ np.array([[-0.9, 0.15], [-0.1, -0.2]])
    view = PanelInView(usual, at, 1.3, 0.9, 120, 180)
    ticks = round(0.0175 * rate_hz)
    still = np.full((120, 180), 0.1)
    bits = SpikeStream.from_pixels(np.random.default_rng(0).random((ticks, 120, 180)) < 0.1).bits
    made, _ = with_panel(bits, still, view, 123_456_789 + np.arange(ticks + 1) * round(1e9 / rate_hz))
    (region,) = blinking_regions(SpikeStream(made, 180, rate_hz))
    assert within_polygon(at, region.polygon_px).all()
    lit = np.stack([view.columns, view.rows], -1).astype(np.float64) + 0.5
    assert within_polygon(lit, region.polygon_px).all()
    assert np.linalg.norm(region.polygon_px.mean(0) - at.mean(0)) < 1.5
    x, y = region.polygon_px.T
    area = 0.5 * abs(x @ np.roll(y, 1) - y @ np.roll(x, 1))
    assert area < 2 * abs(np.linalg.det([at[26] - at[0], at[25] - at[0]])) + 2000  # and little else


def test_what_is_no_panel() -> None:
    t = np.arange(TICKS)
    room = 0.1 + 0.7 * ((t // 48) % 2)[:, None, None] * np.ones((1, H, W))
    assert (dwell_ticks(stream_of(room)) > 0).mean() > 0.9
    assert blinking_regions(stream_of(room)) == ()  # the light itself
    strange = np.full((TICKS, H, W), 0.05)  # lamps with a panel's paces, which do not stand like one
    for (y, x), half in {(10, 10): 32, (50, 80): 32, (50, 10): 64, (10, 80): 64}.items():
        strange[:, y : y + 3, x : x + 3] = (0.8 * ((t // half) % 2))[:, None, None]
    assert len(blinking_regions(stream_of(strange))) == 4
    specks = np.full((TICKS, H, W), 0.2)
    specks[:, 10, 10] = specks[:, 40, 70] = 0.8 * ((t // 48) % 2)
    assert blinking_regions(stream_of(specks)) == ()
    assert not (dwell_ticks(SpikeStream.from_pixels(np.ones((40, H, W), bool), 40_000.0)) > 0).any()
    noise = np.random.default_rng(0).random((TICKS, H, W)) < 0.4  # 50 times the noise of integrate and fire
    assert not (dwell_ticks(SpikeStream.from_pixels(noise, 40_000.0)) > 0).any()
    lit = stream_of(0.05 + panel())
    lost = replace(lit, bits=np.where((t // 100 == 3)[:, None, None], 0, lit.bits), lost=np.array([[300, 400]]))
    assert (dwell_ticks(lost) > 0).sum() <= (dwell_ticks(lit) > 0).sum() == 36


def test_rectangles_and_files(tmp_path: Path) -> None:
    region = panel_of("10,20.5,30,40", "rgb")
    np.testing.assert_array_equal(region.polygon_px, [[10, 20.5], [30, 20.5], [30, 40], [10, 40]])
    for text in ("", "1,2,3", "1,2,3,4,5", "a,b,c,d", "10,10,10,20", "10,10,5,20", "0,0,nan,5", "0,0,inf,5"):
        with pytest.raises(UsageError, match="rectangle"):
            panel_of(text, "spike")
    path = tmp_path / "regions.json"
    path.write_text(json.dumps(regions_json([region])))
    (back,) = read_regions(path)
    assert back.arm == "rgb"
    np.testing.assert_array_equal(back.polygon_px, region.polygon_px)
    for text in ("", "[", "{}{}", "3", '[{"arm": "left", "polygon_px": [[0, 0], [1, 0], [1, 1]]}]',
                 '[{"arm": "rgb", "polygon_px": [[0, 0], [1, 0]]}]',
                 '[{"arm": "rgb", "polygon_px": [[0, 0], [1, 0], [NaN, 1]]}]',
                 '[{"arm": "rgb"}]', '[{"arm": ["rgb"], "polygon_px": []}]'):  # fmt: skip
        path.write_text(text)
        with pytest.raises(DataError, match="regions"):
            read_regions(path)


SCENE: dict[str, Any] = {
    "camera__width": 160,
    "camera__height": 100,
    "exposure__exposure_ms": 2.0,
    "exposure__margin_ticks": 256,
}


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """raw.h5 with a panel that blinks in the spikes of each view, and calib.json."""
    folder = tmp_path_factory.mktemp("take")
    capture(small(**SCENE, effects=["threshold_fpn"]), folder / "plain.h5", workers=1)
    with open_scene(folder / "plain.h5") as scene:
        still = Pose(np.eye(4)[:3])
        write_calibration(folder / "calib.json", RigCalibration(
            scene.camera, scene.camera, still, "common", None, (1000.0, 5000.0)))  # fmt: skip
        with SceneWriter(
            folder / "raw.h5", scene.name, scene.camera, light_gain=scene.light_gain, keep=False
        ) as writer:
            for name in scene.names:
                view = scene.view(name)
                if view.spikes is not None:
                    pixels = np.unpackbits(view.spikes.bits, axis=2, count=160, bitorder="little")
                    on = (np.arange(len(pixels)) // 40) % 2 == 1
                    for x in (10, 20):
                        pixels[:, 80:84, x : x + 4] = on[:, None, None]
                    bits = SpikeStream.from_pixels(pixels).bits
                    view = replace(view, spikes=replace(view.spikes, bits=bits))
                writer.add(view)
    return folder


def test_a_panel_is_never_valid_and_is_recorded(take: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["calib", "align", str(take / "raw.h5"), "--with", str(take / "calib.json"), "--json", "-o"]
    given = tmp_path / "given.h5"
    code = cli.run([*words, str(given), "--panel-spike", "5,75,30,90", "--panel-rgb", "100,10,130,30"])
    told = json.loads(capsys.readouterr().out)
    assert code == 0
    assert [r["arm"] for r in told["regions"]] == ["spike", "rgb"]
    assert told["panels"] is None
    with open_scene(given) as scene:
        assert scene.info["align"]["regions"] == told["regions"]
        for name in scene.names:
            valid = scene.view(name).valid
            assert not valid[75:90, 5:30].any()
            assert not valid[10:30, 100:130].any()
            assert valid[40:60, 40:90].all()
    found = tmp_path / "found.h5"
    code = cli.run([*words, str(found), "--find-panel"])
    told = json.loads(capsys.readouterr().out)
    assert code == 0
    with open_scene(found) as scene:
        assert scene.info["align"]["panels"] == told["panels"]
        for name in scene.train:
            (panel,) = told["panels"][name]
            assert panel["arm"] == "spike"
            valid = scene.view(name).valid
            assert not valid[80:84, 10:24].any()
            assert valid.mean() > 0.9
    for more in (["--panel-rgb", "500,10,600,30"], ["--panel-spike", "1,2,3"]):
        assert cli.run([*words, str(tmp_path / "no.h5"), *more]) == 2
        assert "error" in json.loads(capsys.readouterr().out)
    assert not (tmp_path / "no.h5").exists()


def test_regions_of_a_mirrored_arm_are_raw_pixels_of_it() -> None:
    from calib_rigs import rig

    true = rig(mirrored="spike", rgb_width=480)
    check_regions([Region("spike", np.array([[0, 0], [40, 0], [40, 40.0]]))], true)
    with pytest.raises(UsageError, match="outside"):
        check_regions([Region("rgb", np.array([[480, 0], [500, 0], [500, 40.0]]))], true)
    free, cut = warp_of(true), warp_of(true, regions=[panel_of("10,10,90,90", "spike")])
    gone = free.valid & ~cut.valid
    assert gone.any()
    assert np.nonzero(gone)[1].min() > 300  # the left of the raw picture is the right of the aligned one
    assert within_polygon(free.spike_px[gone], panel_of("10,10,90,90", "spike").polygon_px).all()
