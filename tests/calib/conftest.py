"""Boards shot once for all tests, and boards found once in each picture."""

from collections.abc import Iterator
from pathlib import Path

import board_pictures as bp
import numpy as np
import pytest
from board_shots import shoot

from spikerig.calib import measure
from spikerig.calib.boards import Board, Found, find
from spikerig.calib.shots import content_hash

CACHE: dict[tuple[str, Board], Found | None] = {}


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
