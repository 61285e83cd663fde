"""Flat field, dark rate and response, against a sensor that is known; and its file, which the simulator reads."""

import json
from pathlib import Path

import numpy as np
import pytest
from calib_rigs import rig

from spikerig.calib.photometric import Level, count_level, flat_field
from spikerig.calib.response import fit_response, rgb_mean
from spikerig.calib.rig import read_calibration, write_calibration
from spikerig.dataset import cli
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.flat import FlatField, flattened, read_flat, write_flat
from spikerig.dataset.images import srgb8_from_linear, write_image
from spikerig.dataset.kernels import fire
from spikerig.dataset.spikes import SpikeStream, open_spikes, write_spikes
from spikerig.dataset.texture import tfp
from spikerig.rigctl.sim.effects.maps import read_maps

H, W = 60, 88
RNG = np.random.default_rng(3)
Y, X = np.mgrid[0:H, 0:W]
R2 = (((X + 0.5) / W - 0.5) ** 2 + ((Y + 0.5) / H - 0.5) ** 2 * (H / W) ** 2) * 4
GAIN = (1 + 0.04 * RNG.standard_normal((H, W))) * (1 - 0.2 * R2)
GAIN[5, 7], GAIN[20, 30] = 0.0, 8.0  # dead, stuck
DARK = np.maximum(0.004 + 0.001 * RNG.standard_normal((H, W)), 0)
DARK[40, 50] = 0.6  # hot
GOOD = np.ones((H, W), bool)
GOOD[[5, 20, 40], [7, 30, 50]] = False


RGB_Y, RGB_X = np.mgrid[0:40, 0:64]
RGB_R2 = (((RGB_X + 0.5) - 32) ** 2 + ((RGB_Y + 0.5) - 20) ** 2) / (32**2 + 20**2)
RGB_FALL = (1 - 0.15 * RGB_R2).astype(np.float32)


def recorded(light: float, ticks: int, seed: int, electrons: float = 560) -> SpikeStream:
    rng = np.random.default_rng(seed)
    charge = (GAIN * light + DARK).astype(np.float32)[None].repeat(ticks, 0)
    if light > 0:
        charge += rng.standard_normal(charge.shape, dtype=np.float32) * np.sqrt(charge / np.float32(electrons))
    phase = rng.integers(0, 2**32, (H, W), dtype=np.uint32)
    bits, _, _ = fire(np.maximum(charge, 0), np.arange(ticks + 1), phase, hold=True)
    return SpikeStream(bits, W, 20_000.0)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("even")
    (folder / "spike").mkdir()
    (folder / "rgb").mkdir()
    colours = [(0.7, 0.3, 0.2), (0.2, 0.5, 0.3), (0.2, 0.3, 0.7), (0.4, 0.4, 0.4)]
    for k, rgb in enumerate(colours):
        light = 0.5 * float(np.dot((0.25, 0.6, 0.15), rgb))
        write_spikes(folder / f"spike/l{k}.npz", recorded(light, 4000, k))
        pixels = srgb8_from_linear(RGB_FALL[..., None] * np.float32(rgb))
        write_image(folder / f"rgb/l{k}.png", np.ascontiguousarray(pixels))
    write_spikes(folder / "dark.npz", recorded(0.0, 12_000, 9))
    return folder


def level(path: Path) -> Level:
    with open_spikes(path) as file:
        return count_level(path.name, file)


def test_maps_of_a_known_sensor_come_back(files: Path) -> None:
    flat, told = flat_field([level(p) for p in sorted((files / "spike").glob("*"))], [level(files / "dark.npz")])
    np.testing.assert_array_equal(flat.good, GOOD)
    true = GAIN / GAIN[GOOD].mean()
    assert np.abs(flat.gain - true)[GOOD].std() < 0.002
    assert np.abs(flat.dark - DARK)[GOOD].max() < 2.5e-4
    assert flat.gain[GOOD].mean() == pytest.approx(1, abs=1e-4)
    assert told["pattern_sd"] == pytest.approx(0.04, rel=0.05)
    assert told["falloff"] == pytest.approx(0.2 * R2[0, 0], rel=0.15)
    assert told["threshold_e"] == pytest.approx(560, rel=0.15)
    assert told["bad_pixels"] == 3
    assert told["dark_rate"]["mean"] == pytest.approx(DARK[GOOD].mean(), rel=0.01)


def test_known_light_does_without_a_dark_recording() -> None:
    lux = [100.0, 300.0]
    rates = [np.clip(GAIN * 1e-3 * v + DARK, 0, 1) for v in lux]
    levels = [Level(str(v), r * 20_000, 20_000) for v, r in zip(lux, rates, strict=True)]
    flat, told = flat_field(levels, lux=lux)
    np.testing.assert_allclose(flat.dark[GOOD], DARK[GOOD], atol=1e-6)
    np.testing.assert_allclose(flat.gain[GOOD], (GAIN / GAIN[GOOD].mean())[GOOD], rtol=1e-5)
    assert told["dark_rate"]["measured"] is False
    assert max(abs(row["nonlinearity"]) for row in told["levels"]) < 1e-6
    with pytest.raises(UsageError, match="dark rate"):
        flat_field(levels)
    with pytest.raises(UsageError, match="dark rate"):
        flat_field(levels, lux=[100.0, 100.0])


def test_saturated_pixels_and_levels_do_not_count() -> None:
    dark = Level("dark", DARK * 20_000, 20_000)
    levels = [Level(str(v), np.clip(GAIN * v + DARK, 0, 1) * 20_000, 20_000) for v in (0.3, 1.0)]
    flat, told = flat_field(levels, [dark])
    np.testing.assert_allclose(flat.gain[GOOD], (GAIN / GAIN[GOOD].mean())[GOOD], rtol=2e-3)
    assert told["levels"][1]["saturated"] > 0.1
    with pytest.raises(DataError, match="saturated"):
        flat_field([Level("sun", np.full((H, W), 20_000.0), 20_000)], [dark])
    with pytest.raises(DataError, match="no light"):
        flat_field([dark], [dark])
    with pytest.raises(UsageError, match="size"):
        flat_field([Level("x", np.ones((3, 4)), 20_000)], [dark])
    with pytest.raises(UsageError, match="even field"):
        flat_field([], [dark])


def test_lost_ticks_are_not_counted() -> None:
    bits = np.ones((1000, 4, 8), bool)
    bits[300:400] = False
    stream = SpikeStream(SpikeStream.from_pixels(bits).bits, 8, 20_000.0, lost=np.array([[300, 400]]))
    from spikerig.dataset.stream import SpikeFile

    def cut(a: int, b: int) -> np.ndarray:
        return stream.bits[a:b]

    told = count_level("x", SpikeFile(Path("x"), "npz", 1000, 4, 8, cut, lambda: None, lost=stream.lost))
    assert (told.rate == 1).all()
    assert told.ticks <= 900
    with pytest.raises(DataError, match="short"):
        count_level("x", SpikeFile(Path("x"), "npz", 100, 4, 8, cut, lambda: None))


def test_a_texture_is_flattened_where_pixels_are_good(files: Path) -> None:
    flat, _ = flat_field([level(p) for p in sorted((files / "spike").glob("*"))], [level(files / "dark.npz")])
    rough = tfp(recorded(0.3, 4000, 77), 2000, 4000)
    even = flattened(rough, flat)
    np.testing.assert_array_equal(even.known, GOOD)
    assert even.light[GOOD].std() / even.light[GOOD].mean() < 0.1 * rough.light[GOOD].std() / rough.light[GOOD].mean()
    assert even.light[GOOD].mean() == pytest.approx(0.3 * GAIN[GOOD].mean(), rel=0.005)
    assert (even.light[~GOOD] == 0).all()
    with pytest.raises(UsageError, match="another sensor"):
        flattened(rough, FlatField(*(np.ones((3, 4), t) for t in (np.float32, np.float32, bool, np.float32))))


def test_the_simulator_reads_the_maps(tmp_path: Path) -> None:
    maps = (GAIN / GAIN[GOOD].mean()).clip(0.2, 2).astype(np.float32), DARK.clip(0, 0.1).astype(np.float32)
    flat = FlatField(maps[0] / maps[0].mean(), maps[1], GOOD, np.ones((H, W), np.float32))
    write_flat(tmp_path / "flat.npz", flat, noise=0.01)
    told = read_maps(str(tmp_path / "flat.npz"))
    np.testing.assert_array_equal(told.gain, flat.gain)
    np.testing.assert_array_equal(told.dark, flat.dark)
    back = read_flat(tmp_path / "flat.npz")
    for name in ("gain", "dark", "good", "smooth"):
        np.testing.assert_array_equal(getattr(back, name), getattr(flat, name))
    with pytest.raises(UsageError):
        write_flat(tmp_path / "flat.npz", flat)
    with pytest.raises(UsageError):
        write_flat(tmp_path / "flat.exr", flat)


def test_maps_that_are_none(tmp_path: Path) -> None:
    path = tmp_path / "bad.npz"
    ones = np.ones((3, 4), np.float32)
    for arrays, word in (
        ({"gain": ones}, "dark"),
        ({"gain": ones, "dark": ones[:2]}, "sizes"),
        ({"gain": ones * np.nan, "dark": ones}, "gain"),
        ({"gain": ones.astype(np.float64), "dark": ones}, "gain"),
        ({"gain": np.array([object()]), "dark": ones}, "archive"),
    ):
        np.savez(path, **arrays)
        with pytest.raises(DataError, match=word):
            read_flat(path)
    path.write_bytes(b"PK\x03\x04nothing")
    with pytest.raises(DataError, match="archive"):
        read_flat(path)


def test_response_and_split_ratio() -> None:
    rgb = np.array([[0.7, 0.3, 0.2], [0.2, 0.5, 0.3], [0.2, 0.3, 0.7], [0.4, 0.4, 0.4]])
    true = np.array([0.25, 0.6, 0.15])
    told = fit_response(rgb, 0.45 * rgb @ true, [True] * 4)
    assert told.split_ratio == pytest.approx(0.45)
    assert told.response == pytest.approx(true)
    assert told.curve == pytest.approx(1)
    grays = np.repeat(np.array([[0.1], [0.3], [0.6]]), 3, 1)
    told = fit_response(grays, 0.45 * grays[:, 0], [True] * 3)
    assert told.response is None
    assert told.split_ratio == pytest.approx(0.45)
    bent = fit_response(grays, 0.45 * grays[:, 0] ** 1.1, [True] * 3)
    assert bent.curve == pytest.approx(1.1)
    blind = fit_response(rgb, 0.45 * rgb @ np.array([0.0, 1, 0]), [True] * 4)
    assert blind.response == pytest.approx([0, 1, 0], abs=1e-9)
    cold = fit_response(rgb, 0.45 * rgb @ np.array([-0.05, 0.8, 0.25]), [True] * 4).response
    assert cold is not None
    assert min(cold) == 0
    assert fit_response(rgb, 0.45 * rgb @ true, [True, True, True, False]).used[3] is False
    with pytest.raises(DataError, match="no level"):
        fit_response(rgb, np.zeros(4), [True] * 4)
    black, fits = rgb_mean(np.zeros((20, 20, 3), np.uint8))
    assert not fits
    assert black.tolist() == [0, 0, 0]
    assert not rgb_mean(np.full((20, 20, 3), 255, np.uint8))[1]


def test_the_command(files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, into = tmp_path / "flat.npz", tmp_path / "calib.json"
    write_calibration(into, rig(), {"note": "kept"})
    words = ["calib", "photometric", str(files / "spike"), "-o", str(out), "--json"]
    code = cli.run([*words, "--rgb", str(files / "rgb"), "--dark", str(files / "dark.npz"), "--into", str(into)])
    told = json.loads(capsys.readouterr().out)
    assert code == 0
    assert told["schema"] == "spikerig.calib.photometric/1"
    assert told["response"] == pytest.approx([0.25, 0.6, 0.15], abs=0.02)
    assert told["split_ratio"] == pytest.approx(0.5 * GAIN[GOOD].mean(), rel=0.02)
    assert told["curve"] == pytest.approx(1, abs=0.03)
    assert told["falloff"] == pytest.approx(0.2 * R2[0, 0], rel=0.15)
    assert told["falloff_rgb"] == pytest.approx(0.15, rel=0.1)
    record = read_calibration(into)
    assert record.id == told["id"]
    assert record.split_ratio == pytest.approx(told["split_ratio"], abs=1e-8)
    assert record.flat is not None
    assert record.flat["file"] == "flat.npz"
    assert read_flat(out).good.sum() == GOOD.sum()
    assert cli.run(words) == 2  # exists
    capsys.readouterr()
    assert cli.run([*words, "--force"]) == 2  # neither dark nor lux
    assert "dark" in json.loads(capsys.readouterr().out)["error"]["what"]
    assert cli.run([*words, "--force", "--lux", "1,x"]) == 2
    capsys.readouterr()
