"""Exposure correction: identity at the start, held to a mean of identity, slices as by hand, and the dB come back."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from spikerig.dataset.errors import UsageError
from spikerig.dataset.images import linear_from_srgb, srgb_from_linear
from spikerig.dataset.store import open_scene, write_scene
from spikerig.train import exposure
from spikerig.train.fit import load_state
from spikerig.train.methods import configure
from spikerig.train.metrics import rounded
from spikerig.train.record import open_run
from spikerig.train.run import run_fit
from spikerig.train.score import score_run
from spikerig.train.targets import TrainView

GAINS = np.array([0.6, 1.35, 0.8, 1.4, 0.75, 1.1])  # mean 1


class Six:
    """A task of six views, as far as a start looks at it."""

    class targets:
        views = range(6)

    def __init__(self, kind: str) -> None:
        self.config = configure("plain", "draft", exposure=kind)


def view(*which: int) -> TrainView:
    return TrainView("v", torch.zeros(1), None, {}, which=torch.tensor(which))


def a_picture(height: int = 20, width: int = 30) -> torch.Tensor:
    rng = np.random.default_rng(4)
    picture = rng.uniform(-0.1, 1.3, (height, width, 3)).astype(np.float32)
    picture[0, :3] = 0.0
    return torch.from_numpy(picture)


@pytest.mark.parametrize("kind", ["affine", "bilateral"])
def test_a_part_at_its_start_changes_nothing(kind):
    task = Six(kind)
    params = {name: t.requires_grad_() for name, t in exposure.start(task).items()}
    picture = a_picture().requires_grad_()
    out = exposure.expose(params, view(3), picture, task.config)
    assert torch.allclose(out, picture, rtol=0, atol=2e-6)
    grads = torch.autograd.grad(out.square().sum(), [picture, *params.values()])
    assert all(torch.isfinite(g).all() for g in grads)
    assert grads[1].any()


@pytest.mark.parametrize("kind", ["affine", "bilateral"])
def test_corrections_are_held_to_a_mean_of_identity(kind):
    (name, raw), = exposure.start(Six(kind)).items()  # fmt: skip
    raw = raw + torch.from_numpy(np.random.default_rng(0).normal(0.3, 0.5, raw.shape).astype(np.float32))
    found = exposure.correction({name: raw}, torch.arange(6)).mean(0)
    identity = torch.eye(3, 4) if kind == "affine" else torch.eye(3, 4).reshape(12, 1, 1, 1).expand(raw.shape[1:])
    assert torch.allclose(found, identity, atol=1e-6)
    assert not torch.allclose(exposure.correction({name: raw}, torch.tensor([2]))[0], identity, atol=0.1)


def test_an_affine_correction_is_a_matrix_and_an_offset_in_linear_light():
    raw = torch.zeros(2, 3, 4)
    raw[0] = torch.tensor([[1.0, 0.2, 0, 0.05], [0, -0.5, 0, 0], [0.1, 0, 0.3, -0.02]])
    raw[1] = -raw[0]
    config, picture = configure("plain", "draft", exposure="affine"), a_picture()
    out = exposure.expose({"affine": raw}, view(0), picture, config).double().numpy()
    light = linear_from_srgb(np.clip(picture.double().numpy(), 0, None))
    inside = (picture >= 0).all(-1).numpy()
    expected = light @ (np.eye(3) + raw[0, :, :3].double().numpy()).T + raw[0, :, 3].double().numpy()
    good = inside & (expected > 0).all(-1)
    assert good.sum() > 300
    np.testing.assert_allclose(out[good], srgb_from_linear(expected[good]), atol=3e-6)


def test_rays_get_the_correction_of_their_own_view():
    raw = torch.from_numpy(np.random.default_rng(1).normal(0, 0.2, (4, 3, 4)).astype(np.float32))
    config, picture = configure("plain", "draft", exposure="affine"), a_picture(9, 1)
    which = [0, 3, 3, 1, 2, 0, 1, 2, 2]
    together = exposure.expose({"affine": raw}, view(*which), picture, config)
    for k, number in enumerate(which):
        alone = exposure.expose({"affine": raw}, view(number), picture[k : k + 1], config)
        assert torch.allclose(together[k : k + 1], alone, atol=1e-6)


def test_a_bilateral_grid_is_looked_up_by_place_and_luma():
    """A grid that holds x + 10 y + 100 luma at its cells gives that of every pixel back: trilinear, ends included."""
    depth, tall, wide = exposure.GRID
    z, y, x = torch.meshgrid(*(torch.linspace(0, 1, n) for n in exposure.GRID), indexing="ij")
    grid = (x + 10 * y + 100 * z).expand(12, depth, tall, wide)
    picture = a_picture(20, 30).clamp(0, 1)
    found = exposure.sliced(grid, picture)
    luma = picture @ torch.tensor(exposure.LUMA)
    expected = torch.linspace(0, 1, 30)[None] + 10 * torch.linspace(0, 1, 20)[:, None] + 100 * luma
    assert found.shape == (20, 30, 3, 4)
    assert torch.allclose(found[:, :, 1, 2], expected, atol=1e-3)
    assert float(exposure.roughness(grid)) == pytest.approx(1 / 15**2 + 100 / 15**2 + 1e4 / 7**2, rel=1e-4)
    assert float(exposure.roughness(torch.ones(12, *exposure.GRID))) == 0


def sharp(tiny, path, gains):
    """The tiny scene with sharp training frames, the light of each times a gain; the truth as it was."""
    with open_scene(tiny) as file:
        scene = file.read()
        light = {name: np.array(file.truth_light(name)) for name in file.train}
    views, gains = [], iter(gains)
    for each in scene.views:
        frame = each.frame
        if each.split == "train":
            codes = rounded(srgb_from_linear(np.clip(light[each.name] * next(gains), 0, 1)))
            frame = replace(frame, pixels=codes)
        views.append(replace(each, frame=frame))
    write_scene(path, replace(scene, views=tuple(views)))
    return path


@pytest.fixture(scope="module")
def unequal(tiny, tmp_path_factory):
    return sharp(tiny, tmp_path_factory.mktemp("gains") / "unequal.h5", GAINS)


def fit(scene, out, **changes):
    """What a fit returns, with the dB of renders at the training views against the sharp truth at gain 1."""
    done = run_fit(scene, configure("plain", "draft", splats=800, steps=250, **changes), out, eval_every=0)
    with open_scene(scene) as file:
        return {**done, "psnr": score_run(open_run(out).model, file)["blur_view"]["psnr"]}


def test_gains_of_frames_are_found_and_the_dB_come_back(tiny, unequal, tmp_path):
    equal = fit(sharp(tiny, tmp_path / "equal.h5", np.ones(6)), tmp_path / "equal")["psnr"]
    off = fit(unequal, tmp_path / "off")["psnr"]
    affine = fit(unequal, tmp_path / "affine", exposure="affine", lr_exposure=1e-2)
    bilateral = fit(unequal, tmp_path / "bilateral", exposure="bilateral", lr_exposure=1e-2)
    assert off < equal - 1.8
    assert affine["psnr"] > equal - 0.5
    assert bilateral["psnr"] > off + 0.5
    assert exposure.REMARK in affine["remarks"]
    state, _ = load_state(tmp_path / "affine/checkpoint.safetensors")
    found = exposure.correction({"affine": state.params["exposure:affine"]}, torch.arange(6))
    gray = found.detach()[:, :, :3].sum(2).mean(1).numpy()  # what a gray light of 1 becomes
    assert np.corrcoef(gray, GAINS)[0, 1] > 0.98
    assert np.abs(gray - GAINS).max() < 0.2


def test_equal_frames_lose_nothing_by_it(tiny, tmp_path):
    assert fit(tiny, tmp_path / "on", exposure="affine")["psnr"] > fit(tiny, tmp_path / "off")["psnr"] - 0.5


@pytest.mark.parametrize("field", ["splat", "nerf-fast"])
def test_same_bits_for_any_thread_count_and_every_field(unequal, tmp_path, threads, field):
    kind = "bilateral" if field == "splat" else "affine"
    small = {"splats": 600} if field == "splat" else {"rays": 128}
    config = configure("plain", "draft", field, steps=12, exposure=kind, **small)
    found = set()
    for n in (1, 2):
        threads(n)
        found.add(run_fit(unequal, config, tmp_path / str(n), eval_every=0)["model_sha256"])
    assert len(found) == 1


@pytest.mark.parametrize(
    ("method", "field", "kind", "told"),
    [
        ("oracle", "splat", "affine", "truth"),
        ("plain", "nerf-fast", "bilateral", "whole pictures"),
        ("plain", "splat", "log", "exposure is 'log'"),
    ],
)
def test_combinations_that_make_no_sense_are_told(method, field, kind, told):
    with pytest.raises(UsageError) as caught:
        configure(method, "draft", field, exposure=kind)
    assert told in str(caught.value)
