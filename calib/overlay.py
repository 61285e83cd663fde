"""Pictures by which a person sees whether two arms agree."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.align import Aligned, warp_light, warp_of, warp_texture
from spikerig.calib.rig import RigCalibration
from spikerig.calib.shots import Pair, Reading, read_light
from spikerig.dataset.errors import UsageError
from spikerig.dataset.images import srgb8_from_linear, write_image
from spikerig.dataset.scene import Frame
from spikerig.dataset.texture import Texture

TILE = 25
Kind = Literal["mix", "red-cyan"]
KINDS: tuple[Kind, ...] = ("mix", "red-cyan")


def overlay(aligned: Aligned, kind: Kind = "mix") -> NDArray[np.uint8]:
    """Both arms in one picture, each scaled so that its 99th percentile is white.

    Args:
        aligned: a view on one camera.
        kind: "mix": tiles of the RGB picture and the texture in turn, where edges must run on from tile to tile;
            "red-cyan": the RGB picture's gray in red, the texture in cyan, where edges that agree are gray.

    Returns:
        uint8[H,W,3]; pixels that are not valid are dark blue.
    """
    if kind not in KINDS:
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


def shot_overlays(
    folder: Path, pairs: Sequence[Pair], reading: Reading, calibration: RigCalibration, depth_mm: Sequence[float | None]
) -> list[Path]:
    """Overlays of a board's views, NAME.mix.png and NAME.red-cyan.png in a folder, each aligned at its board's depth.

    Args:
        folder: made where it is not there; pictures in it are replaced.
        pairs, reading: as the views were read.
        calibration: of the rig.
        depth_mm: of each view's board; None: the working depth.

    Cost:
        0.6 s a view.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written, warp = [], warp_of(calibration)
    for pair, depth in zip(pairs, depth_mm, strict=True):
        if calibration.model == "stereo" and depth is not None:
            warp = warp_of(calibration, depth_mm=depth)
        spikes, gray = (read_light(path, reading) for path in (pair.spike, pair.rgb))
        light = np.where(warp.valid[..., None], np.repeat(warp_light(warp, gray[..., None]), 3, 2), 0)
        texture = warp_texture(warp, Texture(spikes, np.ones(spikes.shape, bool), 0.0, "board"))
        frame = Frame(np.zeros((*warp.valid.shape, 3), np.uint8))
        for kind in KINDS:
            path = folder / f"{pair.name}.{kind}.png"
            write_image(path, overlay(Aligned(warp.camera, light, texture, warp.sensor_row, warp.valid, frame), kind),
                        force=True)  # fmt: skip
            written.append(path)
    return written


def _gain(light: NDArray[np.floating], valid: NDArray[np.bool_]) -> np.float32:
    top = float(np.percentile(light[valid], 99)) if valid.any() else 0.0
    return np.float32(1 / top if top > 0 else 1.0)
