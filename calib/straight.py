"""Textures of a scene's raw spikes on its pinhole camera: what its calibration record asks for, and no more.

`calib align` leaves spikes as they were recorded. Where the spike lens bends, or its arm is the mirrored one, pictures
made of them lie elsewhere than the scene's camera says, until they went through here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.align import texture_at
from spikerig.calib.crop import unmirrored
from spikerig.calib.lens import directions, project
from spikerig.calib.rig import RigCalibration, calibration_of
from spikerig.dataset.errors import DataError
from spikerig.dataset.scene import Camera
from spikerig.dataset.texture import Texture

if TYPE_CHECKING:
    from spikerig.dataset.store import SceneFile


@dataclass(frozen=True, slots=True)
class Straight:
    """Where pixels of the pinhole camera come from in raw spike pictures.

    Args:
        mirrored: left and right are swapped first.
        px: float64[H,W,2], the raw pixel of each pixel's centre where the lens bends; None where it does not, so that
            every pixel is one raw pixel and nothing is resampled.
    """

    mirrored: bool = False
    px: NDArray[np.float64] | None = None

    @property
    def resamples(self) -> bool:
        """Whether light is interpolated between raw pixels, so that a single spike no longer has a pixel of its own."""
        return self.px is not None

    def texture(self, raw: Texture) -> Texture:
        """A texture of raw spikes on the pinhole camera; known where all but KNOWN of what a pixel shows is known."""
        if self.px is not None:
            return texture_at(raw, self.px)
        if self.mirrored:
            return Texture(raw.light[:, ::-1], raw.known[:, ::-1], raw.at, raw.method)
        return raw


def straight_of(scene: SceneFile) -> Straight:
    """What textures of a scene's spikes need.

    Args:
        scene: open. One that was not aligned has its spikes on its camera already, as simulated scenes do.

    Raises:
        DataError: the calibration record is damaged, or is of another size of sensor.

    Cost:
        A lens that bends: 30 ms at 400x250, once a scene, and 1 ms a texture. Else nothing, or a flip.
    """
    if "align" not in scene.info or scene.calibration is None:
        return Straight()
    record = calibration_of(dict(scene.calibration), f"{scene.path}: calibration")
    here, there = (record.spike.width, record.spike.height), (scene.camera.width, scene.camera.height)
    if here != there:
        raise DataError("the scene's calibration is of another sensor", value="{}x{}".format(*here),
                        expected="{}x{}, the scene's camera".format(*there), next="spikerig calib align")  # fmt: skip
    return straight(record, scene.camera)


def straight(record: RigCalibration, camera: Camera) -> Straight:
    """The same, of a rig's calibration and the pinhole camera that its scene was aligned to."""
    mirrored = record.mirrored == "spike"
    if not record.spike.distortion.any():
        return Straight(mirrored)
    at = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), -1)
    return Straight(mirrored, unmirrored(record, "spike", project(record.spike, directions(camera, at))))
