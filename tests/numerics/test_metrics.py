"""Metrics against independent implementations and hand-made cases."""

import numpy as np
import pytest

from spikerig.dataset.errors import UsageError
from spikerig.train.metrics import SSIM_VARIANTS, chroma_psnr, luma_psnr, psnr, rounded, ssim


def pair(seed: int, h: int = 40, w: int = 57):
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(w), np.arange(h))
    a = 0.5 + 0.4 * np.stack([np.sin(x / 5 + c) * np.cos(y / 7 - c) for c in range(3)], -1)
    return rounded(a), rounded(a + rng.normal(0, 0.08, a.shape))


def test_psnr_by_hand():
    a = np.zeros((12, 12, 3), np.uint8)
    assert psnr(a, a + np.uint8(51)) == pytest.approx(20 * np.log10(5))
    assert psnr(a, a) == float("inf")


def test_rounding_is_part_of_the_protocol():
    picture = np.array([[[-0.5, 1.7, 0.5004]]])
    assert rounded(picture).tolist() == [[[0, 255, 128]]]
    assert rounded(np.array([[[np.nan, 0, 1]]])).tolist() == [[[0, 0, 255]]]


def test_luma_and_chroma_share_out_the_error():
    grey = np.full((12, 12, 3), 0.5)
    brighter = grey + 0.1
    assert luma_psnr(grey, brighter) == pytest.approx(20)
    assert chroma_psnr(grey, brighter) > 200
    hue = grey + np.array([0.114, 0, -0.299]) * 0.2  # no luma in it
    assert luma_psnr(grey, hue) > 200
    assert chroma_psnr(grey, hue) == pytest.approx(psnr(grey, hue))


def test_ssim_of_equal_pictures_is_one_even_where_flat():
    flat = np.full((20, 30, 3), 0.3)
    a, _ = pair(0)
    for variant in SSIM_VARIANTS:
        assert ssim(a, a, variant) == pytest.approx(1, abs=1e-12)
        assert ssim(flat, flat, variant) == pytest.approx(1, abs=1e-12)
        assert np.isfinite(ssim(flat, np.zeros_like(flat), variant))


# Values of the libraries themselves on pair(1): skimage 0.26 structural_similarity(channel_axis=2, data_range=255), the
# same with gaussian_weights=True, sigma=1.5, use_sample_covariance=False (what tf.image.ssim computes), and
# torchmetrics 1.9.0 structural_similarity_index_measure(data_range=1.0).
@pytest.mark.parametrize(
    ("variant", "expected"),
    [("skimage", 0.7070323063876648), ("tf", 0.6066660044978947), ("torchmetrics", 0.6011258937738703)],
)
def test_variants_give_their_libraries_values(variant, expected):
    a, b = pair(1)
    assert ssim(a, b, variant) == pytest.approx(expected, abs=1e-9)


def test_inria_variant_is_a_zero_padded_convolution():
    import torch

    a, b = pair(2)
    x, y = (torch.from_numpy(p / 255.0).permute(2, 0, 1)[None] for p in (a, b))
    g = torch.exp(-(torch.arange(-5, 6, dtype=torch.float64) ** 2) / (2 * 1.5**2))
    window = torch.outer(g / g.sum(), g / g.sum()).expand(3, 1, 11, 11)

    def blur(z):
        return torch.nn.functional.conv2d(z, window, padding=5, groups=3)

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    top = (2 * mx * my + 1e-4) * (2 * cov + 9e-4)
    expected = (top / ((mx * mx + my * my + 1e-4) * (vx + vy + 9e-4))).mean()
    assert ssim(a, b, "inria") == pytest.approx(expected.item(), abs=1e-12)


def test_variants_differ_enough_to_need_names():
    a, b = pair(3)
    values = {v: ssim(a, b, v) for v in ("torchmetrics", "tf", "skimage", "inria")}
    assert max(values.values()) - min(values.values()) > 1e-3


def test_wrong_pictures_are_told():
    with pytest.raises(UsageError, match="one size"):
        psnr(np.zeros((3, 4, 3)), np.zeros((4, 3, 3)))
    with pytest.raises(UsageError, match="smaller"):
        ssim(np.zeros((5, 40, 3)), np.zeros((5, 40, 3)))
    with pytest.raises(UsageError, match="no such SSIM"):
        ssim(np.zeros((20, 40, 3)), np.zeros((20, 40, 3)), "best")
