"""Rolling shutters: the instant of every pixel, its pose and its textures, and what that is worth."""

import tomllib
from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest
import torch

from spikerig.calib.rolling import tfp_rows
from spikerig.dataset.images import linear_from_srgb
from spikerig.dataset.store import open_scene
from spikerig.dataset.texture import tfp
from spikerig.rigctl.sim.capture import capture
from spikerig.rigctl.sim.caster.light import stage_of
from spikerig.rigctl.sim.spec import read_scene
from spikerig.train.fit import new_state, train
from spikerig.train.methods import configure
from spikerig.train.rolling import late_of, poses_at, row_poses, textures_by_row
from spikerig.train.run import prepare
from spikerig.train.spikelight import spike_tick
from spikerig.train.trajectory import sub_pose

FAST = {"rays": 256, "coarse": 48, "probes": 16, "fine": 8, "width": 16, "grid_levels": 6, "finest": 64,
        "table_log2": 12, "occupancy": 32}  # fmt: skip


def demo():
    """The demo's scene with a strong shake, read out over almost a whole exposure, 64x40."""
    table = tomllib.loads(files("spikerig.rigctl.sim").joinpath("scenes/demo.toml").read_text(encoding="utf-8"))
    table["name"] = "rolled"
    table["camera"] |= {"width": 64, "height": 40}
    table["orbit"] |= {"views": 4, "test_every": 4}
    table["points"] |= {"count": 1500}
    table["shake"] |= {"path_px": [8.0, 10.0], "curvature": 0.1}
    table["effects"] = [{"name": "rolling_shutter", "readout_ms": 7.5}]
    table.pop("consider", None)
    return table


@pytest.fixture(scope="module")
def rolled(tmp_path_factory):
    """That scene's file."""
    path = tmp_path_factory.mktemp("rolling") / "rolled.h5"
    capture(read_scene(demo()), path)
    return path


@pytest.fixture
def view(rolled):
    with open_scene(rolled) as scene:
        return scene.view(scene.train[0])


def test_every_pixel_has_the_pose_of_its_own_instant(view):
    late = late_of(view)
    assert late is not None
    assert late.min() < -0.4
    assert late.max() > 0.4
    assert late[len(late) // 2, 0] == 0
    poses = torch.from_numpy(row_poses(view, 0.3, late))
    pixels = torch.tensor([0, 5 * 64 + 3, 20 * 64, 39 * 64 + 63])
    found = poses_at(poses, torch.from_numpy(late), pixels).numpy()
    frame = view.frame
    for pixel, pose in zip(pixels.tolist(), found, strict=True):
        row = view.sensor_row.reshape(-1)[pixel]
        own = frame.start_ns + float(row) * frame.row_ns + 0.3 * frame.exposure_ns
        middle = view.instant_ns(0.3)
        exact = sub_pose(view, 0.3 + (own - middle) / frame.exposure_ns)
        assert np.abs(pose - exact).max() < 5e-5  # 0.003 of a pixel here, at kinks of the given path
    assert np.abs(found[0] - sub_pose(view, 0.3)).max() > 1e-3  # the middle row's is another


def test_a_global_shutter_has_no_lateness(view):
    assert late_of(replace(view, frame=replace(view.frame, row_ns=0))) is None
    assert late_of(replace(view, trajectory=None)) is None
    one = torch.eye(4)[:3]
    assert torch.equal(poses_at(one, None, torch.arange(3)), one.expand(3, 3, 4))


@pytest.mark.parametrize("whole", [False, True])
def test_textures_follow_the_rows(view, whole):
    """TFP row by row is calib's, made another way, up to the ticks that share a texture; the middle row's is not."""
    late = late_of(view)
    assert late is not None
    window = 160  # long, so that single spikes weigh little
    (found,) = textures_by_row(
        view.spikes, late, lambda later: spike_tick(view, view.instant_ns(0.5 + later), None),
        lambda stream, tick: [tfp(stream, tick, window)], whole=whole,
    )  # fmt: skip
    truth = tfp_rows(view.spikes, view.frame, view.sensor_row, 0.5, window)
    middle = tfp(view.spikes, spike_tick(view, view.instant_ns(0.5), None), window)
    both = found.known & truth.known
    assert both.all()
    assert np.abs(found.light - truth.light).max() < 4 / window
    ends = np.r_[0:4, 36:40]
    assert np.abs(found.light - truth.light)[ends].mean() < 0.3 * np.abs(middle.light - truth.light)[ends].mean()


def test_rows_of_their_own_explain_the_frame_and_the_middle_rows_does_not(rolled, view):
    """The world drawn from each row's own poses over its exposure is the frame; from the middle row's it is skewed."""
    spec = read_scene(demo())
    stage, late = stage_of(spec.world), torch.from_numpy(late_of(view))
    with open_scene(rolled) as scene:
        camera = scene.camera
    rows, times = np.array([1, 6, 33, 38]), np.linspace(0.05, 0.95, 10)
    errors = {}
    for name in ("own", "middle"):
        made = np.zeros((len(rows), 64, 3))
        for phase in times:
            poses = torch.from_numpy(row_poses(view, phase, late.numpy()))
            for k, pose in enumerate(poses_at(poses, late, torch.from_numpy(rows * 64)).numpy()):
                pose = pose if name == "own" else sub_pose(view, phase)
                made[k] += stage.picture(camera, pose, spec.lens.samples)[rows[k]] / len(times)
        light = linear_from_srgb(view.frame.pixels[rows] / view.frame.full)
        errors[name] = np.sqrt(np.mean((made - light) ** 2))
    assert errors["own"] < 0.01
    assert errors["own"] < 0.25 * errors["middle"], errors


def test_what_was_done_with_the_rows_is_told(rolled, monkeypatch):
    config = configure("average", "draft", "nerf-fast", **FAST)
    with open_scene(rolled) as scene:
        remarks = prepare(scene, rolled, config)[1]["remarks"]
        monkeypatch.setattr("spikerig.train.rolling.late_of", lambda view: None)
        told = prepare(scene, rolled, config)[1]["remarks"]
    assert "every row has its own instant" in remarks[0]
    assert "fast shake skews" in told[0]


def test_spike_methods_train_on_rows_and_splats_keep_the_middle_one(rolled):
    config = configure("spikenerf-5x", "draft", "nerf-fast", **FAST, steps=2)
    with open_scene(rolled) as scene:
        task, _ = prepare(scene, rolled, config)
        splats, record = prepare(scene, rolled, configure("spikenerf", "draft"))
    train(new_state(None, task), task)
    assert all(view.late is not None and view.instants[0.5].pose.shape == (33, 3, 4) for view in task.targets.views)
    assert all(view.late is None and view.instants[0.5].pose.shape == (3, 4) for view in splats.targets.views)
    assert "nerf-fast follow the rows" in record["remarks"][0]
