"""The rasteriser's surface: what comes back, what is refused, what densification watches."""

import numpy as np
import pytest
import torch
from closeness import distance, truth
from hard_raster import HEIGHT, POSE, WIDTH, K, changed, cloud

from spikerig.dataset.errors import UsageError
from spikerig.train import bench, oracles
from spikerig.train.splat import Rendered, Splats, render
from spikerig.train.ssim import l1_ssim


def draw(scene: Splats, **settings) -> Rendered:
    return render(scene, K, WIDTH, HEIGHT, POSE, **settings)


def test_shapes_types_and_visibility() -> None:
    scene = cloud(100)
    out = draw(scene)
    assert (out.image.shape, out.image.dtype) == ((HEIGHT, WIDTH, 3), torch.float32)
    assert (out.alpha.shape, out.alpha.dtype) == ((HEIGHT, WIDTH), torch.float32)
    assert out.radii.shape == out.visible.shape == (100,)
    assert 0 < int(out.visible.sum()) <= 100
    behind = changed(scene, means=-scene.means.detach())
    assert not draw(behind).visible.any()


def test_radius_holds_every_pixel_the_splat_touches() -> None:
    for seed in range(20):
        one = cloud(1, seed=seed, size=0.2)
        out = draw(one)
        if not out.visible[0]:
            continue
        y, x = np.nonzero(out.alpha.detach().numpy())
        p = oracles.project(
            Splats(*(t.detach().double() for t in one.tensors().values())),
            K,
            WIDTH,
            HEIGHT,
            POSE.double(),
            1,
            False,
            0.01,
        )
        assert np.hypot(x + 0.5 - float(p.centre[0, 0]), y + 0.5 - float(p.centre[0, 1])).max() <= 1.5 * float(
            out.radii[0]
        )


def test_the_probe_holds_the_screen_gradient() -> None:
    scene = cloud(200)
    out = draw(scene)
    assert out.means2d_probe is not None
    by = torch.from_numpy(np.random.default_rng(0).standard_normal((HEIGHT, WIDTH, 3)).astype(np.float32))
    (out.image * by).sum().backward()
    doubles = [t.detach().double() for t in scene.tensors().values()]
    p = oracles.project(Splats(*doubles), K, WIDTH, HEIGHT, POSE.double(), 1, False, 0.01)
    p.centre.requires_grad_()
    image, _ = oracles.raster(p, WIDTH, HEIGHT, torch.zeros(3, dtype=torch.float64))
    (expected,) = torch.autograd.grad((image * by).sum(), p.centre)
    assert out.means2d_probe.grad is not None
    assert distance(out.means2d_probe.grad[p.index], expected) < 1e-5
    culled = torch.ones(200, dtype=torch.bool)
    culled[p.index] = False
    assert not out.means2d_probe.grad[culled].any()


def test_no_probe_and_no_graph_without_gradients() -> None:
    with torch.no_grad():
        out = draw(cloud(10))
    assert out.means2d_probe is None
    assert not out.image.requires_grad


def test_several_pictures_before_one_backward() -> None:
    """Sub-poses of one exposure: each picture keeps its own lists until its gradient is taken."""
    scene = cloud(300)
    shifts = [torch.tensor([[0, 0, 0, 0.01 * k], [0, 0, 0, 0], [0, 0, 0, 0]]) for k in range(3)]
    together = torch.stack([render(scene, K, WIDTH, HEIGHT, POSE + s).image for s in shifts]).mean(0)
    joint = torch.autograd.grad(together.square().sum(), scene.means)[0]
    apart = torch.zeros_like(joint)
    for s in shifts:
        image = render(scene, K, WIDTH, HEIGHT, POSE + s).image
        apart += torch.autograd.grad(image, scene.means, 2 * together.detach() / 3)[0]
    assert distance(joint, apart) < 1e-6


def test_backward_twice_gives_the_same() -> None:
    scene = cloud(100)
    loss = draw(scene).image.square().sum()
    first = torch.autograd.grad(loss, scene.means, retain_graph=True)[0]
    draw(cloud(300, seed=2))
    assert torch.equal(first, torch.autograd.grad(loss, scene.means)[0])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_degrees_below_the_stored_one(degree: int) -> None:
    scene = cloud(200, degree=3)
    out = draw(scene, sh_degree=degree)
    true = truth(scene, sh_degree=degree)
    black = true.image - (1 - true.alpha)[..., None] * torch.tensor((0.2, 0.5, 0.3))
    assert torch.allclose(out.image.double()[~true.band], black[~true.band], rtol=0, atol=true.tolerance)
    grad = torch.autograd.grad(out.image.sum(), scene.sh)[0]
    assert grad[:, : (degree + 1) ** 2].any()
    assert not grad[:, (degree + 1) ** 2 :].any()


def test_near_drops_centres_nearer_than_it() -> None:
    scene = cloud(100)
    depth = (scene.means @ POSE[:, :3].T + POSE[:, 3])[:, 2].detach()
    assert not (draw(scene, near=1.5).visible & (depth <= 1.5)).any()
    assert (draw(scene).visible & (depth <= 1.5)).any()


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"means": torch.zeros(9, 2)}, "means"),
        ({"quats": torch.zeros(8, 4)}, "quats"),
        ({"log_scales": torch.zeros(9, 3, dtype=torch.float64)}, "log_scales"),
        ({"sh": torch.zeros(9, 5, 3)}, "spherical harmonics"),
    ],
)
def test_tensors_that_do_not_fit_are_refused_by_name(change: dict[str, torch.Tensor], what: str) -> None:
    with pytest.raises(UsageError, match=what):
        draw(changed(cloud(9), **change))


@pytest.mark.parametrize(
    ("camera", "settings"),
    [
        (np.eye(2), {}),
        (np.array([[60.0, 1, 30], [0, 60, 18], [0, 0, 1]]), {}),
        (np.array([[-60.0, 0, 30], [0, 60, 18], [0, 0, 1]]), {}),
        (K, {"near": 0.0}),
        (K, {"sh_degree": 2}),
        (K, {"background": (0, 0)}),
    ],
)
def test_cameras_and_settings_that_do_not_fit_are_refused(camera: np.ndarray, settings: dict) -> None:
    with pytest.raises(UsageError):
        render(cloud(3), camera, WIDTH, HEIGHT, POSE, **settings)


def test_pictures_that_cannot_be_drawn_are_refused() -> None:
    for width, height in ((0, 5), (5, 0), (20000, 5)):
        with pytest.raises(UsageError, match="cannot be drawn"):
            render(cloud(3), K, width, height, POSE)


def test_tensors_of_any_strides() -> None:
    scene = cloud(50)
    means = torch.empty(3, 50).T
    with torch.no_grad():
        means.copy_(scene.means)
    strided = Splats(means.requires_grad_(), *(t for t in list(scene.tensors().values())[1:]))
    one, two = draw(scene), draw(strided)
    assert torch.equal(one.image, two.image)
    two.image.sum().backward()
    one.image.sum().backward()
    assert means.grad is not None
    assert torch.equal(means.grad, scene.means.grad)


def test_losses_that_do_not_fit_are_refused() -> None:
    picture = torch.rand(5, 6, 3)
    for target, extra in (
        (torch.rand(5, 7, 3), {}),
        (picture.double(), {}),
        (picture, {"valid": torch.ones(5, 6)}),
        (picture, {"ssim_weight": 1.5}),
    ):
        with pytest.raises(UsageError):
            l1_ssim(picture, target, **extra)


def test_the_bench_scene_is_as_dense_as_it_says() -> None:
    scene, camera = bench.surface(bench.SPLATS, bench.WIDTH, bench.HEIGHT)
    out = render(scene, camera, bench.WIDTH, bench.HEIGHT, torch.eye(4)[:3])
    assert 300 < bench.consulted(out) / (bench.WIDTH * bench.HEIGHT) < 345


def test_bench_rows_have_their_keys() -> None:
    for row in bench.rows(quick=True):
        assert {"kernel", "seconds", "oracle_seconds", "ratio", "size", "isa", "threads"} <= row.keys()
        assert row["seconds"] > 0
        assert row["ratio"] == row["oracle_seconds"] / row["seconds"]
