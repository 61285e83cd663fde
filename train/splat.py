"""3D Gaussian splats and their picture, differentiable, on the CPU."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from spikerig.dataset.errors import UsageError
from spikerig.train import kernels

SH_ROWS = {1: 0, 4: 1, 9: 2, 16: 3}  # stored coefficients -> degree


@dataclass(frozen=True, slots=True, eq=False)
class Splats:
    """N splats as plain tensors, as they are optimised.

    Args:
        means: [N,3] centres, world units.
        quats: [N,4] rotations, w x y z, any length (0 means no rotation).
        log_scales: [N,3] natural log of the standard deviations, world units.
        logit_opacities: [N] opacity = sigmoid of it.
        sh: [N,(d+1)^2,3] spherical harmonics of the colour; colour = max(0, SH + 0.5), in the picture's encoding.
    """

    means: torch.Tensor
    quats: torch.Tensor
    log_scales: torch.Tensor
    logit_opacities: torch.Tensor
    sh: torch.Tensor

    def __len__(self) -> int:
        return len(self.means)

    def tensors(self) -> dict[str, torch.Tensor]:
        """The five tensors by name, in the order of the fields."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @property
    def sh_degree(self) -> int:
        """Stored degree, 0..3."""
        return SH_ROWS[self.sh.shape[1]]


@dataclass(frozen=True, slots=True, eq=False)
class Rendered:
    """One picture.

    Args:
        image: [H,W,3] colour, the background included.
        alpha: [H,W] 1 - light left.
        radii: [N] half size of each footprint's box in pixels, 0 where culled.
        means2d_probe: [N,2] zeros; after backward its `.grad` holds d loss / d screen position, in loss per pixel
            (what densification watches). None when no gradient is asked for.
        absgrad_probe: the same for the sum over pixels of |d loss / d screen position|; None unless asked for.
    """

    image: torch.Tensor
    alpha: torch.Tensor
    radii: torch.Tensor
    means2d_probe: torch.Tensor | None
    absgrad_probe: torch.Tensor | None = None

    @property
    def visible(self) -> torch.Tensor:
        """[N] bool: not culled."""
        return self.radii > 0


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, settings: tuple[Any, ...], probe: Any, absolute: Any, pose: torch.Tensor, *tensors: torch.Tensor
    ) -> Any:
        intrinsics, width, height, background, sh_degree, antialias, near = settings
        arrays = _arrays(tensors)
        camera = kernels.camera_block(intrinsics, width, height, pose, background, near)
        state, image, alpha, radii = kernels.render_forward(arrays, camera, width, height, sh_degree, antialias)
        out = (torch.from_numpy(image), torch.from_numpy(alpha), torch.from_numpy(radii))
        ctx.mark_non_differentiable(out[2])
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*tensors)
        ctx.state, ctx.pose, ctx.absgrad = state, (pose.dtype, pose.device), absolute is not None
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, image_grad: Any, alpha_grad: Any, _radii: Any) -> Any:  # type: ignore[override]
        width, height = ctx.state.width, ctx.state.height
        shapes = ((image_grad, (height, width, 3)), (alpha_grad, (height, width)))
        by_image, by_alpha = (np.zeros(size, np.float32) if g is None else g.contiguous().numpy() for g, size in shapes)
        arrays = _arrays(ctx.saved_tensors)
        absolute = np.empty((len(arrays[3]), 2), np.float32) if ctx.absgrad else None
        grads, screen, camera = kernels.render_backward(ctx.state, arrays, by_image, by_alpha, absolute)
        dtype, device = ctx.pose
        pose_grad = torch.from_numpy(camera).to(device, dtype)
        sums = None if absolute is None else torch.from_numpy(absolute)
        return None, torch.from_numpy(screen), sums, pose_grad, *(torch.from_numpy(g) for g in grads)


def _arrays(tensors: Sequence[torch.Tensor]) -> list[np.ndarray]:
    n = len(tensors[0])
    shapes: tuple[tuple[int | None, ...], ...] = ((n, 3), (n, 4), (n, 3), (n,), (n, None, 3))
    return [kernels.array(*each) for each in zip(kernels.TENSORS, tensors, shapes, strict=True)]


def render(
    splats: Splats,
    K: Any,
    width: int,
    height: int,
    cam_from_world: Any,
    *,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    sh_degree: int | None = None,
    antialias: bool = False,
    near: float = 0.01,
    absgrad: bool = False,
) -> Rendered:
    """Draw splats with one camera; differentiable in the splats' tensors and in cam_from_world.

    Args:
        splats: N splats, float32 on the CPU.
        K: [3,3] pinhole, pixels, pixel centres at +0.5, no skew; not differentiated.
        width, height: pixels.
        cam_from_world: [3,4], looking along +z, y down; a tensor that requires grad gets its gradient (as 12 free
            numbers; the SH direction counts the camera centre as -R^T t).
        background: colour behind everything; not differentiated.
        sh_degree: degree used, at most the stored one; None: the stored one.
        antialias: Mip 2D compensation (opacity x sqrt(det0 / det), not below 0.005) of the 0.3 pixel^2 dilation.
        near: splats with a centre nearer than this along z, world units, are dropped.
        absgrad: also watch the sum over pixels of |d loss / d screen position| (`absgrad_probe`).

    Returns:
        image, alpha, radii and the probes for densification.

    Raises:
        UsageError: wrong shape, type, degree or camera.
        NumericsError: a parameter is not finite; names tensor and index.

    Edges: no splats or none visible gives the background and alpha 0. A splat leaves a pixel untouched where its
        alpha < 1/255; alpha is at most 0.99 (no gradient where clipped); a pixel is finished when less than 1.1e-4
        of the light is left. Splats of equal float32 depth keep their order. Same bits for any thread count.
    Cost: measured by `spikerig cost kernels`, with absgrad too; not asked for, it costs nothing.
    Source: Kerbl et al. 2023; Zwicker et al. 2001 (EWA); Yu et al. 2024 (Mip-Splatting, 2D filter).
    """
    rows = splats.sh.shape[1] if splats.sh.ndim == 3 else 0
    if rows not in SH_ROWS or not 0 <= (SH_ROWS[rows] if sh_degree is None else sh_degree) <= SH_ROWS[rows]:
        raise UsageError(
            "the spherical harmonics do not fit",
            value=f"sh {list(splats.sh.shape)}, sh_degree {sh_degree}",
            expected="sh [N, 1 | 4 | 9 | 16, 3] and a degree not above the stored one",
        )
    degree = SH_ROWS[rows] if sh_degree is None else sh_degree
    pose = cam_from_world if isinstance(cam_from_world, torch.Tensor) else torch.as_tensor(np.asarray(cam_from_world))
    tensors = tuple(splats.tensors().values())
    probe = absolute = None
    if torch.is_grad_enabled() and (pose.requires_grad or any(t.requires_grad for t in tensors)):
        probe = torch.zeros((len(splats), 2), dtype=torch.float32, requires_grad=True)
        absolute = torch.zeros_like(probe, requires_grad=True) if absgrad else None
    settings = (K, int(width), int(height), tuple(background), degree, antialias, float(near))
    image, alpha, radii = _Render.apply(settings, probe, absolute, pose, *tensors)  # type: ignore[misc]
    return Rendered(image, alpha, radii, probe, absolute)
