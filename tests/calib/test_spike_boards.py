"""Boards through spikes, with known truth: the whole command line, and the simulator's own board."""

import json
from pathlib import Path

import board_pictures as bp
import numpy as np
import pytest
from calib_rigs import crop_error_px, rig, step_of

from spikerig.calib.boards import Board, find
from spikerig.calib.parity import times
from spikerig.calib.rig import read_calibration
from spikerig.dataset import cli
from spikerig.dataset.images import srgb8_from_linear, write_image
from spikerig.dataset.spikes import SpikeStream, write_spikes

pytestmark = pytest.mark.usefixtures("remembered")
VIEWS = 8
TRUE = rig(mirrored="rgb", rgb_width=800)


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders clean/, noisy/ (spike files) and rgb/ of a rig whose RGB arm looks into the splitter's mirror."""
    folder = tmp_path_factory.mktemp("shots")
    for name in ("clean", "noisy", "rgb"):
        (folder / name).mkdir()
    spike, rgb = bp.lens("spike", 4), bp.lens("rgb", 3, rgb_width=800)
    for k, pose in enumerate(bp.poses(VIEWS, 21)):
        light = 0.45 * spike.picture(pose)
        write_image(folder / f"clean/v{k}.exr", light[:, :, None])
        write_spikes(folder / f"noisy/v{k}.npz", bp.spikes(light, 256, k))
        gray = srgb8_from_linear(rgb.picture(times(step_of(TRUE), pose)))[:, ::-1]
        write_image(folder / f"rgb/v{k}.png", np.repeat(gray[:, :, None], 3, 2))
    return folder


def calibrate(folder: Path, arm: str, out: Path, capsys: pytest.CaptureFixture[str], *more: str) -> tuple[int, dict]:
    board = more or ("--pattern", "9x6", "--square-mm", "16")
    words = ["calib", "board", str(folder / arm), str(folder / "rgb"), *board, "-o", str(out), "--json"]
    code = cli.run(words)
    return code, json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(("arm", "rms_px"), [("clean", 0.1), ("noisy", 0.25)])
def test_the_rig_is_found_through_spikes(
    arm: str, rms_px: float, shots: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, told = calibrate(shots, arm, tmp_path / "calib.json", capsys)
    assert code == 0
    assert told["schema"] == "spikerig.calib.board/1"
    assert told["accepted"] is True
    assert told["views_used"] == VIEWS
    assert told["rms_px"]["stereo"] < rms_px  # what was asked for; measured 0.02
    assert told["rms_px"]["stereo"] < 0.04
    assert told["model"] == "common"
    found = read_calibration(tmp_path / "calib.json")
    assert found.id == told["id"]
    assert found.mirrored == "rgb"
    assert crop_error_px(found, TRUE) < 0.15
    assert told["mirror"] == {"parity": "measured", "arm": "convention"}
    assert any("by convention" in w for w in told["warnings"])
    assert told["crop"]["sd_worst_px"] < 0.25


def test_a_charuco_board_through_spikes_says_which_arm_is_mirrored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """6x4 corners, 23 mm squares, some of it out of the picture; the spike arm looks into the mirror."""
    true, art, size = rig(mirrored="spike", rgb_width=800), bp.charuco(6, 4), {"cols": 6, "rows": 4, "square": 23.0}
    spike, rgb = bp.lens("spike", 4), bp.lens("rgb", 3, rgb_width=800)
    for name in ("noisy", "rgb"):
        (tmp_path / name).mkdir()
    for k, pose in enumerate(bp.poses(VIEWS, 21)):
        light = 0.45 * spike.picture(pose, art=art, **size)
        write_spikes(tmp_path / f"noisy/v{k}.npz", bp.spikes(np.ascontiguousarray(light[:, ::-1]), 256, k))
        gray = srgb8_from_linear(rgb.picture(times(step_of(true), pose), art=art, **size))
        write_image(tmp_path / f"rgb/v{k}.png", gray[:, :, None])
    board = ("--pattern", "6x4", "--square-mm", "23", "--charuco", "DICT_4X4_50")
    code, told = calibrate(tmp_path, "noisy", tmp_path / "calib.json", capsys, *board)
    assert code == 0
    print(
        "CH",
        told["rms_px"],
        told["crop"]["sd_worst_px"],
        told["lens"],
        told["warnings"],
        crop_error_px(read_calibration(tmp_path / "calib.json"), true),
    )
    assert told["views_used"] == VIEWS
    assert told["mirrored"] == "spike"
    assert told["mirror"] == {"parity": "markers", "arm": "markers"}
    assert told["rms_px"]["spike"] < 0.25  # what was asked for; measured 0.022
    assert told["rms_px"]["spike"] < 0.04
    found = read_calibration(tmp_path / "calib.json")
    assert crop_error_px(found, true) < 0.25


def test_the_simulators_own_board_is_seen_where_it_is() -> None:
    """A rect of the simulator's checker texture, through its renderer and sensor, with its noise."""
    from spikerig.calib.lens import project
    from spikerig.calib.shots import Reading, still_light
    from spikerig.dataset.scene import Camera
    from spikerig.dataset.stream import SpikeFile
    from spikerig.rigctl.sim.caster.light import Stage
    from spikerig.rigctl.sim.effects import Site, effect_class
    from spikerig.rigctl.sim.sensor import integrate
    from spikerig.rigctl.sim.spec import read_scene

    def rect(half: tuple[float, float], z: float, **texture: object) -> dict:
        return {"kind": "rect", "centre": [0, 0, z], "right": [half[0], 0, 0], "up": [0, half[1], 0],
                "texture": texture}  # fmt: skip

    world = read_scene({
        "name": "board", "orbit": {"views": 1, "test": []},
        "world": {"ambient": [1, 1, 1], "solids": [
            rect((0.096, 0.08), 0.001, kind="plain", a=[0.9] * 3),
            rect((0.08, 0.064), 0.0, kind="checker", size=0.016, a=[0.9] * 3, b=[0.05] * 3),
        ]},
    }).world  # fmt: skip
    camera = Camera(np.array([[620.0, 0, 200], [0, 620, 125], [0, 0, 1]]), np.zeros(0), 400, 250)
    pose = bp.poses(1, 7)[0] * [[1, 1, 1, 1e-3]]
    light = 0.45 * Stage(world).picture(camera, pose, 6)[..., 0]
    site = Site(250, 400, 0, 5)
    hooks = [effect_class(name)().begin(site) for name in ("shot_noise", "threshold_fpn")]
    phase = site.draw("initial_phase").random((250, 400))
    bits, _, _ = integrate(light[None].astype(np.float32), np.array([0, 256]), phase, hooks)
    stream = SpikeStream(bits, 400, 40_000.0)
    file = SpikeFile(Path("board"), "npz", 256, 250, 400, lambda a, b: stream.bits[a:b], lambda: None, 40_000.0)
    found = find(still_light(file, Reading(window=256)), Board(9, 7, 16.0))
    assert found is not None
    true = project(camera, bp.corners(rows=7) * 1e-3 @ pose[:, :3].T + pose[:, 3])
    off = min(np.sqrt(((found.px - t) ** 2).sum(1).mean()) for t in (true, true[::-1]))
    assert off < 0.05
