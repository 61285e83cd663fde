"""Do two aligned pictures agree? Edges are held against edges, part by part; a small error can be taken out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import frozen_array
from spikerig.dataset.errors import RefusedError

Floats = NDArray[np.float64]
REACH = 4  # px that a part is sought over
FAINT = 0.3  # correlation below which a part says nothing
ALONG = 0.03  # edges with less than this part of their slope in a direction do not fix a shift along it
FARTHEST_PX = 3.0  # a refinement that moves a corner of the picture further is none


@dataclass(frozen=True, slots=True)
class Agreement:
    """How far the edges of two pictures lie apart.

    Args:
        shift_px: float64[down,across,2], where the second picture's edges lie relative to the first's; NaN where a
            part has too few edges to say.
        score: float64[down,across], correlation of the edges at that shift.
        here: correlation of all edges as the pictures lie.
    """

    shift_px: Floats
    score: Floats
    here: float

    def __post_init__(self) -> None:
        for name in ("shift_px", "score"):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))

    @property
    def rms_px(self) -> float:
        """Over the parts that say something; NaN where none does."""
        said = np.isfinite(self.shift_px[..., 0])
        return float(np.sqrt((self.shift_px[said] ** 2).sum(-1).mean())) if said.any() else float("nan")


def edge_agreement(
    first: NDArray[np.floating], second: NDArray[np.floating], valid: NDArray[np.bool_], across: int = 4, down: int = 3
) -> Agreement:
    """Hold the edges of two pictures of the same light against each other.

    Args:
        first, second: [H,W] linear light; of different gain, colour response or noise, but the same blur.
        valid: bool[H,W], where both are known.
        across, down: parts.

    Returns:
        An Agreement: a positive x shift means that the second picture lies too far right.

    Source:
        Normalised correlation of gradient magnitudes for whole pixels, then Lucas and Kanade's least squares.
    """
    a, b = _edges(first, valid), _edges(second, valid)
    inner = _shrunk(valid)
    height, width = valid.shape
    shifts, scores = np.full((down, across, 2), np.nan), np.zeros((down, across))
    for j in range(down):
        for i in range(across):
            part = np.zeros_like(valid)
            part[j * height // down : (j + 1) * height // down, i * width // across : (i + 1) * width // across] = True
            shifts[j, i], scores[j, i] = _peak(a, b, part & inner)
    return Agreement(shifts, scores, _correlation(a, b, inner))


def _edges(light: NDArray[np.floating], valid: NDArray[np.bool_]) -> Floats:
    import cv2

    known = valid.astype(np.float64)
    bright = np.sqrt(np.maximum(np.where(valid, light, 0), 0)).astype(np.float64)
    weight = cv2.GaussianBlur(known, (0, 0), 1.2)
    smooth = cv2.GaussianBlur(bright * known, (0, 0), 1.2) / np.maximum(weight, 1e-3)
    gy, gx = np.gradient(smooth)
    return np.hypot(gx, gy)


def _shrunk(valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Valid pixels whose neighbourhood, as far as shifts and filters reach, is valid too."""
    import cv2

    size = 2 * (REACH + 4) + 1
    return cv2.erode(valid.astype(np.uint8), np.ones((size, size), np.uint8), borderValue=0) > 0


def _correlation(a: Floats, b: Floats, where: NDArray[np.bool_]) -> float:
    if where.sum() < 100:
        return 0.0
    x, y = a[where] - a[where].mean(), b[where] - b[where].mean()
    return float((x * y).sum() / max(np.sqrt((x * x).sum() * (y * y).sum()), 1e-300))


def _peak(a: Floats, b: Floats, where: NDArray[np.bool_]) -> tuple[Floats, float]:
    """The shift of b against a at which their edges agree best, to a fraction of a pixel, and how well."""
    steps = range(-REACH, REACH + 1)
    near = _around(where)
    one, other, here = a[near], b[near], where[near]
    scores = np.array([[_correlation(one, np.roll(other, (-y, -x), (0, 1)), here) for x in steps] for y in steps])
    y, x = np.unravel_index(int(scores.argmax()), scores.shape)
    best = float(scores[y, x])
    if best < FAINT:
        return np.full(2, np.nan), best
    return _nudged(a, b, where, np.array([x - REACH, y - REACH], np.float64)), best


def _around(where: NDArray[np.bool_]) -> tuple[slice, slice]:
    """The rectangle of some pixels and all within REACH of them."""
    spans = []
    for axis in (1, 0):
        at = np.flatnonzero(where.any(axis))
        first, last = (int(at[0]), int(at[-1])) if at.size else (0, 0)
        spans.append(slice(max(first - REACH, 0), last + REACH + 1))
    return spans[0], spans[1]


def _nudged(a: Floats, b: Floats, where: NDArray[np.bool_], shift: Floats) -> Floats:
    """A shift made exact by least squares on slopes, gain and offset; 0 along edges, where none can be seen."""
    import cv2

    height, width = a.shape
    for _ in range(4):
        move = np.array([[1, 0, shift[0]], [0, 1, shift[1]]])
        here = cv2.warpAffine(b, move, (width, height), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)
        gy, gx = np.gradient(here)
        slopes = np.stack([gx[where], gy[where]], -1)
        around = np.stack([here[where], np.ones(int(where.sum()))], -1)
        slopes, off = (v - around @ np.linalg.lstsq(around, v, rcond=None)[0] for v in (slopes, a[where]))
        gain = max(float((a[where] * here[where]).sum() / max((here[where] ** 2).sum(), 1e-300)), 1e-300)
        strength, along = np.linalg.eigh(slopes.T @ slopes)
        sure = along[:, strength > ALONG * strength[-1]]
        step = np.linalg.lstsq(slopes @ sure, off / gain, rcond=None)[0]
        shift = sure @ (sure.T @ shift + np.clip(step, -0.7, 0.7))
    return shift


def ecc_refinement(
    texture: NDArray[np.floating], crop: NDArray[np.floating], valid: NDArray[np.bool_]
) -> tuple[Floats, float]:
    """A homography that takes a small misalignment out, by maximising correlation (ECC).

    Args:
        texture: [H,W] light of the spikes, the one that stays.
        crop: [H,W] gray light of the aligned RGB picture at the same size.
        valid: bool[H,W].

    Returns:
        (float64[3,3] for `warp_of(refinement=...)`, the correlation reached).

    Raises:
        RefusedError: it does not converge, or would move a corner of the picture by more than FARTHEST_PX.

    Source:
        Evangelidis and Psarakis 2008, as cv2.findTransformECC.
    """
    import cv2

    start = np.eye(3, dtype=np.float32)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 200, 1e-7)
    pictures = [np.sqrt(np.maximum(np.where(valid, p, 0), 0)).astype(np.float32) for p in (texture, crop)]
    try:
        score, H = cv2.findTransformECC(
            pictures[0], pictures[1], start, cv2.MOTION_HOMOGRAPHY, stop, valid.astype(np.uint8) * 255, 5
        )
    except cv2.error as error:
        raise RefusedError("the pictures could not be brought together", cause="too little in common to correlate",
                           value=str(error).strip().splitlines()[-1][:200]) from error  # fmt: skip
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    H = half @ np.asarray(H, np.float64) @ np.linalg.inv(half)
    height, width = valid.shape
    rim = np.array([[0, 0, 1.0], [width, 0, 1], [0, height, 1], [width, height, 1]])
    moved = rim @ H.T
    worst = float(np.linalg.norm(moved[:, :2] / moved[:, 2:] - rim[:, :2], axis=1).max())
    if not worst <= FARTHEST_PX:
        raise RefusedError(
            "a refinement may only take out a small misalignment",
            value=f"{worst:.1f} px at a corner",
            expected=f"at most {FARTHEST_PX:g} px",
            cause="the calibration is off, or the pictures are not of one scene",
        )
    return H / H[2, 2], float(score)
