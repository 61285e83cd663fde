"""Scenes nobody should record: black, saturated, one view, cameras in one place, no spikes, NaN in the truth.

Each ends in a message that says what is wrong, or in a model that is finite and draws finite pictures.
"""

from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

from spikerig.dataset.errors import DataError, NumericsError
from spikerig.dataset.scene import Pose
from spikerig.dataset.store import open_scene, write_scene
from spikerig.train.fit import load_state
from spikerig.train.methods import configure
from spikerig.train.record import open_run
from spikerig.train.run import run_fit


def frames(scene, value):
    return tuple(replace(v, frame=replace(v.frame, pixels=np.full_like(v.frame.pixels, value))) for v in scene.views)


def bits(views, value):
    return tuple(
        v if v.spikes is None else replace(v, spikes=replace(v.spikes, bits=np.full_like(v.spikes.bits, value)))
        for v in views
    )


def black(scene):
    return replace(scene, views=bits(frames(scene, 0), 0))


def saturated(scene):
    return replace(scene, views=bits(frames(scene, 255), 255))


def one_view(scene):
    held_out = [v for v in scene.views if v.split == "test"]
    views = (next(v for v in scene.views if v.split == "train"), *held_out)
    names = {v.name for v in views}
    truth = replace(scene.truth, **{part: _some(getattr(scene.truth, part), names) for part in PER_VIEW})
    return replace(scene, views=views, truth=truth, events=_some(scene.events, names))


PER_VIEW = ("light", "trajectories", "at_ns")


def _some(by_view, names):
    return {name: value for name, value in by_view.items() if name in names}


def coincident(scene):
    pose = scene.views[0].pose
    return replace(scene, views=tuple(replace(v, pose=Pose(pose.cam_from_world), trajectory=None) for v in scene.views))


def silent(scene):
    return replace(scene, views=bits(scene.views, 0))


def without_spikes(scene):
    return replace(scene, views=tuple(replace(v, spikes=None) for v in scene.views))


def nothing_valid(scene):
    return replace(scene, views=tuple(replace(v, valid=np.zeros_like(v.valid)) for v in scene.views))


FINITE = ""  # a model, all of it finite
UNCALIBRATED = "too few pixels to calibrate"
HARD = {  # scene: what plain, the methods on spikes, and oracle come to
    black: (FINITE, UNCALIBRATED, FINITE),
    saturated: (FINITE, UNCALIBRATED, FINITE),
    one_view: (FINITE, FINITE, FINITE),
    coincident: (FINITE, FINITE, FINITE),
    silent: (FINITE, "spikes do not grow with the frames' light", FINITE),
    without_spikes: (FINITE, "has no spikes", FINITE),
    nothing_valid: ("no pixel of any training view is valid",) * 3,
}
METHODS = {"plain": 0, "spikenerf": 1, "spike-hybrid": 1, "spike-ratio": 1, "oracle": 2}
LITTLE = {"splat": {"splats": 200}, "nerf-fast": {"rays": 64, "coarse": 16, "fine": 8, "table_log2": 10}}


def fit(path, out, method, field, **changes):
    config = configure(method, "draft", field, steps=12, **(LITTLE[field] | changes))
    return run_fit(path, config, out, eval_every=0)


@pytest.fixture(scope="module")
def scenes(tiny, tmp_path_factory):
    """Each of the scenes as a file."""
    folder = tmp_path_factory.mktemp("hostile")
    with open_scene(tiny) as file:
        scene = file.read()
    for make in HARD:
        write_scene(folder / f"{make.__name__}.h5", make(scene))
    return folder


@pytest.mark.parametrize("field", LITTLE)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("make", HARD)
def test_a_hostile_scene_ends_in_a_clear_message_or_a_sane_model(scenes, tmp_path, make, method, field):
    path, out = scenes / f"{make.__name__}.h5", tmp_path / "run"
    expected = HARD[make][METHODS[method]]
    if make is coincident and method in ("spike-hybrid", "spike-ratio"):
        expected = "has no trajectory"
    if expected:
        with pytest.raises(DataError, match=expected) as caught:
            fit(path, out, method, field)
        assert caught.value.expected or caught.value.next
        return
    done = fit(path, out, method, field)
    assert done["steps"] == 12
    assert 5 < done["psnr"] < 40
    state, _ = load_state(out / "checkpoint.safetensors")
    assert all(torch.isfinite(p).all() for p in state.params.values())
    with open_scene(path) as file:
        assert np.isfinite(open_run(out).model.picture(file.view(file.names[0]).pose.cam_from_world)).all()


@pytest.mark.parametrize("make", [black, saturated])
def test_with_a_known_gain_spikes_that_say_nothing_still_train(scenes, tmp_path, make):
    done = fit(scenes / f"{make.__name__}.h5", tmp_path / "run", "spikenerf", "splat", gray="rec601")
    assert 5 < done["psnr"] < 40


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_pixel_of_the_truth_that_is_not_finite_is_refused_when_written_and_when_read(tiny, tmp_path, value):
    with open_scene(tiny) as file:
        scene = file.read()
    light = {name: np.array(picture) for name, picture in scene.truth.light.items()}
    name = next(v.name for v in scene.views if v.split == "train")
    light[name][3, 4, 1] = value
    with pytest.raises(NumericsError, match="finite"):
        write_scene(tmp_path / "written.h5", replace(scene, truth=replace(scene.truth, light=light)))
    path = tmp_path / "tampered.h5"
    path.write_bytes(tiny.read_bytes())
    with h5py.File(path, "r+") as file:
        found = [d for d in _datasets(file) if "truth" in d.name and d.shape[-3:] == light[name].shape]
        assert found
        for data in found:
            values = data[()]
            values[..., 3, 4, 1] = value
            data[...] = values
    with pytest.raises(NumericsError, match=f"true light of view '{name}'") as caught:
        fit(path, tmp_path / "run", "oracle", "splat")
    assert "[3, 4, 1]" in str(caught.value.value)


def _datasets(group):
    found = []
    group.visititems(lambda _, node: found.append(node) if isinstance(node, h5py.Dataset) else None)
    return found
