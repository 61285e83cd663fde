"""The size of a map from a board that some views see."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from calib_worlds import ring

from spikerig.calib import pose_cli
from spikerig.calib.boards import Board, Found
from spikerig.calib.scale import Scale, scale_of
from spikerig.calib.straight import Straight
from spikerig.dataset import cli
from spikerig.dataset.scene import Camera, View
from spikerig.dataset.texture import Texture

BOARD = Board(9, 6, 24.0)
CAMERA = dataclasses.replace(Camera.pinhole(400, 250, 60), distortion=np.array([0.05, -0.02, 0.001, 0.0]))
MM = 137.0  # a unit of the map


def look(pose: np.ndarray, at: np.ndarray, noise: float, turned: bool, seed: int) -> Found:
    """The board lying at a place of the map, as a view sees it; its corners may come in the other order."""
    import cv2

    world = at + BOARD.points() / MM
    K = np.asarray(CAMERA.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], np.float64)
    px = cv2.projectPoints(world, pose[:, :3], pose[:, 3], K, CAMERA.distortion)[0].reshape(-1, 2) + 0.5
    px = np.asarray(px + noise * np.random.default_rng(seed).normal(size=px.shape), np.float64)
    return Found(px[::-1] if turned else px, np.ones(len(px), bool), "sb")


def views(noise: float, count: int = 7) -> tuple[dict[str, np.ndarray], dict[str, Found]]:
    poses = {f"{k:03d}": p for k, p in enumerate(ring(count))}
    at = np.array([0.05, -0.04, 0.0])
    return poses, {n: look(p, at, noise, k % 2 == 1, k) for k, (n, p) in enumerate(poses.items())}


@pytest.mark.parametrize(("noise", "within"), [(0.0, 1e-4), (0.15, 0.02)])
def test_millimetres_are_found_whatever_the_labels(noise: float, within: float) -> None:
    poses, seen = views(noise)
    seen["other"] = seen["000"]  # a view without a pose
    found = scale_of(poses, seen, CAMERA, BOARD)
    assert isinstance(found, Scale)
    assert found.mm_per_unit == pytest.approx(MM, rel=within)
    assert len(found.views) == 7
    if noise:
        assert abs(found.mm_per_unit - MM) < 4 * found.sd + 0.005 * MM


def test_why_there_is_none() -> None:
    poses, seen = views(0.0)
    assert "2 of 7" in str(scale_of(poses, {n: seen[n] for n in ("000", "003")}, CAMERA, BOARD))
    same = dict.fromkeys(poses, poses["002"])
    assert "one direction" in str(scale_of(same, dict.fromkeys(poses, seen["002"]), CAMERA, BOARD))
    far = {n: look(p, np.array([0.05, -0.04, 0.25 * k]), 0.0, False, 0) for k, (n, p) in enumerate(poses.items())}
    assert "do not meet" in str(scale_of(poses, far, CAMERA, BOARD))
    sizes = {n: dataclasses.replace(f, px=100 + (1 + 0.3 * k) * (f.px - 100)) for k, (n, f) in enumerate(seen.items())}
    assert not isinstance(scale_of(poses, sizes, CAMERA, BOARD), Scale)


def test_a_board_needs_its_size(tmp_path: Path) -> None:
    (tmp_path / "scene.h5").write_bytes(b"")
    for words in (["--board", "9x6"], ["--square-mm", "24"]):
        assert cli.run(["calib", "poses", str(tmp_path / "scene.h5"), *words]) == 2


def test_boards_are_looked_for_on_the_placed_views(monkeypatch: pytest.MonkeyPatch) -> None:
    """The command's way: textures of placed views, boards on them, a scale or a reason for the report."""
    poses, seen = views(0.0)
    asked: list[str] = []
    names = {id(f): n for n, f in seen.items()}

    def texture_at(view: View, phase: float, kind: str, gain: None, straight: Straight) -> Texture:
        asked.append(view.name)
        return Texture(np.full((2, 2), int(view.name), np.float32), np.ones((2, 2), bool), 0.0, kind)

    monkeypatch.setattr("spikerig.calib.poses.texture_at", texture_at)
    monkeypatch.setattr("spikerig.calib.boards.find", lambda light, board: seen.get(f"{int(light[0, 0]):03d}"))
    shown: Any = [SimpleNamespace(name=n) for n in [*poses, "009"]]
    told = pose_cli._size(shown, SimpleNamespace(poses=poses), CAMERA, BOARD, Straight())
    assert told is not None
    assert told["mm_per_unit"] == pytest.approx(MM, rel=1e-4)
    assert asked == list(poses) == sorted(names.values())
    del seen["000"], seen["001"], seen["002"], seen["003"], seen["004"]
    told = pose_cli._size(shown, SimpleNamespace(poses=poses), CAMERA, BOARD, Straight())
    assert told == {"mm_per_unit": None, "reason": told and told["reason"]}
    assert pose_cli._size(shown, SimpleNamespace(poses=poses), CAMERA, None, Straight()) is None
