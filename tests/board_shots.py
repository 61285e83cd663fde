"""Folders of pictures of a board, as an operator would shoot them."""

from pathlib import Path

import board_pictures as bp
import numpy as np
from calib_rigs import rig, step_of

from spikerig.calib.parity import times
from spikerig.dataset.images import srgb8_from_linear, write_image

SMALL = {"rgb_width": 480}


def shoot(folder: Path, poses: np.ndarray, late: np.ndarray | None = None, **board: float) -> Path:
    """Pictures of a board in two folders, a/cam_a_00.png and b/cam_b_00.png; `late`: where the RGB arm saw it."""
    arms = {"a": bp.lens("spike", 2), "b": bp.lens("rgb", 2, **SMALL)}
    step = step_of(rig(**SMALL))
    for k, pose in enumerate(poses):
        at = {"a": pose, "b": times(step, pose if late is None else late[k])}
        for name, lens in arms.items():
            (folder / name).mkdir(exist_ok=True, parents=True)
            light = lens.picture(at[name], **board)  # type: ignore[arg-type]
            write_image(folder / name / f"cam_{name}_{k:02d}.png", srgb8_from_linear(light)[:, :, None])
    return folder
