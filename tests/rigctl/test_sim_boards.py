"""Boards before a scene's rig: exact, in view of both arms, and what `calib board` makes of them is the truth."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hard_sim import small

from spikerig.calib.align import coded_like, linear_of, warp_light, warp_of
from spikerig.calib.boards import Board
from spikerig.calib.lens import project
from spikerig.dataset import cli
from spikerig.dataset.errors import UsageError
from spikerig.dataset.store import open_scene
from spikerig.rigctl.sim.boards import Shots, board_picture, board_poses, rays_of, record_boards, true_calibration
from spikerig.rigctl.sim.capture import capture
from spikerig.rigctl.sim.effects import Site, in_order
from spikerig.rigctl.sim.pairs import RIGS, rig_effects
from spikerig.rigctl.sim.rgb import optics
from spikerig.rigctl.sim.viewpoint import camera_of

BOARD = Board(9, 6, 24.0)
SIZE: dict[str, Any] = {"camera__width": 200, "camera__height": 125}
ARMS = [
    {"name": "misalignment", "rotation_deg": [0.7, -1.0, 1.5], "translation": [0.01, 0, 0]},
    {"name": "mirror_flip", "arm": "rgb"},
    {"name": "distortion", "arm": "both", "k1": -0.06, "k2": 0.02, "p1": 0.004, "p2": 0.01},
]


@pytest.mark.parametrize("mirrored", ["rgb", "spike"])
def test_lenses_cast_through_show_what_the_scenes_optics_redraw(mirrored: str) -> None:
    """The record and the effects agree: mirror, tangential terms, turn and shift; up to what redrawing blurs."""
    arms = [ARMS[0], {"name": "mirror_flip", "arm": mirrored}, ARMS[2]]
    spec = small(**SIZE, effects=arms)
    shots, pose = Shots(spec, BOARD), board_poses(spec, BOARD, 2)[1]
    apart: Any = next(e for e in spec.effects if e.name == "misalignment")
    plain = rays_of(camera_of(spec))
    step = np.array(apart.rgb_from_spike) * [1, 1, 1, 1000]
    there = np.concatenate([step[:, :3] @ pose[:, :3], (step[:, :3] @ pose[:, 3] + step[:, 3])[:, None]], 1)
    site = Site(125, 200, 0, 1, camera=camera_of(spec), own_arm=True)
    hooks = [e.begin(site) for e in in_order(spec.effects)]
    wanted = (
        optics(board_picture(plain, pose, BOARD)[None], [h.spike_optics for h in hooks])[0],
        optics(board_picture(plain, there, BOARD)[None], [h.rgb_optics for h in hooks])[0],
    )
    for rays, at, want, arm in zip(shots.rays, (pose, there), wanted, ("spike", "rgb"), strict=True):
        got = board_picture(rays, at, BOARD)
        got = got[:, ::-1] if arm == mirrored else got
        inner = np.s_[12:-12, 12:-12]
        assert np.abs(got - want)[inner].mean() < 0.013, arm
        assert np.abs(got - want[:, ::-1])[inner].mean() > 0.03, "the test would see a flip"


def test_boards_are_wholly_seen_by_both_arms() -> None:
    spec = small(**SIZE, effects=ARMS)
    true, poses = true_calibration(spec), board_poses(spec, BOARD, 12)
    M = true.spike_from_rgb.cam_from_world
    for pose in poses:
        spike = BOARD.points() @ pose[:, :3].T + pose[:, 3]
        for camera, points in ((true.spike, spike), (true.rgb, (spike - M[:, 3]) @ M[:, :3])):
            px = project(camera, points)
            assert (px > 2).all()
            assert (px < [camera.width - 2, camera.height - 2]).all()
    tilts = np.degrees(np.arccos(np.abs(poses[:, 2, 2])))
    assert np.median(tilts) > 20


def test_calib_board_finds_the_rig_it_was_recorded_by(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spec = small(**SIZE, effects=[*RIGS["splitter"], "threshold_fpn"], exposure__exposure_ms=8.0)
    told = record_boards(spec, BOARD, 14, tmp_path)
    assert (told["mirrored"], told["model"]) == ("rgb", "common")
    words = [str(tmp_path / "spike"), str(tmp_path / "rgb"), "--square-mm", "24", "-o", str(tmp_path / "calib.json")]
    assert cli.run(["calib", "board", *words, "--json"]) == 0
    capsys.readouterr()
    assert cli.run(["calib", "compare", str(tmp_path / "calib.json"), told["true"], "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["schema"] == "spikerig.calib.compare/1"
    assert found["crop_px"]["median"] < 0.02
    assert found["crop_px"]["max"] < 0.25
    assert found["focal_ratio"]["spike"] == pytest.approx(1, abs=2e-3)
    assert found["turn_deg"] < 0.05
    assert found["same_mirror"] is True


def test_the_command_writes_the_same_bytes_again_and_keeps_what_is_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "boards"
    words = ["sim", "boards", "demo", "-o", str(out), "--rig", "splitter", "--views", "1", "--json"]
    assert cli.run(words) == 0
    assert json.loads(capsys.readouterr().out)["mirrored"] == "rgb"
    before = {p.name: p.read_bytes() for p in out.rglob("*.*")}
    assert cli.run(words) == 2
    assert "boards already" in json.loads(capsys.readouterr().out)["error"]["what"]
    assert cli.run([*words, "--force"]) == 0
    assert {p.name: p.read_bytes() for p in out.rglob("*.*")} == before
    capsys.readouterr()
    assert cli.run([*words[:-2], "0", "--json"]) == 2


@pytest.mark.parametrize("flip", [{"arm": "both"}, {"arm": "rgb", "axis": "y"}])
def test_a_rig_that_no_calibration_describes_is_refused(flip: dict) -> None:
    with pytest.raises(UsageError, match="one arm"):
        true_calibration(small(effects=[{"name": "mirror_flip", **flip}]))


def test_a_rig_takes_the_place_of_the_scenes_own_optics() -> None:
    spec = small(effects=["threshold_fpn", {"name": "distortion", "arm": "rgb", "k1": 0.2}])
    found = rig_effects("splitter", spec.effects)
    assert [e.name for e in found if e.name == "distortion"] == ["distortion"]
    assert next(e for e in found if e.name == "distortion").arm == "spike"  # type: ignore[attr-defined]
    assert {e.name for e in found} >= {"threshold_fpn", "misalignment", "mirror_flip"}
    with pytest.raises(UsageError, match="no such rig"):
        rig_effects("tripod", ())


def test_a_held_out_picture_is_as_the_rgb_arm_saw_it(tmp_path: Path) -> None:
    """Aligned by the true rig it is the sharp truth again; it has none of the other faults."""
    spec = small(**SIZE, effects=[*RIGS["splitter"], "read_noise"])
    capture(spec, tmp_path / "raw.h5", workers=1)
    warp = warp_of(true_calibration(spec))
    with open_scene(tmp_path / "raw.h5") as file:
        name = file.test[0]
        frame, truth = file.view(name).frame, file.truth_light(name)
    want = coded_like(frame, truth)
    got = coded_like(frame, warp_light(warp, linear_of(frame)))
    off = [np.abs(p.astype(float) - want)[warp.valid].mean() for p in (frame.pixels, got)]
    assert off[1] < 0.25 * off[0]
