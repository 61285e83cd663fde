"""Poses of a simulated scene with truth: found on spikes, refused where they are not, written into the scene."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from calib_worlds import moved, path, ring, turn

from spikerig.calib.consensus import averaged, paths_through
from spikerig.calib.gauge import degrees_apart, pose_errors
from spikerig.calib.mapping import Map, Options, Placed
from spikerig.calib.pose_verdict import judged
from spikerig.calib.poses import Estimate, Wanted, estimate_poses, tick_at
from spikerig.dataset import cli
from spikerig.dataset.errors import UsageError
from spikerig.dataset.store import open_scene, verify_scene
from spikerig.rigctl.sim.capture import capture
from spikerig.rigctl.sim.spec import load_scene_toml


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine views of the demo's world over 36 degrees, one held out."""
    spec = load_scene_toml("demo")
    spec = dataclasses.replace(
        spec,
        orbit=dataclasses.replace(spec.orbit, views=9, arc_deg=36.0, test_every=0, test=(8.0,)),
        exposure=dataclasses.replace(spec.exposure, sub_poses=9),
    )
    path = tmp_path_factory.mktemp("poses") / "nine.h5"
    capture(spec, path, workers=1)
    return path


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict]:
    code = cli.run(["calib", "poses", *words, "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_poses_are_found_on_spikes_and_written(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, posed = tmp_path / "out", tmp_path / "posed.h5"
    options = ("--kinds", "tfp96,adaptive", "--instants", "3", "--threads", "1")
    code, told = run(capsys, str(scene), "-o", str(out), "--write-to", str(posed), *options)
    assert code == 0, told
    assert told["registered"] == told["images"] == 8
    assert told["agreement"] == {**told["agreement"], "maps": 2, "agree": 2}
    assert told["truth"]["deg"]["median"] < 0.5
    assert set(told["residual_px"]) == set(told["observations"])
    assert np.median(list(told["residual_px"].values())) == pytest.approx(told["error_px"], rel=0.5)
    assert told["truth"]["share_of_extent"]["median"] < 0.01
    assert json.loads((out / "poses.json").read_text())["accepted"]
    assert (out / "colmap" / "sparse" / "0" / "images.txt").exists()
    assert verify_scene(posed) == []
    with open_scene(scene) as before, open_scene(posed) as after:
        assert after.info["poses"]["versions"]["pycolmap"]
        assert after.points is not None
        assert after.points.source == "sfm"
        held = after.view("008"), before.view("008")
        assert np.array_equal(held[0].pose.cam_from_world, held[1].pose.cam_from_world)
        for name in after.train:
            view, truth = after.view(name), before.view(name)
            assert degrees_apart(view.pose.cam_from_world[None], truth.pose.cam_from_world[None])[0] < 1
            assert view.spikes is not None
            assert np.array_equal(view.spikes.bits, truth.spikes.bits)
            assert view.trajectory is not None
            assert len(view.trajectory.at_ns) == 3
            assert view.trajectory.cov is not None
            exact = before.truth_trajectory(name)
            ends = [int(np.argmin(np.abs(exact.at_ns - t))) for t in view.trajectory.at_ns]
            assert degrees_apart(view.trajectory.poses, exact.poses[ends]).max() < 1.5
    code, told = run(capsys, str(scene), "-o", str(out), *options)
    assert code == 2  # an earlier result is not replaced unasked


def test_a_map_that_leaves_most_out_is_refused(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Features hardly found: nothing is written, and the command says what to do."""
    posed = tmp_path / "posed.h5"
    words = (str(scene), "--arms", "rgb", "--peak-threshold", "0.2", "--write-to", str(posed))
    code, told = run(capsys, *words)
    assert code == 4
    assert "placed" in told["error"]["value"]
    assert not posed.exists()


def test_same_seed_same_poses(scene: Path) -> None:
    """With as many threads, the same bits; the number of threads may choose another, nearby answer."""
    with open_scene(scene) as file:
        views, camera = [file.view(n) for n in file.train[:5]], file.camera
    wanted = Wanted(kinds=("tfp96",), maps=1, instants=1)
    one, two, three = (estimate_poses(views, camera, wanted, Options(threads=n)) for n in (1, 1, 2))
    stacks = [np.stack([m.poses[n] for n in sorted(m.poses)]) for m in (one, two, three)]
    assert np.array_equal(stacks[0], stacks[1])
    turned, away = pose_errors(stacks[2], stacks[0])
    assert turned.max() < 0.5
    assert away.max() < 0.02


def test_what_cannot_be_mapped(scene: Path) -> None:
    with open_scene(scene) as file:
        views, camera = [file.view(n) for n in file.names], file.camera
    with pytest.raises(UsageError, match="three views"):
        estimate_poses(views[:2], camera, Wanted(), Options())
    with pytest.raises(UsageError, match="does not fit"):
        estimate_poses(views[:4], camera, Wanted(kinds=("tfp99999",)), Options())
    assert tick_at(views[0], 0.5) == pytest.approx(256 + 160)
    with pytest.raises(UsageError, match="no spikes"):
        tick_at(views[8], 0.5)
    for wrong in ({"arms": "left"}, {"maps": 0}, {"instants": 0}, {"min_share": 0.0}):
        with pytest.raises(UsageError):
            Wanted(**wrong)


def made(poses: np.ndarray) -> Map:
    return Map({f"v{k}": Placed(p, 100) for k, p in enumerate(poses)})


def test_an_average_of_maps_is_nearer_to_the_truth() -> None:
    rng, truth = np.random.default_rng(3), ring(12)
    maps = []
    for _ in range(4):
        noisy = truth.copy()
        for k in range(12):
            noisy[k] = turn(*(0.01 * rng.normal(size=3))) @ truth[k]
        maps.append(made(moved(noisy, rng.uniform(0.5, 2), turn(*rng.normal(size=3)), rng.normal(size=3))))
    mean = np.stack([averaged(maps)[f"v{k}"] for k in range(12)])
    single = np.stack([maps[0].poses[f"v{k}"].pose for k in range(12)])
    assert np.median(pose_errors(mean, truth)[0]) < 0.7 * np.median(pose_errors(single, truth)[0])


def test_paths_go_through_the_average() -> None:
    at = np.linspace(0, 1, 5)
    exact = path(at)
    placed = {f"v.at{k:03d}": Placed(exact[k], 50, 1e-6 * np.eye(6)) for k in (0, 1, 3, 4)}
    first = Map({"v": Placed(exact[2], 100)}, placed)
    mean = np.column_stack([turn(0, 0.01, 0) @ exact[2][:, :3], turn(0, 0.01, 0) @ exact[2][:, 3]])
    found = paths_through(first, first, {"v": mean}, at)["v"]
    assert np.allclose(found.poses[2], mean, atol=1e-6)
    relative = [found.poses[k][:, :3] @ found.poses[2][:, :3].T for k in range(5)]
    wanted = [exact[k][:, :3] @ exact[2][:, :3].T for k in range(5)]
    assert np.allclose(relative, wanted, atol=2e-3)
    assert paths_through(first, first, {"other": mean}, at) == {}


def test_reasons() -> None:
    good = made(ring(10))
    good = dataclasses.replace(good, error_px=0.3, xyz=np.random.default_rng(0).normal(size=(50, 3)))
    names = tuple(good.poses)
    poses = {n: p.pose for n, p in good.poses.items()}
    assert judged(Estimate(names, poses, {}, good, ("a",)), Wanted()).reasons == ()
    thin = dataclasses.replace(good, link=35)
    assert judged(Estimate(names, poses, {}, thin, ("a",), agreeing=(3, 3)), Wanted()).reasons == ()
    held = dataclasses.replace(good, link=60)
    assert judged(Estimate(names, poses, {}, held, ("a",), agreeing=(2, 3)), Wanted()).reasons == ()
    for change, says in (
        ({"images": tuple(f"v{k}" for k in range(20))}, "only 10 of 20"),
        ({"best": dataclasses.replace(good, error_px=9.0)}, "residual"),
        ({"best": dataclasses.replace(good, error_px=float("nan"))}, "residual"),
        ({"agreeing": (1, 3)}, "differ"),
        ({"best": dataclasses.replace(good, link=34, hanging=("v0", "v1"))}, "34 points only (views v0, v1 and"),
        ({"best": dataclasses.replace(good, link=59), "agreeing": (2, 3)}, "all maps must agree, and 2 of 3 do"),
        ({"poses": dict.fromkeys(names, poses["v0"])}, "did not move"),
    ):
        reasons = judged(dataclasses.replace(Estimate(names, poses, {}, good, ("a",)), **change), Wanted()).reasons
        assert any(says in r for r in reasons), (says, reasons)


def test_the_weakest_link_is_that_of_the_strongest_tree() -> None:
    """Two groups of views, each held by many points, and together by seven, though more pairs share one or two."""
    from spikerig.calib.colmap_child import weakest_link

    left, right, bridge = set(range(100)), set(range(200, 290)), set(range(300, 307))
    seen = {"a": left, "b": left | bridge, "c": left | {1000}, "d": right | bridge, "e": right | {1000}}
    assert weakest_link(seen) == {"points": 7, "views": ["d", "e"]}
    assert weakest_link({"a": {1}, "b": {2}, "c": {1}}) == {"points": 0, "views": ["b"]}
    assert weakest_link({"a": {1}}) == {"points": 0, "views": ["a"]}
