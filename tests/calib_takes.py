"""Small simulated takes of a rig whose RGB arm is turned, for the tests of alignment."""

from pathlib import Path
from typing import Any

from hard_sim import small

from spikerig.calib.parity import inverse
from spikerig.calib.rig import RigCalibration
from spikerig.dataset.scene import Pose
from spikerig.dataset.store import open_scene
from spikerig.rigctl.sim.capture import capture
from spikerig.rigctl.sim.effects.misalignment import Misalignment

SCENE: dict[str, Any] = {"camera__width": 160, "camera__height": 100, "exposure__exposure_ms": 2.0}
OFF = Misalignment(rotation_deg=(0.8, -1.0, 1.5))


def misaligned(path: Path) -> None:
    """A take whose RGB arm is turned."""
    turned = {"name": "misalignment", "rotation_deg": list(OFF.rotation_deg)}
    capture(small(**SCENE, effects=[turned, "threshold_fpn"]), path, workers=1)


def rig_of(path: Path) -> RigCalibration:
    """The true rig of such a take."""
    with open_scene(path) as scene:
        step = OFF.rgb_from_spike
        return RigCalibration(scene.camera, scene.camera, Pose(inverse(step)), "common", None, (1000.0, 5000.0))
