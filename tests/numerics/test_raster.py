"""The rasteriser on hard inputs: float64 agreement inside derived tolerances, finite gradients, the same bits."""

import hashlib

import numpy as np
import pytest
import torch
from closeness import compare, distance, truth
from hard_raster import BACKGROUND, HARD, HEIGHT, POSE, WIDTH, K, changed, cloud, opaque_stack

from spikerig import _native
from spikerig.dataset.errors import NumericsError
from spikerig.train import oracles
from spikerig.train.splat import Rendered, Splats, render
from spikerig.train.ssim import l1_ssim


def draw(scene: Splats, pose: torch.Tensor = POSE, **settings) -> Rendered:
    return render(scene, K, WIDTH, HEIGHT, pose, background=BACKGROUND, **settings)


def weights(shape: tuple[int, ...], seed: int = 9) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).standard_normal(shape))


def gradients(image: torch.Tensor, alpha: torch.Tensor, on: torch.Tensor, leaves: list[torch.Tensor]):
    """Of a random weighting of the picture, alpha included, over the pixels that are on."""
    by = weights((*on.shape, 4)).to(image.dtype) * on[..., None]
    return torch.autograd.grad((image * by[..., :3]).sum() + (alpha * by[..., 3]).sum(), leaves)


@pytest.mark.parametrize("antialias", [False, True], ids=["classic", "antialias"])
@pytest.mark.parametrize("name", HARD)
def test_hard_scene_agrees_with_float64(name: str, antialias: bool, isa: str) -> None:
    scene = HARD[name]()
    pose = POSE.clone().requires_grad_()
    true = truth(scene, antialias=antialias)
    picture = draw(scene, pose, antialias=antialias)
    compare(picture.image, picture.alpha, true, most_band=0.1 if name == "opaque stack" else 0.02)
    mine = gradients(picture.image, picture.alpha, ~true.band, [*scene.tensors().values(), pose])
    theirs = gradients(true.image, true.alpha, ~true.band, true.leaves)
    nothing = 1e-12 * max(float(t.norm()) for t in theirs)  # round splats have no gradient of their rotation
    for label, g, t in zip(("means", "quats", "log_scales", "logits", "sh", "pose"), mine, theirs, strict=True):
        assert torch.isfinite(g).all(), label
        assert distance(g, t, nothing) <= 1e-5, label


def test_ordinary_gradients_are_within_1e_5_of_float64(isa: str) -> None:
    scene, pose = cloud(1500, seed=11, degree=3), POSE.clone().requires_grad_()
    true = truth(scene)
    picture = draw(scene, pose)
    mine = gradients(picture.image, picture.alpha, ~true.band, [*scene.tensors().values(), pose])
    theirs = gradients(true.image, true.alpha, ~true.band, true.leaves)
    assert max(map(distance, mine, theirs)) <= 1e-5


def test_the_tiled_oracle_is_the_oracle() -> None:
    scene = Splats(*(t.detach().double() for t in cloud(300).tensors().values()))
    dense = oracles.render(scene, K, WIDTH, HEIGHT, POSE.double(), background=BACKGROUND)
    tiled = oracles.render(scene, K, WIDTH, HEIGHT, POSE.double(), background=BACKGROUND, tiled=True)
    assert float((dense[0] - tiled[0]).abs().max()) < 1e-12
    assert float((dense[1] - tiled[1]).abs().max()) < 1e-12


def test_the_oracle_is_the_textbook_for_one_round_splat() -> None:
    """One isotropic splat on the axis: a Gaussian of sigma^2 = (f s / z)^2 + 0.3, opacity 0.5, over a background."""
    z, s, f = 2.0, 0.1, 60.0
    parts = ([[0, 0, z]], [[1.0, 0, 0, 0]], [[np.log(s)] * 3], [0.0], [[[1.0, 0, -1.0]]])
    scene = Splats(*(torch.tensor(p, dtype=torch.float64) for p in parts))
    camera, pose = np.array([[f, 0, 20.0], [0, f, 20.0], [0, 0, 1]]), torch.eye(4, dtype=torch.float64)[:3]
    image, alpha = oracles.render(scene, camera, 40, 40, pose, background=(1, 1, 1))
    x = np.arange(40) + 0.5 - 20
    power = (x[None] ** 2 + x[:, None] ** 2) / (2 * ((f * s / z) ** 2 + 0.3))
    expected = 0.5 * np.exp(-power)
    expected[expected < 1 / 255] = 0
    np.testing.assert_allclose(alpha.numpy(), expected, atol=1e-12)
    c0 = 0.28209479177387814
    for channel, colour in enumerate((0.5 + c0, 0.5, 0.5 - c0)):
        np.testing.assert_allclose(image[..., channel].numpy(), 1 - expected * (1 - colour), atol=1e-12)


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda image, band: image + 3e-5 * ~band[..., None], "a small error everywhere outside the band"),
        (lambda image, band: image + 0.05 * (torch.arange(image.numel()).reshape(image.shape) == 900), "one pixel"),
        (lambda image, band: image.roll(1, 1), "a picture one pixel aside"),
    ],
    ids=["small", "pixel", "shift"],
)
def test_the_band_comparison_can_fail(spoil, why: str) -> None:
    scene = cloud(400)
    true = truth(scene)
    compare(true.image, true.alpha, true)
    with pytest.raises(AssertionError):
        compare(spoil(true.image.detach(), true.band), true.alpha, true)


def test_the_band_comparison_sees_another_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = cloud(400)
    picture = draw(scene)
    monkeypatch.setattr(oracles, "ALPHA_MIN", 1 / 245)
    with pytest.raises(AssertionError):
        compare(picture.image, picture.alpha, truth(scene))


def test_zero_quaternion_means_no_rotation_and_has_no_gradient(isa: str) -> None:
    base = cloud(50)
    none = changed(base, quats=torch.zeros(50, 4))
    unit = changed(base, quats=torch.tensor([1.0, 0, 0, 0]).expand(50, 4))
    assert torch.equal(draw(none).image, draw(unit).image)
    draw(none).image.sum().backward()
    assert none.quats.grad is not None
    assert not none.quats.grad.any()


def test_quaternions_of_any_length_and_sign_turn_alike() -> None:
    base = cloud(50)
    picture = draw(base).image
    for factor in (-1.0, 1e-6, 1e6):
        turned = draw(changed(base, quats=base.quats * factor)).image
        assert torch.allclose(turned, picture, rtol=0, atol=1e-5)


def test_a_thousand_opaque_splats_saturate(isa: str) -> None:
    scene = opaque_stack()
    picture = draw(scene)
    assert float(picture.alpha.detach().max()) <= 1 - 1e-6
    assert float(picture.alpha.detach().max()) >= 0.9998
    picture.image.sum().backward()
    for tensor in scene.tensors().values():
        assert tensor.grad is not None
        assert torch.isfinite(tensor.grad).all()


def test_no_gradient_reaches_behind_the_last_light(isa: str) -> None:
    base = opaque_stack(200)
    wall = changed(base, means=base.means * torch.tensor([0, 0, 1.0]), log_scales=torch.full((200, 3), 3.0))
    draw(wall).image.sum().backward()
    assert wall.sh.grad is not None
    assert wall.sh.grad[:2].abs().amin(0).any()
    assert not any(t.grad[2:].any() for t in wall.tensors().values())


def test_ties_keep_their_order(isa: str) -> None:
    base = cloud(2)
    tied = changed(
        base,
        means=torch.tensor([[0.0, 0, 1.5], [0.0, 0, 1.5]]),
        log_scales=torch.full((2, 3), -2.0),
        logit_opacities=torch.full((2,), 2.0),
        sh=torch.tensor([1.5, -1.5]).reshape(2, 1, 1).expand(2, 1, 3),
    )
    first = draw(tied).image
    other = changed(tied, sh=tied.sh.detach().flip(0))
    assert float(first[18, 30, 0].detach()) > 0.7 > float(draw(other).image[18, 30, 0].detach())
    compare(first, draw(tied).alpha, truth(tied))


def test_a_shuffle_changes_no_bit(isa: str) -> None:
    scene = cloud(400)
    order = torch.from_numpy(np.random.default_rng(3).permutation(400))
    mixed = changed(scene, **{name: t.detach()[order] for name, t in scene.tensors().items()})
    one, two = draw(scene), draw(mixed)
    assert torch.equal(one.image, two.image)
    by = weights((HEIGHT, WIDTH, 3)).float()
    for a, b in zip(
        torch.autograd.grad(one.image, list(scene.tensors().values()), by),
        torch.autograd.grad(two.image, list(mixed.tensors().values()), by),
        strict=True,
    ):
        assert torch.equal(a[order], b)


@pytest.mark.parametrize("away", ["none at all", "behind", "on the camera plane", "far aside", "too faint"])
def test_nothing_visible_is_the_background(away: str, isa: str) -> None:
    base = cloud(20)
    means = base.means.detach().clone()
    if away == "behind":
        means[:, 2] *= -1
    if away == "on the camera plane":
        means = means * 0 + torch.tensor([0.01, 0.01, 0])
    if away == "far aside":
        means[:, 0] += 50
    faint = torch.full((20,), -5.6) if away == "too faint" else base.logit_opacities
    scene = cloud(0) if away == "none at all" else changed(base, means=means, logit_opacities=faint)
    pose = torch.eye(4)[:3].clone().requires_grad_()
    picture = draw(scene, pose)
    assert torch.equal(picture.image.detach(), torch.tensor(BACKGROUND).expand(HEIGHT, WIDTH, 3))
    assert not picture.alpha.any()
    assert not picture.visible.any()
    (picture.image.sum() + picture.alpha.sum()).backward()
    for tensor in (*scene.tensors().values(), pose):
        assert tensor.grad is not None
        assert not tensor.grad.any()


@pytest.mark.parametrize(("width", "height"), [(1, 1), (16, 16), (17, 1), (3, 40), (33, 15)])
def test_pictures_of_any_size(width: int, height: int, isa: str) -> None:
    scene = cloud(300, size=0.2)
    true = truth(scene, width=width, height=height)
    picture = render(scene, K, width, height, POSE, background=BACKGROUND)
    assert picture.image.shape == (height, width, 3)
    compare(picture.image, picture.alpha, true, most_band=1 / 15)
    mine = gradients(picture.image, picture.alpha, ~true.band, list(scene.tensors().values()))
    theirs = gradients(true.image, true.alpha, ~true.band, true.leaves[:5])
    assert max(map(distance, mine, theirs)) <= 1e-5


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "logit_opacities", "sh"])
def test_a_value_that_is_not_finite_is_named(name: str, value: float, isa: str) -> None:
    scene = cloud(40)
    spoiled = getattr(scene, name).detach().clone()
    index = torch.nonzero(draw(scene).visible)[7, 0]
    spoiled.reshape(40, -1)[index, 0] = value
    with pytest.raises(NumericsError, match=rf"'{name}'.*\[{int(index)}[,\]]"):
        draw(changed(scene, **{name: spoiled}))


def test_a_camera_that_is_not_finite_is_named() -> None:
    with pytest.raises(NumericsError, match="cam_from_world"):
        draw(cloud(3), POSE * float("nan"))


def test_same_bits_for_any_thread_count(isa: str, threads: None) -> None:
    scene, pose = cloud(2000, degree=2), POSE.clone().requires_grad_()
    target = weights((HEIGHT, WIDTH, 3)).float().sigmoid()
    found = set()
    for n in (1, 2, 3, 5, 1):
        _native.set_threads(n)
        picture = draw(scene, pose)
        loss = l1_ssim(picture.image, target)
        grads = torch.autograd.grad(loss, [*scene.tensors().values(), pose, picture.means2d_probe])
        parts = (picture.image, picture.alpha, picture.radii, loss, *grads)
        found.add(hashlib.sha256(b"".join(p.detach().numpy().tobytes() for p in parts)).hexdigest())
    assert len(found) == 1


def test_instruction_sets_agree_within_rounding() -> None:
    scene, before, pictures = cloud(2000), _native.isa(), []
    try:
        for name in _native.isas():
            _native.set_isa(name)
            pictures.append(draw(scene).image.detach())
    finally:
        _native.set_isa(before)
    off = max(float((p - pictures[0]).abs().max()) for p in pictures)
    assert off <= truth(scene).tolerance
