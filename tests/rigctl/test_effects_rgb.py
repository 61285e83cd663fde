"""The RGB camera's own effects, from the shutter to the file; and what all effects of this kind must keep to."""

import sys

import numpy as np
import pytest
from hard_effects_arms import drifting, own_effects, run, same, still, textured
from hard_sim import small_table

from spikerig.dataset.errors import HostError, UsageError
from spikerig.dataset.images import srgb_from_linear
from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.capture import take_view
from spikerig.rigctl.sim.effects import EFFECTS, Effect, Site, Stage, effect_class
from spikerig.rigctl.sim.effects.balance import WhiteBalance
from spikerig.rigctl.sim.effects.bayer import PATTERNS, Bayer, colour_masks, demosaic
from spikerig.rigctl.sim.effects.bits import BitDepth
from spikerig.rigctl.sim.effects.dark import DarkCurrent
from spikerig.rigctl.sim.effects.jpeg import Jpeg
from spikerig.rigctl.sim.effects.read import ReadNoise
from spikerig.rigctl.sim.effects.response import ResponseCurve
from spikerig.rigctl.sim.effects.rgb_noise import RgbNoise
from spikerig.rigctl.sim.effects.rolling import RollingShutter
from spikerig.rigctl.sim.effects.video import VideoCodec
from spikerig.rigctl.sim.presets import PRESETS
from spikerig.rigctl.sim.sensor import Light
from spikerig.rigctl.sim.spec import read_scene

ABSENT = [
    RollingShutter(0.0),
    WhiteBalance((1.0, 1.0, 1.0)),
    ResponseCurve("srgb", 2.2, 0.0),
    ReadNoise(0.0),
    BitDepth(8),
]


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / max(np.mean((a.astype(float) - b.astype(float)) ** 2), 1e-9)))


@pytest.mark.parametrize("effect", ABSENT, ids=lambda e: e.name)
def test_the_limit_is_absence(effect: Effect) -> None:
    assert same(run(drifting(), effect), run(drifting()))


@pytest.mark.parametrize("name", own_effects())
@pytest.mark.parametrize("size", [(1, 1), (1, 7), (3, 5), (17, 1)])
def test_hard_sizes_and_lights(name: str, size: tuple[int, int]) -> None:
    """Shapes as asked, spikes and pixels in range, black stays dark, for light of 0, 0.2 and 10 whites."""
    for value in (0.0, 0.2, 10.0):
        rgb = np.full((4, *size, 3), value, np.float32)
        light = Light(rgb, np.array([0, 300, 500, 800]), (300, 500), 40_000.0)
        seen = run(light, effect_class(name)())
        assert seen.frame.pixels.shape == (*size, 3)
        assert seen.spikes.bits.shape == (800, size[0], (size[1] + 7) // 8)
        assert np.isfinite(seen.blurry).all()
        assert (seen.blurry >= 0).all()
        part = seen.frame.pixels / seen.frame.full
        if value == 0:
            assert not seen.spikes.bits.any()
            assert part.max() <= 0.1
        if value == 10 and name not in ("video_codec", "response_curve", "white_balance", "vignetting"):
            assert part.min() > 0.95


def grows(height: int = 20, ticks: int = 800, exposure: tuple[int, int] = (300, 500)) -> Light:
    """Light that grows evenly from 0.1 to 0.5."""
    knots = np.array([0, *exposure, ticks])
    values = np.interp(knots, [0, ticks], [0.1, 0.5])
    rgb = np.broadcast_to(values[:, None, None, None], (4, height, 6, 3)).astype(np.float32)
    return Light(rgb, knots, exposure, 40_000.0, 5_000_000)


@pytest.mark.parametrize("height", [20, 21])
def test_each_row_sees_its_own_time(height: int) -> None:
    light = grows(height)
    seen, bare = run(light, RollingShutter(8.0)), run(light)
    late_ticks = (np.arange(height) - height // 2) * (8.0 / height) * 40
    assert np.allclose(seen.blurry[:, 0, 0], 0.3 + late_ticks * 0.4 / 800, atol=1e-6)
    row_ns = round(8e6 / height)
    assert (seen.frame.row_ns, bare.frame.row_ns) == (row_ns, 0)
    assert seen.frame.start_ns + row_ns * (height // 2) == bare.frame.start_ns
    assert seen.frame.exposure_ns == bare.frame.exposure_ns
    assert np.array_equal(seen.spikes.bits, bare.spikes.bits)


def test_a_moving_edge_leans() -> None:
    """An edge that moves v px/ms is found v * row time further right in each row below."""
    height, width, ticks, v = 24, 60, 1000, 1.6
    at = np.arange(0, ticks + 1, 10)
    x = np.arange(width)
    rgb = np.empty((len(at), height, width, 3), np.float32)
    for k, t in enumerate(at):
        rgb[k] = np.clip(x + 1 - (10 + v * t / 40), 0, 1)[None, :, None]  # bright right of the edge
    light = Light(rgb, at, (480, 520), 40_000.0)
    seen = run(light, RollingShutter(6.0)).blurry[..., 0]
    edge = width - seen.sum(1)
    lean = np.polyfit(np.arange(height), edge, 1)[0]
    assert lean == pytest.approx(v * 6.0 / height, rel=0.02)
    straight = width - run(light).blurry[..., 0].sum(1)
    assert np.ptp(straight) < 1e-5
    assert edge[height // 2] == pytest.approx(straight[0], abs=1e-5)


def test_fast_motion_row_by_row() -> None:
    """50 px an exposure over random stripes: every row is the mean of its own window."""
    rng = np.random.default_rng(2)
    stripes, height, width = rng.random(400), 11, 30
    at = np.arange(0, 601)
    rgb = np.empty((len(at), height, width, 3), np.float32)
    for k in at:
        rgb[k] = np.interp(np.arange(width) + k * 0.25, np.arange(400), stripes)[None, :, None]
    light = Light(rgb, at, (200, 400), 40_000.0)
    seen = run(light, RollingShutter(5.0)).blurry[..., 1]
    for row in range(height):
        first = 200 + (row - height // 2) * 5.0 / height * 40
        fine = np.linspace(first, first + 200, 20_001)
        middle = (fine[1:] + fine[:-1]) / 2
        wanted = np.interp(middle, at, rgb[:, row, 7, 1]).mean()
        assert seen[row, 7] == pytest.approx(wanted, abs=1e-4)


def test_margins_must_hold_the_readout() -> None:
    with pytest.raises(UsageError, match="reads out for longer"):
        run(grows(), RollingShutter(20.0))
    table = small_table(effects=[{"name": "rolling_shutter", "readout_ms": 4.0}])
    with pytest.raises(UsageError) as caught:
        read_scene(table)
    assert "exposure.margin_ticks: is 16, but rolling_shutter exposes the first row 80 ticks before" in str(
        caught.value
    )
    good = read_scene(small_table(effects=[{"name": "rolling_shutter", "readout_ms": 0.7}]))
    assert take_view(good, 0).view.frame.row_ns == round(0.7e6 / 18)


def test_optics_before_a_rolling_shutter_and_after_the_mean_agree() -> None:
    """Optics act on the mean, or on every picture where rows roll: the middle row is the same."""
    light = drifting(21, 27)
    blur = effect_class("defocus")(arm="rgb", radius_px=1.5)
    seen, rolled = run(light, blur).blurry, run(light, blur, RollingShutter(1e-6)).blurry
    assert np.allclose(seen, rolled, atol=1e-5)


def test_noise_has_its_mean_and_variance() -> None:
    for value, well, read in ((0.5, 1000.0, 0.0), (0.1, 6000.0, 20.0), (0.3, 100.0, 3.0)):
        light = np.full((150, 150, 3), value, np.float32)
        noisy = RgbNoise(well, read).begin(_site(150, 150)).linear(light)  # type: ignore[misc]
        sd = np.sqrt(value * well + read**2) / well
        assert noisy.std() == pytest.approx(sd, rel=0.02)
        assert noisy.mean() == pytest.approx(value, abs=4 * sd / 260)
    full = RgbNoise(100.0, 0.0).begin(_site(50, 50)).linear(np.full((50, 50, 3), 3.0, np.float32))  # type: ignore[misc]
    assert full.max() == 1
    far = RgbNoise(1e14, 0.0)
    assert np.array_equal(run(drifting(), far).frame.pixels, run(drifting()).frame.pixels)


def _site(height: int, width: int) -> Site:
    return Site(height, width, 0, 1, camera=Camera.pinhole(width, height, 60))


def test_draws_do_not_depend_on_other_effects() -> None:
    """Noise over noise-free, in standard deviations, is the same whatever else acts."""
    effect, light = RgbNoise(5000.0, 3.0), np.full((9, 11, 3), 0.3, np.float32)

    def z(level: float) -> np.ndarray:
        noisy = effect.begin(_site(9, 11)).linear(light * np.float32(level))  # type: ignore[misc]
        return (noisy - light * level) / effect.spread(light * level)

    assert np.allclose(z(1.0), z(0.2), atol=1e-3)
    others = [BitDepth(10), WhiteBalance(), ResponseCurve(), Bayer()]
    for other in others:
        assert run(drifting(), effect, other).spikes.bits.tobytes() == run(drifting(), effect).spikes.bits.tobytes()
    assert same(run(drifting(), effect, DarkCurrent(0.0)), run(drifting(), effect))
    one, two = (run(drifting(), effect, view=v).frame.pixels for v in (0, 1))
    assert not np.array_equal(one, two)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_flat_colour_survives_the_mosaic(pattern: str) -> None:
    light = np.empty((7, 10, 3), np.float32)
    light[:] = (0.2, 0.5, 0.7)
    assert np.allclose(demosaic(light, colour_masks(pattern, 7, 10)), light, atol=1e-6)
    gray = np.full((6, 6, 3), 0.4, np.float32)
    assert np.allclose(demosaic(gray, colour_masks(pattern, 6, 6)), 0.4, atol=1e-7)


def test_the_mosaic_sees_one_colour_a_pixel() -> None:
    masks = colour_masks("grbg", 4, 6)
    assert masks[0, 0].tolist() == [0, 1, 0]
    assert masks[0, 1].tolist() == [1, 0, 0]
    assert masks[1, 0].tolist() == [0, 0, 1]
    assert (masks.sum(2) == 1).all()
    ramp = np.repeat(np.arange(10, dtype=np.float32)[None, :, None], 8, 0).repeat(3, 2) / 10
    filled = demosaic(ramp, colour_masks("rggb", 8, 10))
    assert np.allclose(filled[1:-1, 1:-1], ramp[1:-1, 1:-1], atol=1e-6)  # bilinear is exact on a ramp
    dot = np.zeros((8, 8, 3), np.float32)
    dot[4, 4] = 1  # a red pixel of rggb
    seen = demosaic(dot, colour_masks("rggb", 8, 8))
    assert seen[4, 4].tolist() == [1, 0, 0]
    assert seen[4, 5, 0] == 0.5
    assert seen[5, 5, 0] == 0.25
    assert not seen[..., 1:].any()
    dot[4, 4], dot[4, 5] = 0, 1  # a green one keeps its own value, and its diagonals theirs
    green = demosaic(dot, colour_masks("rggb", 8, 8))[..., 1]
    assert green[4, 5] == 1
    assert green[3, 4] == green[5, 6] == 0
    assert green[4, 4] == green[3, 5] == 0.25


def test_mosaic_of_a_single_pixel() -> None:
    one = np.array([[[0.2, 0.5, 0.7]]], np.float32)
    assert demosaic(one, colour_masks("rggb", 1, 1)).tolist() == [[[0.2, 0.2, 0.2]]] or np.allclose(
        demosaic(one, colour_masks("rggb", 1, 1)), 0.2
    )
    row = demosaic(np.full((1, 5, 3), 0.3, np.float32), colour_masks("gbrg", 1, 5))
    assert np.isfinite(row).all()
    assert np.allclose(row, 0.3, atol=1e-6)


def test_white_balance_and_cut_highlights() -> None:
    light = np.array([[[0.2, 0.2, 0.2], [5.0, 5.0, 5.0]]], np.float32)
    out = WhiteBalance((1.5, 1.0, 0.5)).balanced(light)
    assert np.allclose(out, [[[0.3, 0.2, 0.1], [1.5, 1.0, 0.5]]])
    seen = run(still(light), WhiteBalance((1.5, 1.0, 0.5))).frame.pixels[0, 0]
    assert seen.tolist() == np.rint(255 * srgb_from_linear(np.array([0.3, 0.2, 0.1]))).tolist()


def test_known_response_values() -> None:
    x = np.array([0.0, 0.18, 0.5, 1.0], np.float32)
    assert np.allclose(ResponseCurve("gamma", 2.0, 0.0).encoded(x), np.sqrt(x), atol=1e-6)
    assert np.allclose(ResponseCurve("protune", 2.2, 0.0).encoded(x), np.log(112 * x + 1) / np.log(113), atol=1e-6)
    fine = np.linspace(0, 1, 1001, dtype=np.float32)
    for curve in ("srgb", "gamma", "protune"):
        for contrast in (0.0, 0.5, 1.0):
            y = ResponseCurve(curve, 2.2, contrast).encoded(fine)
            assert y[0] == pytest.approx(0, abs=1e-6)
            assert y[-1] == pytest.approx(1, abs=1e-6)
            assert (np.diff(y) > -1e-7).all()
    linear_half = ResponseCurve("gamma", 1.0, 1.0).encoded(np.array([0.25, 0.5, 0.75], np.float32))
    assert np.allclose(linear_half, [0.15625, 0.5, 0.84375])
    seen = run(still(np.full((2, 2, 3), 0.18)), ResponseCurve("protune", 2.2, 0.0)).frame.pixels
    assert (seen == round(255 * np.log(112 * 0.18 + 1) / np.log(113))).all()


@pytest.mark.parametrize("bits", [1, 4, 10, 12, 16])
def test_codes_are_stepped_by_bits(bits: int) -> None:
    light = np.linspace(0, 1, 3000, dtype=np.float32).reshape(10, 100, 3)
    frame = run(still(light), BitDepth(bits)).frame
    assert frame.pixels.dtype == (np.uint8 if bits < 8 else np.uint16)
    steps = frame.pixels / frame.full * (2**bits - 1)
    assert np.abs(steps - np.rint(steps)).max() <= 0.51 * (2**bits - 1) / frame.full
    wanted = srgb_from_linear(light.astype(np.float64))
    assert np.abs(frame.pixels / frame.full - wanted).max() <= 0.5 / (2**bits - 1) + 1 / frame.full
    assert len(np.unique(frame.pixels)) == min(2**bits, len(np.unique(frame.pixels)))


def test_jpeg_loses_less_at_higher_quality() -> None:
    picture = run(still(textured())).frame.pixels
    found = [psnr(Jpeg(quality).through(picture), picture) for quality in (5, 20, 50, 80, 95)]
    assert found == sorted(found)
    assert found[0] < 27 < 32 < found[-1]
    best = Jpeg(100, "4:4:4").through(picture).astype(int)
    assert np.abs(best - picture).max() <= 4
    assert psnr(Jpeg(90, "4:2:0").through(picture), picture) < psnr(Jpeg(90, "4:4:4").through(picture), picture)
    assert np.array_equal(Jpeg(30).through(picture), Jpeg(30).through(picture))
    gray = np.full((9, 13, 3), 77, np.uint8)
    gray[..., 0] = 90  # order of channels is kept
    assert np.abs(Jpeg(95).through(gray).astype(int) - gray).max() <= 2


@pytest.mark.parametrize("codec", ["h264", "hevc"])
def test_video_keeps_to_its_rate(codec: str) -> None:
    """A finer rate loses less; sizes come near what was asked; the same bits on every run."""
    picture = run(still(textured()[..., :1].repeat(3, 2))).frame.pixels
    found = []
    for bits_px in (0.3, 0.8, 2.0):
        effect = VideoCodec(codec, mbit_s=bits_px * picture[..., 0].size * 30 / 1e6, fps=30.0, full_px=0)
        assert effect.bits_for(picture) == pytest.approx(bits_px * picture[..., 0].size)
        coded, bits = effect.encoded(picture)
        found.append(psnr(coded, picture))
        assert 0.75 * effect.bits_for(picture) <= bits <= effect.bits_for(picture)
        assert np.array_equal(effect.through(picture), coded)
    assert found == sorted(found)
    assert found[0] + 6 < found[-1]
    part = VideoCodec(codec, 60.0, 120.0, full_px=4 * picture[..., 0].size)
    assert part.bits_for(picture) == pytest.approx(60e6 / 120 / 4)
    starved, bits = VideoCodec(codec, 1e-3, 1e6, full_px=0).encoded(picture)  # coarser than the coarsest
    assert starved.shape == picture.shape
    assert bits > 0


def test_deep_pixels() -> None:
    light = still(textured(65, 67))
    with pytest.raises(UsageError, match="8 bits"):
        run(light, BitDepth(10), Jpeg())
    codec = VideoCodec("hevc", 1000.0, 30.0, 0)
    deep, bare = run(light, BitDepth(10), codec).frame, run(light, BitDepth(10)).frame
    assert deep.pixels.dtype == np.uint16
    assert all(np.array_equal(codec.through(bare.pixels), deep.pixels) for _ in range(6))
    assert psnr(deep.pixels / 257, bare.pixels / 257) > 30


def test_missing_pyav(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(HostError) as caught:
        run(drifting(), VideoCodec())
    assert caught.value.exit_code == 6
    assert "spikerig[video]" in caught.value.next


def test_the_order_is_physical() -> None:
    names = [name for name in EFFECTS if name in own_effects()]
    light, optics, rgb = (
        [name for name in names if effect_class(name).stage == stage]
        for stage in (Stage.LIGHT, Stage.OPTICS, Stage.RGB)
    )
    assert names == light + optics + rgb
    assert optics == ["splitter", "misalignment", "ghost", "mirror_flip", "distortion", "defocus", "vignetting"]
    assert rgb[:4] == ["rolling_shutter", "rgb_noise", "bayer", "white_balance"]
    assert rgb[4:] == ["response_curve", "read_noise", "bit_depth", "jpeg", "video_codec"]


def test_the_gopro_preset_runs() -> None:
    table = small_table(rgb={"preset": "gopro9"}, effects="all", exposure__margin_ticks=160)
    spec = read_scene(table)
    assert [e.name for e in spec.effects if e.name != "initial_phase"] == [t["name"] for t in PRESETS["gopro9"].effects]
    assert len(PRESETS["gopro9"].source) > 100
    taken, again = take_view(spec, 0), take_view(spec, 0)
    assert taken.view.frame.row_ns == round(7e6 / 18)
    assert np.array_equal(taken.view.frame.pixels, again.view.frame.pixels)
