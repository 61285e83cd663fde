"""Capture plans: all faults at once, and what a plan comes to before anything is touched."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from spikerig.dataset.cli import run
from spikerig.dataset.errors import UsageError
from spikerig.rigctl import forecast as forecasts
from spikerig.rigctl.forecast import forecast
from spikerig.rigctl.take_plan import SHIPPED, load_plan, plan_text, read_plan

GOOD = {"name": "a", "viewpoints": 40, "seconds": 2.0}


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_plans_hold(name: str, tmp_path: Path) -> None:
    plan = load_plan(name)
    assert len(plan.viewpoints) == 40
    told = forecast(plan, tmp_path, memory=8 << 30)
    assert [reason["what"] for reason in told.cannot if "disk" not in reason["what"]] == []
    (tmp_path / "copy.toml").write_text(plan_text(name))
    assert load_plan(tmp_path / "copy.toml") == plan


def test_all_faults_are_told_at_once() -> None:
    bad = {
        "name": "a b", "viewpoints": ["x", "x"], "seconds": -1, "advance": "car", "colour": 3,
        "spike": {"profile": "vidor"}, "rgb": {"use": "yes", "settings": 3}, "sync": {"mode": "bux"},
        "checks": {"exposure": [0.9, 0.1]}, "recorder": {"ring_s": 1e9, "on_full": "weep"},
    }  # fmt: skip
    with pytest.raises(UsageError, match="12 faults") as caught:
        read_plan(bad)
    text = str(caught.value)
    places = (
        "name", "viewpoints", "seconds", "advance", "colour", "spike.profile", "rgb.use", "rgb.settings", "sync.mode",
        "checks.exposure", "recorder.ring_s", "recorder.on_full",
    )  # fmt: skip
    assert [place for place in places if f"{place}:" not in text] == []


@pytest.mark.parametrize("told", [0, -1, 10_001, True, 2.5, [], ["a", 3], ["../x"], "40"])
def test_viewpoints_are_a_number_or_names(told: object) -> None:
    with pytest.raises(UsageError, match="a fault"):
        read_plan(GOOD | {"viewpoints": told})


def test_names_and_own_profiles(tmp_path: Path) -> None:
    assert read_plan(GOOD | {"viewpoints": ["left", "right"]}).viewpoints == ("left", "right")
    wire = {"name": "mine", "width": 64, "height": 48, "row_bits": 64, "rate_hz": 20_000}
    assert read_plan(GOOD | {"spike": {"wire": wire}}).profile.tick_bytes == 384
    (tmp_path / "mine.toml").write_text("\n".join(f"{k} = {json.dumps(v)}" for k, v in wire.items()))
    (tmp_path / "plan.toml").write_text(
        'name = "a"\nviewpoints = 1\nseconds = 1\n[spike]\nprofile = "mine.toml"\n', encoding="utf-8"
    )
    assert load_plan(tmp_path / "plan.toml").profile.name == "mine"
    with pytest.raises(UsageError, match="a fault"):
        read_plan(GOOD | {"spike": {"wire": wire | {"row_bits": 8}}})


@pytest.mark.parametrize("text", ["name = ", "\xff"])
def test_files_that_are_no_plan(tmp_path: Path, text: str) -> None:
    (tmp_path / "p.toml").write_bytes(text.encode("latin1"))
    with pytest.raises(UsageError):
        load_plan(tmp_path / "p.toml")
    with pytest.raises(UsageError, match="cannot read"):
        load_plan(tmp_path / "none.toml")


def test_the_forecast_is_what_would_be_written(tmp_path: Path) -> None:
    told = forecast(read_plan(GOOD), tmp_path, memory=8 << 30)
    assert told.view_bytes == 40 * (12_800_000 + 4096)  # 2 s are 39.06 chunks of 51.2 ms
    assert told.spike_bytes == 40 * told.view_bytes
    assert told.clip_bytes == round(40 * 3.0 * 60e6 / 8)
    assert told.ring_bytes == 22 * (12_800_000 + 4096)
    assert told.seconds == 120
    assert forecast(read_plan(GOOD), tmp_path, done=30, memory=8 << 30).spike_bytes == 10 * told.view_bytes


def test_every_reason_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forecasts.shutil, "disk_usage", lambda _: SimpleNamespace(free=10_000_000_000))
    table = GOOD | {
        "spike": {"profile": "vidar-400x250-40k-416"}, "rgb": {"card_gb": 0.1}, "recorder": {"memory_mb": 1500},
    }  # fmt: skip
    told = forecast(read_plan(table), tmp_path / "not" / "there", memory=100_000_000)
    what = [reason["what"] for reason in told.cannot]
    assert [w.split(":")[0] for w in what] == [
        "the camera makes more bytes than its link can carry", "not enough room", "not enough room", "not enough room",
    ]  # fmt: skip
    assert "520 MB/s" in told.cannot[0]["value"]
    tight = forecast(read_plan(GOOD | {"recorder": {"memory_mb": 100}}), tmp_path, memory=8 << 30)
    assert any("memory it may have" in reason["what"] for reason in tight.cannot)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forecasts.shutil, "disk_usage", lambda _: SimpleNamespace(free=100_000_000_000))
    monkeypatch.setattr(forecasts, "_free_memory", lambda: 8 << 30)
    copy = tmp_path / "p.toml"
    assert run(["rig", "plan", "example", "-o", str(tmp_path), "--save", str(copy), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["ok"] is True
    assert told["plan"]["viewpoints"][39] == "039"
    assert run(["rig", "plan", "example", "--save", str(copy)]) == 2  # it is there
    copy.write_text(copy.read_text().replace("20k", "40k"))
    capsys.readouterr()
    assert run(["rig", "plan", str(copy)]) == 1
    said = capsys.readouterr().err
    assert "CANNOT  the camera makes more bytes" in said
    assert "500 MB/s" in said
