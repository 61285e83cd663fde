"""Loss terms, all means over pixels; pictures are sRGB codes [H,W,3], light is linear, textures have white at 1.

The native kernels behind `tfs_loss` and `average_exposure` have their definitions here as plain torch: `tfs_oracle`
and `average_oracle` (any dtype and device; float64 in tests, and what a CUDA run uses).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from spikerig import _native
from spikerig.dataset.errors import UsageError
from spikerig.train.converter import respond

DOMAINS = {"encoded": 0, "linear": 1, "luma": 2, "naive": 2}  # what the gray of a picture is compared as
REC601 = (0.299, 0.587, 0.114)


def linear_from_srgb(code: Tensor) -> Tensor:
    """Linear light of sRGB codes (exact piecewise curve, extended beyond [0, 1]); gradients finite everywhere."""
    curve = ((code.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(code <= 0.04045, code / 12.92, curve)


def srgb_from_linear(light: Tensor) -> Tensor:
    """SRGB codes of linear light (exact piecewise curve, extended beyond [0, 1]); gradients finite everywhere."""
    curve = 1.055 * light.clamp(min=0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(light <= 0.0031308, light * 12.92, curve)


def average_oracle(images: list[Tensor], others: Tensor | None = None, count: int = 0) -> Tensor:
    """The definition of `average_exposure`."""
    light = torch.stack([linear_from_srgb(image) for image in images]).sum(0)
    return srgb_from_linear((light if others is None else light + others) / max(count, len(images)))


class _Average(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, others: Tensor | None, count: int, *images: Tensor) -> Tensor:
        out, light = torch.empty_like(images[0]), torch.empty_like(images[0])
        base = None if others is None else others.numpy()
        _native.average([image.numpy() for image in images], base, count, out.numpy(), light.numpy())
        ctx.save_for_backward(out, light, *images)
        ctx.count = count
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        out, light, *images = ctx.saved_tensors
        to = [torch.empty_like(image) for image in images]
        grad = grads[0].contiguous().numpy()
        codes = [image.numpy() for image in images]
        _native.average_back(codes, ctx.count, out.numpy(), light.numpy(), grad, [g.numpy() for g in to])
        return None, None, *to


def average_exposure(images: list[Tensor], others: Tensor | None = None, count: int = 0) -> Tensor:
    """The picture of an exposure from sub-exposures, averaged in linear light; differentiable in `images`.

    Args:
        images: [H,W,3] sRGB codes each, at least one.
        others: [H,W,3] sum of the linear light of further sub-exposures, or None.
        count: how many there are in all; 0 means len(images).

    Returns:
        [H,W,3] sRGB codes.

    Edges: one image alone is returned as it is. Cost: two powers a number of `images`. Oracle: `average_oracle`.
    """
    count = max(count, len(images))
    if count == 1:
        return images[0]
    if any(image.shape != images[0].shape for image in images):
        raise UsageError("sub-exposures must have one size", value=[tuple(i.shape) for i in images])
    if images[0].device.type != "cpu" or images[0].dtype != torch.float32:
        return average_oracle(images, others, count)
    return _Average.apply(others, count, *[image.contiguous() for image in images])  # type: ignore[return-value]


def light_of(image: Tensor) -> Tensor:
    """Linear light of sRGB codes, without a gradient; the native kernel where it can."""
    image = image.detach()
    if image.device.type != "cpu" or image.dtype != torch.float32:
        return linear_from_srgb(image)
    light = torch.empty_like(image)
    _native.decode(image.contiguous().numpy(), light.numpy())
    return light


def gray_of(image: Tensor, gray: Tensor, domain: str) -> Tensor:
    """What is compared with a texture: [H,W] from codes [H,W,3] and gray[4] (three weights, bias)."""
    channels = image if domain in ("luma", "naive") else linear_from_srgb(image)
    y = channels[..., 0] * gray[0] + channels[..., 1] * gray[1] + channels[..., 2] * gray[2] + gray[3]
    return srgb_from_linear(y) if domain == "encoded" else y


def tfs_oracle(
    image: Tensor, texture: Tensor, weight: Tensor, gray: Tensor, domain: str = "encoded", heights: Tensor | None = None
) -> Tensor:
    """The definition of `tfs_loss`."""
    seen = gray_of(image, gray, domain)
    residual = torch.where(weight > 0, (seen if heights is None else respond(seen, heights)) - texture, 0.0)
    return (weight * residual * residual).sum()


class _Tfs(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, texture: Tensor, weight: Tensor, gray: Tensor, domain: str) -> Tensor:
        grad = torch.empty_like(image)
        arrays = (image.numpy(), texture.numpy(), weight.numpy(), gray.numpy())
        value, by_gray = _native.tfs(*arrays, DOMAINS[domain], grad.numpy())
        ctx.grad, ctx.by_gray = grad, by_gray
        return torch.tensor(value, dtype=image.dtype)

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        by_gray = grads[0] * torch.tensor(ctx.by_gray) if ctx.needs_input_grad[3] else None
        return ctx.grad * grads[0], None, None, by_gray, None


def tfs_loss(
    image: Tensor, texture: Tensor, weight: Tensor, gray: Tensor, domain: str = "encoded", heights: Tensor | None = None
) -> Tensor:
    """The TfS term of one rendered picture against one texture: a weighted mean of squared residuals.

    Args:
        image: [H,W,3] sRGB codes of the render.
        texture: [H,W]: sRGB code of the texture for domains `encoded` and `luma`, its light for `linear`, `naive`.
        weight: [H,W]: `mean_weights` of the known pixels, so that the sum is a mean.
        gray: [4], weights of R, G, B and bias.
        domain: see FitConfig.tfs_domain.
        heights: of a response curve at equally spaced grays from 0 to 1 (`converter.respond`); None: a straight line.

    Returns:
        A scalar, differentiable in `image`, `gray` and `heights`. Same bits for any thread count.

    Edges: a pixel of weight 0 contributes nothing, whatever its texture holds.
    Cost: with `heights` by plain torch, several times the kernel's.
    Source: paper, Eq. TfS, as a mean. Oracle: `tfs_oracle`.
    """
    if domain not in DOMAINS:
        raise UsageError("no such domain of the TfS term", value=domain, expected=", ".join(DOMAINS))
    if image.shape[:2] != texture.shape or weight.shape != texture.shape or gray.shape != (4,):
        raise UsageError(
            "the TfS term needs image[H,W,3], texture[H,W], weight[H,W] and gray[4]",
            value=tuple(tuple(t.shape) for t in (image, texture, weight, gray)),
        )
    if heights is not None or image.device.type != "cpu" or image.dtype != torch.float32:
        return tfs_oracle(image, texture, weight, gray, domain, heights)
    return _Tfs.apply(image.contiguous(), texture, weight, gray.contiguous(), domain)  # type: ignore[return-value]


def mean_weights(mask: Tensor) -> Tensor:
    """1/count on the true pixels of a mask [H,W], 0 elsewhere, so that a weighted sum is a mean; all 0 for none."""
    count = int(mask.sum())
    return mask.to(torch.float32) / max(count, 1)


def l2_loss(image: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
    """Mean over pixels and channels of the squared error; `weight` [H,W] from `mean_weights`, None = every pixel."""
    error = image - target
    if weight is None:
        return (error * error).mean()
    error = torch.where(weight[..., None] > 0, error, 0.0)
    return (error * error * weight[..., None]).sum() / 3


def ratio_target(
    frame_light: Tensor, texture: Tensor, mean: Tensor, known: Tensor, *, eps: float, low: float, high: float
) -> Tensor:
    """Spike-ratio target: the blurry frame times texture-at-an-instant over exposure mean, in linear light, encoded.

    Args:
        frame_light: [H,W,3] linear light of the blurry frame.
        texture: [H,W] texture at the instant, white at 1; of colour spikes [H,W,3].
        mean: texture of the whole exposure, same units and shape.
        known: bool[H,W] where both are known; the ratio is 1 elsewhere.
        eps: added to both, so that ratios of small counts stay near 1.
        low, high: bounds of the ratio.

    Returns:
        [H,W,3] sRGB codes, clipped to [0, 1].

    Source: the double-integral idea of EDI with counts instead of log events; gain and fixed pattern cancel.
    """
    ratio = ((texture + eps) / (mean + eps)).clamp(low, high)
    ratio = torch.where(known[..., None], ratio if ratio.ndim == 3 else ratio[..., None], 1.0)
    return srgb_from_linear((frame_light * ratio).clamp(0.0, 1.0))
