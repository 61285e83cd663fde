"""When a fit diverges: the very step is found, the state before it kept, and the step can be taken again."""

import json
import subprocess
import sys

import pytest
import torch

from spikerig.dataset.errors import DataError, NumericsError
from spikerig.train import fit, guard, record
from spikerig.train.fit import load_state
from spikerig.train.methods import configure
from spikerig.train.run import run_fit

BREAKS = 23  # between two looks of the loop, which are at 0 and 50


def settings(method="plain", **changes):
    return configure(method, "draft", **({"splats": 300, "steps": 120} | changes))


@pytest.fixture
def broken(tiny, tmp_path, monkeypatch):
    """A run whose step 23 leaves an infinite colour, told only by the look at step 50."""
    real = fit._descend

    def spoiled(state, task, fraction):
        real(state, task, fraction)
        if state.step == BREAKS:
            with torch.no_grad():
                state.params["quats"].view(-1)[9] = float("inf")

    monkeypatch.setattr(fit, "_descend", spoiled)
    monkeypatch.setattr(fit, "view_loss", _without_refusal(fit.view_loss))
    with pytest.raises(NumericsError) as caught:
        run_fit(tiny, settings(), tmp_path / "run", eval_every=0)
    return tmp_path / "run", caught.value


def _without_refusal(real):
    """The loss with what is not finite put to zero, so that only the loop's own look can find it."""

    def loss(state, task, view, step):
        with torch.no_grad():
            kept = {n: p.clone() for n, p in state.params.items()}
            for p in state.params.values():
                p.nan_to_num_(0, 0, 0)
        value = real(state, task, view, step)
        with torch.no_grad():
            for n, p in state.params.items():
                p.data = kept[n]
        return value

    return loss


def test_the_first_step_that_broke_is_found_not_the_look_that_saw_it(broken):
    folder, error = broken
    assert f"step {BREAKS + 1}:" in error.what  # seen once step 23 is done
    assert "quats, index [2, 1]" in str(error.value)
    assert f"spikerig train diverged {folder}" in error.next
    state, config = load_state(folder / record.DIVERGED)
    assert state.step == BREAKS
    assert config["method"] == "plain"
    assert all(torch.isfinite(p).all() for p in state.params.values())


def test_a_run_that_goes_on_takes_the_file_away(broken, tiny):
    folder, _ = broken
    record.prepare_folder(folder, force=True, resume=False)
    assert not (folder / record.DIVERGED).exists()


def test_a_copy_is_left_alone_by_later_steps(tiny, tmp_path):
    run_fit(tiny, settings("spike-hybrid", steps=20), tmp_path / "run", eval_every=0)
    state, _ = load_state(tmp_path / "run/checkpoint.safetensors")
    copy = guard.copy_state(state)
    before = {n: p.detach().clone() for n, p in copy.params.items()}
    with torch.no_grad():
        for p in state.params.values():
            p += 1
        for mean, _ in state.moments.values():
            mean += 1
    state.memory.clear()
    state.history.append({})
    assert all(torch.equal(copy.params[n], before[n]) for n in before)
    assert all((mean != state.moments[n][0]).all() for n, (mean, _) in copy.moments.items() if mean.numel())
    assert copy.memory
    assert {} not in copy.history


def test_a_failure_that_does_not_come_again_is_told_as_such(tiny, tmp_path, monkeypatch):
    real, calls = fit._descend, []

    def once(state, task, fraction):
        real(state, task, fraction)
        calls.append(state.step)
        if calls.count(30) == 1 and state.step == 30:
            raise NumericsError("training diverged at step 30: a passing cloud")

    monkeypatch.setattr(fit, "_descend", once)
    with pytest.raises(NumericsError, match="did not break") as caught:
        run_fit(tiny, settings(), tmp_path / "run", eval_every=0)
    assert "a passing cloud" in caught.value.what
    state, _ = load_state(tmp_path / "run" / record.DIVERGED)
    assert state.step == 1  # after the look at step 0


def spikerig(*words):
    return subprocess.run([sys.executable, "-m", "spikerig.dataset", *map(str, words)], capture_output=True, text=True)


def test_the_command_takes_the_step_again(tiny, tmp_path):
    """A true divergence, in a process of its own: eight layers whose weights grow by 9e5 a step overflow."""
    fit_it = ("train", "fit", tiny, "-o", tmp_path / "run", "--field", "nerf", "--preset", "draft", "--steps", 60)
    small = ("rays=32", "coarse=8", "fine=8", "width=16", "lr_net=9e5")
    done = spikerig(*fit_it, *(word for each in small for word in ("--set", each)), "--json")
    if done.returncode == 0:
        pytest.fail("these rates no longer break a fit: choose others")
    error = json.loads(done.stdout)["error"]
    assert (done.returncode, error["type"]) == (5, "NumericsError")
    assert "train diverged" in error["next"]
    again = spikerig("train", "diverged", tmp_path / "run", "--json")
    assert again.returncode == 1, again.stderr
    told = json.loads(again.stdout)
    assert told["breaks"] is True
    assert "breaks again" in again.stderr
    assert all(kinds["value"]["not_finite"] == 0 for kinds in told["tensors"].values())
    assert "Traceback" not in again.stderr


def test_a_run_that_did_not_diverge_and_another_scene_are_refused(tiny, tmp_path, broken):
    run_fit(tiny, settings(steps=5), tmp_path / "good", eval_every=0)
    done = spikerig("train", "diverged", tmp_path / "good")
    assert done.returncode == 4
    assert "has not diverged" in done.stderr
    other = tmp_path / "other.h5"
    other.write_bytes(tiny.read_bytes() + b"x")
    done = spikerig("train", "diverged", broken[0], "--scene", other)
    assert done.returncode == 4
    with pytest.raises(DataError):
        record.open_run(tmp_path / "nowhere")
