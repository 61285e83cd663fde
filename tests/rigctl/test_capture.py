"""A scene from viewpoint to file: truth, points, timing, seeds, workers, the command."""

import json
from pathlib import Path

import numpy as np
import pytest
from hard_sim import small, small_table

from spikerig.dataset.cli import run
from spikerig.dataset.errors import HostError, NumericsError, UsageError
from spikerig.dataset.kernels import count
from spikerig.dataset.scene import Scene
from spikerig.dataset.store import open_scene, verify_scene
from spikerig.rigctl.sim import farm
from spikerig.rigctl.sim.capture import camera_of, capture, take_view, view_path
from spikerig.rigctl.sim.caster.light import Stage
from spikerig.rigctl.sim.rgb import encode
from spikerig.rigctl.sim.spec import SceneSpec
from spikerig.rigctl.sim.take import in_parallel, share_of


def captured(tmp_path: Path, spec: SceneSpec, name: str = "s.h5", workers: int = 1) -> Scene:
    capture(spec, tmp_path / name, workers=workers)
    with open_scene(tmp_path / name) as file:
        return file.read()


def test_a_scene_is_whole(tmp_path: Path) -> None:
    spec = small()
    scene = captured(tmp_path, spec)
    assert [v.split for v in scene.views] == ["train", "train", "test", "train"]
    assert scene.light_gain == pytest.approx(0.4)
    assert scene.truth is not None
    assert scene.truth.label == "mid"
    assert set(scene.truth.effects) == {e.name for e in spec.effects}
    assert scene.points is not None
    assert scene.points.source == "simulator"
    assert len(scene.points.xyz) == 100
    stage = Stage(spec.world)
    for number, view in enumerate(scene.views):
        path = view_path(spec, number)
        assert np.allclose(view.pose.cam_from_world, path.poses(0.5)[0])
        sharp = stage.picture(camera_of(spec), path.poses(0.5)[0], 2)
        assert np.array_equal(scene.truth.light[view.name], sharp)
        begin = (number + 1) * 1_000_000_000
        assert scene.truth.at_ns[view.name] == begin + 500_000
        assert scene.truth.trajectories[view.name].at_ns[[0, -1]].tolist() == [begin, begin + 1_000_000]
        if view.split == "test":
            assert view.spikes is None
            assert view.trajectory is None
            assert view.frame.exposure_ns == 0
            assert view.frame.start_ns == begin + 500_000
            assert np.array_equal(view.frame.pixels, encode(sharp))
            continue
        assert view.spikes is not None
        assert view.spikes.ticks == 40 + 2 * 16
        assert view.spikes.t0_ns == begin - 16 * 25_000
        assert view.frame.start_ns == begin
        assert view.frame.exposure_ns == 1_000_000
        assert view.mid_ns == begin + 500_000
        assert view.trajectory is not None
        assert np.array_equal(view.trajectory.poses, path.poses((view.trajectory.at_ns - begin) / 1e6))
    assert verify_scene(tmp_path / "s.h5") == []


def test_spikes_and_frame_see_the_same_light() -> None:
    """Spikes of the exposure / ticks = gain * response . linear blurry light, without effects, to one spike."""
    spec = small(effects=[], exposure__phase="zero", exposure__exposure_ms=8.0, exposure__sub_poses=33)
    taken = take_view(spec, 0)
    stage, path, gray = Stage(spec.world), view_path(spec, 0), np.array(spec.sensor.response)
    many = np.mean([stage.picture(camera_of(spec), p, 2) @ gray for p in path.poses(np.linspace(0, 1, 81))], axis=0)
    spikes = taken.view.spikes
    assert spikes is not None
    seen = count(spikes.bits, 29, 16, 16 + 320)
    assert np.abs(seen - 320 * 0.4 * many).mean() < 0.75
    assert np.abs(seen - 320 * 0.4 * many).max() < 6
    assert taken.spikes_mean == pytest.approx(seen.mean())
    assert taken.spikes_max == seen.max()


def test_blur_comes_from_the_shake() -> None:
    still, shaken = (take_view(small(effects=[], shake__path_px=[p, p]), 1) for p in (0, 8))
    assert np.array_equal(still.view.frame.pixels, encode(still.light))
    assert still.blur_db > 100
    assert shaken.blur_db < 35
    assert np.array_equal(still.light, shaken.light)  # the label is mid-exposure: the same pose


def test_the_first_pose_as_label() -> None:
    mid, first = (take_view(small(exposure__label=label), 1) for label in ("mid", "first"))
    path = view_path(small(), 1)
    assert np.allclose(first.view.pose.cam_from_world, path.poses(0)[0])
    assert first.at_ns == first.view.frame.start_ns
    assert np.array_equal(first.view.frame.pixels, mid.view.frame.pixels)
    assert first.blur_db < mid.blur_db - 1
    assert not np.array_equal(first.light, mid.light)


def test_the_papers_protocol() -> None:
    spec = small(exposure={"protocol": "paper", "phase": "zero"}, effects=[])
    taken = take_view(spec, 0)
    spikes = taken.view.spikes
    assert spikes is not None
    assert spikes.ticks == 18
    stage, path = Stage(spec.world), view_path(spec, 0)
    level = [
        stage.picture(camera_of(spec), p, 2) @ spec.sensor.response for p in path.poses((np.arange(18) + 0.5) / 18)
    ]
    charge, bits = np.zeros((18, 29)), []
    for light in level:  # Eq. 5 and 6 with threshold 2
        charge = charge + light
        bits.append(charge >= 2)
        charge = np.where(charge >= 2, charge - 2, charge)
    got = np.unpackbits(spikes.bits, axis=2, bitorder="little", count=29)
    assert (got != np.array(bits)).mean() < 2e-3  # float32 against float64: only crossings within rounding


def test_points_lie_on_surfaces(tmp_path: Path) -> None:
    spec = small(points__depth_noise=0.0, points__count=400)
    scene = captured(tmp_path, spec)
    assert scene.points is not None
    q = scene.points.xyz
    ball = np.abs(np.linalg.norm(q - [0, 0, 0.4], axis=1) - 0.4)
    walls = np.minimum(np.abs(np.abs(q[:, :2]) - 3).min(1), np.minimum(np.abs(q[:, 2]), np.abs(q[:, 2] - 2.6)))
    c, s = np.cos(np.radians(20)), np.sin(np.radians(20))
    local = (q - [0.7, 0.6, 0.3]) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]).T
    box = np.abs(np.max(np.abs(local) - [0.2, 0.25, 0.3], axis=1))
    panel = np.abs((q - [-0.7, 0.7, 0.5])[:, 1])
    off = np.minimum.reduce([ball, walls, box, panel])
    assert off.max() < 1e-5
    assert (ball < 1e-5).sum() > 20
    noisy = captured(tmp_path, small(points__depth_noise=0.01, points__count=400), "n.h5").points
    assert noisy is not None
    centre = -view_path(spec, 0).base[:, :3].T @ view_path(spec, 0).base[:, 3]
    first = slice(0, share_of(400, 0, 3))
    ratio = np.linalg.norm(noisy.xyz[first] - centre, axis=1) / np.linalg.norm(q[first] - centre, axis=1)
    assert ratio.std() == pytest.approx(0.01, rel=0.2)


def test_shares_sum_to_the_whole() -> None:
    assert sum(share_of(7200, k, 7) for k in range(7)) == 7200
    assert sum(share_of(3, k, 7) for k in range(7)) == 3


def test_bits_do_not_depend_on_workers_and_do_on_the_seed(tmp_path: Path) -> None:
    digests = []
    for name, spec, workers in (("a", small(), 1), ("b", small(), 2), ("c", small(seed=6), 1)):
        capture(spec, tmp_path / name, workers=workers)
        import h5py

        with h5py.File(tmp_path / name) as file:
            digests.append(bytes(file["views"].attrs["sha256"]))
    assert digests[0] == digests[1] != digests[2]


def _dies(job: object, number: int) -> int:
    import os

    if number == 1:
        os._exit(9)
    return number


def test_a_dead_worker_is_told() -> None:
    with pytest.raises(HostError, match="worker process died"):
        list(in_parallel(_dies, None, 4, 2))


def test_the_command(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "small.toml"
    file.write_text(
        'seed = 3\neffects = ["dark_current"]\n[camera]\nwidth = 16\nheight = 9\n[orbit]\nviews = 3\n'
        "[exposure]\nexposure_ms = 0.5\nsub_poses = 3\nmargin_ticks = 8\n[points]\ncount = 10\n"
        '[[world.solids]]\nkind = "sphere"\ncentre = [0, 0, 0]\nradius = 0.5\n'
    )
    out = tmp_path / "s.h5"
    words = ["sim", "capture", str(file), "-o", str(out), "--workers", "1", "--json"]
    assert run(words) == 0
    told = json.loads(capfd.readouterr().out)
    assert told["schema"] == "spikerig.sim.capture/1"
    assert (told["scene"], told["train_views"], told["test_views"], told["ticks"]) == ("small", 2, 1, 20)
    assert told["pose_label"] == "mid"
    assert run(words) == 2
    assert "exists already" in json.loads(capfd.readouterr().out)["error"]["what"]
    assert run([*words, "--force", "--seed", "9", "--views", "5"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert (told["seed"], told["train_views"] + told["test_views"]) == (9, 5)
    assert run(["sim", "capture", "demoo", "-o", str(tmp_path / "x.h5")]) == 2
    assert "did you mean 'demo'" in capfd.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["s.h5", "small.toml"]


def test_an_interrupted_capture_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop() -> None:
        raise KeyboardInterrupt

    out = tmp_path / "s.h5"
    with pytest.raises(KeyboardInterrupt):
        capture(small(), out, done=stop)
    assert [p.name for p in tmp_path.iterdir()] == ["s.h5.views"]
    assert sorted(p.name for p in (tmp_path / "s.h5.views").iterdir()) == ["000000.npz", "made.json"]
    with pytest.raises(UsageError, match="unfinished views of another run") as caught:
        capture(small(seed=6), out)
    assert "seed: 5 there, 6 here" in str(caught.value)
    (tmp_path / "s.h5.partial").write_bytes(b"what a kill while sealing leaves")
    made, steps = [], []
    monkeypatch.setattr(farm, "take_view", lambda spec, number: made.append(number) or take_view(spec, number))
    capture(small(), out, done=lambda: steps.append(1))
    assert made == [1, 2, 3]
    assert len(steps) == 4
    assert [p.name for p in tmp_path.iterdir()] == ["s.h5"]
    capture(small(), tmp_path / "t.h5")
    assert (tmp_path / "t.h5").read_bytes() == out.read_bytes()


def test_a_failure_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(spec: SceneSpec, number: int) -> None:
        raise NumericsError("light must be finite")

    monkeypatch.setattr(farm, "take_view", fail)
    with pytest.raises(NumericsError):
        capture(small(), tmp_path / "s.h5")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "s.h5").write_text("something of the user's")
    with pytest.raises(UsageError):
        capture(small(), tmp_path / "s.h5")
    assert (tmp_path / "s.h5").read_text() == "something of the user's"


def test_the_recorded_scene_file_is_the_one_read(tmp_path: Path) -> None:
    scene = captured(tmp_path, small())
    told = scene.info["scene_file"]
    assert told["exposure"]["sub_poses"] == 5
    assert told["effects"]["shot_noise"]["threshold_e"] == 560
    assert len(told["world"]["solids"]) == len(small_table()["world"]["solids"])
