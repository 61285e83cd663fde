"""Optimised paths: identity at the start, gauge taken out, the same bits always, and better poses than were given."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from spikerig.dataset.cli import run as command
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.rigid import compose, exp_se3, inverse, log_se3
from spikerig.dataset.store import open_scene, write_scene
from spikerig.train import path
from spikerig.train.bridge import bridge, true_pose
from spikerig.train.fit import load_state, new_state, one_step, torch_threads
from spikerig.train.methods import METHODS, configure
from spikerig.train.parts import own, parts_of, pose_of
from spikerig.train.path import PART, gauge_directions, moves, paths, span_of
from spikerig.train.run import prepare, run_fit
from spikerig.train.trajectory import PATH_PHASES, pose_at

SMALL = {"splats": 800, "steps": 30}
NOISE = {"pose_noise_deg": 1.5, "pose_noise_share": 0.01}
KINDS = [{"trajectory": "linear"}, {"trajectory": "cubic"}, {"trajectory": "cubic", "knots_at": "spikes"}]


def config_of(method="spike-ratio", **changes):
    return configure(method, "draft", **(SMALL | changes))


def task_of(tiny, config):
    with open_scene(tiny) as scene, torch_threads():
        task, _ = prepare(scene, tiny, config)
        return task, new_state(scene.points, task)


@pytest.fixture(scope="module")
def still(tiny, tmp_path_factory):
    """The tiny scene without trajectories: one pose a view."""
    out = tmp_path_factory.mktemp("still") / "still.h5"
    with open_scene(tiny) as file:
        scene = file.read()
    write_scene(out, replace(scene, views=tuple(replace(v, trajectory=None) for v in scene.views)))
    return out


@pytest.mark.parametrize("changes", KINDS)
@pytest.mark.parametrize("anchor", ["mean", "mid", "none"])
def test_a_path_starts_as_what_was_given(tiny, changes, anchor):
    task, state = task_of(tiny, config_of(anchor=anchor, **changes))
    for view in task.targets.views:
        for phase, instant in view.instants.items():
            assert torch.allclose(pose_of(state.params, view, phase, task.config), instant.pose, atol=1e-6)
    assert np.allclose(np.stack(list(paths(state, task).values())), task.targets.given, atol=1e-12)
    with open_scene(tiny) as scene:
        assert np.allclose(task.targets.given[2, 2], scene.view(scene.train[2]).pose.cam_from_world, atol=1e-9)


def test_knots_lie_where_the_spikes_are():
    assert span_of(config_of(trajectory="linear")) == (0, 1, 2)
    assert span_of(config_of(trajectory="cubic")) == (0, 1, 4)
    assert span_of(config_of(trajectory="linear", knots=5)) == (0, 1, 5)
    assert span_of(config_of(trajectory="linear", knots_at="spikes")) == (0.1, 0.9, 5)
    assert span_of(config_of(trajectory="cubic", knots_at="spikes", ratio_instants=9)) == (0.5 / 9, 8.5 / 9, 11)
    five = config_of("spikenerf-5x", trajectory="cubic", knots_at="spikes", instants_rule="endpoints")
    assert span_of(five) == (0, 1, 7)
    tied = config_of(trajectory="linear", knots_at="spikes")
    knots = torch.randn(1, 5, 6, dtype=torch.float64) * 0.1
    for k, phase in enumerate((0.1, 0.3, 0.5, 0.7, 0.9)):  # a knot of the spline at each texture
        assert np.allclose(path.correction(knots, phase, tied)[0], exp_se3(knots[0, k].numpy()), atol=1e-12)


def test_without_a_trajectory_a_path_is_learned_and_without_a_path_refused(still):
    with pytest.raises(DataError, match="no trajectory"):
        task_of(still, config_of())
    task, state = task_of(still, config_of(trajectory="linear"))
    view = task.targets.views[1]
    ends = [pose_of(state.params, view, phase, task.config).detach().double().numpy() for phase in (0.1, 0.9)]
    turn = log_se3(compose(ends[1], inverse(ends[0])))
    assert np.linalg.norm(turn[:3]) * task.camera.K[0, 0] == pytest.approx(0.8 * path.START_PX, rel=1e-3)
    middle = pose_of(state.params, view, 0.5, task.config)
    assert torch.allclose(middle, view.instants[0.5].pose, atol=1e-6)
    other = pose_of(state.params, task.targets.views[2], 0.9, task.config).detach().double().numpy()
    again = log_se3(compose(other, inverse(task.targets.views[2].instants[0.9].pose.double().numpy())))
    assert np.abs(again[:2] / np.linalg.norm(again) - turn[:2] / np.linalg.norm(turn)).max() > 0.05  # drawn by view


def test_the_directions_of_the_gauge_are_motions_that_change_no_picture():
    rng = np.random.default_rng(0)
    poses = np.stack([exp_se3(rng.normal(0, 1, 6)) for _ in range(5)])
    found = gauge_directions(poses).reshape(30, 7)
    assert np.allclose(found.T @ found, np.eye(7), atol=1e-12)
    common = exp_se3(1e-6 * rng.normal(size=6))
    moved = np.concatenate([log_se3(compose(compose(p, common), inverse(p))) for p in poses]) / 1e-6
    assert np.abs(moved - found @ (found.T @ moved)).max() < 1e-4
    scaled = np.concatenate([np.concatenate([np.zeros(3), p[:, 3]]) for p in poses])
    assert np.abs(scaled - found @ (found.T @ scaled)).max() < 1e-12
    assert np.abs(found.T @ rng.normal(size=30)).max() > 0.1
    alone = gauge_directions(poses[:1]).reshape(6, 7)
    assert np.linalg.matrix_rank(alone) == 6
    assert np.isfinite(gauge_directions(np.repeat(np.eye(4)[None, :3], 3, 0))).all()


@pytest.mark.parametrize("anchor", ["mean", "mid", "none"])
def test_anchors_take_out_what_they_say(tiny, anchor):
    task, state = task_of(tiny, config_of(trajectory="linear", anchor=anchor, lr_poses=1e-2, **NOISE))
    with torch_threads():
        for _ in range(12):
            one_step(state, task, 0.2)
    params = {n: p.detach() for n, p in own(PART, state.params).items()}
    freedom = (params["freedom"] * params["knots"].mean(1)[..., None]).sum((0, 1)).abs().max()
    middle = (moves(params, slice(None), 0.5, task.config) - torch.eye(4)[:3]).abs().max()
    assert (freedom < 1e-5) == (anchor == "mean") or anchor == "mid"
    assert (middle < 1e-5) == (anchor == "mid")
    assert params["knots"].abs().max() > 1e-3


def test_only_views_that_were_looked_at_move(tiny):
    task, state = task_of(tiny, config_of(trajectory="linear", anchor="none"))
    with torch_threads():
        for seen in (1, 2, 3):
            before = state.params["path:knots"].detach().clone()
            one_step(state, task, 0.5)
            changed = (state.params["path:knots"] != before).any(-1).any(-1)
            assert changed.sum() == 1
            assert state.params["path:looks"].sum() == seen


def test_a_batch_of_pixels_gets_the_pose_of_its_view(tiny):
    task, state = task_of(tiny, configure("average", "draft", field="nerf-fast", trajectory="linear", rays=64))
    with torch.no_grad():
        state.params["path:knots"].normal_(0, 0.05, generator=torch.Generator().manual_seed(1))
    batch = task.field.look(task.targets, task.camera, task.config, 0, np.random.default_rng(0))
    found = pose_of(state.params, batch, 0.3, task.config)
    assert found.shape == (64, 3, 4)
    for k in (0, 20, 63):
        view = task.targets.views[int(batch.which[k])]
        assert torch.allclose(found[k], pose_of(state.params, view, 0.3, task.config), atol=1e-6)
    found.sum().backward()
    assert state.params["path:knots"].grad.abs().sum() > 0


@pytest.mark.parametrize("changes", KINDS)
def test_the_loss_falls_along_the_gradient_of_the_knots(tiny, changes):
    """Through the rasteriser: a small step against the gradient lowers the loss of the same view and draws."""
    from spikerig.train.field import Step
    from spikerig.train.fit import view_loss

    task, state = task_of(tiny, config_of("average", fresh_poses=0, **changes, **NOISE))
    view, knots = task.targets.views[0], state.params["path:knots"]

    def loss():
        return view_loss(state, task, view, Step(0, 0.5, (0.0, 0.0, 0.0), np.random.default_rng(0)))

    first = loss()
    first.backward()
    with torch.no_grad():
        knots -= 2e-4 * knots.grad / knots.grad.norm()
    assert loss() < first


@pytest.mark.parametrize("changes", [{"trajectory": "linear"}, {"trajectory": "cubic", "path_from": "mid"}])
def test_same_bits_for_any_thread_count_and_resumed(tiny, tmp_path, threads, changes, monkeypatch):
    found = set()
    config = config_of("spike-hybrid", **changes, **NOISE)
    for n in (1, 3):
        threads(n)
        found.add(run_fit(tiny, config, tmp_path / f"run{n}", eval_every=0)["model_sha256"])
    whole = json.loads((tmp_path / "run1/run.json").read_text())
    from spikerig.train import run as runs

    train = runs.train

    def stops(state, task, after):
        def watched(state, fraction, loss):
            after(state, fraction, loss)
            if state.step == 13:
                raise KeyboardInterrupt

        return train(state, task, after=watched)

    monkeypatch.setattr(runs, "train", stops)
    with pytest.raises(KeyboardInterrupt):
        run_fit(tiny, config, tmp_path / "cut", eval_every=0)
    part = json.loads((tmp_path / "cut/run.json").read_text())
    assert part["steps"] == 13
    assert part["cameras"] != whole["cameras"]
    monkeypatch.setattr(runs, "train", train)
    found.add(run_fit(tiny, config, tmp_path / "cut", eval_every=0, resume=True)["model_sha256"])
    assert len(found) == 1
    done = json.loads((tmp_path / "cut/run.json").read_text())
    assert done["cameras"] == whole["cameras"]
    assert (tmp_path / "cut/paths.json").read_bytes() == (tmp_path / "run1/paths.json").read_bytes()


def test_noisy_poses_get_better_and_the_score_reads_them(tiny, tmp_path, capsys):
    """End to end: held-out cameras are brought over from the optimised training cameras, and are not optimised."""
    from spikerig.train.score_cli import trained_cameras

    found = {}
    for name, changes in (("noisy", {}), ("path", {"trajectory": "linear", "lr_poses": 1e-2})):
        config = config_of(steps=300, **NOISE, **changes)
        done = run_fit(tiny, config, tmp_path / name, eval_every=0)
        assert command(["train", "score", str(tmp_path / name), "--align-steps", "20", "--json"]) == 0
        found[name] = json.loads(capsys.readouterr().out)
        assert found[name]["psnr"] == pytest.approx(done["psnr"])  # the curve is brought over alike
        assert not found[name]["worlds"]["same_world"]
        assert found[name]["novel_view_aligned"]["psnr"] != found[name]["psnr"]
    noisy, better = found["noisy"], found["path"]
    assert better["psnr"] > noisy["psnr"] + 0.3
    assert better["blur_view"]["psnr"] > noisy["blur_view"]["psnr"] + 0.5
    assert better["worlds"]["apart_deg_median"] < 0.7 * noisy["worlds"]["apart_deg_median"]
    record = json.loads((tmp_path / "path/run.json").read_text())
    with open_scene(tiny) as scene:
        assert record["cameras"].keys() == set(scene.train)
        known = {name: true_pose(scene, name) for name in scene.train}
        made = {name: np.array(pose) for name, pose in record["cameras"].items()}
        assert bridge(known, made, estimated=True).deg == better["worlds"]["apart_deg_median"]
    told = json.loads((tmp_path / "path/paths.json").read_text())
    assert told["phases"] == list(PATH_PHASES)
    for name, poses in told["cam_from_world"].items():
        assert np.allclose(np.reshape(poses[2], (3, 4)), record["cameras"][name], atol=0)
    from spikerig.train.record import open_run

    cameras, estimated = trained_cameras(open_run(tmp_path / "path"))
    assert estimated
    assert np.array_equal(cameras[next(iter(cameras))], made[next(iter(cameras))])


def test_bad_finds_the_path_of_a_blur_from_its_mid_pose(tiny, still, tmp_path):
    """Without spikes; the scene's own trajectory is not used, so a scene without one gives the same model."""
    done = run_fit(still, configure("bad", "draft", splats=800, steps=5), tmp_path / "a", eval_every=0)
    same = run_fit(tiny, configure("bad", "draft", splats=800, steps=5), tmp_path / "b", eval_every=0)
    assert done["model_sha256"] == same["model_sha256"]
    assert [part.name for part in parts_of(configure("bad"))] == ["path"]
    rays = configure("bad", "draft", field="nerf-fast")
    assert rays.colour_loss == "l2"
    assert rays.poses_per_view == 10
    small = {"splats": 800, "steps": 200}
    few = configure("bad", "draft", poses_per_view=5, lr_poses=1e-2, **small)
    psnr = {
        name: run_fit(tiny, config, tmp_path / name, eval_every=0)["psnr"]
        for name, config in (("c", few), ("plain", configure("plain", "draft", **small)))
    }
    assert psnr["c"] > psnr["plain"]
    told = json.loads((tmp_path / "c/paths.json").read_text())["cam_from_world"]
    likeness = []
    with open_scene(tiny) as scene:
        for name, poses in told.items():
            view = scene.view(name, spikes=False)
            ends = [np.reshape(poses[k], (3, 4)) for k in (0, 4)]
            true = [pose_at(view.trajectory, view.instant_ns(phase)) for phase in (0.0, 1.0)]
            found, wanted = (log_se3(compose(b, inverse(a)))[:2] for a, b in (ends, true))
            likeness.append(abs(found @ wanted) / np.linalg.norm(found) / np.linalg.norm(wanted))  # forth or back
    assert np.median(likeness) > 0.8, likeness


@pytest.mark.parametrize(
    "changes",
    [
        {"trajectory": "cubic", "knots": 3},
        {"trajectory": "linear", "knots": 1},
        {"trajectory": "linear", "knots": 3, "knots_at": "spikes"},
        {"path_from": "mid"},
        {"knots": 4},
        {"anchor": "first"},
        {"trajectory": "linear", "lr_poses_end": 0.0},
        {"pose_noise_deg": -1.0},
        {"pose_noise_share": float("nan")},
        {"colour_target": "truth", "trajectory": "linear"},
    ],
)
def test_settings_that_make_no_sense_are_told(changes):
    with pytest.raises(UsageError, match="do not hold together"):
        config_of("plain", **changes)


def test_a_gradient_too_small_to_square_moves_nothing_to_nan(tiny):
    task, state = task_of(tiny, config_of(trajectory="linear"))
    params, moments = own(PART, state.params), own(PART, state.moments)
    params["knots"].grad = torch.full_like(params["knots"], 1e-40)
    PART.descend(params, moments, task.config, 0.5)
    assert torch.isfinite(params["knots"]).all()


def test_noise_is_drawn_by_seed_and_view_as_large_as_asked(tiny):
    given = [task_of(tiny, config_of(seed=seed, **NOISE))[0].targets.given for seed in (0, 0, 1)]
    exact = task_of(tiny, config_of(trajectory="linear"))[0].targets.given
    assert np.array_equal(given[0], given[1])
    off = np.array(
        [[log_se3(compose(a, inverse(b))) for a, b in zip(x[:, 2], exact[:, 2], strict=True)] for x in given]
    )
    assert np.abs(off[0] - off[2]).max() > 0.01
    assert np.degrees(off[:, :, :3].std()) == pytest.approx(1.5, rel=0.5)
    ends = log_se3(compose(given[0][0, 4], inverse(exact[0, 4])))
    assert 0 < np.abs(ends - off[0][0]).max() < 0.1


def test_every_method_but_the_oracle_takes_a_path(tiny, tmp_path):
    for method in METHODS:
        if method == "oracle":
            continue
        assert config_of(method, trajectory="linear").needs_trajectory is False
    done = run_fit(tiny, config_of("plain", trajectory="linear"), tmp_path / "run", eval_every=0)
    assert done["psnr"] > 12
    state, _ = load_state(tmp_path / "run/checkpoint.safetensors")
    assert state.params["path:knots"].shape == (6, 2, 6)


def test_one_training_view_has_a_path_too(tiny, tmp_path):
    """Its middle is all gauge and stays; a similarity cannot be told from it, so the curve takes the world as it is."""
    with open_scene(tiny) as file:
        scene = file.read()
    kept = (scene.views[1], *(v for v in scene.views if v.split == "test"))
    write_scene(tmp_path / "one.h5", replace(scene, views=kept, truth=None, events={}))
    done = run_fit(tmp_path / "one.h5", config_of(trajectory="linear", steps=8), tmp_path / "run", eval_every=0)
    assert np.isfinite(done["psnr"])
    state, _ = load_state(tmp_path / "run/checkpoint.safetensors")
    assert state.params["path:knots"].abs().max() > 1e-5
    assert state.params["path:knots"].mean(1).abs().max() < 1e-6
