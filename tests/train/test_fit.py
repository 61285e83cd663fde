"""The loop: the same bits always, resumed or not; every method runs; spikes help; divergence is told."""

import contextlib
import json
import signal
import subprocess
import sys
import time

import pytest
import torch

from spikerig.dataset.errors import NumericsError, UsageError
from spikerig.dataset.store import open_scene
from spikerig.train import checkpoint, run
from spikerig.train.fit import check_finite, load_state, save_state
from spikerig.train.methods import METHODS, configure
from spikerig.train.record import open_run
from spikerig.train.run import run_fit
from spikerig.train.score import score_run
from spikerig.train.targets import load_targets

SMALL = {"splats": 800, "steps": 40}


def fit(tiny, out, method="plain", **changes):
    options = {k: changes.pop(k) for k in ("force", "resume", "eval_every", "ply") if k in changes}
    return run_fit(tiny, configure(method, "draft", **(SMALL | changes)), out, **options)


NEED_MORE = ("mpr", "d2net", "colour-spikes")  # a network, a colour sensor


@pytest.mark.parametrize("method", [m for m in METHODS if m not in NEED_MORE])
def test_every_method_trains_and_says_what_it_did(tiny, tmp_path, method):
    done = fit(tiny, tmp_path / "run", method)
    assert done["steps"] == 40
    assert done["psnr"] > 14
    record = json.loads((tmp_path / "run/run.json").read_text())
    assert record["status"] == "complete"
    assert record["pose_label"] == "mid"
    assert record["config"]["method"] == method
    assert len(record["scene"]["sha256"]) == 64
    history = json.loads((tmp_path / "run/history.json").read_text())
    assert [row["step"] for row in history] == sorted({row["step"] for row in history})
    assert history[-1]["step"] == 40
    assert history[-1]["psnr"] == done["psnr"]


@pytest.mark.parametrize(
    ("method", "changes"),
    [
        ("plain", {}),
        ("spike-hybrid", {"gray": "learned", "background": "random"}),
        ("spikenerf-5x", {"densify": "mcmc", "densify_every": 10, "sh_degree": 1, "steps": 30}),
    ],
)
def test_same_bits_for_any_thread_count(tiny, tmp_path, threads, method, changes):
    found = set()
    for n in (1, 2, 3):
        threads(n)
        torch.set_num_threads(n)
        found.add(fit(tiny, tmp_path / f"run{n}", method, eval_every=0, **changes)["model_sha256"])
    torch.set_num_threads(1)
    assert len(found) == 1


def test_readings_of_w_are_the_same_weight_by_other_names(tiny, tmp_path):
    pixels = 64 * 40
    found = {
        fit(tiny, tmp_path / reading, "spikenerf", eval_every=0, tfs_weight=w, weight_reading=reading)["model_sha256"]
        for reading, w in (("mean", 10.0), ("sum-image", 10.0 / pixels))
    }
    assert len(found) == 1
    done = fit(tiny, tmp_path / "u8", "spikenerf", eval_every=0, tfs_weight=1e-4, weight_reading="u8")
    assert done["effective_tfs_weight"] == pytest.approx(6.5025)


@pytest.mark.parametrize(
    "changes",
    [
        {"textures": kind, "tfs_combine": combine, "tfs_domain": domain}
        for kind, combine, domain in (
            ("tfp", "average", "linear"),
            ("tfi", "average", "luma"),
            ("both", "sum", "encoded"),
            ("raw", "average", "naive"),
        )
    ]
    + [
        {"poses_per_view": 4, "textures_per_view": 1},
        {"poses_per_view": 1, "textures_per_view": 3, "fresh_poses": 1},
        {"poses_per_view": 3, "instants_rule": "endpoints", "pose_label": "first", "highlights": "keep"},
        {"ratio_until": 1.0, "ratio_instants": 1, "pose_label": "first"},
        {"ratio_until": 0.5, "ratio_instants": 2, "poses_per_view": 3, "gray": "rec601"},
        {"opacity_reg": 0.01, "scale_reg": 0.01, "background": "white", "antialias": True, "sh_degree": 2},
    ],
)
def test_every_switch_trains(tiny, tmp_path, changes):
    done = fit(tiny, tmp_path / "run", "spikenerf", steps=15, eval_every=0, **changes)
    assert done["steps"] == 15
    assert done["psnr"] > 10


def test_another_seed_is_another_model(tiny, tmp_path):
    a, b = (fit(tiny, tmp_path / str(seed), eval_every=0, seed=seed)["model_sha256"] for seed in (0, 1))
    assert a != b


KILLED = """
import os, signal, sys
from spikerig.train import checkpoint
save, asked = checkpoint.save, []
def dies(*told):
    asked.append(1)
    if len(asked) == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    save(*told)
checkpoint.save = dies
from spikerig.dataset import cli
sys.exit(cli.run(sys.argv[1:]))
"""


def test_killed_and_resumed_is_as_if_never_killed(tiny, tmp_path):
    """kill -9 some steps after the second checkpoint."""
    words = ["train", "fit", str(tiny), "--method", "spike-hybrid", "--preset", "draft", "--splats", "800"]
    words += ["--steps", "400", "--gray", "learned", "--set", "densify=mcmc", "--eval-every", "0", "--json"]
    words += ["--checkpoint-every", "0.05", "-o"]
    command = [sys.executable, "-m", "spikerig.dataset", *words]
    whole = json.loads(subprocess.run([*command, str(tmp_path / "a")], check=True, capture_output=True).stdout)
    child = subprocess.run(
        [sys.executable, "-c", KILLED, *words, str(tmp_path / "b")], capture_output=True, check=False
    )
    assert child.returncode == -signal.SIGKILL, child.stderr.decode()
    state = tmp_path / "b/checkpoint.safetensors"
    assert json.loads((tmp_path / "b/run.json").read_text())["status"] == "running"
    assert 0 < load_state(state)[0].step < 400
    done = json.loads(
        subprocess.run([*command, str(tmp_path / "b"), "--resume"], check=True, capture_output=True).stdout
    )
    assert done["steps"] == 400
    assert done["model_sha256"] == whole["model_sha256"]


def test_a_run_is_not_overwritten_and_not_resumed_with_other_settings(tiny, tmp_path):
    fit(tiny, tmp_path / "run")
    with pytest.raises(UsageError, match="a run already"):
        fit(tiny, tmp_path / "run")
    with pytest.raises(UsageError, match="settings it began with") as caught:
        fit(tiny, tmp_path / "run", resume=True, lr_means=1e-3)
    assert "lr_means" in str(caught.value.value)
    assert fit(tiny, tmp_path / "run", resume=True)["steps"] == 40
    assert fit(tiny, tmp_path / "run", force=True)["steps"] == 40
    (tmp_path / "other").mkdir()
    (tmp_path / "other/thesis.tex").write_text("x")
    with pytest.raises(UsageError, match="no run"):
        fit(tiny, tmp_path / "other", force=True)
    assert (tmp_path / "other/thesis.tex").exists()


def test_a_run_by_seconds_stops_and_counts_only_training(tiny, tmp_path):
    start = time.monotonic()
    done = fit(tiny, tmp_path / "run", seconds=0.5, steps=1)
    assert 0.5 <= done["train_seconds"] < time.monotonic() - start
    assert done["steps"] > 1


def test_spikes_help_and_the_first_pose_costs(tiny, tmp_path):
    """The demo's claims in small: sharper with TfS and with ours than without, worse with the first-pose label."""
    found = {}
    with open_scene(tiny) as scene:
        for name, method, changes in (
            ("plain", "plain", {}),
            ("first", "plain", {"pose_label": "first"}),
            ("tfs", "spikenerf", {}),
            ("ratio", "spike-ratio", {}),
            ("hybrid", "spike-hybrid", {}),
            ("oracle", "oracle", {}),
        ):
            fit(tiny, tmp_path / name, method, steps=250, eval_every=0, **changes)
            found[name] = score_run(open_run(tmp_path / name).model, scene)["blur_view"]["psnr"]
    assert found["tfs"] > found["plain"] + 1
    assert found["oracle"] > found["hybrid"] > found["plain"] + 1
    assert found["oracle"] > found["ratio"] > found["tfs"]
    assert found["first"] < found["plain"] - 1


def test_a_target_that_is_not_finite_is_told_by_step_and_view(tiny, tmp_path, monkeypatch):
    def spoiled(*arguments):
        found = load_targets(*arguments)
        found.views[2].frame[3, 4, 1] = float("nan")
        return found

    monkeypatch.setattr(run, "load_targets", spoiled)
    with pytest.raises(NumericsError, match="diverged at step") as caught:
        fit(tiny, tmp_path / "run")
    assert caught.value.exit_code == 5
    assert "targets" in str(caught.value.value)


@pytest.mark.parametrize("tensor", ["means", "sh"])
def test_a_broken_parameter_is_told_by_name_and_index(tiny, tmp_path, tensor):
    fit(tiny, tmp_path / "run")
    state, _ = load_state(tmp_path / "run/checkpoint.safetensors")
    check_finite(state)
    with torch.no_grad():
        state.params[tensor].view(-1)[7] = float("inf")
    with pytest.raises(NumericsError) as caught:
        check_finite(state)
    assert "step 40" in str(caught.value)
    assert f"{tensor}, index [2, " in str(caught.value.value)


def test_hostile_rates_end_in_a_model_or_a_clear_error(tiny, tmp_path):
    for rate in ("lr_scales", "lr_means", "lr_colours", "lr_opacities", "lr_quats"):
        with contextlib.suppress(NumericsError):
            fit(tiny, tmp_path / rate, eval_every=0, **{rate: 9e5})
            assert all(torch.isfinite(p).all() for p in open_run(tmp_path / rate).model.splats.tensors().values())


def test_state_survives_the_file(tiny, tmp_path):
    fit(tiny, tmp_path / "run", "spike-hybrid")
    state, config = load_state(tmp_path / "run/checkpoint.safetensors")
    save_state(tmp_path / "again.safetensors", state, configure("spike-hybrid", "draft", **SMALL))
    first, _ = checkpoint.load(tmp_path / "run/checkpoint.safetensors")
    second, _ = checkpoint.load(tmp_path / "again.safetensors")
    assert first.keys() == second.keys()
    assert all(torch.equal(first[k], second[k]) for k in first)
    assert config["method"] == "spike-hybrid"
    assert len(open_run(tmp_path / "run").model.splats) == 800
