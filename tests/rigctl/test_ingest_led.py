"""A take without a clock box: a plain blinking LED alone pairs frames and spikes, or the numbers say why not."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from emulated_takes import led_clocks, plan_of, take

from spikerig.dataset.cli import run
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.rawtake import open_take
from spikerig.dataset.store import open_scene
from spikerig.rigctl.forecast import forecast
from spikerig.rigctl.ingest import ingest
from spikerig.rigctl.ingest_times import read_truth
from spikerig.rigctl.view_parts import Near

SPEC = """
scene = "demo"
seed = 3
[spike]
ppm = 21.0
walk = 1e-8
ram_bytes = 16777216
[rgb]
ppm = -33.0
walk = 1e-8
[led]                # a lamp of its own: neither the plan's period nor where it is are told to the ingest
period_ms = 410.0
ppm = 40.0
walk = 1e-8
spike = [41.0, 30.0]
rgb = [20.0, 13.0]
radius_px = 3.0
"""
PLAN = """
name = "optical"
viewpoints = 3
seconds = 1.0
advance = "auto"
settle_s = 0.1
test_every = 3
[spike.wire]
name = "tiny"
width = 64
height = 48
row_bits = 64
rate_hz = 20000
link_bytes_s = 3.6e8
packet_bytes = 16384
[rgb]
lead_s = 0.05
[rgb.settings]
shutter = "1/240"
[sync]
mode = "optical"
[led]
period_ms = 400.0    # three per cent wrong
[checks]
focus = 0.0
spare_gb = 0.001
[recorder]
on_full = "wait"
segment_mb = 16
"""


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("led")
    (folder / "plan.toml").write_text(PLAN)
    (folder / "rig.toml").write_text(SPEC)
    plan, out = str(folder / "plan.toml"), str(folder / "take")
    assert run(["rig", "plan", plan, "-o", out]) == 0
    assert run(["rig", "record", plan, "-o", out, "--emulate", str(folder / "rig.toml")]) == 0
    return folder / "take"


@pytest.fixture
def folder(taken: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(taken, tmp_path / "take"))


def test_an_led_ties_every_frame_to_the_spikes(taken: Path) -> None:
    times, found, truth = led_clocks(taken)
    assert times.clocks.rig == "spike"
    assert found.missing == {}
    assert found.period_ns == pytest.approx(410e6 * (1 + 21e-6 - 40e-6), rel=1e-5)
    for name in ("000", "001", "002"):
        (spike,), (rgb,) = found.spike[name], found.rgb[name]
        assert (spike.x_px, spike.y_px) == pytest.approx((41, 30), abs=0.3)
        assert (rgb.x_px, rgb.y_px) == pytest.approx((20, 13), abs=0.3)
    off, claimed = [], []
    for clip in (r for r in truth[0]["rgb"] if r["event"] == "clip"):
        media, true = np.array(clip["media_ns"]), np.array(clip["true_ns"])
        model = times.clocks.fit("rgb", clip["number"], int(media[0])).model
        off.append(model.rig_from_device(media) - times.rig_from_true(truth[0], true))
        claimed.append(2 * model.sigma_at(media))
    wrong, claim = np.abs(np.concatenate(off)), np.concatenate(claimed)
    assert np.percentile(wrong, 99) <= 100_000
    assert (wrong <= claim).mean() >= 0.95
    assert np.median(claim) < 400_000


def test_the_whole_road_without_a_box(taken: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "s.h5"
    capsys.readouterr()
    assert run(["data", "ingest", str(taken), "-o", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["views"], told["test"], told["rgb_times"]) == (3, ["000"], {"sights": 3})
    assert told["led"]["period_ms"] == pytest.approx(410, abs=0.02)
    assert run(["data", "verify", str(out)]) == 0
    with open_scene(out) as file:
        scene = file.read()
    truth = read_truth(open_take(taken))
    for view in scene.views[1:]:
        assert not view.valid[30, 41]  # the LED
        assert view.valid[5, 50]
        assert view.trajectory is not None
        assert view.spikes is not None
    assert scene.info["clocks"]["rig"] == "spike"
    assert truth[0]["box"] is None
    # without any truth the same frames at the same times
    (taken / "truth.json").rename(tmp_path / "truth.json")
    try:
        ingest(taken, tmp_path / "blind.h5")
    finally:
        (tmp_path / "truth.json").rename(taken / "truth.json")
    with open_scene(tmp_path / "blind.h5") as file:
        blind = file.read()
    assert [v.frame.start_ns for v in blind.views[1:]] == [v.frame.start_ns for v in scene.views[1:]]


def test_a_light_that_blinks_too_fast_is_refused_with_the_numbers(tmp_path: Path) -> None:
    folder = tmp_path / "take"
    led = {"period_ms": 62.0, "spike": [41.0, 30.0], "rgb": [20.0, 13.0]}
    take(folder, plan_of(viewpoints=2, seconds=0.3, sync={"mode": "optical"}, led=led), led={"ppm": 5.0})
    _, found, _ = led_clocks(folder)
    assert sorted(found.missing) == ["000 rgb", "001 rgb"]
    for why in found.missing.values():
        assert "cannot be told" in why
        assert "period 62.0 ms" in why
        left = float(why.partition(", ")[2].split()[0])
        assert 130 < left < 400  # ms: by when its clip was started and stopped
    assert run(["data", "ingest", str(folder), "-o", str(tmp_path / "s.h5")]) == 4
    assert not (tmp_path / "s.h5").exists()


def test_an_led_that_is_not_where_the_plan_has_it(folder: Path) -> None:
    told = json.loads((folder / "take.json").read_text())
    told["plan"]["led"] |= {"spike": [10.0, 40.0]}
    (folder / "take.json").write_text(json.dumps(told))
    _, found, _ = led_clocks(folder)
    assert sorted(found.missing) == ["000 spike", "001 spike", "002 spike"]
    assert any("no even beat" in why for why in found.missing.values()), found.missing
    assert found.sights == []


def test_stamps_that_contradict_a_clips_length(folder: Path) -> None:
    lines = (folder / "views.jsonl").read_text().splitlines()
    view = json.loads(lines[-1])
    view["clip"]["stop_ns"] = [t + 10**9 for t in view["clip"]["stop_ns"]]
    (folder / "views.jsonl").write_text("\n".join([*lines[:-1], json.dumps(view), ""]))
    _, found, _ = led_clocks(folder)
    assert list(found.missing) == [f"{view['name']} rgb"]
    assert "does not agree with its length" in found.missing[f"{view['name']} rgb"]


@pytest.mark.parametrize(
    ("led", "where"),
    [({"spike": [1, 2, 3]}, "led.spike"), ({"period_ms": -1}, "led.period_ms"), ({"hue": 3}, "led.hue")],
)
def test_plans_of_leds_that_are_none(led: dict[str, Any], where: str) -> None:
    with pytest.raises(UsageError, match="a fault") as caught:
        plan_of(sync={"mode": "optical"}, led=led)
    assert where in str(caught.value)


def test_what_an_optical_plan_cannot_do_is_told_before(tmp_path: Path) -> None:
    def cannot(**more: Any) -> list[str]:
        told = forecast(plan_of(sync={"mode": "optical"}, **more), tmp_path, memory=8 << 30)
        return [reason["what"] for reason in told.cannot]

    assert cannot(seconds=1.0, led={"period_ms": 410}) == []
    assert any("LED" in what for what in cannot(seconds=0.3, led={"period_ms": 410}))
    assert any("RGB camera" in what for what in cannot(rgb={"use": False}))


def test_an_epoch_without_stamps_is_told() -> None:
    near = Near([])
    assert near.of_host(5) == 5
    with pytest.raises(DataError, match="no stamps tell"):
        near.of_spike(0, 0)
