"""The record: a round trip to the last bit, an id, and a reader that nothing upsets."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from calib_rigs import crop_error_px, rig
from hard_calib import bad_records

from spikerig.calib.crop import (
    crop_homography,
    grid,
    parallax_px,
    rgb_px_from_spike_px,
    spike_px_from_rgb_px,
    unmirrored,
    working_depth_mm,
)
from spikerig.calib.rig import RigCalibration, as_json, calibration_of, read_calibration, write_calibration
from spikerig.dataset.errors import DataError, UsageError

RIGS = {
    "common": rig(),
    "stereo, mirrored": dataclasses.replace(
        rig((15.0, -2.0, 3.0), "rgb"), residual_px=0.1 + 0.2, sd={"spike.fx_px": 1 / 3}, response=(0.3, 0.6, 0.1),
        split_ratio=0.4, flat={"file": "flat.npz", "sha256": "0" * 64}, forced=("flat-boards",), made_ns=2**60 + 1,
    ),
    "spike arm mirrored": rig((0, 0, 0), "spike"),
}  # fmt: skip


def same(a: RigCalibration, b: RigCalibration) -> bool:
    return as_json(a) == as_json(b) and a.id == b.id and a.spike.K.tobytes() == b.spike.K.tobytes()


@pytest.mark.parametrize("name", RIGS)
def test_round_trip(name: str, tmp_path: Path) -> None:
    path = tmp_path / "calib.json"
    write_calibration(path, RIGS[name], {"views": [1, math.nan]})
    assert same(read_calibration(path), RIGS[name])
    with pytest.raises(UsageError, match="exists"):
        write_calibration(path, RIGS[name])
    write_calibration(path, RIGS["common"], force=True)
    assert same(read_calibration(path), RIGS["common"])


def test_the_id_is_the_content_without_the_date() -> None:
    a = RIGS["common"]
    assert dataclasses.replace(a, made_ns=5).id == a.id
    assert dataclasses.replace(a, residual_px=1e-9).id != a.id


def test_a_changed_record_is_refused_and_one_without_an_id_taken(tmp_path: Path) -> None:
    path = tmp_path / "calib.json"
    write_calibration(path, RIGS["common"])
    table = json.loads(path.read_text())
    table["spike"]["K"][0][0] += 1
    path.write_text(json.dumps(table))
    with pytest.raises(DataError, match="changed"):
        read_calibration(path)
    del table["id"]
    path.write_text(json.dumps(table))
    assert read_calibration(path).spike.K[0, 0] == 621


@pytest.mark.parametrize("name", bad_records())
def test_hostile_records_end_in_one_error(name: str, tmp_path: Path) -> None:
    path = tmp_path / "calib.json"
    path.write_bytes(bad_records()[name])
    with pytest.raises(DataError) as caught:
        read_calibration(path)
    assert len(str(caught.value)) < 4000


def test_all_faults_of_a_record_at_once() -> None:
    table = {**as_json(RIGS["common"]), "model": "one", "mirrored": "left", "residual_px": None, "extra": 1}
    with pytest.raises(DataError) as caught:
        calibration_of(table)
    assert all(word in str(caught.value) for word in ("model", "mirrored", "residual_px", "extra"))
    with pytest.raises(UsageError):
        read_calibration("/nowhere/calib.json")


@pytest.mark.parametrize("name", RIGS)
def test_pixels_there_and_back(name: str) -> None:
    c = RIGS[name]
    px = grid(400, 250, 7, 5)
    for depth in (None, 400.0, math.inf):
        back = spike_px_from_rgb_px(c, rgb_px_from_spike_px(c, px, depth), depth)
        np.testing.assert_allclose(back, px, atol=1e-6)
    assert crop_error_px(c, c) < 1e-6
    np.testing.assert_allclose(unmirrored(c, "rgb", unmirrored(c, "rgb", px)), px, atol=1e-12)


@pytest.mark.parametrize("shift", [(0, 0, 0), (15.0, -2.0, 3.0)])
def test_the_homography_is_the_map_of_straight_pictures(shift: tuple[float, float, float]) -> None:
    c = rig(shift)
    straight = dataclasses.replace(
        c,
        spike=dataclasses.replace(c.spike, distortion=np.zeros(0)),
        rgb=dataclasses.replace(c.rgb, distortion=np.zeros(0)),
    )
    px = grid(400, 250, 4, 3)
    for depth in (working_depth_mm(c), 500.0):
        H = crop_homography(straight, depth)
        rgb = rgb_px_from_spike_px(straight, px, depth)
        p = np.concatenate([rgb, np.ones_like(rgb[..., :1])], -1) @ H.T
        np.testing.assert_allclose(p[..., :2] / p[..., 2:], px, atol=1e-9)


def test_parallax_is_what_simple_trigonometry_says() -> None:
    c = rig((10.0, 0, 0))
    near, far = c.depth_mm
    assert working_depth_mm(c) == pytest.approx(2 / (1 / near + 1 / far))
    assert parallax_px(c) == pytest.approx(620 * 10 * (1 / near - 1 / far) / 2, rel=0.05)
    assert parallax_px(rig()) == 0
    with pytest.raises(UsageError, match="depth"):
        crop_homography(c, -1.0)
