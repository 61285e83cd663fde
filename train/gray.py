"""From RGB to what a spike camera saw: three weights and a bias, calibrated before training, fixed, or learned.

Calibrated: the spikes counted over an exposure and the blurry frame hold the same blur, so a linear fit of one by
the other is exact without any deblurring. Frozen, it cannot cheat; the learned one (the paper's) raises contrast
beside a blurry colour term until a blurred render fits a sharp texture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError
from spikerig.dataset.terminal import note

REC601 = (0.299, 0.587, 0.114)
DARKEST, BRIGHTEST = 4, 250  # 8-bit codes outside are clipped or near it
FEWEST = 200  # pixels


@dataclass(frozen=True, slots=True)
class Gray:
    """gray = weights . linear RGB + bias, in units where display white has gray 1.

    Args:
        weights, bias: the converter.
        white: texture value (spikes a tick) of display white; textures are divided by it.
        how: calibrated, rec601 or learned (then these are the start).
        pixels: used by the fit, 0 where none was made.
        rms: of its residual, in units of white.
    """

    weights: tuple[float, float, float]
    bias: float
    white: float
    how: str
    pixels: int = 0
    rms: float = 0.0

    def as_json(self) -> dict[str, Any]:
        """A JSON-ready record."""
        return {
            "weights": list(self.weights), "bias": self.bias, "white": self.white, "how": self.how,
            "pixels": self.pixels, "rms": self.rms,
        }  # fmt: skip


class Pairs:
    """Sums over pixels of (linear RGB, 1) against exposure counts: all a least-squares fit needs, view by view."""

    def __init__(self) -> None:
        self.moments = np.zeros((4, 4))
        self.cross = np.zeros(4)
        self.square = 0.0
        self.pixels = 0

    def add(self, codes: NDArray[np.uint8], light: NDArray, counts: NDArray, mask: NDArray[np.bool_]) -> None:
        """Take in a view.

        Args:
            codes: uint8[H,W,3], the frame; pixels with a channel near 0 or 255 are left out.
            light: [H,W,3], its linear light.
            counts: [H,W], spikes a tick over the exposure.
            mask: bool[H,W], pixels that both arms see and know.
        """
        good = mask & (codes >= DARKEST).all(-1) & (codes <= BRIGHTEST).all(-1)
        x = np.ones((4, int(good.sum())))
        x[:3] = light[good].T
        y = counts[good].astype(np.float64)
        for i in range(4):  # elementwise and pairwise sums: the same bits whatever BLAS and threads there are
            self.cross[i] += (x[i] * y).sum()
            for j in range(i, 4):
                self.moments[i, j] += (x[i] * x[j]).sum()
                self.moments[j, i] = self.moments[i, j]
        self.square += (y * y).sum()
        self.pixels += x.shape[1]


def solve(pairs: Pairs, how: str, light_gain: float | None) -> Gray:
    """The converter from the gathered pairs.

    Args:
        pairs: of all training views.
        how: calibrated (weights and bias by least squares), rec601 or learned (Rec.601; only white may be fitted).
        light_gain: texture value of display white, where the scene knows it; else the fit's value for RGB (1,1,1).

    Raises:
        DataError: too few pixels for the fit that is needed, or a fit in which white is not brighter than black.

    Edges: in a colourless scene the weights are not determined; a ridge of 1e-6 towards Rec.601 decides.
    """
    if how != "calibrated" and light_gain is not None:
        return Gray(REC601, 0.0, light_gain, how)
    if pairs.pixels < FEWEST:
        raise DataError(
            "too few pixels to calibrate the gray converter",
            value=pairs.pixels,
            expected=f"at least {FEWEST} pixels with all codes in {DARKEST}..{BRIGHTEST}, valid, with spikes",
            cause="frames that are black or saturated, or views without spikes over their exposure",
            next="--gray rec601 (needs the scene's light_gain)",
        )
    flat = np.array([*REC601, 0.0])
    gain = float(flat @ pairs.cross / (flat @ pairs.moments @ flat))
    if how == "calibrated":
        ridge = 1e-6 * np.trace(pairs.moments) * np.eye(4)
        found = np.linalg.solve(pairs.moments + ridge, pairs.cross + ridge @ (gain * flat))
    else:
        found = gain * flat
    rest = pairs.square - 2 * found @ pairs.cross + found @ pairs.moments @ found
    white = float(found.sum()) if light_gain is None else light_gain
    if not (np.all(np.isfinite(found)) and found[:3].sum() > 0 and white > 0):
        raise DataError(
            "spikes do not grow with the frames' light",
            value=f"weights {found[:3]}, bias {found[3]}",
            cause="spikes and frames of different scenes, times or orientations",
            next="spikerig data verify FILE; look at spikerig data texture",
        )
    weights = found / white
    if weights[:3].min() < -0.05:
        note(f"warning: the calibrated gray has a negative weight: {np.round(weights[:3], 3)}")
    rms = float(np.sqrt(max(rest, 0.0) / pairs.pixels)) / white
    return Gray(
        (float(weights[0]), float(weights[1]), float(weights[2])), float(weights[3]), white, how, pairs.pixels, rms
    )
