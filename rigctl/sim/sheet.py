"""Contact sheets of simulated scenes: the blurry picture, what the spikes show, the sharp truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.images import srgb8_from_linear, write_image
from spikerig.dataset.store import open_scene
from spikerig.dataset.texture import tfp

Pixels = NDArray[np.uint8]
WINDOW = 64  # ticks that a sheet's textures average


def panels(scene: Path, count: int) -> list[tuple[Pixels, Pixels, Pixels]]:
    """Of some views for training, evenly picked: the frame, the spikes' average at mid-stream, the sharp truth.

    Args:
        scene: a scene file with truth.
        count: how many views at most; of one, the middle one.

    Returns:
        uint8[H,W,3] each, sRGB; the average scaled so that RGB white is white.
    """
    found = []
    with open_scene(scene) as file:
        names = file.train or file.names
        spread = np.linspace(0, len(names) - 1, min(count, len(names))) if count > 1 else [len(names) // 2]
        for name in [names[round(k)] for k in spread]:
            view = file.view(name)
            pixels = np.rint(view.frame.pixels * (255 / np.iinfo(view.frame.pixels.dtype).max)).astype(np.uint8)
            gray = np.zeros_like(pixels)
            if view.spikes is not None:
                ticks = view.spikes.ticks
                light = tfp(view.spikes, ticks // 2, min(WINDOW, ticks)).light / (file.light_gain or 1)
                gray = np.repeat(srgb8_from_linear(light)[..., None], 3, 2)
            found.append((pixels, gray, srgb8_from_linear(file.truth_light(name))))
    return found


def contact_sheet(out: Path, scene: Path, columns: int = 4) -> None:
    """A PNG of a scene: a column a view, and from top to bottom its `panels`."""
    rows = zip(*panels(scene, columns), strict=True)
    write_image(out, np.concatenate([np.concatenate(row, 1) for row in rows], 0), force=True)


def overview(out: Path, scenes: Sequence[Path]) -> None:
    """A PNG of several scenes of one size: the `panels` of one view of each, two scenes a row, halved in size."""
    strips = [np.concatenate(panels(scene, 1)[0], 1) for scene in scenes]
    strips += [np.zeros_like(strips[0])] * (len(strips) % 2)
    rows = [np.concatenate(strips[k : k + 2], 1) for k in range(0, len(strips), 2)]
    write_image(out, halved(np.concatenate(rows, 0)), force=True)


def halved(pixels: Pixels) -> Pixels:
    """Every 2x2 pixels' mean (of encoded values: a thumbnail); an odd last row or column is left out."""
    height, width = (n // 2 for n in pixels.shape[:2])
    cells = pixels[: 2 * height, : 2 * width].reshape(height, 2, width, 2, -1)
    return np.rint(cells.mean((1, 3))).astype(np.uint8)
