"""How close two pictures are. Every variant has a name, printed beside its number.

Pictures are sRGB codes [H,W,3], nominally in [0, 1]; `rounded` clips and rounds both to 8 bits first, as the
common protocols do, and every metric here expects that done (or deliberately not).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import NumericsError, UsageError

Picture = NDArray[np.float64]
LUMA = np.array([0.299, 0.587, 0.114])  # Rec.601, on codes
ROUNDING = "clipped to [0,1], rounded to 8 bits"
C1, C2 = 0.01**2, 0.03**2


def rounded(picture: NDArray) -> NDArray[np.uint8]:
    """Clip to [0, 1] and round to 8 bits (half to even); NaN is an error of the caller's, and becomes 0."""
    return np.rint(np.clip(np.nan_to_num(picture, nan=0.0), 0, 1) * 255).astype(np.uint8)


def as_float(picture: NDArray) -> Picture:
    """float64 in [0, 1]; uint8 is divided by 255, floats pass."""
    return picture / 255.0 if picture.dtype == np.uint8 else picture.astype(np.float64)


def _pair(a: NDArray, b: NDArray) -> tuple[Picture, Picture]:
    if a.shape != b.shape or a.ndim != 3 or a.shape[2] != 3:
        raise UsageError("pictures to compare are two [H,W,3] of one size", value=(a.shape, b.shape))
    if a.size == 0:
        raise UsageError("pictures to compare have no pixels", value=a.shape)
    x, y = as_float(a), as_float(b)
    bad = int((~np.isfinite(x)).sum() + (~np.isfinite(y)).sum())
    if bad:
        raise NumericsError("pictures to compare hold NaN or infinite values", value=f"{bad} values")
    return x, y


def _db(mse: float) -> float:
    return float("inf") if mse == 0 else float(-10 * np.log10(mse))


def psnr(a: NDArray, b: NDArray) -> float:
    """-10 log10 of the mean squared error over all pixels and channels; inf for equal pictures."""
    x, y = _pair(a, b)
    return _db(float(np.mean((x - y) ** 2)))


def luma_psnr(a: NDArray, b: NDArray) -> float:
    """PSNR of the luma error alone (Rec.601 on codes): what is left when colour errors are forgiven."""
    x, y = _pair(a, b)
    return _db(float(np.mean(((x - y) @ LUMA) ** 2)))


def chroma_psnr(a: NDArray, b: NDArray) -> float:
    """PSNR of the error without its luma, mean over channels: how wrong the colour is."""
    x, y = _pair(a, b)
    error = x - y
    return _db(float(np.mean((error - (error @ LUMA)[..., None]) ** 2)))


def _gaussian() -> Picture:
    x = np.arange(-5, 6)
    g = np.exp(-(x**2) / (2 * 1.5**2))
    return g / g.sum()


def _filter(x: Picture, taps: Picture, pad: str | None) -> Picture:
    """Separable filter over the first two axes: windows inside the picture (None), or padded to full size."""
    half = len(taps) // 2
    if pad is not None:
        x = np.pad(x, ((half, half), (half, half), (0, 0)), mode=pad)  # type: ignore[call-overload]
    h, w = x.shape[0] - 2 * half, x.shape[1] - 2 * half
    rows = sum(t * x[k : k + h] for k, t in enumerate(taps))
    return sum(t * rows[:, k : k + w] for k, t in enumerate(taps))  # type: ignore[return-value,index]


def _ssim_map(x: Picture, y: Picture, taps: Picture, pad: str | None, sample: float = 1.0) -> Picture:
    mx, my = _filter(x, taps, pad), _filter(y, taps, pad)
    vx = np.maximum(sample * (_filter(x * x, taps, pad) - mx * mx), 0)
    vy = np.maximum(sample * (_filter(y * y, taps, pad) - my * my), 0)
    cov = sample * (_filter(x * y, taps, pad) - mx * my)
    return (2 * mx * my + C1) * (2 * cov + C2) / ((mx * mx + my * my + C1) * (vx + vy + C2))


def _ssim_valid(x: Picture, y: Picture) -> Picture:
    return _ssim_map(x, y, _gaussian(), None)


def _ssim_reflect(x: Picture, y: Picture) -> Picture:
    return _ssim_map(x, y, _gaussian(), "reflect")


def _ssim_inria(x: Picture, y: Picture) -> Picture:
    return _ssim_map(x, y, _gaussian(), "constant")


def _ssim_skimage(x: Picture, y: Picture) -> Picture:
    return _ssim_map(x, y, np.full(7, 1 / 7), None, sample=49 / 48)


SSIM_VARIANTS: dict[str, tuple[str, Callable[[Picture, Picture], Picture]]] = {
    "torchmetrics": ("11x11 gaussian, sigma 1.5, reflected at the border (torchmetrics 1.x, gsplat)", _ssim_reflect),
    "tf": ("11x11 gaussian, sigma 1.5, windows inside the picture (tf.image, dm_pix, nerfbaselines)", _ssim_valid),
    "skimage": ("7x7 uniform, sample covariance, windows inside the picture (skimage's default)", _ssim_skimage),
    "inria": ("11x11 gaussian, sigma 1.5, padded by zeros (the 3DGS code)", _ssim_inria),
}


def ssim(a: NDArray, b: NDArray, variant: str = "torchmetrics") -> float:
    """Structural similarity, mean over windows and channels, data range 1.

    Args:
        a, b: [H,W,3].
        variant: one of SSIM_VARIANTS; they differ by 0.01 and more.

    Raises:
        UsageError: unknown variant, or a picture smaller than its window.
    """
    x, y = _pair(a, b)
    if variant not in SSIM_VARIANTS:
        raise UsageError("no such SSIM", value=variant, expected=", ".join(SSIM_VARIANTS))
    if variant != "inria" and min(x.shape[:2]) < 11:
        raise UsageError("a picture smaller than SSIM's window", value=x.shape[:2], expected="at least 11x11")
    return float(np.mean(SSIM_VARIANTS[variant][1](x, y)))
