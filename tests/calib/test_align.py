"""Both arms on one camera: pixels where they belong, filtered, timed, and checked."""

import dataclasses

import board_pictures as bp
import cv2
import numpy as np
import pytest
from calib_rigs import rig, step_of

from spikerig.calib.agree import ecc_refinement, edge_agreement
from spikerig.calib.align import Aligned, Region, pair, rows_of_spike_px, warp_light, warp_of, within_polygon
from spikerig.calib.bundle import turn
from spikerig.calib.overlay import overlay
from spikerig.calib.parity import times
from spikerig.calib.rig import RigCalibration
from spikerig.calib.rolling import exposure_texture, tfp_rows, windows_at
from spikerig.dataset.errors import DataError, RefusedError, UsageError
from spikerig.dataset.images import srgb8_from_linear
from spikerig.dataset.scene import Camera, Frame, Pose, View
from spikerig.dataset.spikes import SpikeStream
from spikerig.dataset.texture import Texture

POSE = bp.poses(5, 9)[4]
HALF = {"rgb_width": 800}


def raw_view(calibration: RigCalibration, pixels: np.ndarray, spikes: SpikeStream | None = None, **frame: int) -> View:
    shape = pixels.shape[:2]
    pose = Pose(np.eye(4)[:3])
    rows = np.repeat(np.arange(shape[0], dtype=np.float32)[:, None], shape[1], 1)
    return View("v", Frame(pixels, **frame), spikes, rows, np.ones(shape, bool), pose, None)


def known(light: np.ndarray) -> Texture:
    return Texture(light.astype(np.float32), np.ones(light.shape, bool), 0.0, "true")


def seen(mirrored: str | None, shift: tuple[float, float, float] = (0, 0, 0)) -> tuple[RigCalibration, View, Texture]:
    """A view of a board by a rig, and the texture of its spikes without their noise."""
    true = rig(shift, mirrored, **HALF)
    light = bp.lens("spike", 3).picture(POSE)
    gray = bp.lens("rgb", 3, **HALF).picture(times(step_of(true), POSE)) if not any(shift) else (
        bp.Lens(true.rgb, 3).picture(times(step_of(true), POSE)))  # fmt: skip
    light = light[:, ::-1] if mirrored == "spike" else light
    gray = gray[:, ::-1] if mirrored == "rgb" else gray
    return true, raw_view(true, srgb8_from_linear(np.repeat(gray[..., None], 3, 2))), known(light)


def straight() -> np.ndarray:
    """What the spike arm would see without distortion."""
    return bp.Lens(dataclasses.replace(rig().spike, distortion=np.zeros(0)), 3).picture(POSE)


@pytest.mark.parametrize("mirrored", [None, "rgb", "spike"])
def test_both_arms_come_to_lie_on_the_pinhole_picture(mirrored: str | None) -> None:
    true, view, texture = seen(mirrored)
    told = pair(view, true, texture=texture)
    want = straight()
    assert told.camera.distortion.size == 0
    assert told.valid.mean() > 0.9
    inner = told.valid & told.texture.known
    for got in (told.light.mean(2), told.texture.light):
        agreement = edge_agreement(want, got, inner)
        assert agreement.rms_px < 0.05
        assert np.abs(got - want)[inner].mean() < 0.012
    assert edge_agreement(told.texture.light, told.light.mean(2), inner).rms_px < 0.05
    assert told.frame.pixels.shape == (250, 400, 3)
    assert (told.light[~told.valid] == 0).all()


def test_a_stereo_rig_is_aligned_at_the_depth_asked_for() -> None:
    true, view, texture = seen(None, (15.0, -2.0, 3.0))
    depth = float(POSE[2, 3])
    at_board = pair(view, true, warp=warp_of(true, depth_mm=depth), texture=texture)
    beyond = pair(view, true, warp=warp_of(true, depth_mm=3 * depth), texture=texture)
    good, bad = (edge_agreement(a.texture.light, a.light.mean(2), a.valid) for a in (at_board, beyond))
    assert good.here > bad.here
    assert np.nanmedian(np.abs(good.shift_px[..., 0])) < 3 < np.nanmax(np.abs(bad.shift_px[..., 0]))


def test_full_resolution_has_the_rgb_arms_pixels() -> None:
    true, view, texture = seen(None)
    told = pair(view, true, warp=warp_of(true, full=True), texture=texture)
    assert told.light.shape[1] == pytest.approx(400 * true.rgb.K[0, 0] / 620, abs=2)
    shrunk = cv2.resize(told.light.mean(2), (400, 250), interpolation=cv2.INTER_AREA)
    agreement = edge_agreement(straight(), shrunk, pair(view, true, texture=texture).valid)
    assert agreement.rms_px < 0.05


def test_an_undistorted_spike_arm_is_not_resampled() -> None:
    true, view, texture = seen(None)
    plain = dataclasses.replace(true, spike=dataclasses.replace(true.spike, distortion=np.zeros(4)))
    assert pair(view, plain, texture=texture).texture is texture
    assert pair(view, true, texture=texture).texture is not texture


def test_the_prefilter_takes_out_what_spike_pixels_cannot_show() -> None:
    true = rig(rgb_width=1600)
    warp = warp_of(true)
    assert warp.samples >= 3
    stripes = np.zeros((true.rgb.height, 1600, 3), np.float32)
    stripes[::2] = 1
    light = warp_light(warp, stripes)[warp.valid]
    assert light.mean() == pytest.approx(0.5, abs=0.01)
    assert light.std() < 0.1
    one = cv2.remap(stripes, *[np.nan_to_num(warp.rgb_px[..., k] - 0.5).astype(np.float32) for k in (0, 1)],
                    cv2.INTER_NEAREST)  # fmt: skip
    assert one[warp.valid].std() > 0.4


@pytest.mark.parametrize("mirrored", [None, "rgb"])
def test_the_sensor_row_survives_the_warp(mirrored: str | None) -> None:
    true = rig((0, 0, 0), mirrored, **HALF)
    warp = warp_of(true)
    ramp = np.repeat(((np.arange(true.rgb.height) + 0.5) / true.rgb.height)[:, None, None], 800, 1).astype(np.float32)
    told = warp_light(warp, np.ascontiguousarray(np.broadcast_to(ramp, (*ramp.shape[:2], 3))))
    row = told[..., 0] * true.rgb.height - 0.5
    np.testing.assert_allclose(row[warp.valid], warp.sensor_row[warp.valid], atol=0.02)
    raw = rows_of_spike_px(true)
    middle = warp.sensor_row[125, 200]
    assert raw[125, 200] == pytest.approx(middle, abs=0.5)
    assert raw[249].mean() > raw[0].mean() + 200


def test_rolling_exposures_see_what_each_row_saw() -> None:
    """Light comes on at tick 200; rows are exposed for 100 ticks, each 2 ticks after the one before."""
    on = np.zeros((400, 50, 16), bool)
    on[200:] = True
    stream = SpikeStream.from_pixels(on, 40_000.0, t0_ns=1_000)
    rows = np.repeat(np.arange(50, dtype=np.float32)[:, None], 16, 1)
    frame = Frame(np.zeros((4, 4, 3), np.uint8), start_ns=1_000 + 120 * 25_000, exposure_ns=100 * 25_000, row_ns=50_000)
    texture = exposure_texture(stream, frame, rows)
    first = 120 + 2 * np.arange(50)
    np.testing.assert_allclose(texture.light[:, 3], np.clip(first + 100 - 200, 0, 100) / 100, atol=1e-6)
    assert texture.known.all()
    assert texture.method == "exposure-100"
    late = dataclasses.replace(frame, start_ns=1_000 + 250 * 25_000)
    assert exposure_texture(stream, late, rows).known[:, 0].tolist() == [250 + 2 * r + 100 <= 400 for r in range(50)]
    moment = tfp_rows(stream, frame, rows, 0.5, 20)
    np.testing.assert_allclose(moment.light[:, 0], np.clip(first + 50 + 10 - 200, 0, 20) / 20, atol=1e-6)
    lost = dataclasses.replace(stream, lost=np.array([[230, 231]]))
    assert windows_at(lost, np.full((50, 16), 200), 31, 0, "x").known.sum() == 0
    assert windows_at(lost, np.full((50, 16), 200), 30, 0, "x").known.all()
    with pytest.raises(UsageError, match="clocks"):
        exposure_texture(dataclasses.replace(stream, clock="device"), frame, rows)
    with pytest.raises(UsageError, match="rate"):
        exposure_texture(dataclasses.replace(stream, rate_hz=None), frame, rows)


def test_the_default_texture_is_the_mean_over_each_exposure() -> None:
    true = rig(**HALF)
    stream = SpikeStream.from_pixels(np.ones((300, 250, 400), bool), 40_000.0)
    pixels = np.full((true.rgb.height, 800, 3), 128, np.uint8)
    told = pair(raw_view(true, pixels, stream, exposure_ns=100 * 25_000, row_ns=5_000), true)
    inside = told.texture.known
    assert inside[20:-20, 20:-20].all()
    np.testing.assert_allclose(told.texture.light[inside], 1, atol=1e-6)


def test_regions_are_not_valid() -> None:
    true = rig((0, 0, 0), "rgb", **HALF)
    panel = np.array([[300.0, 100], [420, 110], [400, 200], [310, 190]])
    free, blocked = warp_of(true), warp_of(true, regions=[Region("rgb", panel), Region("spike", panel * 0.3)])
    gone = free.valid & ~blocked.valid
    assert 500 < gone.sum() < 20_000
    inside = within_polygon(free.rgb_px, panel) | within_polygon(free.spike_px, panel * 0.3)
    assert not (blocked.valid & inside).any()
    square = np.array([[0, 0], [2, 0], [2, 2], [0, 2.0]])
    told = within_polygon(np.array([[1, 1], [3, 1], [1, 3], [np.nan, 1]]), square)
    assert told.tolist() == [True, False, False, False]
    with pytest.raises(UsageError, match="polygon"):
        within_polygon(free.rgb_px, np.zeros((2, 2)))


def test_edges_tell_a_known_shift() -> None:
    camera = dataclasses.replace(rig().spike, distortion=np.zeros(0))
    moved = Camera(camera.K + np.array([[0, 0, 0.6], [0, 0, -1.3], [0, 0, 0]]), camera.distortion, 400, 250)
    pose = bp.poses(1, 3, near=330, far=331)[0] * [[1, 1, 1, 1]]
    a, b = (bp.Lens(c, 3).picture(pose) for c in (camera, moved))
    rng = np.random.default_rng(0)
    noisy = 0.2 * b * (1 + 0.04 * rng.standard_normal(b.shape))
    told = edge_agreement(a, noisy, np.ones(a.shape, bool))
    said = np.isfinite(told.shift_px[..., 0])
    assert said.sum() >= 3
    np.testing.assert_allclose(np.nanmedian(told.shift_px, axis=(0, 1)), [0.6, -1.3], atol=0.1)
    assert edge_agreement(a, a, np.ones(a.shape, bool)).rms_px < 1e-6
    nothing = edge_agreement(a, np.full_like(a, 0.5), np.ones(a.shape, bool))
    assert np.isnan(nothing.rms_px)
    assert np.isnan(edge_agreement(a, b, np.zeros(a.shape, bool)).rms_px)


def test_a_small_misalignment_is_taken_out_and_a_large_one_refused() -> None:
    true, view, texture = seen(None)
    M = true.spike_from_rgb.cam_from_world

    def off(degrees: float) -> RigCalibration:
        R = turn(np.radians([degrees, 0, 2 * degrees])) @ M[:, :3]
        return dataclasses.replace(true, spike_from_rgb=Pose(np.concatenate([R, M[:, 3:]], 1)))

    def here(calibration: RigCalibration, **more: np.ndarray) -> Aligned:
        return pair(view, calibration, warp=warp_of(calibration, **more), texture=texture)  # type: ignore[arg-type]

    before = here(off(0.1))
    assert edge_agreement(before.texture.light, before.light.mean(2), before.valid).rms_px > 0.5
    H, score = ecc_refinement(before.texture.light, before.light.mean(2), before.valid)
    after = here(off(0.1), refinement=H)
    assert score > 0.95
    assert edge_agreement(after.texture.light, after.light.mean(2), after.valid).rms_px < 0.1
    far = here(off(0.6))
    with pytest.raises(RefusedError):
        ecc_refinement(far.texture.light, far.light.mean(2), far.valid)


def test_overlays_show_both_arms() -> None:
    true, view, texture = seen(None)
    told = pair(view, true, texture=texture)
    mix, red = overlay(told), overlay(told, "red-cyan")
    inner = told.valid & told.texture.known
    assert (mix[~inner] == [0, 0, 60]).all()
    gray = red[inner].astype(int)
    assert np.abs(gray[:, 0] - gray[:, 1]).mean() < 6
    np.testing.assert_array_equal(gray[:, 1], gray[:, 2])
    with pytest.raises(UsageError):
        overlay(told, "green")  # type: ignore[arg-type]


def test_sizes_must_be_those_of_the_calibration() -> None:
    true, view, texture = seen(None)
    small = raw_view(true, np.zeros((100, 200, 3), np.uint8))
    with pytest.raises(DataError, match="size"):
        pair(small, true, texture=texture)
    with pytest.raises(DataError, match="size"):
        pair(view, true, texture=known(np.zeros((100, 200))))
    with pytest.raises(UsageError, match="no spikes"):
        pair(view, true)
