"""Boards shot once for all tests, and boards found once in each picture."""

from collections.abc import Iterator
from pathlib import Path

import board_pictures as bp
import numpy as np
import pytest
from calib_rigs import rig, step_of

from spikerig.calib import measure
from spikerig.calib.boards import Board, Found, find
from spikerig.calib.parity import times
from spikerig.calib.shots import content_hash
from spikerig.dataset.images import srgb8_from_linear, write_image

SMALL = {"rgb_width": 480}
CACHE: dict[tuple[str, Board], Found | None] = {}


def shoot(folder: Path, poses: np.ndarray, names: str = "ab", late: np.ndarray | None = None, **board: float) -> Path:
    """Pictures of a board in two folders, a/cam_a_00.png and b/cam_b_00.png; `late`: where the RGB arm saw it."""
    spike, rgb = bp.lens("spike", 2), bp.lens("rgb", 2, **SMALL)
    step = step_of(rig(**SMALL))
    for k, pose in enumerate(poses):
        other = times(step, pose if late is None else late[k])
        for name, light in zip(names, (spike.picture(pose, **board), rgb.picture(other, **board)), strict=True):
            (folder / name).mkdir(exist_ok=True, parents=True)
            write_image(folder / name / f"cam_{name}_{k:02d}.png", srgb8_from_linear(light)[:, :, None])
    return folder


@pytest.fixture(scope="session")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five good views."""
    return shoot(tmp_path_factory.mktemp("shots"), bp.poses(5, 31))


@pytest.fixture
def remembered() -> Iterator[None]:
    """Boards already sought in a picture are not sought again."""

    def once(light: np.ndarray, board: Board) -> Found | None:
        key = content_hash(light), board
        if key not in CACHE:
            CACHE[key] = find(light, board)
        return CACHE[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measure, "find", once)
        yield
