"""`spikerig cost train`: which runs there are, that finished ones are not run again, a run in its own process."""

import json

import pytest

from spikerig.dataset.errors import UsageError
from spikerig.train import cost, onerun
from spikerig.train.methods import configure


def made(config):
    return {"psnr": 20.0 + config["seed"], "cpu_seconds": 2.0, "train_seconds": 1.0, "peak_bytes": 10**8}


def test_every_series_is_there_and_of_the_field_asked_for():
    every = list(cost.plan(50))
    assert len({(series, value) for series, value, _ in every}) == len(every)
    kinds = [value for _, value, _ in cost.plan(50, ("textures",))]
    assert kinds == ["raw", "tfp", "tfi", "both", "tfi-window", "raw, linear"]
    rays = list(cost.plan(50, field="nerf-fast"))
    assert {config.field for _, _, config in rays} == {"nerf-fast"}
    assert not any("one rendered" in series for series, _, _ in rays)
    with pytest.raises(UsageError, match="no such series"):
        list(cost.plan(50, ("steps", "phase")))


def test_a_sweep_goes_on_where_it_stopped(tiny, tmp_path, monkeypatch):
    settings = list(cost.plan(5, ("readings",)))
    ran = []

    def fragile(scene, config):
        if len(ran) == 3:
            raise KeyboardInterrupt
        ran.append(config["weight_reading"])
        return made(config)

    monkeypatch.setattr(cost, "run_apart", fragile)
    with pytest.raises(KeyboardInterrupt):
        cost.sweep(tiny, settings, 1, tmp_path / "runs")
    assert len(list((tmp_path / "runs").glob("*.json"))) == 3
    monkeypatch.setattr(
        cost, "run_apart", lambda scene, config: (ran.append(config["weight_reading"]), made(config))[1]
    )
    done = cost.sweep(tiny, settings, 1, tmp_path / "runs")
    assert ran == list(cost.READINGS)
    assert [row.value for row in done.rows] == list(cost.READINGS)
    assert done.rows[0].error == pytest.approx(0.1)
    more = cost.sweep(tiny, settings, 3, tmp_path / "runs")  # only the new seeds are run
    assert len(ran) == 3 * len(settings)
    assert more.rows[0].error == pytest.approx(10 ** (-21 / 20))


def test_other_settings_are_other_runs(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(cost, "run_apart", lambda scene, config: made(config))
    for steps in (5, 6):
        cost.sweep(tiny, list(cost.plan(steps, ("readings",))), 1, tmp_path)
    assert len(list(tmp_path.glob("*.json"))) == 2 * len(cost.READINGS)


def test_a_run_of_its_own_tells_its_memory_and_its_failure(tiny):
    config = configure("oracle", "draft", "splat", steps=2, splats=200).as_json()
    done = onerun.run_apart(tiny, config)
    assert done["steps"] == 2
    assert done["psnr"] > 5
    assert 5e7 < done["peak_bytes"] < 1e10
    with pytest.raises(UsageError, match="a run of this sweep failed") as caught:
        onerun.run_apart(tiny.with_name("none.h5"), config)
    assert "none.h5" in str(caught.value)
    assert json.dumps(config)  # what a job file holds
