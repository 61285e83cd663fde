"""Pictures that features are found on: spike textures, 8 bits, chosen by measured sharpness and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import UsageError
from spikerig.dataset.scene import Frame
from spikerig.dataset.spikes import SpikeStream
from spikerig.dataset.texture import Texture, tfi, tfp, tfp_adaptive

# What is tried when nothing is asked for: windows, intervals, and a window a pixel (what the paper calls HDR).
KINDS = ("tfp48", "tfp64", "tfp96", "tfp128", "tfp192", "tfi5", "adaptive")
WHITE = 99.5  # percentile that becomes white
REFOUND_PX = 1.5  # a feature is found again when it lies that near to where the others say


@dataclass(frozen=True, slots=True)
class Looks:
    """How good textures of one kind are for features.

    Args:
        kind: of texture.
        sharpness: 90th percentile of the gradient, gray levels a pixel.
        noise: standard deviation, gray levels, on flat parts.
        refound: features of one instant that are found again at another of the same exposure, a view.
        spread: how far from their place, median, pixels.
    """

    kind: str
    sharpness: float
    noise: float
    refound: float = 0.0
    spread: float = REFOUND_PX

    @property
    def score(self) -> float:
        """What poses gain by: the root of the number of features over their spread.

        Sharpness over noise would do where noise is alike everywhere. Where each pixel has a window of its own it is
        not: noise on flat parts is least, and at the details, where windows jump, most features are lost.
        """
        return float(np.sqrt(self.refound) / max(self.spread, 0.05))


def texture_of(stream: SpikeStream, at: float, kind: str) -> Texture:
    """The texture of a kind at an instant.

    Args:
        stream: spikes of one view.
        at: tick.
        kind: `tfpN` (window of N ticks), `tfiN` (N intervals), `adaptive` (a window a pixel).

    Raises:
        UsageError: an unknown kind, or a window that leaves the stream.
    """
    if kind == "adaptive":
        return tfp_adaptive(stream, at)
    word, number = kind[:3], kind[3:]
    if word in ("tfp", "tfi") and number.isdigit() and int(number) > 0:
        return tfp(stream, at, int(number)) if word == "tfp" else tfi(stream, at, intervals=int(number))
    raise UsageError("unknown kind of texture", value=kind, expected="tfpN, tfiN or adaptive")


def picture_of(texture: Texture) -> NDArray[np.uint8]:
    """An 8-bit picture, gamma 2.2, white at the 99.5th percentile; unknown pixels take the median."""
    light = np.where(texture.known, texture.light, np.nan)
    if not np.isfinite(light).any():
        return np.zeros(light.shape, np.uint8)
    white = max(float(np.nanpercentile(light, WHITE)), 1e-9)
    light = np.where(texture.known, texture.light, np.nanmedian(light))
    return np.rint(255 * np.clip(light / white, 0, 1) ** (1 / 2.2)).astype(np.uint8)


def frame_picture(frame: Frame) -> NDArray[np.uint8]:
    """A frame's pixels, 8 bits: of 16, the upper ones."""
    pixels = frame.pixels
    return (pixels >> 8 if pixels.dtype == np.uint16 else pixels).astype(np.uint8, copy=False)


def looks(
    pictures: Sequence[NDArray[np.uint8]],
    kind: str,
    pairs: Sequence[tuple[NDArray[np.uint8], NDArray[np.uint8]]] = (),
) -> Looks:
    """Sharpness and noise of pictures, each the median over them; how well features are found again, the mean.

    Args:
        pictures: of this kind of texture.
        kind: its name.
        pairs: two pictures each, of one exposure at instants that share no spike.

    Edges:
        Noise is measured where the picture is smoothest (the lowest quarter of local contrast), so that texture does
        not count as noise.

    Source: the noise estimator of Immerkaer 1996, on flat parts.
    """
    sharp, noise = (float(np.median([f(p) for p in pictures])) for f in (_sharpness, _noise))
    found = np.array([refound(*pair) for pair in pairs]).reshape(-1, 2)
    return Looks(kind, sharp, noise, *(map(float, found.mean(0)) if len(found) else ()))


def refound(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> tuple[int, float]:
    """How many features of picture a are found again in b, and how far from their place (median, pixels).

    Their place is that of an affine motion of the whole picture, the one that most features agree on.
    """
    import cv2

    sift = cv2.SIFT.create(contrastThreshold=0.01)  # a third of this is COLMAP's peak threshold
    points, words = zip(*(sift.detectAndCompute(np.ascontiguousarray(p), None) for p in (a, b)), strict=True)  # pyright: ignore
    if any(w is None or len(w) < 8 for w in words):
        return 0, REFOUND_PX
    pairs = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(*words)
    here = np.array([points[0][m.queryIdx].pt for m in pairs])
    there = np.array([points[1][m.trainIdx].pt for m in pairs])
    if len(pairs) < 8:
        return 0, REFOUND_PX
    motion = cv2.estimateAffine2D(here, there, method=cv2.RANSAC, ransacReprojThreshold=REFOUND_PX)[0]
    if motion is None:
        return 0, REFOUND_PX
    off = np.linalg.norm(here @ motion[:, :2].T + motion[:, 2] - there, axis=1)
    kept = off[off < REFOUND_PX]
    return len(kept), float(np.median(kept)) if len(kept) else REFOUND_PX


def _sharpness(picture: NDArray[np.uint8]) -> float:
    p = _blur(picture.astype(np.float64))
    gy, gx = p[2:, 1:-1] - p[:-2, 1:-1], p[1:-1, 2:] - p[1:-1, :-2]
    return float(np.percentile(np.hypot(gy, gx) / 2, 90)) if p.size > 9 else 0.0


def _noise(picture: NDArray[np.uint8]) -> float:
    p = picture.astype(np.float64)
    if min(p.shape) < 3:
        return 0.0
    c = p[1:-1, 1:-1] * 4 - 2 * (p[:-2, 1:-1] + p[2:, 1:-1] + p[1:-1, :-2] + p[1:-1, 2:])
    c += p[:-2, :-2] + p[:-2, 2:] + p[2:, :-2] + p[2:, 2:]
    b = _blur(p)[1:-1, 1:-1]
    rough = np.abs(np.gradient(b, axis=0)) + np.abs(np.gradient(b, axis=1)) if min(b.shape) > 1 else np.zeros_like(b)
    flat = rough <= np.percentile(rough, 25)
    return float(np.median(np.abs(c[flat]))) * 1.4826 / 6


def _blur(p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Binomial 3x3, edges repeated."""
    for axis in (0, 1):
        wide = np.pad(p, [(1, 1) if a == axis else (0, 0) for a in (0, 1)], mode="edge")
        low, mid, high = (np.take(wide, range(k, k + p.shape[axis]), axis) for k in range(3))
        p = (low + 2 * mid + high) / 4
    return p
