"""Checks that hold both arms' light together: true on hard sensors, undecided where nothing can be said."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hard_sim import small
from spoil_checks import SIZE, TIME, bits, frame, late, pixels, rolled, spikes, views

from spikerig.calib.check_cli import check_scene, chosen
from spikerig.calib.lag import Lagged, lag_of, lagged
from spikerig.calib.parity import inverse
from spikerig.calib.rig import RigCalibration, write_calibration
from spikerig.dataset import cli
from spikerig.dataset.check import Result
from spikerig.dataset.check_look import Undecided
from spikerig.dataset.scene import Pose, Scene
from spikerig.dataset.store import open_scene, write_scene
from spikerig.rigctl.sim.capture import capture

FIVE: dict[str, Any] = {"orbit__views": 5, "orbit__test": [3], "shake__path_px": [6, 8], "effects": ["threshold_fpn"]}


def played(path: Path, **changes: Any) -> Scene:
    capture(small(**{**SIZE, **TIME, **FIVE, **changes}), path, workers=1)
    with open_scene(path) as file:
        return file.read()


def light_of(path: Path, *names: str) -> dict[str, Result]:
    checks = names or ("frames-are-in-step", "brightness-agrees", "edges-lie-together")
    return {r.check.name: r for r in check_scene(path, chosen(",".join(checks)))}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return played(tmp_path_factory.mktemp("light") / "scene.h5")


HARD: dict[str, dict[str, Any]] = {
    "a rolling shutter": {"effects": [{"name": "rolling_shutter", "readout_ms": 8.0}, "threshold_fpn"]},
    "noise of every kind": {"effects": ["shot_noise", "dark_current", "threshold_fpn", "initial_phase", "read_noise"]},
    "a Bayer sensor": {"sensor__colour": "bayer"},
}


@pytest.mark.parametrize("kind", HARD)
def test_good_scenes_of_hard_sensors_pass(tmp_path: Path, kind: str) -> None:
    played(tmp_path / "scene.h5", **HARD[kind])
    found = light_of(tmp_path / "scene.h5")
    assert {name: r.status for name, r in found.items()} == dict.fromkeys(found, "passed"), [
        (f.message, r.undecided) for r in found.values() for f in r.findings
    ]
    assert abs(found["frames-are-in-step"].figures["lag_ticks"]) < 1


@pytest.mark.parametrize("ticks", [-20, -5, 3, 9, 30])
def test_a_lag_is_measured(scene: Scene, tmp_path: Path, ticks: int) -> None:
    """Pictures that say a time `ticks` too late fit spikes of so many ticks earlier."""
    write_scene(tmp_path / "late.h5", late(ticks)(scene))
    (found,) = light_of(tmp_path / "late.h5", "frames-are-in-step").values()
    assert found.figures["lag_ticks"] == pytest.approx(-ticks, abs=1)
    assert found.figures["sd_ticks"] < 1


def test_misaligned_pictures_do_not_look_late(scene: Scene, tmp_path: Path) -> None:
    write_scene(tmp_path / "off.h5", pixels(lambda p: np.roll(p, 2, 1))(late(9)(scene)))
    (found,) = light_of(tmp_path / "off.h5", "frames-are-in-step").values()
    assert found.figures["lag_ticks"] == pytest.approx(-9, abs=2)


def test_what_cannot_be_decided_is_said(scene: Scene, tmp_path: Path) -> None:
    still = played(tmp_path / "still.h5", shake__path_px=[0, 0])
    cases: list[tuple[Scene, str, str]] = [
        (still, "frames-are-in-step", "ticks only"),
        (views(lambda v: replace(v, spikes=None))(scene), "frames-are-in-step", "no spikes"),
        (frame(exposure_ns=0)(scene), "frames-are-in-step", "has no length"),
        (late(400)(scene), "edges-lie-together", "outside the spikes"),
        (spikes(lambda s: replace(s, rate_hz=None))(scene), "brightness-agrees", "no rate"),
        (spikes(lambda s: replace(s, bits=s.bits[:, :30]))(scene), "edges-lie-together", "different sizes"),
        (spikes(lambda s: replace(s, clock="own"))(scene), "edges-lie-together", "different clocks"),
        (pixels(lambda p: np.full_like(p, 90))(scene), "edges-lie-together", "no edges"),
        (bits(np.ones_like)(pixels(lambda p: np.full_like(p, 255))(scene)), "brightness-agrees", "too few pixels"),
        (replace(scene, views=scene.views[:2], truth=None), "frames-are-in-step", "3 views"),
    ]
    for k, (spoiled, name, why) in enumerate(cases):
        write_scene(tmp_path / f"{k}.h5", spoiled)
        (found,) = light_of(tmp_path / f"{k}.h5", name).values()
        assert found.status == "undecided", (name, why, found.findings)
        assert any(why in text for text in found.undecided.values()), (why, found.undecided)


def test_an_aligned_scene_of_a_bent_spike_lens(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Spikes stay raw: the check brings their textures onto the scene's camera by the scene's own calibration."""
    bend = {"name": "distortion", "arm": "spike", "k1": -0.3}
    raw = tmp_path / "raw.h5"
    scene = played(raw, effects=[bend, "threshold_fpn"])
    assert light_of(raw, "edges-lie-together")["edges-lie-together"].status == "failed"
    lens = replace(scene.camera, distortion=np.array([-0.3, 0, 0, 0]))
    same = inverse(np.eye(4)[:3])
    rig = RigCalibration(lens, scene.camera, Pose(same), "common", None, (1000.0, 5000.0))
    write_calibration(tmp_path / "calib.json", rig)
    assert cli.run(["calib", "align", str(raw), "--with", str(tmp_path / "calib.json")]) == 0
    found = light_of(raw)
    assert {r.status for r in found.values()} == {"passed"}, [f.message for r in found.values() for f in r.findings]
    with open_scene(raw) as file:
        aligned = file.read()
    write_scene(tmp_path / "forgot.h5", replace(aligned, calibration=None))
    assert light_of(tmp_path / "forgot.h5", "edges-lie-together")["edges-lie-together"].status == "failed"
    capsys.readouterr()


def drawn(lag: float, shift: float, seed: int) -> Lagged:
    """A picture that moves one way or the other, seen `lag` ticks late and `shift` pixels off, at 13 lags."""
    rng = np.random.default_rng(seed)
    wave = rng.normal(size=(12, 4))
    y, x = np.indices((40, 60)) / 8

    def light(at: float, off: float) -> np.ndarray:
        u, v = x + off / 8 + (-1) ** seed * at / 40, y
        return np.sum([a * np.sin(b * u + c * v + d) for a, b, c, d in wave], axis=0) + 9

    lags = np.arange(-30, 31, 5)
    good = np.ones((40, 60), bool)
    picture = np.stack([light(0, shift)] * 3, -1).astype(np.float32) * np.array([1, 0.5, 0.2], np.float32)
    return lagged(lags, [light(k + lag, 0).astype(np.float32) for k in lags], picture, good, 100.0)


def test_one_shift_of_all_views_is_told_from_a_lag() -> None:
    found = lag_of([drawn(7.0, 0.4, seed) for seed in range(6)])
    assert found.ticks == pytest.approx(-7, abs=1)
    assert not found.at_end
    far = lag_of([drawn(80.0, 0.0, seed) for seed in range(6)])
    assert far.at_end or far.sd > 2
    with pytest.raises(Undecided, match="3 views"):
        lag_of([drawn(0, 0, 1), drawn(0, 0, 2)])


def test_views_of_other_lags_are_left_out() -> None:
    views = [drawn(0.0, 0.0, seed) for seed in range(4)]
    odd = replace(views[0], lags=views[0].lags * 2)
    assert lag_of([*views, odd]) == lag_of(views)


def test_shifted_edges_are_told_in_pixels(scene: Scene, tmp_path: Path) -> None:
    write_scene(tmp_path / "off.h5", pixels(rolled)(scene))
    (found,) = light_of(tmp_path / "off.h5", "edges-lie-together").values()
    assert found.figures["median_px"] == pytest.approx(3, abs=0.3)
