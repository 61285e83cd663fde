"""Absgrad against float64, the rasteriser's thresholds from both sides, and what culling leaves out."""

import hashlib

import numpy as np
import pytest
import torch
from closeness import compare, distance, truth
from hard_raster import BACKGROUND, HARD, HEIGHT, POSE, WIDTH, K, changed, cloud, splats

from spikerig import _native
from spikerig.train import oracles
from spikerig.train.splat import Rendered, Splats, render

EYE = torch.eye(4)[:3]
LIGHT = torch.tensor(BACKGROUND, dtype=torch.float64)


def draw(scene: Splats, pose: torch.Tensor = POSE, **settings) -> Rendered:
    return render(scene, K, WIDTH, HEIGHT, pose, background=BACKGROUND, **settings)


def footprints(scene: Splats, pose: torch.Tensor = POSE) -> oracles.Footprints:
    doubles = Splats(*(t.detach().double() for t in scene.tensors().values()))
    return oracles.project(doubles, K, WIDTH, HEIGHT, pose.double(), doubles.sh_degree, False, 0.01)


def probes(out: Rendered) -> list[torch.Tensor]:
    return [p for p in (out.means2d_probe, out.absgrad_probe) if p is not None]


def random_weights(seed: int = 9) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).standard_normal((HEIGHT, WIDTH, 4))).float()


@pytest.mark.parametrize("name", [n for n in HARD if n != "opaque stack"])
def test_absgrad_agrees_with_float64(name: str, isa: str) -> None:
    scene = HARD[name]()
    by = random_weights() * ~truth(scene).band[..., None]
    out = draw(scene, absgrad=True)
    ((out.image * by[..., :3]).sum() + (out.alpha * by[..., 3]).sum()).backward()
    p = footprints(scene)
    expected = oracles.absgrad(p, WIDTH, HEIGHT, LIGHT, by[..., :3].double(), by[..., 3].double())
    assert out.absgrad_probe is not None
    assert out.means2d_probe is not None
    found, signed = out.absgrad_probe.grad, out.means2d_probe.grad
    assert found is not None
    assert signed is not None
    assert distance(found[p.index], expected) <= 1e-5
    assert (found >= signed.abs() * (1 - 1e-5)).all()
    culled = torch.ones(len(scene), dtype=torch.bool)
    culled[p.index] = False
    assert not found[culled].any()


def round_splat(opacity: float, colour: float = 1.0, size: float = 0.15, z: float = 2.0) -> list[list]:
    logit = np.log(opacity / (1 - opacity))
    return [
        [[0, 0, z]],
        [[1.0, 0, 0, 0]],
        [[np.log(size)] * 3],
        [logit],
        [[[(colour - 0.5) / 0.28209479177387814] * 3]],
    ]


def test_absgrad_keeps_what_cancels() -> None:
    """A white splat on black whose two halves are pulled apart equally: by hand, from the Gaussian itself."""
    scene = splats(*(np.array(a) for a in round_splat(0.5)))
    camera = np.array([[60.0, 0, 20], [0, 60, 20], [0, 0, 1]])
    out = render(scene, camera, 40, 40, EYE, absgrad=True)
    out.image.sum().backward()
    assert out.absgrad_probe is not None
    assert out.means2d_probe is not None
    found, signed = out.absgrad_probe.grad, out.means2d_probe.grad
    assert found is not None
    assert signed is not None
    x = np.arange(40) + 0.5 - 20
    variance = (60 * 0.15 / 2) ** 2 + 0.3
    alpha = 0.5 * np.exp(-(x[None] ** 2 + x[:, None] ** 2) / (2 * variance))
    alpha[alpha < 1 / 255] = 0
    by_hand = 3 * (alpha * np.abs(x[None]) / variance).sum()
    assert found[0].tolist() == pytest.approx([by_hand, by_hand], rel=1e-5)
    assert signed.abs().max() < 1e-5 * by_hand


def test_absgrad_has_the_same_bits_for_any_thread_count_and_changes_no_other(isa: str, threads: None) -> None:
    scene, by = cloud(2000, degree=1), random_weights()
    leaves = list(scene.tensors().values())
    without = draw(scene)
    plain = torch.autograd.grad((without.image * by[..., :3]).sum(), [*leaves, *probes(without)])
    found = set()
    for n in (1, 2, 3, 5):
        _native.set_threads(n)
        out = draw(scene, absgrad=True)
        grads = torch.autograd.grad((out.image * by[..., :3]).sum(), [*leaves, *probes(out)])
        assert len(grads) == len(plain) + 1
        assert all(map(torch.equal, plain, grads[:-1]))
        found.add(hashlib.sha256(grads[-1].numpy().tobytes()).hexdigest())
    assert len(found) == 1


def peak(opacity: float, pixel: int) -> tuple[Splats, torch.Tensor]:
    """One splat, and the weights of one pixel of the row through its centre."""
    by = torch.zeros(HEIGHT, WIDTH, 3)
    by[18, pixel] = 1.0
    return splats(*(np.array(a) for a in round_splat(opacity))), by


@pytest.mark.parametrize("side", [-1, 1], ids=["below", "above"])
@pytest.mark.parametrize(("level", "pixel"), [(oracles.ALPHA_MIN, 44), (oracles.ALPHA_MAX, 30)], ids=["cut", "clip"])
def test_gradients_on_both_sides_of_a_kink(level: float, pixel: int, side: int, isa: str) -> None:
    """Alpha at one pixel is 1e-4 of itself beside the threshold; differences of 1e-6 stay on one side."""
    camera = np.array([[60.0, 0, 30.5], [0, 60, 18.5], [0, 0, 1]])
    variance = (60 * 0.15 / 2) ** 2 + 0.3
    opacity = level * (1 + 1e-4 * side) / np.exp(-((pixel - 30) ** 2) / (2 * variance))
    scene, by = peak(opacity, pixel)
    image = render(scene, camera, WIDTH, HEIGHT, EYE).image
    (found,) = torch.autograd.grad((image * by).sum(), scene.logit_opacities)

    def value(logit: torch.Tensor) -> torch.Tensor:
        doubles = [t.detach().double() for t in scene.tensors().values()]
        doubles[3] = logit
        return (oracles.render(Splats(*doubles), camera, WIDTH, HEIGHT, EYE.double())[0] * by).sum()

    logit = scene.logit_opacities.detach().double()
    expected = float(value(logit + 1e-6) - value(logit - 1e-6)) / 2e-6
    at = logit.clone().requires_grad_()
    assert torch.autograd.gradcheck(value, at, eps=1e-6, atol=1e-8)
    open_side = side > 0 if level == oracles.ALPHA_MIN else side < 0
    assert (expected != 0) == open_side
    assert float(found) == pytest.approx(expected, rel=2e-5, abs=1e-9)


@pytest.mark.parametrize("side", [-1, 1], ids=["ended", "open"])
def test_the_last_light_on_both_sides(side: int, isa: str) -> None:
    """Two splats leave 1.1e-4 of the light, 1e-3 of that more or less; a third one behind them is drawn or not."""
    left = oracles.LIGHT_MIN * (1 + 1e-3 * side)
    stack = [round_splat(1 - np.sqrt(left), 1.0, 0.4, 2.0), round_splat(1 - np.sqrt(left), 0.2, 0.4, 2.1)]
    stack.append(round_splat(0.9, 0.9, 0.4, 2.2))
    scene = splats(*(np.concatenate(each) for each in zip(*(map(np.array, s) for s in stack), strict=True)))
    camera = np.array([[60.0, 0, 30.5], [0, 60, 18.5], [0, 0, 1]])
    by = torch.zeros(HEIGHT, WIDTH, 3)
    by[18, 30] = 1.0
    image = render(scene, camera, WIDTH, HEIGHT, EYE).image
    (found,) = torch.autograd.grad((image * by).sum(), scene.sh)
    doubles = [t.detach().double().requires_grad_() for t in scene.tensors().values()]
    true = oracles.render(Splats(*doubles), camera, WIDTH, HEIGHT, EYE.double())[0]
    (expected,) = torch.autograd.grad((true * by).sum(), doubles[4])
    assert bool(found[2].any()) == bool(expected[2].any()) == (side > 0)
    assert distance(found, expected) <= 1e-5
    assert float((image[18, 30].detach().double() - true[18, 30].detach()).abs().max()) <= 1e-6


@pytest.mark.parametrize(
    ("limit", "value", "name"), [("LIGHT_MIN", 2e-3, "opaque stack"), ("ALPHA_MAX", 0.97, "cloud")]
)
def test_the_band_comparison_sees_other_limits(
    limit: str, value: float, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = HARD[name]()
    if limit == "ALPHA_MAX":
        scene = changed(scene, logit_opacities=torch.full((len(scene),), 8.0))
    picture = draw(scene)
    compare(picture.image, picture.alpha, truth(scene), most_band=0.1)
    monkeypatch.setattr(oracles, limit, value)
    with pytest.raises(AssertionError):
        compare(picture.image, picture.alpha, truth(scene), most_band=0.1)


def test_no_pixel_above_the_cut_is_culled(isa: str) -> None:
    """An opaque splat reaches 3.33 sigma: a box of 3 sigma would lose these pixels."""
    scene = splats(*(np.array(a) for a in round_splat(0.985)))
    camera = np.array([[60.0, 0, 30.5], [0, 60, 18.5], [0, 0, 1]])
    alpha = render(scene, camera, WIDTH, HEIGHT, EYE).alpha.detach().double()
    sigma = np.sqrt((60 * 0.15 / 2) ** 2 + 0.3)
    x = np.hypot(np.arange(WIDTH)[None] - 30, np.arange(HEIGHT)[:, None] - 18)
    expected = 0.985 * np.exp(-(x**2) / (2 * sigma**2))
    rim = (x > 3 * sigma) & (expected > 1.001 / 255)
    assert rim.sum() > 20
    np.testing.assert_allclose(alpha.numpy()[rim], expected[rim], rtol=2e-5)
    assert not alpha.numpy()[expected < 0.999 / 255].any()


def test_culling_loses_no_light_of_small_splats(isa: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Centres up to four pictures away: float64 without any cull by place sees the same."""
    base = cloud(600, seed=12)
    scene = changed(base, means=base.means.detach() * torch.tensor([5.0, 5.0, 1.0]))
    picture = draw(scene)
    dropped = int((~picture.visible).sum())
    monkeypatch.setattr(oracles, "CULL_MARGIN", 1e6)
    true = truth(scene)
    assert dropped > 300
    assert len(footprints(scene).index) > int(picture.visible.sum())
    compare(picture.image, picture.alpha, true)


def test_parameters_at_the_ends_of_float32(isa: str) -> None:
    base = cloud(60, seed=13)
    scales, quats = base.log_scales.detach().clone(), base.quats.detach().clone()
    scales[::6, 0], scales[1::6, 2] = 3e38, -3e38
    quats[2::6] *= 1e-30
    quats[3::6] *= 1e18
    scene = changed(base, log_scales=scales, quats=quats, logit_opacities=base.logit_opacities.detach() - 2)
    pose = POSE.clone().requires_grad_()
    picture = draw(scene, pose)
    compare(picture.image, picture.alpha, truth(scene))
    for g in torch.autograd.grad(picture.image.sum(), [*scene.tensors().values(), pose]):
        assert torch.isfinite(g).all()
