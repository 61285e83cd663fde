"""A rolling shutter from capture to aligned scene: each pixel's time is that of its sensor row, within a row."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hard_sim import small

from spikerig.calib.rig import write_calibration
from spikerig.calib.rolling import exposure_texture
from spikerig.dataset import cli
from spikerig.dataset.images import linear_from_srgb
from spikerig.dataset.scene import View
from spikerig.dataset.store import open_scene, verify_scene
from spikerig.rigctl.sim.boards import true_calibration
from spikerig.rigctl.sim.capture import capture

READOUT_MS, HEIGHT = 8.0, 64
ROLLING: dict[str, Any] = {
    "camera__width": 96, "camera__height": HEIGHT, "exposure__exposure_ms": 2.0, "exposure__margin_ticks": 240,
    "exposure__phase": "zero", "exposure__sub_poses": 9, "shake__path_px": [2, 3], "shake__curvature": 0,
    "sensor__gain": 0.8,
    "effects": [{"name": "misalignment", "rotation_deg": [3.0, -1.0, 1.5]},
                {"name": "rolling_shutter", "readout_ms": READOUT_MS}],
}  # fmt: skip


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(as recorded, aligned by the command)."""
    folder = tmp_path_factory.mktemp("rolling")
    spec = small(**ROLLING)
    capture(spec, folder / "raw.h5", workers=1)
    write_calibration(folder / "calib.json", true_calibration(spec))
    words = ["calib", "align", str(folder / "raw.h5"), "--with", str(folder / "calib.json")]
    assert cli.run([*words, "-o", str(folder / "aligned.h5")]) == 0
    return folder / "raw.h5", folder / "aligned.h5"


def views(path: Path) -> list[View]:
    with open_scene(path) as file:
        return [file.view(name) for name in file.train]


def test_rows_keep_the_time_of_the_raw_row_they_came_from(scenes: tuple[Path, Path]) -> None:
    """The raw row by the misalignment's own homography, which the calibration's geometry has no part in."""
    apart: Any = next(e for e in small(**ROLLING).effects if e.name == "misalignment")
    assert verify_scene(scenes[1]) == []
    with open_scene(scenes[1]) as file:
        H = np.linalg.inv(apart.spike_from_rgb(file.camera.K, np.inf))
    x, y = np.meshgrid(np.arange(96) + 0.5, np.arange(HEIGHT) + 0.5)
    p = np.stack([x, y, np.ones_like(x)], -1) @ H.T
    row = p[..., 1] / p[..., 2] - 0.5
    for raw, view in zip(*map(views, scenes), strict=True):
        assert raw.frame.row_ns == round(READOUT_MS * 1e6 / HEIGHT)
        got = view.frame.start_ns + view.frame.row_ns * view.sensor_row.astype(np.float64)
        want = raw.frame.start_ns + raw.frame.row_ns * row
        assert np.abs(got - want)[view.valid].max() < 0.01 * raw.frame.row_ns
        middle = view.valid[HEIGHT // 2]
        late = view.mid_ns - raw.frame.exposure_ns // 2 - np.median(want[HEIGHT // 2][middle])
        assert abs(late) < 0.01 * raw.frame.row_ns
        assert abs(view.mid_ns - raw.mid_ns) > 2 * raw.frame.row_ns, "the crop's middle is another row of the sensor"


def test_spikes_of_each_rows_own_time_show_what_the_row_shows(scenes: tuple[Path, Path]) -> None:
    """Of all delays of the rows the recorded one makes spikes and frame most alike: within a row."""
    delays = np.arange(-8, 9)
    response = np.array([0.299, 0.587, 0.114])
    total = np.zeros(len(delays))
    for view in views(scenes[1]):
        assert view.spikes is not None
        frame = linear_from_srgb(view.frame.pixels) @ response
        for k, delay in enumerate(delays):
            made = exposure_texture(view.spikes, view.frame, view.sensor_row + np.float32(delay))
            seen = view.valid & made.known
            total[k] += np.mean((made.light / 0.8 - frame)[seen] ** 2)
    assert abs(delays[int(np.argmin(total))]) <= 1
    assert total[8] < 0.7 * min(total[0], total[-1])


def test_what_the_command_says_of_a_rolling_scene(
    scenes: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["calib", "align", str(scenes[0]), "--with", str(scenes[0].with_name("calib.json")), "--check", "--json"]
    assert cli.run(words) == 0
    assert json.loads(capsys.readouterr().out)["edges_px"]["median"] < 0.3
