"""Ours: intervals between spikes, restored targets where the answer is known, light above white, every field."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from spikerig.calib.straight import Straight
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.images import srgb_from_linear
from spikerig.dataset.spikes import SpikeStream
from spikerig.dataset.store import open_scene, write_scene
from spikerig.train import restore
from spikerig.train.fit import Task, new_state, one_step
from spikerig.train.gauge import Gauge
from spikerig.train.losses import linear_from_srgb
from spikerig.train.methods import configure
from spikerig.train.metrics import psnr
from spikerig.train.run import prepare
from spikerig.train.targets import load_targets
from spikerig.train.trajectory import sub_pose

UNIT = Gauge((0.0, 0.0, 0.0), 1.0)


def task_of(path, **changes) -> Task:
    config = configure("ours", "draft", **changes)
    with open_scene(path) as scene:
        targets = load_targets(scene, config, UNIT)
        return Task(config, scene.camera, UNIT, targets, torch.tensor([*targets.gray.weights, targets.gray.bias]))


def stream(rates: np.ndarray, ticks: int = 640) -> SpikeStream:
    total = np.cumsum(np.broadcast_to(rates, (ticks, *rates.shape[-2:])), 0)
    on = np.floor(total) > np.floor(total - rates)
    return SpikeStream(np.packbits(on, axis=2, bitorder="little"), rates.shape[-1], 40_000.0)


def test_intervals_of_steady_light_are_that_light_within_their_doubt():
    rates = np.array([[0.9, 0.41, 0.11, 0.03, 0.011]])
    found = restore.intervals_at(stream(rates), 320, 24, Straight())
    error = found.light / rates - 1
    assert np.abs(error).max() < 0.1
    assert (np.abs(error) < 4 * np.sqrt(found.variance)).all()
    assert (found.first <= 320).all()
    assert (found.last >= 320).all()
    assert ((found.last - found.first)[:, :3] <= 24).all()  # as long as the window allows


def test_a_pixel_without_an_interval_is_not_known():
    found = restore.intervals_at(stream(np.array([[0.5, 1e-4]])), 320, 24, Straight())
    assert found.light[0, 1] == 0
    assert found.light[0, 0] > 0


def test_an_interval_is_the_mean_of_what_it_covers():
    grays = [torch.full((1, 3), float(v)) for v in (1, 2, 4, 8)]
    first, last = torch.tensor([[0.25, 0.125, -0.5]]), torch.tensor([[0.5, 0.375, 0.25]])
    assert restore.covered(grays, first, last)[0].tolist() == pytest.approx([2.0, 1.5, 1.0])


def test_the_gain_trusts_the_better_of_model_and_spikes():
    known = torch.ones(50, 80, dtype=torch.bool)
    noise = torch.from_numpy(np.random.default_rng(0).normal(0, 0.1, (50, 80)))
    clean = restore.kalman(noise, torch.full((50, 80), 0.01), known)  # all that is seen is the spikes' noise
    assert clean.max() < 0.1
    wrong = restore.kalman(noise + 0.5, torch.full((50, 80), 0.01), known)
    assert wrong.min() > 0.9


def test_what_is_missing_is_a_factor_and_clipped_channels_are_at_least():
    lights = [torch.full((1, 1, 3), v) for v in (0.2, 0.6)]
    frame = torch.tensor([[[0.8, 0.2, 0.2]]])
    factor = restore.missing(frame, None, lights)
    assert factor[0, 0].tolist() == pytest.approx([2, 0.5, 0.5], rel=0.01)
    clipped = torch.tensor([[[True, True, False]]])
    assert restore.missing(frame, clipped, lights)[0, 0].tolist() == pytest.approx([2, 1, 0.5], rel=0.01)


@pytest.fixture(scope="module")
def views_of_truth(tiny):
    """Per training view: the sharp light at the middle instant."""
    with open_scene(tiny) as scene:
        return {n: scene.truth_light(n).astype(np.float32) for n in scene.train}


def target_psnr(task: Task, truth: dict, lights_of, early: bool) -> float:
    flat = restore.start(task)["flat"]
    found = []
    for view in task.targets.views:
        made = restore.restored(view, 2, lights_of(view), flat, task, early).numpy()
        found.append(psnr(np.clip(made, 0, 1), srgb_from_linear(truth[view.name]).clip(0, 1)))
    return float(np.mean(found))


def test_targets_are_near_the_truth_and_nearer_with_the_model_s_colour(tiny, views_of_truth):
    task = task_of(tiny)
    blurred = np.mean([
        psnr(v.frame.numpy(), srgb_from_linear(views_of_truth[v.name]).clip(0, 1)) for v in task.targets.views
    ])  # fmt: skip
    gray = torch.tensor([0.299, 0.587, 0.114])

    def colourless(view):  # a model with the right gray and no colour
        one = (torch.from_numpy(views_of_truth[view.name]) @ gray)[..., None].expand(-1, -1, 3)
        return [one] * 5

    early = target_psnr(task, views_of_truth, colourless, early=True)
    assert early > blurred + 3
    right = target_psnr(task, views_of_truth, lambda v: [torch.from_numpy(views_of_truth[v.name])] * 5, early=False)
    assert right > blurred + 2  # a still model under a moving frame; the spikes hold its gray
    assert target_psnr(task, views_of_truth, colourless, early=False) > blurred + 2  # colour came from the frame


def test_a_model_that_explains_everything_is_left_alone(tiny):
    """With frames and intervals made of the model's own light, the target is the render."""
    task = task_of(tiny)
    rng = np.random.default_rng(1)
    lights = [torch.from_numpy(rng.uniform(0.1, 0.8, (40, 64, 3)).astype(np.float32)) for _ in range(5)]
    view = task.targets.views[0]
    frame = torch.from_numpy(srgb_from_linear(torch.stack(lights).mean(0).numpy()).astype(np.float32))
    seen = [restore.gray_light(light, task.gray) for light in lights]
    first, last = torch.full((40, 64), 0.3), torch.full((40, 64), 0.7)
    said = restore.covered(seen, first, last) * task.targets.gray.white
    beside = dict(view.beside) | {"instant 2": torch.stack([said, torch.full_like(said, 1e-3), first, last], -1)}
    view = replace(view, frame=frame, beside=beside)
    made = restore.restored(view, 2, lights, torch.ones(40, 64), task, early=False)
    assert float((linear_from_srgb(made) - lights[2]).abs().max()) < 2e-3
    doubled = {"instant 2": torch.stack([said * 2, torch.full_like(said, 1e-3), first, last], -1)}
    keen = restore.restored(replace(view, beside=beside | doubled), 2, lights, torch.full((40, 64), 2.0), task, False)
    assert float((linear_from_srgb(keen) - lights[2]).abs().max()) < 2e-3  # pixels twice as sensitive
    dark = {"instant 2": torch.stack([said / 2, torch.full_like(said, 1e-3), first, last], -1)}
    halved = restore.restored(replace(view, beside=beside | dark), 2, lights, torch.ones(40, 64), task, early=False)
    assert float((linear_from_srgb(halved) / lights[2]).mean()) == pytest.approx(0.5, abs=0.03)


def test_light_above_white_is_kept_or_clipped(tiny):
    task = task_of(tiny)
    view = task.targets.views[0]
    bright = torch.full((40, 64), 3.0 * task.targets.gray.white)
    held = torch.stack([bright, torch.full_like(bright, 1e-4), bright * 0 + 0.3, bright * 0 + 0.5], -1)
    view = replace(view, frame=torch.ones(40, 64, 3), beside=dict(view.beside) | {"instant 2": held})
    white = [torch.ones(40, 64, 3)] * 5
    for early in (True, False):
        kept = linear_from_srgb(restore.restored(view, 2, white, torch.ones(40, 64), task, early))
        assert float(kept.mean()) == pytest.approx(3, rel=0.03)
    clip = Task(replace(task.config, highlights="clip"), task.camera, UNIT, task.targets, task.gray)
    assert float(restore.restored(view, 2, white, torch.ones(40, 64), clip, True).max()) == pytest.approx(1)


def test_the_flat_field_is_the_sensor_s(tiny, tmp_path):
    """Fixed pattern: a pixel that fires twice as often has twice the sensitivity, whatever it sees."""
    task = task_of(tiny)
    views = tuple(
        replace(v, beside=dict(v.beside) | {"mean": v.beside["mean"] * torch.where(torch.arange(64) < 32, 2.0, 1.0)})
        for v in task.targets.views
    )
    flat = restore.start(Task(task.config, task.camera, UNIT, replace(task.targets, views=views), task.gray))["flat"]
    was = restore.start(task)["flat"]
    assert (flat / was)[:, :32].mean() == pytest.approx(2, rel=0.01)
    assert (flat / was)[:, 32:].mean() == pytest.approx(1, rel=0.01)
    assert float(was.std()) == pytest.approx(0.04, abs=0.03)  # the simulated sensor's


def test_unknown_pixels_take_the_frame_s_word(tiny):
    task = task_of(tiny)
    view = task.targets.views[0]
    beside = dict(view.beside) | {"instant 2": torch.zeros(40, 64, 4)}
    made = restore.restored(replace(view, beside=beside), 2, [], torch.ones(40, 64), task, early=True)
    assert float((made - view.frame).abs().max()) < 1e-4


@pytest.mark.parametrize("field", ["splat", "nerf-fast"])
def test_ours_trains_every_field(tiny, field):
    changes = {"splats": 600} if field == "splat" else {"rays": 64, "fine": 16}
    config = configure("ours", "draft", field, steps=24, **changes)
    with open_scene(tiny) as scene:
        task, record = prepare(scene, tiny, config)
        state = new_state(scene.points, task)
    assert record["renders_per_step"] == {"ratio": 0, "average": 5}
    losses = [one_step(state, task, k / 24) for k in range(24)]
    assert np.mean(losses[-5:]) < np.mean(losses[:5])
    assert torch.equal(state.params["restore:flat"], restore.start(task)["flat"])  # not trained


def test_a_splat_step_draws_one_instant_once_all_are_remembered(tiny):
    config = configure("ours", "draft", steps=40, splats=300)
    with open_scene(tiny) as scene:
        task, _ = prepare(scene, tiny, config)
        state = new_state(scene.points, task)
    for k in range(6):
        one_step(state, task, k / 40)
    assert len(state.memory) == 6 * 5
    before = {k: v.clone() for k, v in state.memory.items()}
    one_step(state, task, 0.5)
    assert sum(not torch.equal(before[k], state.memory[k]) for k in before) == 1


def test_instants_follow_the_trajectory(tiny):
    task = task_of(tiny)
    with open_scene(tiny) as scene:
        view = scene.view(task.targets.views[0].name)
    for phase in restore.instants(task.config):
        want = UNIT.pose(sub_pose(view, phase))
        assert task.targets.views[0].instants[phase].pose.numpy() == pytest.approx(want)


def test_a_rolling_shutter_under_rays_is_refused(tiny, tmp_path):
    with open_scene(tiny) as file:
        scene = file.read()
    frame = replace(scene.views[0].frame, row_ns=100, start_ns=scene.views[0].frame.start_ns - 100 * 20)
    path = tmp_path / "rolling.h5"
    write_scene(path, replace(scene, views=(replace(scene.views[0], frame=frame), *scene.views[1:])))
    with open_scene(path) as opened, pytest.raises(DataError, match="rolling"):
        load_targets(opened, configure("ours", "draft", "nerf-fast"), UNIT)


@pytest.mark.parametrize("trajectory", ["linear", "cubic"])
def test_ours_trains_along_a_trajectory_that_is_trained_too(tiny, trajectory):
    config = configure("ours", "draft", steps=20, splats=300, trajectory=trajectory)
    with open_scene(tiny) as scene:
        task, _ = prepare(scene, tiny, config)
        state = new_state(scene.points, task)
    before = {n: p.detach().clone() for n, p in state.params.items() if n.startswith("path:")}
    for k in range(12):
        one_step(state, task, k / 20)
    assert before
    assert any(not torch.equal(before[n], state.params[n]) for n in before)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"ratio_until": 0.5}, "ratio_until"),
        ({"colour_target": "truth"}, "colour_target"),
        ({"exposure": "affine"}, "exposure"),
        ({"kernel_points": 4}, "kernel_points"),
        ({"pose_label": "first"}, "pose_label"),
        ({"restore_from": 1.5}, "restore_from"),
        ({"restore_instants": 0, "align_arms": "shift"}, "arms"),
    ],
)
def test_settings_that_do_not_go_together_are_told(changes, told):
    with pytest.raises(UsageError, match=told):
        configure("ours", "draft", **changes)
