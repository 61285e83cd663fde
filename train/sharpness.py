"""How sharp and how noisy one picture is, without a reference and without trained weights. Each measure is named.

All work on luma: Rec.601 of sRGB codes, [H,W] float64, 1.0 = white.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import NumericsError, UsageError
from spikerig.train.metrics import LUMA, as_float

Plane = NDArray[np.float64]
BLOCK = 8  # pixels: the squares in which a picture is looked at for flatness
STEP = 1 / 255
TAPS = 11  # of Crete's second blur, as scikit-image has it
TINY = float(np.spacing(1.0))


def luma(picture: NDArray) -> Plane:
    """Rec.601 luma [H,W] of codes uint8 or float [H,W,3], or [H,W,1] taken as it is.

    Raises:
        NumericsError: NaN or infinity.
        UsageError: another shape, or no pixels.
    """
    if picture.ndim != 3 or picture.shape[2] not in (1, 3) or picture.size == 0:
        raise UsageError("a picture to be measured is [H,W,1] or [H,W,3]", value=picture.shape)
    codes = as_float(picture)
    if not np.isfinite(codes).all():
        raise NumericsError("a picture holds NaN or infinite values", value=f"{int((~np.isfinite(codes)).sum())}")
    return codes[:, :, 0] if picture.shape[2] == 1 else codes @ LUMA


def _needs(plane: Plane, least: int, name: str) -> None:
    if min(plane.shape) < least:
        raise UsageError(f"a picture too small for {name}", value=plane.shape, expected=f"at least {least}x{least}")


def noise_sigma(plane: Plane) -> float:
    """Standard deviation of white noise, in codes; fine texture counts as noise too.

    Source: Immerkaer, Fast noise variance estimation, CVIU 64(2), 1996: mean |mask| of a mask blind to planes.
    """
    _needs(plane, 3, "noise")
    d = plane[:-2] - 2 * plane[1:-1] + plane[2:]
    d = d[:, :-2] - 2 * d[:, 1:-1] + d[:, 2:]
    return float(np.sqrt(np.pi / 2) / 6 * np.mean(np.abs(d)))


def laplacian_variance(plane: Plane) -> float:
    """Variance of the four-neighbour Laplacian over inner pixels, codes^2; higher is sharper, or noisier.

    Source: Pech-Pacheco et al., Diatom autofocusing in brightfield microscopy, ICPR 2000 (LAPV).
    """
    _needs(plane, 3, "the Laplacian")
    inner = plane[1:-1, 1:-1]
    return float(np.var(plane[:-2, 1:-1] + plane[2:, 1:-1] + plane[1:-1, :-2] + plane[1:-1, 2:] - 4 * inner))


def laplacian_over_noise(plane: Plane) -> float | None:
    """`laplacian_variance` over what white noise of `noise_sigma` alone gives (20 sigma^2); 1 = nothing but noise.

    Returns:
        None where there is no noise at all (a flat picture, a plane).
    """
    sigma = noise_sigma(plane)
    return laplacian_variance(plane) / (20 * sigma * sigma) if sigma > TINY else None


def _symmetric(x: Plane, before: int, after: int, axis: int) -> Plane:
    return np.pad(x, [(before, after) if k == axis else (0, 0) for k in range(2)], mode="symmetric")


def sobel(plane: Plane, axis: int) -> Plane:
    """Sobel derivative along an axis, codes a pixel (a ramp of slope s gives s inside), edges mirrored."""
    x = _symmetric(plane, 1, 1, axis)
    x = (np.take(x, range(2, x.shape[axis]), axis) - np.take(x, range(x.shape[axis] - 2), axis)) / 2
    across = 1 - axis
    x = _symmetric(x, 1, 1, across)
    n = x.shape[across] - 2
    return (np.take(x, range(n), across) + 2 * np.take(x, range(1, n + 1), across) + np.take(x, range(2, n + 2), across)
            ) / 4  # fmt: skip


def tenengrad(plane: Plane) -> float:
    """Mean squared Sobel gradient over inner pixels, (codes a pixel)^2; higher is sharper, or noisier.

    Source: Krotkov, Focusing, IJCV 1(3), 1987 (after Tenenbaum 1970), without its threshold.
    """
    _needs(plane, 3, "Tenengrad")
    return float(np.mean((sobel(plane, 0) ** 2 + sobel(plane, 1) ** 2)[1:-1, 1:-1]))


def _running_mean(plane: Plane, axis: int) -> Plane:
    x = _symmetric(plane, TAPS // 2, TAPS // 2, axis)
    n = plane.shape[axis]
    return sum(np.take(x, range(k, k + n), axis) for k in range(TAPS)) / TAPS  # type: ignore[return-value]


def crete_blur(plane: Plane) -> float:
    """Perceptual blur, 0 sharp to 1 blurred: how little of the gradient a second blur takes away.

    Edges:
        A flat picture gives 1: nothing is there to lose.

    Source: Crete et al., The blur effect, Proc. SPIE 6492, 2007, in the form of scikit-image 0.26 `blur_effect`
        (Sobel, 11 taps, the larger of both axes; the paper has plain differences and 9 taps).
    """
    _needs(plane, 4, "Crete's blur")
    axes = []
    for axis in (0, 1):
        sharp = np.maximum(np.abs(sobel(plane, axis)), TINY)[2:-1, 2:-1]
        blurred = np.maximum(np.abs(sobel(_running_mean(plane, axis), axis)), TINY)[2:-1, 2:-1]
        lost = np.maximum(sharp - blurred, 0).sum()
        axes.append(abs(float(sharp.sum() - lost)) / float(sharp.sum()))
    return max(axes)


def flat_share(plane: Plane) -> float:
    """Share of 8x8 squares that hold at most one 8-bit step of contrast; 1 for a picture smaller than a square."""
    h, w = (n // BLOCK * BLOCK for n in plane.shape)
    if not h or not w:
        return float(np.ptp(plane) <= 1.5 * STEP)
    squares = plane[:h, :w].reshape(h // BLOCK, BLOCK, w // BLOCK, BLOCK)
    return float(np.mean(squares.max((1, 3)) - squares.min((1, 3)) <= 1.5 * STEP))


MEASURES: dict[str, tuple[str, Callable[[Plane], float | None]]] = {
    "noise_sigma": ("Immerkaer 1996, codes; texture counts too", noise_sigma),
    "laplacian_variance": ("Pech-Pacheco 2000, codes^2; higher is sharper or noisier", laplacian_variance),
    "laplacian_over_noise": ("that over 20 noise_sigma^2; 1 = noise alone", laplacian_over_noise),
    "tenengrad": ("Krotkov 1987, mean squared Sobel; higher is sharper or noisier", tenengrad),
    "crete_blur": ("Crete 2007 as in scikit-image: 0 sharp, 1 blurred", crete_blur),
}


def sharpness(picture: NDArray) -> tuple[dict[str, float | None], list[str]]:
    """All measures of one picture by name, and remarks; None with a remark where a picture is too small."""
    plane, found, remarks = luma(picture), {}, []
    for name, (_, measure) in MEASURES.items():
        try:
            found[name] = measure(plane)
        except UsageError as error:
            found[name] = None
            remarks.append(f"{name}: {error.what}")
    return found, remarks
