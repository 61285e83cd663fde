"""Checked entrances to the native train kernels: shapes, types and finite values are settled here, in words.

The kernels' definitions, in float64, are in oracles.py under the same names.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np

from spikerig import _native
from spikerig.dataset.errors import NumericsError, UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    import torch

TENSORS = ("means", "quats", "log_scales", "logit_opacities", "sh")
MAX_SIDE = 16384  # pixels


def array(name: str, tensor: torch.Tensor, shape: tuple[int | None, ...]) -> np.ndarray:
    """The float32 C-ordered array of a CPU tensor, without a copy where it already is one.

    Args:
        name: what to call it in a message.
        tensor: any strides; must be float32 and on the CPU.
        shape: expected sizes, None where any will do.

    Raises:
        UsageError: wrong type, device or shape.
    """
    found = tuple(tensor.shape)
    kind = str(tensor.dtype).removeprefix("torch.")
    fits = len(found) == len(shape) and all(want in (None, have) for want, have in zip(shape, found, strict=True))
    if kind != "float32" or tensor.device.type != "cpu" or not fits:
        want = ", ".join("any" if size is None else str(size) for size in shape)
        raise UsageError(
            f"'{name}' does not fit the native kernels",
            value=f"{kind} {list(found)} on {tensor.device}",
            expected=f"float32 [{want}] on cpu",
            next=f"{name}.float().cpu(), and check its sizes",
        )
    return tensor.detach().contiguous().numpy()


def refuse_not_finite(named: dict[str, np.ndarray]) -> None:
    """Raise a NumericsError that names the first value which is not finite; return when all are."""
    for name, values in named.items():
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            index = tuple(int(k) for k in bad[0])
            raise NumericsError(
                f"'{name}' has {len(bad)} values that are not finite; the first is at index {list(index)}",
                value=values[index],
                expected="finite numbers",
                cause="a step of the optimiser diverged: too large a learning rate, or a gradient that was not finite",
                next="resume from the last checkpoint with a smaller learning rate",
            )


def camera_block(
    intrinsics: Any, width: int, height: int, cam_from_world: Any, background: Sequence[float], near: float
) -> np.ndarray:
    """The camera as the kernels take it: float64 [20] = fx fy cx cy, cam_from_world[12], near, background[3].

    Raises:
        UsageError: K is not an upright pinhole without skew, or a shape or size is wrong.
        NumericsError: a value is not finite.
    """
    k = np.asarray(_plain(intrinsics), dtype=np.float64)
    pose = np.asarray(_plain(cam_from_world), dtype=np.float64)
    light = np.asarray(_plain(background), dtype=np.float64)
    if k.shape != (3, 3) or pose.shape != (3, 4) or light.shape != (3,):
        raise UsageError(
            "the camera's arrays have the wrong shapes",
            value=f"K {list(k.shape)}, cam_from_world {list(pose.shape)}, background {list(light.shape)}",
            expected="K [3, 3], cam_from_world [3, 4], background [3]",
        )
    refuse_not_finite({"K": k, "cam_from_world": pose, "background": light, "near": np.asarray([near], np.float64)})
    if k[0, 0] <= 0 or k[1, 1] <= 0 or k[0, 1] != 0 or k[1, 0] != 0 or tuple(k[2]) != (0, 0, 1):
        raise UsageError(
            "K is not a pinhole without skew",
            value=k.tolist(),
            expected="[[fx > 0, 0, cx], [0, fy > 0, cy], [0, 0, 1]], pixels, centres at +0.5",
            next="undistort the view first (calib.align.pair gives such a camera)",
        )
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE) or not near > 0:
        raise UsageError(
            "the picture cannot be drawn",
            value=f"{width} x {height}, near {near}",
            expected=f"1..{MAX_SIDE} pixels each way, near > 0",
        )
    return np.concatenate([[k[0, 0], k[1, 1], k[0, 2], k[1, 2]], pose.ravel(), [near], light])


def _plain(values: Any) -> Any:
    return values.detach().cpu().numpy() if hasattr(values, "detach") else values


def render_forward(
    arrays: Sequence[np.ndarray], camera: np.ndarray, width: int, height: int, sh_degree: int, antialias: bool
) -> tuple[_native.Render, np.ndarray, np.ndarray, np.ndarray]:
    """Draw splats.

    Args:
        arrays: means [N,3], quats [N,4], log_scales [N,3], logit_opacities [N], sh [N,K,3]; float32.
        camera: from `camera_block`.
        width, height: pixels.
        sh_degree: 0..3, at most the stored one.
        antialias: Mip 2D compensation of the dilation.

    Returns:
        (state for the way back, image [H,W,3], alpha [H,W], radii [N] in pixels, 0 where culled), float32.

    Raises:
        NumericsError: a parameter is not finite; names the tensor and the index.

    Cost: CPU-time of projection, sort and raster; `spikerig cost kernels` measures it.
    """
    image = np.empty((height, width, 3), np.float32)
    alpha = np.empty((height, width), np.float32)
    radii = np.empty(len(arrays[3]), np.float32)
    means, quats, log_scales, logits, sh = arrays
    made = _native.render_forward(
        means, quats, log_scales, logits, sh, camera, width, height, sh_degree, antialias, image, alpha, radii
    )
    state = cast("_native.Render | None", made)
    if state is None:
        refuse_not_finite(dict(zip(TENSORS, arrays, strict=True)))
        raise NumericsError(
            "a splat's colour overflows float32",
            expected="SH coefficients far below 1e38",
            next="resume from the last checkpoint",
        )
    return state, image, alpha, radii


def render_backward(
    state: _native.Render,
    arrays: Sequence[np.ndarray],
    image_grad: np.ndarray,
    alpha_grad: np.ndarray,
    absgrad: np.ndarray | None = None,
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Gradients of what `render_forward` drew, given those of the image and of alpha.

    `absgrad` [N,2], where given, gets the sums over pixels of |d loss / d screen position|, in loss per pixel.

    Returns:
        (gradients of the five arrays; of the screen positions [N,2], in loss per pixel; of cam_from_world [3,4],
        float64).
    """
    means, quats, log_scales, logits, sh = arrays
    g_means, g_quats, g_log_scales, g_logits, g_sh = grads = [np.empty_like(a) for a in arrays]
    screen, camera = np.empty((len(logits), 2), np.float32), np.empty(12, np.float64)
    _native.render_backward(
        state, means, quats, log_scales, logits, sh, image_grad, alpha_grad,
        g_means, g_quats, g_log_scales, g_logits, g_sh, screen, camera, absgrad,
    )  # fmt: skip
    return grads, screen, camera.reshape(3, 4)


def l1_ssim(
    image: np.ndarray, target: np.ndarray, valid: np.ndarray | None, ssim_weight: float, *, grad: bool
) -> tuple[float, np.ndarray | None]:
    """(1 - w) mean |image - target| + w mean (1 - SSIM), and its gradient in `image`.

    Args:
        image, target: float32 [H,W,3], range 1.
        valid: bool [H,W] or None; pixels that are not valid count as outside the picture, and the means leave them out.
        ssim_weight: w.
        grad: whether the gradient is wanted.

    Returns:
        (loss, gradient [H,W,3] or None).

    Edges: no valid pixel: 0 and a zero gradient.
    """
    count = 3 * (image.shape[0] * image.shape[1] if valid is None else int(np.count_nonzero(valid)))
    out = np.empty_like(image) if grad else None
    mask = None if valid is None else np.ascontiguousarray(valid).view(np.uint8)
    each = 1 / max(count, 1)
    loss = _native.l1_ssim(image, target, mask, out, (1 - ssim_weight) * each, ssim_weight * each)
    return loss, out
