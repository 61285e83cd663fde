"""Mitsuba scenes: the same camera as ours, linear light, seeds, a folder gone on with, a child that may die."""

import json
import runpy
import shutil
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spikerig.dataset.cli import run
from spikerig.dataset.errors import DataError, HostError, UsageError
from spikerig.dataset.images import read_image
from spikerig.dataset.store import open_scene
from spikerig.rigctl.sim.capture import camera_of, view_path
from spikerig.rigctl.sim.sources import mitsuba_scene as module
from spikerig.rigctl.sim.sources.mitsuba_scene import capture_toml, plan_scene, render_folder

DOCS = Path(__file__).resolve().parents[2] / "docs" / "mitsuba"
BALL = """<scene version="3.0.0">
<integrator type="path"><integer name="max_depth" value="4"/></integrator>
<emitter type="constant"><rgb name="radiance" value="0.5 0.25 0.125"/></emitter>
<shape type="sphere"><point name="center" x="0.2" y="0.1" z="0.3"/><float name="radius" value="0.5"/>
<bsdf type="diffuse"><rgb name="reflectance" value="0.8 0.4 0.2"/></bsdf></shape>
</scene>"""
SETTINGS = """seed = 3
effects = ["shot_noise", { name = "dark_current", rate = 0.01 }]
[mitsuba]
spp = 4
[camera]
width = 32
height = 20
fov_deg = 50
[orbit]
views = 3
radius = 2.5
height = 1.1
target = [0.0, 0.25, 0.2]
test = [2]
[shake]
path_px = [3, 5]
[exposure]
exposure_ms = 1
sub_poses = 3
margin_ticks = 5
[points]
count = 40
"""
CENTRE, RADIUS = np.array([0.2, 0.1, 0.3]), 0.5


def ball(root: Path, settings: str = SETTINGS, scene: str = BALL) -> Path:
    (root / "ball.xml").write_text(scene)
    (root / "ball.toml").write_text(settings)
    return root / "ball.xml"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ball played once, its frames kept."""
    root = tmp_path_factory.mktemp("ball")
    words = ["sim", "mitsuba", str(ball(root)), "-o", str(root / "o.h5"), "--frames", str(root / "f"), "--workers", "1"]
    assert run(words) == 0
    return root


def test_the_pictures_are_of_our_camera(made: Path) -> None:
    """Depth against the sphere's own, through the pixel centres of our pinhole; the sky is its radiance, exactly."""
    spec = plan_scene(made / "ball.xml").spec
    camera = camera_of(spec)
    x, y = np.meshgrid(np.arange(32) + 0.5, np.arange(20) + 0.5)
    rays = np.stack([(x - 16) / camera.K[0, 0], (y - 10) / camera.K[1, 1], np.ones_like(x)], 2)
    for number in (0, 1):
        pose = view_path(spec, number).poses(0.5)[0]
        middle = pose[:, :3] @ CENTRE + pose[:, 3]
        a, b, c = (rays**2).sum(2), rays @ middle, middle @ middle - RADIUS**2
        inside = b * b - a * c
        expected = np.where(inside > 0, (b - np.sqrt(np.maximum(inside, 0))) / a, np.inf)
        depth = read_image(made / f"f/{number:03d}/depth.exr", nonfinite="keep")[:, :, 0]
        edge = np.abs(inside) < 1e-2 * (b * b)
        assert (np.isfinite(expected) & ~edge).sum() > 60
        np.testing.assert_allclose(depth[~edge], expected[~edge], rtol=1e-4)
        sky = read_image(made / f"f/{number:03d}/0001.exr")[0, 0]
        np.testing.assert_allclose(sky, [0.5, 0.25, 0.125], rtol=1e-6)


def test_the_scene_holds_the_poses_the_times_and_the_points(made: Path) -> None:
    spec = plan_scene(made / "ball.xml").spec
    with open_scene(made / "o.h5") as file:
        scene = file.read()
    assert [v.split for v in scene.views] == ["train", "train", "test"]
    for number, view in enumerate(scene.views):
        path = view_path(spec, number)
        np.testing.assert_allclose(view.pose.cam_from_world, path.poses(0.5)[0], atol=1e-9)
        if view.spikes is None:
            continue
        assert view.spikes.ticks == 50
        assert view.trajectory is not None
        np.testing.assert_allclose(view.trajectory.poses, path.poses([0, 0.5, 1]), atol=1e-9)
    assert scene.truth is not None
    assert set(scene.truth.effects) == {"shot_noise", "dark_current", "initial_phase"}
    assert scene.points is not None
    assert len(scene.points.xyz) == 40
    assert np.abs(np.linalg.norm(scene.points.xyz - CENTRE, axis=1) - RADIUS).mean() < 0.05


def test_seeds_make_the_bits_and_threads_do_not(made: Path, tmp_path: Path) -> None:
    pictures = []
    for seed, threads in ((3, 2), (4, 1)):
        plan = plan_scene(made / "ball.xml", seed=seed)
        plan.shots[:] = plan.shots[:1]
        render_folder(plan, tmp_path / f"{seed}", threads=threads)
        pictures.append(read_image(tmp_path / f"{seed}/000/0000.exr"))
    np.testing.assert_array_equal(pictures[0], read_image(made / "f/000/0000.exr"))
    assert not np.array_equal(pictures[0], pictures[1])


def test_a_run_cut_short_goes_on(made: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(made / "f", tmp_path / "f")
    lost, kept = tmp_path / "f/001/0002.exr", tmp_path / "f/000/0000.exr"
    lost.unlink()
    before = kept.stat().st_mtime_ns
    words = ["sim", "mitsuba", str(made / "ball.xml"), "-o", str(tmp_path / "o.h5"), "--frames", str(tmp_path / "f")]
    assert run([*words, "--workers", "1", "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert told["schema"] == "spikerig.sim.mitsuba/1"
    assert told["mitsuba"] == {"spp": 4, "variant": "scalar_rgb", "pictures": 13}
    np.testing.assert_array_equal(read_image(lost), read_image(made / "f/001/0002.exr"))
    assert kept.stat().st_mtime_ns == before
    with open_scene(tmp_path / "o.h5") as a, open_scene(made / "o.h5") as b:
        for name in a.train:
            assert np.array_equal(a.spikes(name).bits, b.spikes(name).bits)
    assert run([*words, "--spp", "2", "--force", "--seed", "9"]) == 0
    assert kept.stat().st_mtime_ns != before
    assert run(words) == 2
    assert "exists already" in capfd.readouterr().err
    with pytest.raises(UsageError, match="begun with another"):
        render_folder(plan_scene(made / "ball.xml"), tmp_path / "f")
    with pytest.raises(UsageError, match="something else"):
        render_folder(plan_scene(made / "ball.xml"), tmp_path)


def test_the_axis_that_points_up(tmp_path: Path) -> None:
    """The ball of a scene whose y (or x) points up, seen as ours is: the same depth, picture by picture."""
    depths = {}
    turns = {"z": lambda x, y, z: (x, y, z), "y": lambda x, y, z: (x, z, -y), "x": lambda x, y, z: (z, x, y)}
    for up, turn in turns.items():
        root = tmp_path / up
        root.mkdir()
        target, (x, y, z) = turn(0.0, 0.25, 0.2), turn(0.2, 0.1, 0.3)
        text = SETTINGS.replace("[mitsuba]", f'[mitsuba]\nup = "{up}"').replace("[0.0, 0.25, 0.2]", str(list(target)))
        plan = plan_scene(ball(root, text, BALL.replace('x="0.2" y="0.1" z="0.3"', f'x="{x}" y="{y}" z="{z}"')))
        plan.shots[:] = [shot for shot in plan.shots if shot["kind"] == "depth"]
        render_folder(plan, root / "f")
        depths[up] = [read_image(root / f"f/{k:03d}/depth.exr", nonfinite="keep") for k in range(2)]
    for up in "yx":
        np.testing.assert_allclose(depths[up], depths["z"], rtol=1e-4)


def test_the_papers_protocol_and_one_pose(tmp_path: Path) -> None:
    text = SETTINGS.replace("exposure_ms = 1\nsub_poses = 3\nmargin_ticks = 5", 'protocol = "paper"\nsub_poses = 6')
    plan = plan_scene(ball(tmp_path, text))
    assert [len(v["frames"]) for v in plan.document["views"]] == [6, 6, 1]
    assert not any("phase" in f for v in plan.document["views"] for f in v["frames"])
    assert run(["sim", "mitsuba", str(plan.scene), "-o", str(tmp_path / "o.h5"), "--spp", "1", "--workers", "1"]) == 0
    with open_scene(tmp_path / "o.h5") as file:
        assert file.spikes("000").ticks == 18
    assert sorted(p.name for p in tmp_path.iterdir()) == ["ball.toml", "ball.xml", "o.h5"], "no frames left behind"
    one = plan_scene(ball(tmp_path, SETTINGS.replace("sub_poses = 3", "sub_poses = 1")))
    assert [len(v["frames"]) for v in one.document["views"]] == [1, 1, 1]


def test_the_documented_example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """docs/mitsuba: the mesh is made, loaded and seen; smaller, and fewer views."""
    for name in ("knot.xml", "make_knot.py"):
        shutil.copy(DOCS / name, tmp_path / name)
    monkeypatch.setattr("sys.argv", ["make_knot.py"])
    runpy.run_path(str(tmp_path / "make_knot.py"), run_name="__main__")
    text = (DOCS / "knot.toml").read_text()
    for old, new in {"width = 200": "width = 32", "height = 125": "height = 20", "views = 10": "views = 1"}.items():
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "knot.toml").write_text(text.replace("sub_poses = 9", "sub_poses = 2") + "[points]\ncount = 50\n")
    assert run(["sim", "mitsuba", str(tmp_path / "knot.xml"), "-o", str(tmp_path / "k.h5"), "--spp", "4"]) == 0
    with open_scene(tmp_path / "k.h5") as file:
        light = file.truth_light("000")
        assert file.points is not None
        assert np.isfinite(file.points.xyz).all()
    red = (light[:, :, 0] > 2 * light[:, :, 1]) & (light[:, :, 0] > 0.02)
    assert 0.1 < red.mean() < 0.6, "the knot, lit from outside"
    lines = (tmp_path / "knot.obj").read_text().splitlines()
    assert sum(line[0] == "v" for line in lines) == 24 * 400
    assert sum(line[0] == "f" for line in lines) == 2 * 24 * 400


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[world]\nambient = [1, 1, 1]\n", "Mitsuba scene's"),
        ('[mitsuba]\nvariant = "scalar_rbg"\n', "did you mean 'scalar_rgb'"),
        ("[mitsuba]\nssp = 3\n", "did you mean 'spp'"),
        ("mitsuba = 3\n", "expected a table"),
        ('[mitsuba]\nup = "w"\n', "expected one of x, y, z"),
        ('[exposure]\nlight = "hold"\n', "margin_ticks: are not for light that holds"),
        ("[exposure]\nsub_poses = 0\n", "say how many"),
        ("[orbit]\nradus = 3\n", "did you mean 'radius'"),
        ("[orbit\n", "cannot be read"),
    ],
)
def test_settings_that_cannot_be(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(UsageError) as told:
        plan_scene(ball(tmp_path, text))
    assert says in str(told.value)


def test_scenes_that_cannot_be(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such scene"):
        plan_scene(tmp_path / "none.xml")
    mesh = BALL.replace("</scene>", '<shape type="ply"><string name="filename" value="none.ply"/></shape></scene>')
    for scene, says in (
        ("<scene", "parse"),
        (mesh, "none.ply"),
        ('<bsdf version="3.0.0" type="diffuse"/>', "not a scene"),
    ):
        plan = plan_scene(ball(tmp_path, scene=scene))
        with pytest.raises(DataError, match="cannot render") as told:
            render_folder(plan, tmp_path / "f", force=True)
        assert says in told.value.cause.lower()


def test_a_child_that_dies_or_is_too_slow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = plan_scene(ball(tmp_path))
    with pytest.raises(HostError, match="too long"):
        render_folder(plan, tmp_path / "slow", patience_s=0.001)
    with pytest.raises(HostError, match="died"):
        render_folder(plan, tmp_path / "small", memory_gb=0.05)
    abort = tmp_path / "python"
    abort.write_text("#!/bin/sh\necho 'LLVM ERROR: Cannot select: fminimum' >&2\nkill -ABRT $$\n")
    abort.chmod(0o755)
    monkeypatch.setattr(module.sys, "executable", str(abort))
    with pytest.raises(HostError, match="died") as told:
        render_folder(plan_scene(plan.scene, variant="llvm_ad_rgb"), tmp_path / "llvm")
    assert "LLVM 19" in told.value.cause
    assert "fminimum" in told.value.cause
    assert "scalar_rgb" in told.value.next


def test_without_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    assert run(["sim", "mitsuba", str(ball(tmp_path)), "-o", str(tmp_path / "o.h5")]) == 6
    assert 'pip install "spikerig[mitsuba]"' in capfd.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["ball.toml", "ball.xml"]


def test_effects_chosen_by_the_scene(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """`auto` is settled by the rendered frames; a noise far below the tolerance is left out, one far above is not."""
    chosen = 'effects = "auto"\nconsider = [{ name = "read_noise", sd = 1e-6 }, { name = "dark_current", rate = 0.5 }]'
    text = SETTINGS.replace('effects = ["shot_noise", { name = "dark_current", rate = 0.01 }]', chosen)
    words = ["sim", "mitsuba", str(ball(tmp_path, text)), "-o", str(tmp_path / "o.h5"), "--workers", "1", "--json"]
    assert run(words) == 0
    told = json.loads(capfd.readouterr().out)
    assert "dark_current" in told["effects"]
    assert "read_noise" not in told["effects"]


def test_settings_survive_as_toml() -> None:
    table: dict[str, Any] = {
        "name": 'a "b" \\ ü', "seed": 3, "effects": ["x", {"name": "y", "sd": 1e-7, "on": True}],
        "exposure": {"protocol": "paper", "sub_poses": 3, "margin_ticks": 4, "rate_hz": 40_000.0},
        "camera": {"width": 3}, "mitsuba": {}, "sensor": {"response": [0.1, 1, 2.5]},
    }  # fmt: skip
    back = tomllib.loads(capture_toml(table))
    assert back == {
        "name": table["name"], "seed": 3, "effects": table["effects"], "sensor": table["sensor"],
        "exposure": {"protocol": "paper", "rate_hz": 40_000.0},
    }  # fmt: skip
