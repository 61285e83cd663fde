"""Growth by screen gradients: what is cloned, split, dropped; moments; resets; the same bits, resumed or not."""

import json
import signal
import subprocess
import sys

import numpy as np
import pytest
import torch
from splat_params import moments, params, picture

from spikerig.dataset.errors import UsageError
from spikerig.train.fit import load_state
from spikerig.train.grow import RESET, SEEN, SUM, Rule, blank, fade, grow, watch
from spikerig.train.growthcost import plan
from spikerig.train.methods import configure
from spikerig.train.run import run_fit
from spikerig.train.splat import Rendered

RULE = Rule(gradient=1.0, size=0.1, cap=1000)


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def seen(mean: list[float] | torch.Tensor) -> dict[str, torch.Tensor]:
    """Statistics of splats seen three times with these mean gradients."""
    grad = torch.as_tensor(mean, dtype=torch.float32)
    return {SUM: 3 * grad, SEEN: torch.full_like(grad, 3.0)}


def sized(*largest: float) -> dict[str, torch.Tensor]:
    p = params(len(largest))
    scales = torch.log(torch.tensor(largest))[:, None] + torch.tensor([-1.0, 0.0, -0.5])
    return p | {"log_scales": scales}


def test_small_splats_are_cloned_and_large_ones_split():
    p = sized(0.05, 0.05, 0.5, 0.5)
    grown, m = grow(p, moments(p), seen([2.0, 0.5, 2.0, 0.5]), RULE, rng())
    assert len(grown["means"]) == 6
    for name, t in p.items():
        assert torch.equal(grown[name][[0, 1, 3]], t[[0, 1, 3]])  # the cloned one and those left alone
        assert torch.equal(grown[name][4], t[0])
    for half in (2, 5):
        assert torch.allclose(grown["log_scales"][half], p["log_scales"][2] - np.log(1.6))
        assert torch.equal(grown["quats"][half], p["quats"][2])
        assert torch.equal(grown["sh"][half], p["sh"][2])
        assert not torch.equal(grown["means"][half], p["means"][2])
    for pair in m.values():
        for each in pair:
            assert (each[[0, 1, 3]] == 1).all()  # what stays keeps its moments
            assert not each[[2, 4, 5]].any()  # what is new starts without


def test_halves_are_drawn_from_the_splat_itself():
    n = 4000
    p = {k: t[:1].expand(n, *t.shape[1:]).contiguous() for k, t in sized(0.5).items()}
    grown, _ = grow(p, moments(p), seen([2.0] * n), Rule(1.0, 0.1, 10 * n), rng())
    from spikerig.train.densify import rotations

    inside = (grown["means"] - p["means"][0]) @ rotations(p["quats"])[0]
    assert torch.allclose(inside.std(0), p["log_scales"][0].exp(), rtol=0.05)
    assert float(inside.mean(0).abs().max()) < 0.02


def test_faint_and_huge_splats_are_dropped_with_their_moments():
    p = sized(0.05, 0.05, 3.0, 0.05)
    p["logit_opacities"][1] = -9.0
    ids = {name: torch.arange(4.0).reshape(-1, *[1] * (t.ndim - 1)).expand_as(t) for name, t in p.items()}
    m = {name: (t, t) for name, t in ids.items()}
    left, kept = grow(p, m, blank(4), Rule(1.0, 0.1, 1000, huge=1.0), rng())
    assert torch.equal(left["means"], p["means"][[0, 3]])
    assert kept["sh"][0].flatten()[0::3].tolist() == [0.0, 3.0]
    assert len(grow(p, m, blank(4), RULE, rng())[0]["means"]) == 3  # huge ones only where asked


def test_where_all_would_be_dropped_none_is():
    p = params(5, opacity=0.001)
    assert len(grow(p, moments(p), blank(5), RULE, rng())[0]["means"]) == 5


def test_what_nobody_saw_is_left_alone():
    p = params(5)
    grown, _ = grow(p, moments(p), blank(5), Rule(0.0, 0.1, 1000), rng())
    assert all(torch.equal(grown[name], t) for name, t in p.items())


def test_the_cap_takes_the_largest_gradients_ties_by_index():
    p = sized(*[0.05] * 6)
    grads = [2.0, 5.0, 3.0, 3.0, 9.0, 3.0]
    grown, _ = grow(p, moments(p), seen(grads), Rule(1.0, 0.1, 9), rng())
    assert torch.equal(grown["means"][6:], p["means"][[1, 2, 4]])
    shared, _ = grow(p, moments(p), seen(grads), Rule(1.0, 0.1, 1000, share=0.34), rng())
    assert torch.equal(shared["means"][6:], p["means"][[1, 4]])
    assert len(grow(p, moments(p), seen(grads), Rule(1.0, 0.1, 4), rng())[0]["means"]) == 6  # above the cap: none


def test_a_huge_splat_is_split_to_finite_places():
    p = sized(0.5, 0.5)
    p["log_scales"][0] = 60.0
    grown, _ = grow(p, moments(p), seen([2.0, 0.0]), RULE, rng())
    assert all(torch.isfinite(t).all() for t in grown.values())


def test_inputs_are_left_as_they_are_and_the_same_draws_give_the_same():
    p = sized(0.05, 0.5, 0.5)
    before = {name: t.clone() for name, t in p.items()}
    m = moments(p)
    one, two = (grow(p, m, seen([2.0, 2.0, 2.0]), RULE, rng())[0] for _ in range(2))
    assert all(torch.equal(one[name], two[name]) for name in one)
    assert all(torch.equal(before[name], t) for name, t in p.items())
    assert all((each == 1).all() for pair in m.values() for each in pair)


def test_statistics_do_not_depend_on_resolution_and_sub_poses_add_up_first():
    def drawn(width: int, *radii: float) -> Rendered:
        size = (width // 2, width)
        return Rendered(torch.zeros(*size, 3), torch.zeros(size), torch.tensor(radii), None)

    grids, double = blank(3), blank(3)
    grad = torch.tensor([[1.0, 0.0], [3.0, 4.0], [1.0, 1.0]])
    watch(grids, [drawn(64, 2, 2, 0)], [grad])
    assert grids[SUM].tolist() == pytest.approx([32.0, np.hypot(96, 64), 0.0])
    assert grids[SEEN].tolist() == [1, 1, 0]
    watch(double, [drawn(128, 2, 2, 0)], [grad / 2])  # twice the pixels: half the loss per pixel
    assert torch.equal(double[SUM], grids[SUM])
    both = blank(3)
    watch(both, [drawn(64, 2, 0, 2), drawn(64, 2, 0, 0)], [grad, -grad])
    assert both[SUM].tolist() == [0, 0, 0]
    assert both[SEEN].tolist() == [1, 0, 1]


def test_a_reset_leaves_opacities_faint_and_forgets_their_moments_alone():
    p, m = params(6), moments(params(6))
    p["logit_opacities"][0] = -8.0
    fade(p, m)
    assert float(torch.sigmoid(p["logit_opacities"]).max()) == pytest.approx(RESET)
    assert float(p["logit_opacities"][0]) == -8.0
    assert not any(each.any() for each in m["logit_opacities"])
    assert all((each == 1).all() for name in p if name != "logit_opacities" for each in m[name])


def test_cloning_changes_the_picture_where_it_says_and_splitting_keeps_its_size():
    p = params(40)
    before = picture(p)
    grown, _ = grow(p, moments(p), seen([2.0] * 40), Rule(1.0, 0.1, 60), rng())
    assert len(grown["means"]) == 60
    assert float((picture(grown) - before).abs().mean()) < 0.15


GROWING = {
    "densify": "default", "densify_every": 10, "densify_grad": 1e-5, "splats_most": 1000, "densify_share": 0.1,
    "opacity_reset": 25,
}  # fmt: skip


@pytest.mark.parametrize(
    ("method", "changes"),
    [
        ("plain", {"absgrad": True}),
        ("spikenerf-5x", {"densify_by": "colour"}),
        ("spike-hybrid", {"densify_by": "tfs", "absgrad": True, "tfs_from": 0.4}),
    ],
)
def test_same_bits_for_any_thread_count_and_resumed(tiny, tmp_path, threads, method, changes):
    config = configure(method, "draft", splats=600, steps=40, **GROWING, **changes)
    found = set()
    for n in (1, 2, 3):
        threads(n)
        torch.set_num_threads(n)
        done = run_fit(tiny, config, tmp_path / f"run{n}", eval_every=0)
        found.add(done["model_sha256"])
        assert 600 < done["splats"] <= 1000
    torch.set_num_threads(1)
    assert len(found) == 1


KILLED = """
import os, signal, sys
from spikerig.train import run
call = run._Watch.__call__
def dies(watch, state, fraction, loss):
    call(watch, state, fraction, loss)
    if state.step == 27:
        watch.save(state)
        os.kill(os.getpid(), signal.SIGKILL)
run._Watch.__call__ = dies
from spikerig.dataset import cli
sys.exit(cli.run(sys.argv[1:]))
"""


def test_killed_between_two_rounds_and_resumed_is_as_if_never_killed(tiny, tmp_path):
    words = ["train", "fit", str(tiny), "--method", "plain", "--preset", "draft", "--splats", "600", "--steps", "60"]
    for name, value in GROWING.items():
        words += ["--set", f"{name}={value}"]
    words += ["--eval-every", "0", "--json", "-o"]
    command = [sys.executable, "-m", "spikerig.dataset", *words]
    whole = json.loads(subprocess.run([*command, str(tmp_path / "a")], check=True, capture_output=True).stdout)
    child = subprocess.run(
        [sys.executable, "-c", KILLED, *words, str(tmp_path / "b")], capture_output=True, check=False
    )
    assert child.returncode == -signal.SIGKILL, child.stderr.decode()
    state, _ = load_state(tmp_path / "b/checkpoint.safetensors")
    assert state.step == 27
    assert state.grids[SEEN].any()  # half a round's statistics are in the file
    again = subprocess.run([*command, str(tmp_path / "b"), "--resume"], check=True, capture_output=True)
    assert json.loads(again.stdout)["model_sha256"] == whole["model_sha256"]


def test_which_gradient_is_watched_matters_and_without_tfs_all_is_colour(tiny, tmp_path):
    def model(method: str, **changes) -> str:
        config = configure(method, "draft", splats=600, steps=30, **{**GROWING, **changes})
        out = tmp_path / f"{method}-{len(list(tmp_path.iterdir()))}"
        return run_fit(tiny, config, out, eval_every=0)["model_sha256"]

    found = [model("spikenerf", tfs_weight=1.0, densify_by=by) for by in ("all", "colour", "tfs")]
    assert len({*found, model("spikenerf", tfs_weight=1.0, absgrad=True)}) == 4
    assert model("plain", densify_by="all") == model("plain", densify_by="colour")


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"absgrad": True}, "absgrad"),
        ({"densify": "mcmc", "densify_by": "colour"}, "densify_by"),
        ({"densify": "default", "densify_by": "tfs"}, "TfS term"),
        ({"densify": "default", "splats": 500, "splats_most": 400}, "splats_most"),
        ({"densify": "default", "absgrad": True, "device": "cuda"}, "device must be cpu"),
        ({"densify_share": 0.0}, "densify_share"),
    ],
)
def test_settings_that_do_not_hold_together_are_told(changes, told):
    with pytest.raises(UsageError) as caught:
        configure("plain", "draft", **changes)
    assert told in str(caught.value)


def test_the_rows_of_cost_densify_grow_to_one_number():
    rows = plan("spikenerf", 800, 3000, 9000)
    assert {c.splats_most or c.splats for c in rows.values()} == {3000, 9000}
    assert {(c.steps, c.tfs_weight) for c in rows.values()} == {(800, 20.0)}
    assert {c.densify_by for c in rows.values()} == {"all", "colour", "tfs"}
    assert "default, TfS alone" not in plan("plain", 800, 3000, 9000)
