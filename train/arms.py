"""What is left between the two arms after calibration: one small affine motion a run, found before training.

The spikes counted over an exposure and the gray of its frame hold the same blur. So wherever the rest of the motion
comes from (a bumped mirror, warmth), one registers on the other, pooled over all views, to hundredths of a pixel; then
the frames are brought to the spikes, whose camera is the one that poses belong to.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError
from spikerig.train.gray import BRIGHTEST, DARKEST

ROUNDS = 4  # Gauss-Newton steps; two are enough for a pixel, more for several
BORDER = 8  # pixels at the edge that are left out
MOST_PX = 12.0  # a larger motion is not what is left after a calibration


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Pixel x of the spikes shows what pixel x + u of the frames shows; u[2] = matrix[2,3] @ (1, x', y').

    x', y' run from -1 to 1 over the width and (same scale) the height. `pixels` used; `rms_before`, `rms_after` of the
    grays' difference, white at 1.
    """

    matrix: NDArray[np.float64]
    pixels: int
    rms_before: float
    rms_after: float

    @property
    def shift_px(self) -> tuple[float, float]:
        """In the middle of the picture."""
        return float(self.matrix[0, 0]), float(self.matrix[1, 0])

    def as_json(self) -> dict[str, Any]:
        """A JSON-ready record."""
        return {
            "matrix": self.matrix.tolist(), "shift_px": list(self.shift_px), "pixels": self.pixels,
            "rms_before": self.rms_before, "rms_after": self.rms_after,
        }  # fmt: skip


def motion_of(
    frames: list[NDArray], spikes: list[NDArray], masks: list[NDArray], weights: NDArray, kind: str
) -> Motion:
    """The motion between frames and spikes, over all views together.

    Args:
        frames: [H,W,3] each, linear light.
        spikes: [H,W] each, their exposure's mean in the same units (white at 1).
        masks: bool[H,W] each, where both are known and not clipped.
        weights: gray converter [4].
        kind: shift (2 numbers) or affine (6).

    Raises:
        DataError: too little texture to tell, or a motion of more than MOST_PX pixels.

    Source: Lucas and Kanade 1981, least squares of the brightness difference along the frame's own gradient.
    """
    height, width = spikes[0].shape
    base = _base(height, width)
    columns = [0, 1, 2] if kind == "affine" else [0]
    used = (slice(BORDER, height - BORDER), slice(BORDER, width - BORDER))
    matrix = np.zeros((2, 3))
    before = after = 0.0
    pixels = 0
    for k in range(ROUNDS + 1):
        normal, right, square, pixels = np.zeros((2 * len(columns),) * 2), np.zeros(2 * len(columns)), 0.0, 0
        for frame, spike, mask in zip(frames, spikes, masks, strict=True):
            light = moved(frame, matrix)
            gray = light[..., 0] * weights[0] + light[..., 1] * weights[1] + light[..., 2] * weights[2] + weights[3]
            slopes = np.gradient(gray)
            good = (moved(mask.astype(np.float32)[..., None], matrix)[..., 0] > 0.999)[used]
            rest = (spike - gray)[used][good].astype(np.float64)
            rows = [slope[used][good] * base[c][used][good] for slope in (slopes[1], slopes[0]) for c in columns]
            # elementwise and pairwise sums: the same bits whatever BLAS and threads there are
            right += [(row * rest).sum() for row in rows]
            normal += [[(a * b).sum() for b in rows] for a in rows]
            square, pixels = square + (rest * rest).sum(), pixels + len(rest)
        after = float(np.sqrt(square / max(pixels, 1)))
        before = after if k == 0 else before
        if pixels == 0 or np.linalg.cond(normal) > 1e8:
            raise DataError(
                "the arms cannot be registered on each other",
                value=f"{pixels} pixels",
                expected="textured pictures that do not clip",
                next="--set align_arms=off, or shift instead of affine",
            )
        if k < ROUNDS:
            matrix[:, columns] += np.linalg.solve(normal, right).reshape(2, -1)
        if np.abs(matrix[:, 0]).max() > MOST_PX:
            raise DataError(
                "the arms are further apart than a calibration leaves them",
                value=f"{matrix[0, 0]:.1f}, {matrix[1, 0]:.1f} px",
                expected=f"at most {MOST_PX:g} px",
                next="spikerig calib align",
            )
    return Motion(matrix, pixels, before, after)


def moved(picture: NDArray, matrix: NDArray[np.float64]) -> NDArray[np.float32]:
    """A picture [H,W,C] of the frames' camera on the pixels of the spikes'; the border goes on outside.

    Source: cubic convolution, Keys 1981, a = -1/2 (exact for slopes; -3/4, which torch has, shifts them).
    """
    if not matrix.any():
        return np.asarray(picture, np.float32)
    height, width = picture.shape[:2]
    source = sources(height, width, matrix) - 0.5
    whole = np.floor(source)
    taps = [_keys(axis) for axis in np.moveaxis(source - whole, -1, 0)]
    x, y = np.moveaxis(whole.astype(np.int64), -1, 0)
    out = np.zeros(picture.shape)
    for j, down in enumerate(taps[1]):
        row = np.clip(y + j - 1, 0, height - 1)
        for i, across in enumerate(taps[0]):
            out += (down * across)[..., None] * picture[row, np.clip(x + i - 1, 0, width - 1)]
    return out.astype(np.float32)


def _keys(f: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    square, cube = f * f, f * f * f
    return (
        square - (f + cube) / 2,
        1 - 2.5 * square + 1.5 * cube,
        2 * square + f / 2 - 1.5 * cube,
        (cube - square) / 2,
    )


def sources(height: int, width: int, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where in the frames the spikes' pixels are [H,W,2], pixels, centres at halves."""
    here = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)
    one, x, y = _base(height, width)
    return np.asarray(here + np.stack([row[0] * one + row[1] * x + row[2] * y for row in matrix], -1), np.float64)


def _base(height: int, width: int) -> NDArray[np.float64]:
    x, y = np.meshgrid((np.arange(width) + 0.5) / width * 2 - 1, (2 * np.arange(height) + 1 - height) / width)
    return np.stack([np.ones_like(x), x, y])


def align(raw: list[dict[str, Any]], weights: NDArray, white: float, kind: str) -> Motion:
    """Bring the frames of all views (`light`, `codes`, `valid` of each) to their spikes, in place."""
    masks = [
        v["valid"] & v["mean_known"] & (v["codes"] >= DARKEST).all(-1) & (v["codes"] <= BRIGHTEST).all(-1) for v in raw
    ]
    found = motion_of([v["light"] for v in raw], [v["mean"] / white for v in raw], masks, weights, kind)
    height, width = masks[0].shape
    source = sources(height, width, found.matrix)
    inside = ((source >= 0.5) & (source <= np.array([width, height]) - 0.5)).all(-1)
    for view in raw:
        seen = moved(view["valid"][..., None].astype(np.float32), found.matrix)[..., 0] > 0.999
        view["light"] = moved(view["light"], found.matrix).clip(0, 1)
        view["codes"] = np.rint(moved(view["codes"].astype(np.float32), found.matrix).clip(0, 255)).astype(np.uint8)
        view["valid"] = view["valid"] & seen & inside
    return found
