"""Scene files: what is read, and how faults are told."""

from pathlib import Path

import pytest
from hard_sim import small, small_table

from spikerig.dataset.errors import UsageError
from spikerig.rigctl.sim.spec import builtin_names, load_scene_toml, read_scene, read_settings, with_changes


def test_built_in_scenes() -> None:
    assert {"demo", "chroma"} <= set(builtin_names())
    for name in builtin_names():
        spec = load_scene_toml(name)
        assert spec.name == name
        assert len(spec.orbit.held_out()) == 6
        assert spec.orbit.views == 30
        assert spec.exposure.ticks == 320


def test_presets_are_defaults() -> None:
    paper = small(exposure={"protocol": "paper"})
    e = paper.exposure
    assert (e.ticks, e.sub_poses, e.light, e.margin_ticks, paper.sensor.gain) == (18, 18, "hold", 0, 0.5)
    assert [x.name for x in paper.effects][-2:] == ["initial_phase", "read_noise"]
    zero = small(exposure={"protocol": "paper", "phase": "zero"}, effects=[], sensor={"gain": 0.25})
    assert zero.effects == ()
    assert zero.sensor.gain == 0.25
    rig = small(exposure={})
    assert (rig.exposure.ticks, rig.exposure.margin_ticks, rig.exposure.light) == (320, 256, "linear")


def test_all_faults_at_once() -> None:
    table = small_table(
        camera__widht=3,
        camera__fov_deg=190,
        exposure__label="middle",
        exposure__rate_hz="fast",
        shake__path_px=[1, 2, 3],
        orbit__views=0,
        sensor__gain=float("nan"),
        effects=["shot_nose", {"name": "threshold_fpn", "sd": 4}],
        colour=1,
    )
    table["world"]["solids"][1]["radius"] = -1
    table["world"]["solids"][2]["textur"] = {}
    table["world"]["solids"].append({"kind": "ball"})
    with pytest.raises(UsageError) as caught:
        read_scene(table, "x.toml")
    text = str(caught.value)
    for piece in (
        "13 faults",
        "camera.widht: unknown key; did you mean 'width'?",
        "camera.fov_deg: is 190, expected 1 to 170 degrees",
        "exposure.label: is 'middle'",
        "exposure.rate_hz: is 'fast', expected a number",
        "shake.path_px: is [1, 2, 3], expected 2 numbers",
        "orbit.views: is 0",
        "sensor.gain: is nan",
        "did you mean 'shot_noise'?",
        "effects[1].sd: is 4, expected 0 to 0.3 of the threshold",
        "colour: unknown key",
        "world.solids[1].radius: is -1",
        "world.solids[2].textur: unknown key; did you mean 'texture'?",
        "world.solids[4].kind: is 'ball'",
    ):
        assert piece in text, piece


@pytest.mark.parametrize(
    ("effects", "phase", "says"),
    [
        (["shot_noise", {"name": "shot_noise", "threshold_e": 9}], "random", "a second time"),
        (["initial_phase"], "zero", "contradict"),
        ([3], "random", "expected a name"),
        ("auto", "random", "nothing to choose from"),
        ("shot_noise", "random", "expected a list"),
    ],
)
def test_effects_that_do_not_go_together(effects: object, phase: str, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        small(effects=effects, exposure__phase=phase)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"exposure__exposure_ms": 1.01}, "40.4 ticks"),
        ({"exposure__sub_poses": 60}, "more than fit the 40 ticks"),
        ({"exposure__period_ms": 1.5}, "less than exposure and margins"),
        ({"orbit__test": [4]}, "holds 4"),
        ({"orbit__test": [0, 1, 2, 3]}, "leaves no view to train on"),
        ({"sensor__response": [0, 0, 0]}, "blind"),
        ({"orbit__radius": 9.0}, "outside world.solids.0., the room"),
        ({"orbit__radius": 0.3, "orbit__height": 0.5}, "inside world.solids.1., a sphere"),
        ({"world__solids": []}, "expected 1 to"),
        ({"shake__path_px": [5, 3]}, "low, high"),
    ],
)
def test_what_cannot_be(changes: dict, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        small(**changes)


def test_files_that_are_no_scenes(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="did you mean 'demo'"):
        load_scene_toml("demoo")
    bad = tmp_path / "bad.toml"
    bad.write_text("seed = = 3")
    with pytest.raises(UsageError, match="not valid TOML"):
        load_scene_toml(bad)
    bad.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UsageError, match="cannot read"):
        load_scene_toml(bad)


def test_changes_from_the_command_line() -> None:
    spec = small(orbit__test=[], orbit__test_every=5)
    assert with_changes(spec, seed=9, views=10).orbit.held_out() == {2, 7}
    assert with_changes(spec, seed=9).seed == 9
    for wrong in ({"seed": -1}, {"seed": 2**32}, {"views": 0}):
        with pytest.raises(UsageError):
            with_changes(spec, **wrong)
    with pytest.raises(UsageError, match="holds 2"):
        with_changes(small(), views=2)


def test_settings_alone() -> None:
    read = read_settings({"seed": 3, "exposure": {"protocol": "paper"}, "effects": ["read_noise"]}, "s")
    assert (read.seed, read.exposure.ticks, read.sensor.gain) == (3, 18, 0.5)
    with pytest.raises(UsageError, match="camera: unknown key"):
        read_settings({"camera": {}}, "s")
