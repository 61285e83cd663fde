"""Scenes whose spike arm is mirrored, or bends: what is trained on is what an arm that does neither would give."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hard_sim import small

from spikerig.calib.rig import RigCalibration, as_json
from spikerig.calib.straight import straight_of
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.scene import Camera, Pose
from spikerig.dataset.store import open_scene, write_scene
from spikerig.rigctl.sim.capture import capture
from spikerig.train.gauge import Gauge
from spikerig.train.methods import configure
from spikerig.train.scene_dataset import SceneDataset
from spikerig.train.targets import Targets, load_targets

UNIT = Gauge((0.0, 0.0, 0.0), 1.0)
QUIET: dict[str, Any] = {"exposure__phase": "zero", "camera__width": 64, "camera__height": 40,
                         "shake__path_px": [0, 0.5], "exposure__exposure_ms": 4.0, "sensor__gain": 0.8}  # fmt: skip
K1 = -0.3


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same scene by a plain spike arm, one in a mirror, and one that bends; the last two marked as aligned."""
    folder = tmp_path_factory.mktemp("arms")
    arms: dict[str, list[dict]] = {
        "plain": [],
        "mirror": [{"name": "mirror_flip", "arm": "spike"}],
        "bent": [{"name": "distortion", "arm": "spike", "k1": K1}],
        "both": [{"name": "mirror_flip", "arm": "spike"}, {"name": "distortion", "arm": "spike", "k1": K1}],
    }
    for name, effects in arms.items():
        capture(small(**QUIET, effects=effects), folder / f"{name}.h5", workers=1)
        if name != "plain":
            mark(folder / f"{name}.h5", name in ("mirror", "both"), name in ("bent", "both"))
    return {name: folder / f"{name}.h5" for name in arms}


def mark(path: Path, mirrored: bool, bent: bool) -> None:
    """What `calib align` leaves in the scene's record."""
    with open_scene(path) as file:
        scene = file.read()
    lens = Camera(scene.camera.K, np.array([K1, 0, 0, 0]) if bent else np.zeros(0), 64, 40)
    rig = RigCalibration(lens, scene.camera, Pose(np.eye(4)[:3]), "common", "spike" if mirrored else None)
    record = {**as_json(rig), "id": rig.id}
    write_scene(path, replace(scene, calibration=record, info={**scene.info, "align": {}}), force=True)


def targets(path: Path, method: str = "spike-ratio", **changes: Any) -> Targets:
    with open_scene(path) as scene:
        return load_targets(scene, configure(method, "draft", **changes), UNIT)


@pytest.mark.parametrize("textures", ["both", "tfi-window", "raw"])
def test_a_mirrored_arm_trains_on_the_very_same_textures(scenes: dict[str, Path], textures: str) -> None:
    for method in ("spikenerf", "spike-ratio"):
        want, got = (targets(scenes[k], method, textures=textures) for k in ("plain", "mirror"))
        assert want.gray is not None
        assert want.gray == got.gray
        for a, b in zip(want.views, got.views, strict=True):
            for phase, instant in a.instants.items():
                assert instant.ratio.equal(b.instants[phase].ratio)
                for (light, weight), (other, known) in zip(instant.textures, b.instants[phase].textures, strict=True):
                    assert light.equal(other)
                    assert weight.equal(known)


@pytest.mark.parametrize("arm", ["bent", "both"])
def test_a_lens_that_bends_is_taken_out(scenes: dict[str, Path], arm: str) -> None:
    """Against the plain arm's: nearer by far than bent ones, up to what resampling costs."""
    changes = {"textures": "tfp", "texture_window": 150}
    want, got = (targets(scenes[k], "spikenerf", **changes) for k in ("plain", arm))
    with open_scene(scenes[arm]) as file:
        record = replace(file.read(), info={})
    raw = scenes[arm].with_name(f"raw-{arm}.h5")
    write_scene(raw, record, force=True)
    left = targets(raw, "spikenerf", **changes)
    off = []
    for other in (got, left):
        errors = []
        for a, b in zip(want.views, other.views, strict=True):
            (light, weight), (seen, known) = a.instants[0.5].textures[0], b.instants[0.5].textures[0]
            both = (weight > 0) & (known > 0)
            assert both.float().mean() > 0.9
            errors.append(float((light - seen)[both].square().mean()))
        off.append(np.mean(errors))
    assert off[0] < 0.3 * off[1]


def test_single_spikes_of_a_lens_that_bends_are_refused(scenes: dict[str, Path]) -> None:
    with pytest.raises(UsageError, match="single spikes"):
        targets(scenes["bent"], "spikenerf", textures="raw")
    targets(scenes["bent"], "plain", textures="raw")  # needs no spikes


def test_the_torch_dataset_straightens_too(scenes: dict[str, Path]) -> None:
    plain, mirror = (SceneDataset(scenes[k], window=16)[0] for k in ("plain", "mirror"))
    for name in ("tfp", "tfi", "tfp_known", "tfi_known"):
        assert plain[name].equal(mirror[name])


def test_a_scene_that_was_not_aligned_is_left_alone_and_a_foreign_record_is_refused(
    scenes: dict[str, Path], tmp_path: Path
) -> None:
    with open_scene(scenes["bent"]) as file:
        assert straight_of(file).resamples
        scene = file.read()
    write_scene(tmp_path / "raw.h5", replace(scene, info={}))
    with open_scene(tmp_path / "raw.h5") as file:
        assert not straight_of(file).resamples
    small_camera = replace(scene.camera, width=32)
    rig = RigCalibration(small_camera, small_camera, Pose(np.eye(4)[:3]), "common")
    write_scene(tmp_path / "odd.h5", replace(scene, calibration=as_json(rig)))
    with open_scene(tmp_path / "odd.h5") as file, pytest.raises(DataError, match="another sensor"):
        straight_of(file)
