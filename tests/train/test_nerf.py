"""The fields of rays inside a fit: every method, resume, threads, what is refused, what is drawn."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from spikerig import _native
from spikerig.dataset.errors import HostError, NumericsError, UsageError
from spikerig.dataset.store import open_scene
from spikerig.train.fit import load_state, new_state, one_step, train
from spikerig.train.methods import configure
from spikerig.train.record import open_run
from spikerig.train.render import render_path
from spikerig.train.run import model_hash, prepare, run_fit
from spikerig.train.score import score_run

SMALL = {
    "nerf": {"rays": 32, "coarse": 8, "fine": 8, "width": 16},
    "nerf-fast": {"rays": 64, "coarse": 16, "fine": 8, "width": 16, "grid_levels": 4, "finest": 64, "table_log2": 10,
                  "occupancy": 16},
}  # fmt: skip
METHODS = ("plain", "average", "spikenerf", "spikenerf-5x", "spike-ratio", "spike-hybrid", "oracle")


def small(field, method="plain", **changes):
    return configure(method, "draft", field, **(SMALL[field] | {"steps": 4} | changes))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("field", SMALL)
def test_every_method_trains_every_field(tiny, tmp_path, field, method):
    done = run_fit(tiny, small(field, method), tmp_path / "run", eval_every=0)
    assert done["steps"] == 4
    assert np.isfinite(done["psnr"])


def test_the_fast_field_learns(tiny, tmp_path):
    config = small("nerf-fast", "oracle", steps=120, rays=256, fine=16, finest=128, table_log2=13)
    done = run_fit(tiny, config, tmp_path / "run")
    history = json.loads((tmp_path / "run/history.json").read_text())
    assert done["psnr"] > history[0]["psnr"] + 3


def test_points_put_the_fast_field_where_the_scene_is(tiny):
    """Taught points, it begins darker off them, solid on them, and coloured as they are; random starts know nothing."""
    from spikerig.train.hashed import density_of

    config = small("nerf-fast", finest=128, table_log2=13, grid_levels=8)
    with open_scene(tiny) as scene:
        points, (task, _) = scene.points, prepare(scene, tiny, config)
        assert points is not None
        taught, bare = (new_state(points, replace(task, config=c)) for c in (config, replace(config, init="random")))
    xyz = torch.from_numpy(task.gauge.inside(points.xyz).astype(np.float32))
    anywhere = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (2000, 3)).astype(np.float32))
    on, off = (density_of(taught.params, config, x)[0].median().item() for x in (xyz, anywhere))
    assert on > 20 * off
    assert density_of(bare.params, config, xyz)[0].median().item() == pytest.approx(1, rel=0.2)
    assert taught.grids["occupancy"].unique().tolist() == pytest.approx([0.6, 90.0])
    assert bare.grids["occupancy"].unique().tolist() == [1.0]


def test_points_outside_the_box_teach_nothing(tiny):
    from spikerig.train.hashed import start_hashed
    from spikerig.train.prime import prime

    config = small("nerf-fast")
    params, grids = start_hashed(config)
    prime(params, grids, np.full((5, 3), 7.0), np.zeros((5, 3)), config)
    fresh, _ = start_hashed(config)
    assert all(torch.equal(params[name], fresh[name]) for name in fresh)
    assert torch.all(grids["occupancy"] == 1)


def test_the_papers_field_learns(tiny):
    losses = fitted(tiny, small("nerf", "oracle", steps=80, rays=64, width=32, lr_net=2e-3))[1]
    assert np.mean(losses[-20:]) < 0.6 * np.mean(losses[:5])


def fitted(tiny, config):
    """(state, losses) of a fit without a folder."""
    with open_scene(tiny) as scene:
        task, _ = prepare(scene, tiny, config)
        state = new_state(scene.points, task)
    losses = []
    train(state, task, after=lambda state, fraction, loss: losses.append(loss))
    return state, losses


def test_the_fast_field_has_the_same_bits_for_any_thread_count(tiny, threads):
    found = set()
    for count in (1, 2, 3):
        threads(count)
        state, _ = fitted(tiny, small("nerf-fast", "spikenerf", steps=20))
        grid = state.grids["occupancy"].numpy().tobytes()
        found.add((model_hash(state), hash(grid)))
    assert len(found) == 1


@pytest.mark.parametrize("field", SMALL)
def test_the_seed_decides(tiny, field):
    states = [fitted(tiny, small(field, seed=seed))[0] for seed in (0, 0, 1)]
    hashes = [model_hash(state) for state in states]
    assert hashes[0] == hashes[1] != hashes[2]


@pytest.mark.parametrize(("field", "steps"), [("nerf", 6), ("nerf-fast", 40)])
def test_resumed_is_uninterrupted(tiny, tmp_path, field, steps):
    """Beyond two refreshes of the occupancy grid, which must come back from the checkpoint too."""
    whole = run_fit(tiny, small(field, "spikenerf", steps=steps), tmp_path / "whole", eval_every=0)

    def stop(state, fraction, loss):
        if state.step == steps // 2 + 1:
            raise KeyboardInterrupt

    from spikerig.train import run

    with pytest.MonkeyPatch.context() as patch:
        begun = run.train
        patch.setattr(run, "train", lambda state, task, after: begun(
            state, task, after=lambda *now: (after(*now), stop(*now))))  # fmt: skip
        with pytest.raises(KeyboardInterrupt):
            run_fit(tiny, small(field, "spikenerf", steps=steps), tmp_path / "cut", eval_every=0)
    assert load_state(tmp_path / "cut/checkpoint.safetensors")[0].step == steps // 2 + 1
    resumed = run_fit(tiny, small(field, "spikenerf", steps=steps), tmp_path / "cut", eval_every=0, resume=True)
    assert resumed["model_sha256"] == whole["model_sha256"]
    grids = [load_state(tmp_path / name / "checkpoint.safetensors")[0].grids for name in ("whole", "cut")]
    assert all(torch.equal(grids[0][name], grids[1][name]) for name in grids[0])


@pytest.mark.parametrize("field", SMALL)
def test_a_run_is_opened_scored_and_drawn_along_paths(tiny, tmp_path, field):
    run_fit(tiny, small(field), tmp_path / "run", eval_every=0)
    model = open_run(tmp_path / "run").model
    with open_scene(tiny) as scene:
        scored = score_run(model, scene)
        assert scored["field"] == field
        assert np.isfinite(scored["psnr"])
        (tmp_path / "drawn").mkdir()
        path = "test" if field == "nerf" else "shake"  # the slow one draws one view
        written = render_path(model, scene, path, tmp_path / "drawn", suffix="exr", subframes=2)
        assert path == "test" or any(name.endswith("depth.exr") for name in written)
        assert all((tmp_path / "drawn" / name).exists() for name in written)
        pose = scene.view(scene.test[0], spikes=False).pose.cam_from_world
    picture, depth = model.picture(pose), model.depth(pose)
    assert picture.shape == (40, 64, 3)
    assert np.all((picture >= 0) & (picture <= 1))
    assert np.all(depth[np.isfinite(depth)] > 0)


def test_no_points_file_and_no_missing_gpu(tiny, tmp_path):
    with pytest.raises(UsageError, match="only splats"):
        run_fit(tiny, small("nerf-fast"), tmp_path / "run", ply=True)
    if not torch.cuda.is_available():
        with pytest.raises(HostError, match="no CUDA device"):
            run_fit(tiny, small("nerf-fast", device="cuda"), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("field", SMALL)
def test_a_number_that_is_none_is_told_with_step_tensor_and_index(tiny, field):
    config = small(field)
    with open_scene(tiny) as scene:
        task, _ = prepare(scene, tiny, config)
        state = new_state(scene.points, task)
    one_step(state, task, 0.0)
    name = "fine/3/weight" if field == "nerf" else "density/1/weight"
    with torch.no_grad():
        state.params[name][1, 2] = float("nan")
    with pytest.raises(NumericsError) as caught:
        one_step(state, task, 0.5)
    for part in ("step 1", name, "[1, 2]"):
        assert part in str(caught.value)


def test_the_torch_threads_of_a_fit(threads):
    from spikerig.train.fields import field_of

    threads(3)
    assert _native.threads() == 3
    assert field_of(small("nerf")).torch_threads() == 3
    assert field_of(small("nerf-fast")).torch_threads() == 1
    assert field_of(configure()).torch_threads() == 1


def changed(tiny, config, change):
    """(task, state) of a fit whose targets were changed view by view."""
    with open_scene(tiny) as scene:
        task, _ = prepare(scene, tiny, config)
        points = scene.points
    targets = replace(task.targets, views=tuple(change(view) for view in task.targets.views))
    task = replace(task, targets=targets)
    return task, new_state(points, task)


def test_a_black_scene_goes_black(tiny):
    config = small("nerf-fast", steps=120, lr_net=2e-2)
    task, state = changed(tiny, config, lambda view: replace(view, frame=torch.zeros_like(view.frame)))
    train(state, task)
    with open_scene(tiny) as scene:
        picture = task.model(state).picture(scene.view(scene.test[0], spikes=False).pose.cam_from_world)
    assert np.isfinite(picture).all()
    assert picture.mean() < 0.05


@pytest.mark.parametrize("field", SMALL)
def test_one_view_trains(tiny, field):
    config = small(field, "spikenerf", steps=3)
    with open_scene(tiny) as scene:
        task, _ = prepare(scene, tiny, config)
        points = scene.points
    task = replace(task, targets=replace(task.targets, views=task.targets.views[:1]))
    state = new_state(points, task)
    losses = []
    train(state, task, after=lambda state, fraction, loss: losses.append(loss))
    assert np.isfinite(losses).all()
    assert len(losses) == 3


def test_a_target_that_is_no_number_is_told(tiny):
    task, state = changed(tiny, small("nerf-fast"), lambda view: replace(view, frame=view.frame * float("nan")))
    with pytest.raises(NumericsError, match="step 0"):
        one_step(state, task, 0.0)


def test_pixels_outside_the_valid_part_do_not_count(tiny):
    def masked(view):
        valid = torch.zeros(view.frame.shape[:2], dtype=torch.bool)
        valid[10:20] = True
        return replace(view, frame=torch.where(valid[..., None], view.frame, torch.nan), valid=valid)

    task, state = changed(tiny, small("nerf-fast", steps=3), masked)
    train(state, task)
    assert all(torch.isfinite(p).all() for p in state.params.values())


def test_a_batch_holds_the_views_own_pixels(tiny):
    """Each row of a batch is the pixel of the view it came from, with that view's pose and textures."""
    from spikerig.train.fields import field_of

    config = small("nerf-fast", "spikenerf-5x", rays=64)
    with open_scene(tiny) as scene:
        task, _ = prepare(scene, tiny, config)
    batch = field_of(config).look(task.targets, task.camera, config, 3, np.random.default_rng(0))
    views = {view.name: view for view in task.targets.views}
    names = batch.name.split(", ")
    assert len(names) == 6  # eight wanted, six there: two of them twice
    assert batch.pixels is not None
    for row, pixel in enumerate(batch.pixels.tolist()):
        y, x = divmod(pixel, task.camera.width)
        owners = [v for v in views.values() if all(
            torch.equal(batch.instants[p].pose[row], v.instants[p].pose) for p in batch.instants)]  # fmt: skip
        (owner,) = owners
        assert torch.equal(batch.frame[row, 0], owner.frame[y, x])
        for phase, instant in batch.instants.items():
            for (light, _), (whole, _) in zip(instant.textures, owner.instants[phase].textures, strict=True):
                assert light[row, 0] == whole[y, x]


def test_all_fields_are_timed_side_by_side(tiny, monkeypatch):
    from spikerig.train import config, fieldcost, methods

    def tiny_field(method, preset, name, seed):
        return small(name, method, seed=seed) if name != "splat" else config.FitConfig(preset="draft", splats=50)

    monkeypatch.setattr(methods, "configure", tiny_field)
    rows = fieldcost.field_cost(tiny, method="plain", preset="draft", rounds=1)
    assert [row["field"] for row in rows] == ["splat", "nerf-fast", "nerf"]
    assert [row["timed_steps"] for row in rows] == [30, 30, 1]
    assert rows[-1]["times_nerf"] == 1
    assert all(row["cpu_seconds"] > 0 for row in rows)
