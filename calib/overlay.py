"""Pictures by which a person sees whether two arms agree."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.align import Aligned
from spikerig.dataset.errors import UsageError
from spikerig.dataset.images import srgb8_from_linear

TILE = 25


def overlay(aligned: Aligned, kind: Literal["mix", "red-cyan"] = "mix") -> NDArray[np.uint8]:
    """Both arms in one picture, each scaled so that its 99th percentile is white.

    Args:
        aligned: a view on one camera.
        kind: "mix": tiles of the RGB picture and the texture in turn, where edges must run on from tile to tile;
            "red-cyan": the RGB picture's gray in red, the texture in cyan, where edges that agree are gray.

    Returns:
        uint8[H,W,3]; pixels that are not valid are dark blue.
    """
    if kind not in ("mix", "red-cyan"):
        raise UsageError("no such overlay", value=kind, expected="mix, red-cyan")
    valid = aligned.valid & aligned.texture.known
    light = aligned.light * _gain(aligned.light.mean(2), valid)
    texture = aligned.texture.light * _gain(aligned.texture.light, valid)
    if kind == "mix":
        y, x = np.indices(valid.shape) // TILE
        told = np.where(((x + y) % 2 == 0)[..., None], light, texture[..., None])
    else:
        told = np.stack([light.mean(2), texture, texture], -1)
    return np.where(valid[..., None], srgb8_from_linear(np.clip(told, 0, 1)), np.array([0, 0, 60], np.uint8))


def _gain(light: NDArray[np.floating], valid: NDArray[np.bool_]) -> np.float32:
    top = float(np.percentile(light[valid], 99)) if valid.any() else 0.0
    return np.float32(1 / top if top > 0 else 1.0)
