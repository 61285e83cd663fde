"""Two calibrations held against each other: known differences come out as such."""

from dataclasses import replace

import numpy as np
import pytest
from calib_rigs import rig

from spikerig.calib.bundle import turn
from spikerig.calib.compare_cli import apart
from spikerig.dataset.errors import UsageError
from spikerig.dataset.scene import Camera, Pose


def test_a_calibration_is_no_way_from_itself() -> None:
    for mirrored, shift in ((None, (0, 0, 0)), ("rgb", (0, 0, 0)), ("spike", (12.0, 0, 3.0))):
        told = apart(rig(shift, mirrored), rig(shift, mirrored))
        assert told["crop_px"]["max"] < 1e-6
        assert told["lens_px"]["max"] < 1e-6
        assert told["focal_ratio"] == {"spike": 1.0, "rgb": 1.0}
        assert told["turn_deg"] == told["shift_mm"] == 0
        assert told["same_mirror"] is True


def test_known_differences_are_told_in_their_units() -> None:
    true = rig(lens=())
    moved = replace(true, rgb=Camera(true.rgb.K + np.eye(3)[:1].T * [0, 0, 3.0], true.rgb.distortion,
                                     true.rgb.width, true.rgb.height))  # fmt: skip
    ratio = true.spike.K[0, 0] / true.rgb.K[0, 0]
    assert apart(moved, true)["crop_px"]["median"] == pytest.approx(3 * ratio, rel=0.05)
    turned = true.spike_from_rgb.cam_from_world.copy()
    turned[:, :3] = turn(np.radians([0, 0.25, 0])) @ turned[:, :3]
    told = apart(replace(true, spike_from_rgb=Pose(turned)), true)
    assert told["turn_deg"] == pytest.approx(0.25)
    assert told["crop_px"]["median"] == pytest.approx(true.spike.K[0, 0] * np.radians(0.25), rel=0.05)
    longer = replace(true, spike=replace(true.spike, K=true.spike.K * [[1.01, 1, 1], [1, 1.01, 1], [1, 1, 1]]))
    assert apart(longer, true)["focal_ratio"]["spike"] == pytest.approx(1.01)
    assert apart(rig((5.0, 0, 0)), rig((2.0, 0, 0)))["shift_mm"] == pytest.approx(3.0)
    assert apart(rig(mirrored="rgb"), rig())["same_mirror"] is False


def test_other_sensors_are_refused() -> None:
    with pytest.raises(UsageError, match="other sensors"):
        apart(rig(), rig(rgb_width=480))
