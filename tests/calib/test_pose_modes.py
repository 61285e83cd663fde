"""Poses in other ways (as a rig, by the global mapper), and hard inputs: each is refused, or said to be what it is."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from spikerig.calib.gauge import pose_errors
from spikerig.calib.mapping import Map, Options, Placed
from spikerig.calib.poses import Estimate, Wanted, estimate_poses
from spikerig.dataset.errors import UsageError
from spikerig.dataset.scene import Camera, View
from spikerig.dataset.store import open_scene
from spikerig.rigctl.sim.capture import capture
from spikerig.rigctl.sim.spec import load_scene_toml

Seen = tuple[list[View], Camera]
ONE = Wanted(kinds=("tfp96",), maps=1, instants=1)
OPTIONS = Options(threads=1)


def seen(folder: Path, **orbit: object) -> Seen:
    spec = load_scene_toml("demo")
    spec = dataclasses.replace(
        spec,
        orbit=dataclasses.replace(spec.orbit, **{"views": 6, "arc_deg": 24.0, "test_every": 0, "test": (), **orbit}),
        exposure=dataclasses.replace(spec.exposure, sub_poses=5),
    )
    capture(spec, folder / "few.h5", workers=1)
    with open_scene(folder / "few.h5") as scene:
        return [scene.view(n) for n in scene.names], scene.camera


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> Seen:
    """Six views of the demo's world over 24 degrees."""
    return seen(tmp_path_factory.mktemp("few"))


def off(found: Estimate, views: list[View]) -> tuple[float, float]:
    """Median degrees and share of the extent."""
    names = sorted(found.poses)
    truth = {v.name: v.pose.cam_from_world for v in views}
    turned, moved = pose_errors(*(np.stack([m[n] for n in names]) for m in (found.poses, truth)))
    return float(np.median(turned)), float(np.median(moved))


def test_two_arms_as_a_rig(few: Seen) -> None:
    """The blurry frames join the textures; the spike arm's poses come back, under the views' names."""
    views, camera = few
    found = estimate_poses(views, camera, dataclasses.replace(ONE, arms="both"), OPTIONS)
    assert found.reasons == ()
    assert sorted(found.poses) == [v.name for v in views]
    assert found.best.models[0] == 12
    turned, moved = off(found, views)
    assert turned < 2.5
    assert moved < 0.02


def test_the_global_mapper(few: Seen) -> None:
    views, camera = few
    found = estimate_poses(views, camera, ONE, dataclasses.replace(OPTIONS, mapper="global"))
    assert found.reasons == ()
    assert len(found.poses) == 6
    turned, moved = off(found, views)
    assert turned < 1.5
    assert moved < 0.02


def test_pictures_without_anything(few: Seen) -> None:
    """Not one spike: all textures are black."""
    views = [
        dataclasses.replace(v, spikes=dataclasses.replace(v.spikes, bits=np.zeros_like(v.spikes.bits)))
        for v in few[0]
        if v.spikes is not None
    ]
    found = estimate_poses(views, few[1], ONE, OPTIONS)
    assert found.poses == {}
    assert any("only 0 of 6" in r for r in found.reasons)


def test_identical_views(few: Seen) -> None:
    """One picture, six times: a scale cannot be found."""
    views = [dataclasses.replace(few[0][0], name=v.name) for v in few[0]]
    assert estimate_poses(views, few[1], ONE, OPTIONS).reasons


def test_one_place(tmp_path: Path) -> None:
    """The camera turns and does not move: no depth, no scale, whatever the mapper makes of it."""
    views, camera = seen(tmp_path, radius=0.001, target=(0.0, -1.6, 1.25), arc_deg=50.0)
    assert estimate_poses(views, camera, Wanted(kinds=("tfp96", "adaptive"), maps=2, instants=1), OPTIONS).reasons


def test_too_few_views(few: Seen) -> None:
    with pytest.raises(UsageError, match="three views"):
        estimate_poses(few[0][:2], few[1], ONE, OPTIONS)


@pytest.mark.parametrize("times", [0.5, 1.3, 2.0])
def test_another_cameras_intrinsics(few: Seen, times: float) -> None:
    """A wrong focal length still gives a map with small residuals; freed, it moves back and takes residual along."""
    views, camera = few
    wrong = dataclasses.replace(camera, K=camera.K * [[times, 1, 1], [1, times, 1], [1, 1, 1]])
    found = estimate_poses(views, wrong, ONE, OPTIONS)
    assert any("focal" in r for r in found.reasons), (found.best.focal, found.reasons)
    assert found.best.focal["ratio"] * times == pytest.approx(1, abs=0.1)


def test_the_right_intrinsics_are_not_doubted(few: Seen) -> None:
    found = estimate_poses(*few, ONE, OPTIONS)
    assert found.reasons == ()
    assert found.best.focal["ratio"] == pytest.approx(1, abs=0.05)


def test_a_second_try_keeps_its_own_name(few: Seen, monkeypatch: pytest.MonkeyPatch) -> None:
    """Too few placed: the spare kinds are mapped one by one, to the last, and then all again for low contrast."""
    made: list[str] = []

    def nothing(self: object, kind: str, first: bool = False) -> Map:
        made.append(kind)
        return Map()

    monkeypatch.setattr("spikerig.calib.poses._Rigged.map", nothing)
    wanted = Wanted(kinds=("tfp48", "tfp64", "tfp96", "tfp128"), maps=1, instants=1)
    found = estimate_poses(*few, wanted, OPTIONS)
    assert len(set(made)) == 4
    assert set(found.kinds) == {*made, f"{made[0]}, low contrast"}
    assert found.reasons


def test_a_second_try_ends_when_enough_are_placed(few: Seen, monkeypatch: pytest.MonkeyPatch) -> None:
    views, camera = few
    rows: list[Callable[[], Map]] = [Map, lambda: Map({v.name: Placed(v.pose.cam_from_world, 99) for v in views})]
    monkeypatch.setattr("spikerig.calib.poses._Rigged.map", lambda self, kind, first=False: rows.pop(0)())
    wanted = Wanted(kinds=("tfp48", "tfp64", "tfp96", "tfp128"), maps=1, instants=1)
    assert len(estimate_poses(views, camera, wanted, OPTIONS).poses) == 6
    assert rows == []


def test_only_the_mapped_pictures_are_paired() -> None:
    """Further instants are matched later, with a few neighbours; a rig's arms of one frame count as one."""
    from spikerig.calib.colmap_child import _pairs

    names = [f"{k:03d}.png" for k in range(30)]
    every = _pairs({"map": names, "place": ["000.at001.png"], "pairs": "exhaustive", "overlap": 10})
    assert len(every) == 30 * 29 // 2
    near = _pairs({"map": names, "pairs": "sequential", "overlap": 2})
    assert {int(b[:3]) - int(a[:3]) for a, b in near} == {1, 2}
    both = _pairs(
        {"map": [f"{arm}/{n}" for arm in ("spike", "rgb") for n in names], "pairs": "sequential", "overlap": 1}
    )
    assert ("rgb/000.png", "spike/001.png") in both
    assert ("rgb/000.png", "spike/002.png") not in both
