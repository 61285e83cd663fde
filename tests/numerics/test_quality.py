"""Sharpness measures against independent implementations, float64 oracles and hand-made cases."""

import cv2
import numpy as np
import pytest
from scipy import ndimage

from spikerig.dataset.errors import NumericsError, UsageError
from spikerig.train import metrics
from spikerig.train.sharpness import (
    crete_blur,
    flat_share,
    laplacian_over_noise,
    laplacian_variance,
    luma,
    noise_sigma,
    sharpness,
    sobel,
    tenengrad,
)


def plane(seed: int, h: int = 40, w: int = 57):
    x, y = np.meshgrid(np.arange(w), np.arange(h))
    return 0.5 + 0.3 * np.sin(x / 5) * np.cos(y / 7) + np.random.default_rng(seed).normal(0, 0.03, (h, w))


# skimage 0.26 measure.blur_effect(plane(seed, h, w)); the smaller ones are narrower than its 11 taps.
@pytest.mark.parametrize(
    ("seed", "h", "w", "expected"),
    [
        (0, 40, 57, 0.6503853802088229),
        (1, 64, 64, 0.6655754688207208),
        (2, 9, 30, 0.5307899900190087),
        (3, 5, 5, 0.09685858023631494),
    ],
)
def test_crete_gives_the_librarys_values(seed, h, w, expected):
    assert crete_blur(plane(seed, h, w)) == pytest.approx(expected, abs=1e-12)


def test_sobel_matches_scipy_and_a_ramp_has_its_slope():
    p = plane(4)
    for axis in (0, 1):
        assert np.allclose(sobel(p, axis), ndimage.sobel(p, axis, mode="reflect") / 8, rtol=0, atol=1e-14)
    ramp = np.tile(np.arange(20) * 0.03, (20, 1))
    assert np.allclose(sobel(ramp, 1)[:, 1:-1], 0.03, atol=1e-15)
    assert np.allclose(sobel(ramp, 0), 0)
    assert tenengrad(ramp) == pytest.approx(0.03**2)


def test_laplacian_and_noise_match_convolutions():
    p = plane(5)
    lap = ndimage.convolve(p, np.array([[0, 1, 0], [1, -4, 1], [0, 1, 0]], float))[1:-1, 1:-1]
    assert laplacian_variance(p) == pytest.approx(lap.var(), rel=1e-12)
    mask = np.outer([1, -2, 1], [1, -2, 1]).astype(float)
    hit = np.abs(ndimage.convolve(p, mask)[1:-1, 1:-1]).sum()
    assert noise_sigma(p) == pytest.approx(np.sqrt(np.pi / 2) * hit / (6 * 38 * 55), rel=1e-12)


def test_noise_is_found_and_alone_gives_one():
    noise = np.random.default_rng(6).normal(0, 0.05, (300, 300))
    x, y = np.meshgrid(np.arange(300), np.arange(300))
    assert noise_sigma(noise) == pytest.approx(0.05, rel=0.01)
    assert noise_sigma(noise + 0.002 * x - 0.001 * y) == pytest.approx(noise_sigma(noise), rel=1e-9)
    assert laplacian_over_noise(noise) == pytest.approx(1, abs=0.03)


def test_blur_is_ordered_and_brightness_does_not_matter():
    sharp = ndimage.gaussian_filter((plane(7, 96, 96) > 0.5).astype(float), 0.4)
    rows = [ndimage.gaussian_filter(sharp, s) if s else sharp for s in (0, 0.7, 1.5, 3.0, 6.0)]
    blurs = [crete_blur(r) for r in rows]
    assert blurs == sorted(blurs)
    assert [tenengrad(r) for r in rows] == sorted((tenengrad(r) for r in rows), reverse=True)
    assert crete_blur(0.5 * sharp + 0.2) == pytest.approx(crete_blur(sharp), abs=1e-9)


def test_flat_pictures_have_finite_measures_and_say_so():
    for level in (0, 128, 255):
        found, remarks = sharpness(np.full((40, 30, 3), level, np.uint8))
        assert found["crete_blur"] == pytest.approx(1, abs=1e-6)
        assert found["laplacian_over_noise"] is None
        assert found["tenengrad"] == pytest.approx(0, abs=1e-30)
        assert remarks == []
    assert flat_share(np.full((40, 30), 0.5)) == 1


def test_flat_share_counts_squares_on_both_sides_of_a_step():
    p = np.full((16, 32), 0.5)
    p[:8, :8] += np.indices((8, 8)).sum(0) % 2 / 255  # one 8-bit step: still flat
    p[8:, 8:16] += np.indices((8, 8)).sum(0) % 2 * 2 / 255  # two: not
    assert flat_share(p) == 7 / 8
    assert flat_share(np.full((3, 3), 0.1)) == 1
    assert flat_share(np.array([[0.0, 1.0]])) == 0


@pytest.mark.parametrize("shape", [(1, 1, 3), (2, 50, 1), (3, 3, 3)])
def test_tiny_pictures_are_null_with_a_remark(shape):
    found, remarks = sharpness(np.full(shape, 7, np.uint8))
    assert found["crete_blur"] is None
    assert any("crete_blur" in r for r in remarks)
    assert (found["tenengrad"] is None) == (min(shape[:2]) < 3)


def test_nan_and_foreign_shapes_are_told():
    picture = np.full((20, 20, 3), 0.5)
    picture[3, 4, 1] = np.nan
    with pytest.raises(NumericsError, match="NaN"):
        luma(picture)
    with pytest.raises(UsageError):
        luma(np.zeros((20, 20)))
    with pytest.raises(UsageError):
        luma(np.zeros((0, 20, 3)))


def test_metrics_refuse_nan_and_nothing():
    good, bad = np.full((20, 20, 3), 0.5), np.full((20, 20, 3), 0.5)
    bad[0, 0, 0] = np.inf
    for measure in (metrics.psnr, metrics.ssim, metrics.luma_psnr, metrics.chroma_psnr):
        with pytest.raises(NumericsError, match="1 values"):
            measure(good, bad)
        with pytest.raises(UsageError, match="no pixels"):
            measure(np.zeros((0, 4, 3)), np.zeros((0, 4, 3)))


def test_hdr_pictures_compare_unclipped_and_one_pixel_is_enough_for_psnr():
    one, hdr = np.array([[[0.5, 0.5, 0.5]]]), np.array([[[4.5, 0.5, 0.5]]])
    assert metrics.psnr(one, hdr) == pytest.approx(-10 * np.log10(16 / 3))
    assert metrics.psnr(metrics.rounded(one), metrics.rounded(hdr)) == pytest.approx(
        -10 * np.log10((127 / 255) ** 2 / 3)
    )
    with pytest.raises(UsageError, match="smaller"):
        metrics.ssim(one, one)


def test_psnr_keeps_its_digits_on_tiny_errors_and_against_opencv():
    a = np.random.default_rng(8).integers(0, 256, (40, 50, 3), np.uint8)
    b = np.clip(a.astype(int) + np.random.default_rng(9).integers(-9, 10, a.shape), 0, 255).astype(np.uint8)
    assert metrics.psnr(a, b) == pytest.approx(cv2.PSNR(a, b), abs=1e-9)
    flat = np.full((16, 16, 3), 0.5)
    assert metrics.psnr(flat, flat + 1e-9) == pytest.approx(180, abs=1e-4)
