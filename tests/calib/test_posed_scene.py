"""Poses into a scene, in place: whole or not at all, and with a record of where they come from."""

import dataclasses
import hashlib
import os
from pathlib import Path

import numpy as np
import pytest

from spikerig.calib.consensus import Path as Course
from spikerig.calib.mapping import Map, Placed
from spikerig.calib.posed_scene import write_poses
from spikerig.calib.poses import Estimate
from spikerig.dataset.errors import HostError, UsageError
from spikerig.dataset.scene import Pose
from spikerig.dataset.store import SceneWriter, open_scene, verify_scene
from spikerig.rigctl.sim.capture import capture
from spikerig.rigctl.sim.spec import load_scene_toml


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    spec = load_scene_toml("demo")
    orbit = dataclasses.replace(spec.orbit, views=4, arc_deg=20.0, test_every=0, test=())
    path = tmp_path / "four.h5"
    capture(dataclasses.replace(spec, orbit=orbit, exposure=dataclasses.replace(spec.exposure, sub_poses=3)), path)
    return path


def estimate(path: Path, left_out: str = "") -> Estimate:
    """The true poses in another world: twice as large."""
    with open_scene(path) as file:
        names = file.names
        poses = {n: np.array(file.view(n).pose.cam_from_world) for n in names if n != left_out}
    for pose in poses.values():
        pose[:, 3] *= 2
    return Estimate(tuple(names), poses, {}, Map({n: Placed(p, 9) for n, p in poses.items()}), ("tfp96",))


@pytest.mark.parametrize("stop", [KeyboardInterrupt, OSError("disk full")])
def test_an_interrupted_write_leaves_the_scene_as_it_was(scene: Path, stop: type[BaseException]) -> None:
    before, seen = scene.read_bytes(), []

    def after_two() -> None:
        seen.append(len(list(scene.parent.iterdir())))
        if len(seen) == 2:
            raise stop

    with pytest.raises((KeyboardInterrupt, HostError)):
        write_poses(scene, estimate(scene), {}, done=after_two)
    assert seen[1] > 1  # the new one was being written beside
    assert scene.read_bytes() == before
    assert [p.name for p in scene.parent.iterdir()] == [scene.name]


def test_a_killed_write_leaves_the_scene_as_it_was(scene: Path) -> None:
    before, child = scene.read_bytes(), os.fork()
    if child == 0:
        write_poses(scene, estimate(scene), {}, done=lambda: os._exit(9))
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9
    assert scene.read_bytes() == before
    assert verify_scene(scene) == []


def test_in_place_with_a_record(scene: Path) -> None:
    found = estimate(scene, left_out="002")
    told = write_poses(scene, found, {"options": {"seed": 1}})
    assert told["left_out"] == ["002"]
    assert told["scale"] == pytest.approx(0.5)
    assert verify_scene(scene) == []
    assert [p.name for p in scene.parent.iterdir()] == [scene.name]
    total = hashlib.sha256()
    for name, pose in sorted(found.poses.items()):
        total.update(name.encode() + b"\0" + np.ascontiguousarray(pose, "<f8").tobytes())
    with open_scene(scene) as file:
        assert file.names == ["000", "001", "003"] or tuple(file.names) == ("000", "001", "003")
        record = file.info["poses"]
        assert record["options"] == {"seed": 1}
        assert record["sha256"]["poses"] == total.hexdigest()
        spikes = record["sha256"]["spikes"]
    write_poses(scene, dataclasses.replace(found, images=("000", "001")), {})
    with open_scene(scene) as file:
        assert file.info["poses"]["sha256"]["spikes"] not in (spikes, "")


def test_another_file_is_not_replaced_unasked(scene: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.h5"
    other.write_bytes(b"mine")
    with pytest.raises(UsageError, match="exists"):
        write_poses(scene, estimate(scene), {}, out=other)
    assert other.read_bytes() == b"mine"


def test_a_take_without_poses_gets_the_maps_world(scene: Path, tmp_path: Path) -> None:
    """As ingested: every view at one place. Metres by the board; a view that was not mapped has no place, and goes."""
    found, fresh, posed = estimate(scene, left_out="003"), tmp_path / "fresh.h5", tmp_path / "posed.h5"
    found = dataclasses.replace(found, images=tuple(found.poses))
    with open_scene(scene) as file, SceneWriter(fresh, file.name, file.camera, light_gain=file.light_gain) as writer:
        for name in file.names:
            writer.add(dataclasses.replace(file.view(name), pose=Pose(np.eye(3, 4)), trajectory=None))
    told = write_poses(fresh, found, {}, out=posed, mm_per_unit=500.0)
    assert told["left_out"] == ["003"]
    assert told["world"] == {"of": "the map", "metres_per_unit": 1.0}
    with open_scene(posed) as file:
        assert set(file.names) == {"000", "001", "002"}
        for name in file.names:
            there = found.poses[name]
            assert np.allclose(file.view(name).pose.cam_from_world[:, :3], there[:, :3])
            assert np.allclose(file.view(name).pose.cam_from_world[:, 3], there[:, 3] / 2)
    assert write_poses(fresh, found, {}, out=posed, force=True)["world"]["metres_per_unit"] is None


def test_an_earlier_world_is_kept_or_made_metres(scene: Path, tmp_path: Path) -> None:
    """The estimate is twice as large as the scene, and a unit of it 250 mm: a unit of the scene is half a metre."""
    found = estimate(scene)
    held = dataclasses.replace(
        found, images=("000", "001", "002"), poses={n: found.poses[n] for n in ("000", "001", "002")}
    )
    assert write_poses(scene, held, {}, out=tmp_path / "kept.h5", mm_per_unit=250.0)["world"] == {
        "of": "earlier poses",
        "metres_per_unit": pytest.approx(0.5),
    }
    told = write_poses(scene, held, {}, out=tmp_path / "metres.h5", mm_per_unit=250.0, rescale=True)
    assert told["world"]["metres_per_unit"] == 1.0
    assert told["world"]["rescaled_by"] == pytest.approx(0.5)
    with open_scene(scene) as before, open_scene(tmp_path / "kept.h5") as kept, open_scene(told["written"]) as after:
        for name in before.names:
            was, same, now = (f.view(name).pose.cam_from_world for f in (before, kept, after))
            assert np.allclose(same, was, atol=1e-9)
            assert np.allclose(now[:, :3], was[:, :3], atol=1e-9)
            assert np.allclose(now[:, 3], was[:, 3] / 2, atol=1e-9)  # held out or not
            assert np.allclose(
                after.truth_trajectory(name).poses[:, :, 3], before.truth_trajectory(name).poses[:, :, 3] / 2
            )
    with pytest.raises(UsageError, match="metres are not known"):
        write_poses(scene, held, {}, out=tmp_path / "no.h5", rescale=True)
    assert not (tmp_path / "no.h5").exists()


def test_a_path_grows_with_its_world(scene: Path, tmp_path: Path) -> None:
    found = estimate(scene)
    still = {
        n: Course(np.array([0.0, 1.0]), np.stack([p, p]), np.stack([np.eye(6)] * 2), None)
        for n, p in found.poses.items()
    }
    told = write_poses(scene, dataclasses.replace(found, paths=still), {}, out=tmp_path / "out.h5")
    with open_scene(told["written"]) as file:
        path = file.view("000").trajectory
        assert path is not None
        assert path.cov is not None
        assert np.allclose(np.diag(path.cov[0]), [1, 1, 1, 0.25, 0.25, 0.25])
        assert np.allclose(path.poses[0], file.view("000").pose.cam_from_world)
