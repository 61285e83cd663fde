"""L1 + SSIM of two pictures: one fused kernel for value and gradient."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from spikerig.dataset.errors import UsageError
from spikerig.train import kernels


class _L1Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: torch.Tensor, target: torch.Tensor, valid: Any, weight: float) -> torch.Tensor:
        loss, ctx.grad = kernels.l1_ssim(*_arrays(image, target), valid, weight, grad=ctx.needs_input_grad[0])
        return torch.tensor(loss, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> Any:  # type: ignore[override]
        return torch.from_numpy(ctx.grad) * grad, None, None, None


def l1_ssim(
    image: torch.Tensor, target: torch.Tensor, ssim_weight: float = 0.2, valid: torch.Tensor | np.ndarray | None = None
) -> torch.Tensor:
    """(1 - w) mean |image - target| + w (1 - SSIM): the colour loss of 3D Gaussian Splatting.

    Args:
        image: [H,W,3] float32, range 1; gets the gradient.
        target: [H,W,3] float32; not differentiated.
        ssim_weight: w, 0..1.
        valid: [H,W] bool; other pixels count as outside the picture (zero in both) and the means leave them out.

    Returns:
        The loss, a float32 scalar.

    Raises:
        UsageError: a shape or type does not fit.

    Edges: no valid pixel gives 0; pictures smaller than the window are fine (zero outside, as everywhere).
        |x| has gradient 0 at 0. Same bits for any thread count.
    Cost: measured by `spikerig cost kernels`, kernel `ssim`.
    Source: SSIM: Wang et al. 2004, 11 x 11 Gaussian window, sigma 1.5, zero padding (Inria's variant).
    """
    _check(image, target)
    mask = None
    if valid is not None:
        mask = np.asarray(valid.detach().cpu() if isinstance(valid, torch.Tensor) else valid)
        if mask.dtype != np.bool_ or mask.shape != tuple(target.shape[:2]):
            raise UsageError(
                "'valid' does not fit the picture",
                value=f"{mask.dtype} {list(mask.shape)}",
                expected=f"bool {list(target.shape[:2])}",
            )
    if not 0 <= ssim_weight <= 1:
        raise UsageError("'ssim_weight' is out of range", value=ssim_weight, expected="0..1")
    return _L1Ssim.apply(image, target, mask, float(ssim_weight))  # type: ignore[no-any-return]


def ssim(image: torch.Tensor, target: torch.Tensor) -> float:
    """SSIM, the `inria` variant: 11 x 11 Gaussian window, sigma 1.5, zero padding, mean over pixels and channels.

    Args:
        image, target: [H,W,3] float32, range 1.

    Returns:
        -1..1; 1 for equal pictures.

    Raises:
        UsageError: a shape or type does not fit.
    """
    _check(image, target)
    return 1.0 - kernels.l1_ssim(*_arrays(image, target), None, 1.0, grad=False)[0]


def _arrays(image: torch.Tensor, target: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    shape = tuple(target.shape)
    return kernels.array("image", image, shape), kernels.array("target", target, shape)


def _check(image: torch.Tensor, target: torch.Tensor) -> None:
    if target.ndim != 3 or target.shape[2] != 3 or target.numel() == 0 or image.shape != target.shape:
        raise UsageError(
            "the two pictures do not fit",
            value=f"image {list(image.shape)}, target {list(target.shape)}",
            expected="both [H, W, 3], not empty",
        )
