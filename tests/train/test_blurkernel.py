"""Deblur-NeRF's kernel: rays that are displaced as asked, pictures mixed as asked, blur that is learned."""

import numpy as np
import pytest
import torch

from spikerig.dataset.errors import UsageError
from spikerig.dataset.scene import Camera
from spikerig.dataset.store import open_scene
from spikerig.train import blurkernel
from spikerig.train.blurkernel import KERNEL, displaced, kernel_at, lattice, mixed, places_of, start, warped
from spikerig.train.field import Step
from spikerig.train.fit import load_state, new_state, view_loss
from spikerig.train.losses import linear_from_srgb, srgb_from_linear
from spikerig.train.methods import configure
from spikerig.train.parts import own
from spikerig.train.rays import rays_of
from spikerig.train.record import open_run
from spikerig.train.run import prepare, run_fit

CAMERA = Camera([[50.0, 0, 31], [0, 48.0, 21], [0, 0, 1]], np.zeros(0), 64, 40)


def step(fraction=0.5, seed=0) -> Step:
    return Step(5, fraction, (0.0, 0.0, 0.0), np.random.default_rng(seed))


def drawn_pose(seed=0) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    q *= np.sign(np.linalg.det(q))
    return torch.from_numpy(np.concatenate([q, rng.standard_normal((3, 1))], 1))


def test_displaced_poses_see_what_displaced_pixels_see():
    """Against the definition: a ray from R^T (o - t) through the displaced pixel's place on the plane z = 1."""
    pixels = torch.tensor([0, 63, 40 * 64 - 1, 777])
    pose = drawn_pose().expand(4, 3, 4)
    rng = np.random.default_rng(1)
    moved, origin = (torch.from_numpy(rng.standard_normal((4, 3, 2)) * s) for s in (6, 0.1))
    poses = displaced(CAMERA, pose, pixels, moved, origin)
    rays = rays_of(CAMERA, poses.flatten(0, 1), pixels.repeat_interleave(3))
    for b in range(4):
        for n in range(3):
            x, y = pixels[b] % 64 + 0.5 + moved[b, n, 0], pixels[b] // 64 + 0.5 + moved[b, n, 1]
            o = torch.tensor([*origin[b, n], 0.0], dtype=torch.float64)
            there = torch.stack([(x - 31) / 50, (y - 21) / 48, torch.tensor(1.0, dtype=torch.float64)])
            R, t = pose[b, :, :3], pose[b, :, 3]
            expected = R.T @ (there - o)
            k = b * 3 + n
            np.testing.assert_allclose(rays.origins[k], R.T @ (o - t), atol=1e-12)
            np.testing.assert_allclose(rays.directions[k], expected / expected.norm(), atol=1e-12)


def test_nothing_displaced_is_the_very_pose_with_finite_gradients():
    pixels, zero = torch.arange(64 * 40), torch.zeros(64 * 40, 2, 2, dtype=torch.float64, requires_grad=True)
    pose = drawn_pose(3).expand(64 * 40, 3, 4)
    found = displaced(CAMERA, pose, pixels, zero, zero)
    np.testing.assert_allclose(found.detach(), pose[:, None].expand(-1, 2, 3, 4), atol=1e-12)
    (grad,) = torch.autograd.grad(found.square().sum() + found.sum(), zero)
    assert torch.isfinite(grad).all()
    both = tuple(torch.zeros(2, 2, 2, dtype=torch.float64, requires_grad=True) for _ in range(2))
    assert torch.autograd.gradcheck(lambda m, o: displaced(CAMERA, pose[:2], pixels[:2], m, o), both)


def test_a_picture_displaced_by_whole_pixels_is_shifted():
    picture = torch.from_numpy(np.random.default_rng(0).uniform(0, 1, (12, 17, 3)).astype(np.float32))
    moved = torch.zeros(1, 12, 17, 2)
    moved[..., 0], moved[..., 1] = 3, -2
    found = warped(picture, moved, torch.ones(1, 12, 17), "encoded")
    np.testing.assert_allclose(found[2:, :-3], picture[:-2, 3:], atol=1e-5)
    np.testing.assert_allclose(found[2:, -1], picture[:-2, -1], atol=1e-5)  # the border goes on


@pytest.mark.parametrize("domain", ["linear", "encoded"])
def test_halves_are_mixed_in_their_domain(domain):
    picture = torch.zeros(4, 8, 3)
    picture[:, 4:] = 0.8
    moved = torch.zeros(2, 4, 8, 2)
    moved[1, ..., 0] = 4
    weights = torch.stack([torch.full((4, 8), 0.25), torch.full((4, 8), 0.75)])
    found = warped(picture, moved, weights, domain)
    expected = 0.6 if domain == "encoded" else float(srgb_from_linear(0.75 * linear_from_srgb(torch.tensor(0.8))))
    np.testing.assert_allclose(found[:, :4], expected, atol=1e-5)
    pairs = torch.stack([picture[:, :4], picture[:, 4:]], -2)
    np.testing.assert_allclose(mixed(pairs, torch.tensor([0.25, 0.75]), domain), expected, atol=1e-5)


def tiny_task(tiny, field="splat", **changes):
    with open_scene(tiny) as scene:
        given = {"steps": 10, **({"splats": 800} if field == "splat" else {}), **changes}
        return prepare(scene, tiny, configure("deblur", "draft", field, **given))[0], scene.points


def test_weights_sum_to_one_and_views_have_kernels_of_their_own(tiny):
    task, _ = tiny_task(tiny)
    params = start(task)
    places = lattice(4, 6)
    first, origin, weights = kernel_at(params, torch.tensor([0]), places)
    assert first.shape == origin.shape == (24, 5, 2)
    np.testing.assert_allclose(weights.sum(-1), 1, rtol=1e-6)
    second, _, _ = kernel_at(params, torch.tensor([1]), places)
    assert not torch.allclose(first, second)
    assert float(first.abs().mean()) < 2  # it begins as a slight blur
    again, _, _ = kernel_at(params, torch.tensor([1]).expand(24), places)
    assert torch.equal(second, again)


def test_a_lattice_covers_the_picture_as_its_pixels_do():
    every = places_of(CAMERA, torch.arange(64 * 40)).reshape(40, 64, 2)
    coarse = lattice(6, 9).reshape(6, 9, 2)
    np.testing.assert_allclose(coarse[0, 0], [-1, -1])
    np.testing.assert_allclose(coarse[-1, -1], [1, 1])
    np.testing.assert_allclose(every[0, 0], [-1 + 1 / 64, -1 + 1 / 40], rtol=1e-6)
    blown = torch.nn.functional.interpolate(coarse.permute(2, 0, 1)[None], (40, 64), mode="bilinear",
                                            align_corners=True)[0].permute(1, 2, 0)  # fmt: skip
    assert float((blown - every).abs().max()) < 1 / 39


def test_a_known_blur_is_learned(tiny):
    """A picture blurred by three pixels to and fro: the kernel alone explains it, where a sharp picture cannot."""
    task, _ = tiny_task(tiny)
    rng = np.random.default_rng(2)
    coarse = torch.from_numpy(rng.uniform(0.1, 0.9, (1, 3, 10, 16)).astype(np.float32))
    sharp = torch.nn.functional.interpolate(coarse, (40, 64), mode="bicubic")[0].permute(1, 2, 0).clamp(0, 1)
    moved = torch.zeros(5, 40, 64, 2)
    moved[:, ..., 0] = torch.arange(-3, 4.5, 1.5)[:, None, None]
    blurry = warped(sharp, moved, torch.full((5, 40, 64), 0.2), "linear")
    params = {n: p.clone().requires_grad_() for n, p in start(task).items()}
    adam = torch.optim.Adam(params.values(), 5e-3)
    view = task.targets.views[0]
    losses = []
    for k in range(150):
        (found,) = KERNEL.draw(params, lambda v, p: [sharp], view, torch.zeros(3, 4), step(seed=k), task)
        loss = (found - blurry).square().mean()
        losses.append(loss.item())
        adam.zero_grad()
        loss.backward()
        adam.step()
    assert losses[-1] < 0.15 * float((sharp - blurry).square().mean())


def test_before_its_start_there_is_no_kernel(tiny):
    task, _ = tiny_task(tiny)
    drawn = [torch.rand(40, 64, 3)]
    view = task.targets.views[0]
    found = KERNEL.draw(start(task), lambda v, p: drawn, view, torch.zeros(3, 4), step(0.019), task)
    assert found is drawn
    state = type("State", (), {"params": {f"kernel:{n}": p for n, p in start(task).items()}})
    assert KERNEL.loss(state, task, view, {}, step(0.019)) == []
    assert KERNEL.loss(state, task, view, {}, step(0.95)) == []
    (align,) = KERNEL.loss(state, task, view, {}, step(0.5))
    moved, origin, _ = kernel_at(start(task), view.which, lattice(8, 8))
    assert float(align) == pytest.approx(0.01 * float(moved[:, 0].abs().mean() + 10 * origin[:, 0].abs().mean()))


@pytest.mark.parametrize("field", ["splat", "nerf", "nerf-fast"])
def test_every_number_of_the_kernel_is_trained(tiny, field):
    small = {} if field == "splat" else {"rays": 32, "coarse": 8, "fine": 8, "width": 16}
    small |= {"init": "random", "finest": 64, "table_log2": 10} if field == "nerf-fast" else {}
    task, points = tiny_task(tiny, field, **small)
    state = new_state(points, task)
    view = task.field.look(task.targets, task.camera, task.config, 0, np.random.default_rng(0))
    view_loss(state, task, view, step(0.95)).backward()  # without the alignment, which is no picture's gradient
    for name in own(KERNEL, state.params):
        grad = state.params[f"kernel:{name}"].grad
        assert grad is not None
        assert torch.isfinite(grad).all()
        assert grad.abs().max() > 0, name
    last = state.params["kernel:out/bias"].grad  # origins (of rays), displacements, weight
    assert last is not None
    assert (last[2 if field == "splat" else 0 :] != 0).all()


def test_rays_are_traced_from_every_point_of_the_kernel(tiny):
    """Two pixels, two points: renders are asked for at all four, in the order of the weights."""
    task, _ = tiny_task(tiny, "nerf", rays=4, coarse=4, fine=4, width=8, kernel_points=3)
    params = start(task)
    view = task.field.look(task.targets, task.camera, task.config, 0, np.random.default_rng(0))
    asked = []

    def draw(many, poses):
        asked.append((many.pixels, poses))
        return [torch.arange(12.0).reshape(12, 1, 1).expand(12, 1, 3) / 12]

    pose = view.instants[0.5].pose
    (found,) = KERNEL.draw(params, draw, view, pose, step(seed=4), task)
    pixels, poses = asked[0]
    assert pixels.tolist() == [int(p) for p in view.pixels for _ in range(3)]
    assert poses.shape == (12, 3, 4)
    jitter = torch.from_numpy(np.random.default_rng(4).standard_normal((4, 3, 2), np.float32)) * blurkernel.JITTER
    moved, origin, weights = kernel_at(params, view.which, places_of(task.camera, view.pixels), jitter)
    expected = mixed((torch.arange(12.0) / 12).reshape(4, 3, 1).expand(4, 3, 3), weights, "linear")
    np.testing.assert_allclose(found[:, 0].detach(), expected.detach(), rtol=1e-5)
    np.testing.assert_allclose(
        poses.detach(), displaced(task.camera, pose, view.pixels, moved, origin).detach().flatten(0, 1), rtol=1e-5
    )


def test_the_finished_model_knows_no_kernel(tiny, tmp_path):
    done = run_fit(tiny, configure("deblur", "draft", splats=800, steps=60), tmp_path / "run", eval_every=0)
    assert done["psnr"] > 14
    state, _ = load_state(tmp_path / "run/checkpoint.safetensors")
    begun = {f"kernel:{n}": p for n, p in start(tiny_task(tiny)[0]).items()}
    assert all(not torch.equal(state.params[n], p) for n, p in begun.items())  # it was trained, and kept for --resume
    assert set(open_run(tmp_path / "run").model.splats.tensors()) == set(state.params) - set(begun)


@pytest.mark.parametrize("changes", [{"kernel_points": 65}, {"poses_per_view": 5}, {"kernel_start": 1.5}])
def test_settings_that_make_no_sense_are_refused(changes):
    with pytest.raises(UsageError, match="do not hold together"):
        configure("deblur", "draft", **changes)
