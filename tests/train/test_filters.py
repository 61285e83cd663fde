"""Colour spikes as training input: what a pixel saw is what it is compared with; alone they give a coloured scene."""

import tomllib
from importlib.resources import files

import numpy as np
import pytest
import torch

from spikerig.dataset.bayer import Bayer, mosaic
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.store import open_scene
from spikerig.rigctl.sim.capture import capture
from spikerig.rigctl.sim.spec import read_scene
from spikerig.train.filters import solve_filters, tfs_through
from spikerig.train.gauge import gauge_of
from spikerig.train.losses import linear_from_srgb, srgb_from_linear
from spikerig.train.methods import configure
from spikerig.train.run import run_fit
from spikerig.train.targets import load_targets

GAIN = (0.9, 1.0, 1.3)


@pytest.fixture(scope="module")
def coloured(tmp_path_factory):
    """The tiny scene with strong colours, seen by a Bayer spike camera of 64x40 pixels."""
    table = tomllib.loads(files("spikerig.rigctl.sim").joinpath("scenes/chroma.toml").read_text(encoding="utf-8"))
    table["name"] = "coloured"
    table["camera"] |= {"width": 64, "height": 40}
    table["orbit"] |= {"views": 9, "test_every": 7}
    table["points"] |= {"count": 600}
    table.setdefault("sensor", {})
    table["sensor"] |= {"colour": "bayer", "pattern": "grbg", "channel_gain": list(GAIN)}
    path = tmp_path_factory.mktemp("coloured") / "coloured.h5"
    capture(read_scene(table), path)
    return path


def targets(path, **changes):
    with open_scene(path) as scene:
        config = configure(changes.pop("method", "colour-spikes"), "draft", **changes)
        return load_targets(
            scene, config, gauge_of(scene.points.xyz, np.stack([p.cam_from_world for p in poses(scene)]))
        )


def poses(scene):
    return [scene.view(name, spikes=False).pose for name in scene.names]


def test_each_kind_of_pixel_has_its_own_white_and_converter(coloured):
    found = targets(coloured)
    filters = found.filters
    assert found.gray is None
    assert filters.site[:2, :2].tolist() == [[1, 0], [2, 1]]
    whites = [g.white for g in filters.gray]
    assert np.allclose(np.array(whites) / whites[1], np.array(GAIN) / GAIN[1], rtol=1e-6)
    for c, gray in enumerate(filters.gray):  # the simulator's filters are pure
        assert np.argmax(gray.weights) == c
        assert gray.weights[c] == pytest.approx(1.0, abs=0.08)
    assert filters.weights.shape == (3, 4)


def test_filters_that_leak_are_found(tmp_path):
    rng = np.random.default_rng(0)
    leak = np.array([[0.8, 0.15, 0.05], [0.1, 0.8, 0.1], [0.0, 0.2, 0.8]])
    bayer, raw = Bayer("rggb", GAIN), []
    for _ in range(5):
        codes = rng.integers(6, 248, (40, 60, 3), dtype=np.uint8)
        light = linear_from_srgb(torch.tensor(codes / 255.0)).numpy()
        mean = 0.4 * mosaic(light @ leak.T, bayer)
        everywhere = np.ones((40, 60), bool)
        raw.append({"codes": codes, "light": light, "mean": mean, "mean_known": everywhere, "valid": everywhere})
    found = solve_filters(raw, bayer, "calibrated", 0.4)
    assert np.allclose([g.weights for g in found.gray], leak, atol=2e-3)
    assert np.allclose([g.bias for g in found.gray], 0, atol=1e-3)
    pure = solve_filters(raw, bayer, "rec601", 0.4)
    assert np.array_equal([g.weights for g in pure.gray], np.eye(3))
    unknown = solve_filters(raw, bayer, "rec601", None)  # white must be measured then
    assert np.allclose([g.white for g in unknown.gray], 0.4 * np.array(GAIN), rtol=1e-2)


def test_the_term_compares_each_pixel_with_its_own_colour_by_hand():
    rng = np.random.default_rng(1)
    light = torch.tensor(rng.uniform(0.05, 0.9, (6, 8, 3)), dtype=torch.float32)
    image = srgb_from_linear(light).requires_grad_()
    bayer = Bayer("bggr")
    site = torch.from_numpy(bayer.channels(6, 8).astype(np.uint8))
    texture = srgb_from_linear(torch.from_numpy(mosaic(light.numpy(), bayer)))
    pure = torch.cat([torch.eye(3), torch.zeros(3, 1)], 1)
    weight = torch.full((6, 8), 1 / 48)
    assert tfs_through(image, texture, weight, site, pure, "encoded").item() == pytest.approx(0, abs=1e-9)
    off = texture.clone()
    off[2, 3] += 0.1  # a blue pixel for bggr is at even, even; (2, 3) is green
    value = tfs_through(image, off, weight, site, pure, "encoded")
    assert value.item() == pytest.approx(0.01 / 48, rel=1e-3)
    value.backward()
    assert torch.nonzero(image.grad.abs() > 1e-7).tolist() == [[2, 3, 1]]


def test_colour_spikes_alone_learn_colour(coloured, tmp_path):
    """Better than from blurry frames by the same steps, and no frame is looked at."""
    shape = {"steps": 250, "splats": 600}
    alone = run_fit(coloured, configure("colour-spikes", "draft", **shape), tmp_path / "alone", eval_every=0)
    plain = run_fit(coloured, configure("plain", "draft", **shape), tmp_path / "plain", eval_every=0)
    assert alone["psnr"] > plain["psnr"] + 0.5
    assert len(alone["filters"]) == 3


@pytest.mark.parametrize("method", ["spikenerf", "spikenerf-5x", "spike-ratio", "spike-hybrid"])
@pytest.mark.parametrize("field", ["splat", "nerf-fast"])
def test_every_method_on_spikes_takes_colour_spikes(coloured, tmp_path, method, field):
    little = {"splats": 200} if field == "splat" else {"rays": 64, "coarse": 16, "fine": 8, "table_log2": 10}
    done = run_fit(coloured, configure(method, "draft", field, steps=8, **little), tmp_path / "run", eval_every=0)
    assert done["steps"] == 8
    assert done["psnr"] > 5


def test_a_ratio_of_colour_spikes_brings_colours_back(coloured):
    """Each channel has a ratio of its own: against the sharp truth it beats the blurry frame by far."""
    with open_scene(coloured) as scene:
        name = scene.train[0]
        truth = np.clip(np.array(scene.truth_light(name)), 0, 1)
    found = targets(coloured, method="spike-ratio", ratio_instants=1)
    view = next(v for v in found.views if v.name == name)
    codes = srgb_from_linear(torch.from_numpy(np.asarray(truth, np.float32)))
    errors = [float((picture - codes).square().mean()) for picture in (view.instants[0.5].ratio.float(), view.frame)]
    assert errors[0] < 0.6 * errors[1]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"method": "spikenerf", "gray": "learned"}, "gray learned"),
        ({"method": "spikenerf", "tfs_domain": "naive"}, "tfs_domain naive"),
        ({"method": "ours"}, "restored instants"),
    ],
)
def test_what_does_not_go_with_colour_spikes_is_refused(coloured, changes, told):
    with pytest.raises(UsageError, match="colour spikes do not go") as caught:
        targets(coloured, **changes)
    assert told in str(caught.value.value)


def test_gray_spikes_alone_are_refused(tiny):
    with pytest.raises(DataError, match="do not say what colour"):
        targets(tiny)
    with pytest.raises(UsageError, match="do not hold together"):
        configure("plain", "draft", colour_weight=0.0)
    with pytest.raises(UsageError, match="do not hold together"):
        configure("spike-ratio", "draft", colour_weight=0.0)
