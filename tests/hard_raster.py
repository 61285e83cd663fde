"""Hard inputs of the rasteriser, and the hard cases of it and of SSIM."""

from collections.abc import Callable

import numpy as np
import torch

from spikerig.train.splat import Splats

WIDTH, HEIGHT = 61, 37  # partial tiles on both sides
K = np.array([[60.0, 0, 30.5], [0, 63, 18.0], [0, 0, 1]])
POSE = torch.tensor([[1, 0.02, 0, 0.01], [-0.02, 1, 0.03, 0.02], [0, -0.03, 1, 0.05]])
BACKGROUND = (0.2, 0.5, 0.3)

RASTER, SSIM = "numerics/test_raster.py::test_", "numerics/test_ssim.py::test_"
ROWS = [
    (
        "needle splats, condition 1 to 1e8",
        "render",
        "image and gradients agree with float64",
        RASTER + "hard_scene_agrees_with_float64",
    ),
    (
        "an axis of no length (log scale -60)",
        "render",
        "the same; gradient 0 beyond the clamp of 30",
        RASTER + "hard_scene_agrees_with_float64",
    ),
    (
        "quaternion 0",
        "render",
        "no rotation, gradient 0",
        RASTER + "zero_quaternion_means_no_rotation_and_has_no_gradient",
    ),
    (
        "splat across the camera plane",
        "render",
        "finite, agrees with float64; dropped nearer than `near`",
        RASTER + "hard_scene_agrees_with_float64",
    ),
    (
        "1000 opaque splats in a row",
        "render",
        "saturates: first ones drawn, alpha clipped at 0.99, finite gradients",
        RASTER + "a_thousand_opaque_splats_saturate",
    ),
    (
        "splats of equal depth",
        "render",
        "drawn in their order; a shuffle of others changes no bit",
        RASTER + "ties_keep_their_order",
    ),
    ("splats in another order", "render", "the same bits", RASTER + "a_shuffle_changes_no_bit"),
    (
        "opacity 0 and 1 (logits of +-1e4)",
        "render",
        "nothing, or 0.99; finite gradients",
        RASTER + "hard_scene_agrees_with_float64",
    ),
    (
        "splats far below a pixel",
        "render",
        "agrees with float64 (dilated to 0.3 pixel^2)",
        RASTER + "hard_scene_agrees_with_float64",
    ),
    (
        "splats of e^20 and e^60 units",
        "render",
        "finite, agrees with float64",
        RASTER + "hard_scene_agrees_with_float64",
    ),
    (
        "splats behind the camera, at it, far aside",
        "render",
        "dropped, gradient 0",
        RASTER + "nothing_visible_is_the_background",
    ),
    ("no splats at all", "render", "the background, empty gradients", RASTER + "nothing_visible_is_the_background"),
    ("a picture of one pixel", "render", "agrees with float64", RASTER + "pictures_of_any_size"),
    (
        "centres outside the picture's 1.3 x",
        "render",
        "Jacobian frozen, gradient as float64's",
        RASTER + "hard_scene_agrees_with_float64",
    ),
    (
        "NaN or infinity in a parameter",
        "render",
        "NumericsError that names tensor and index",
        RASTER + "a_value_that_is_not_finite_is_named",
    ),
    (
        "alpha on the very edge of 1/255",
        "render",
        "only pixels of a counted band may differ, by a bounded step",
        RASTER + "the_band_comparison_can_fail",
    ),
    (
        "1, 2, 3, 5 threads",
        "render, l1_ssim",
        "the same bits, gradients included",
        RASTER + "same_bits_for_any_thread_count",
    ),
    (
        "constant pictures",
        "l1_ssim",
        "variance clamped at 0: SSIM 1 where equal, finite gradient",
        SSIM + "constant_pictures",
    ),
    (
        "pictures smaller than the window",
        "l1_ssim",
        "value and gradient agree with float64",
        SSIM + "agrees_with_float64",
    ),
    ("no valid pixel", "l1_ssim", "loss 0, gradient 0", SSIM + "no_valid_pixel_is_no_loss"),
    ("values far outside 0..1", "l1_ssim", "finite, agrees with float64", SSIM + "values_outside_the_range"),
]


def cloud(n: int, seed: int = 0, degree: int = 1, size: float = 0.05) -> Splats:
    """Ordinary splats in front of the camera; float32 leaves that require grad."""
    rng = np.random.default_rng(seed)
    means = rng.uniform(-1, 1, (n, 3)) * [0.7, 0.45, 0.5] + [0, 0, 1.6]
    return splats(
        means,
        rng.standard_normal((n, 4)),
        np.log(rng.uniform(0.1, 1, (n, 3)) * size),
        rng.normal(0, 1.5, n),
        0.4 * rng.standard_normal((n, (degree + 1) ** 2, 3)),
    )


def splats(*arrays: np.ndarray) -> Splats:
    return Splats(*(torch.tensor(np.asarray(a), dtype=torch.float32).requires_grad_() for a in arrays))


def changed(base: Splats, **arrays: torch.Tensor) -> Splats:
    """The same splats with some tensors replaced; fresh leaves."""
    parts = base.tensors() | arrays
    return Splats(*(t.detach().clone().requires_grad_() for t in parts.values()))


def needles(condition: float) -> Splats:
    base = cloud(60, seed=1)
    scales = torch.log(torch.tensor([0.5, 0.5 / condition, 0.5 / condition**0.5]))
    return changed(base, log_scales=scales.expand(60, 3))


def no_length() -> Splats:
    base = cloud(60, seed=2)
    scales = base.log_scales.detach().clone()
    scales[::2, 1] = -60
    scales[::3, 0] = -60
    return changed(base, log_scales=scales)


def across_the_camera_plane() -> Splats:
    base = cloud(60, seed=3, size=0.6)
    means = base.means.detach().clone()
    means[:, 2] = torch.linspace(-0.3, 0.3, 60)
    means[:, :2] *= 0.05
    return changed(base, means=means)


def opaque_stack(n: int = 1000) -> Splats:
    base = cloud(n, seed=4, size=0.3)
    means = base.means.detach() * torch.tensor([0.2, 0.2, 0]) + torch.linspace(1, 3, n)[:, None] * torch.tensor(
        [0, 0, 1.0]
    )
    return changed(base, means=means, logit_opacities=torch.full((n,), 9.0))


def opacities_at_the_ends() -> Splats:
    base = cloud(60, seed=5)
    return changed(base, logit_opacities=torch.tensor([-1e4, -30.0, -5.6, 5.0, 30.0, 1e4]).repeat(10))


def below_a_pixel() -> Splats:
    return changed(cloud(300, seed=6), log_scales=torch.full((300, 3), -12.0))


def huge() -> Splats:
    base = cloud(12, seed=7)
    return changed(
        base, log_scales=torch.tensor([3.0, 20.0, 60.0]).repeat(12, 1), logit_opacities=torch.full((12,), -1.0)
    )


def outside_the_picture() -> Splats:
    base = cloud(80, seed=8, size=0.5)
    return changed(base, means=base.means.detach() * torch.tensor([2.2, 2.2, 1]))


HARD: dict[str, Callable[[], Splats]] = {
    "cloud": lambda: cloud(400),
    "needles 1": lambda: needles(1),
    "needles 1e2": lambda: needles(1e2),
    "needles 1e4": lambda: needles(1e4),
    "needles 1e8": lambda: needles(1e8),
    "no length": no_length,
    "across the camera plane": across_the_camera_plane,
    "opaque stack": opaque_stack,
    "opacities at the ends": opacities_at_the_ends,
    "below a pixel": below_a_pixel,
    "huge": huge,
    "outside the picture": outside_the_picture,
}
