"""The same splats drawn by gsplat on a CUDA device (extra `cuda`): same tensors, same checkpoints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from spikerig.dataset.errors import HostError
from spikerig.train.splat import SH_ROWS, Rendered, Splats

DEVICE = "cuda"


def render_cuda(
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
) -> Rendered:
    """Draw splats with gsplat; arguments and result as `splat.render`: tensors of the CPU in, a picture on the CPU out.

    Splats and picture travel to the device and back at every call (differentiably), so that losses, optimiser and
    checkpoints are the same code on both paths.

    Raises:
        HostError: no CUDA device, or gsplat is not installed or cannot compile.

    Edges: gsplat 1.5.3 clips alpha at 0.999, the native rasteriser at 0.99, so saturated pixels differ slightly;
        atomics make gradients differ from run to run.
    Source: gsplat's `rasterization` (Apache-2.0), called, not copied.
    """
    rasterization = check_cuda()
    there = {name: tensor.to(DEVICE) for name, tensor in splats.tensors().items()}
    pose = torch.as_tensor(cam_from_world, dtype=torch.float32).to(DEVICE)
    view = torch.cat([pose, pose.new_tensor([[0.0, 0.0, 0.0, 1.0]])])[None]
    image, alpha, info = rasterization(
        there["means"],
        there["quats"],
        there["log_scales"].exp(),
        torch.sigmoid(there["logit_opacities"]),
        there["sh"],
        view,
        torch.as_tensor(np.asarray(K), dtype=torch.float32).to(DEVICE)[None],
        width,
        height,
        near_plane=near,
        sh_degree=SH_ROWS[splats.sh.shape[1]] if sh_degree is None else sh_degree,
        packed=False,
        backgrounds=torch.tensor(background, dtype=torch.float32).to(DEVICE)[None],
        rasterize_mode="antialiased" if antialias else "classic",
    )
    probe = info["means2d"] if image.requires_grad else None
    if probe is not None:
        probe.retain_grad()
    radii = info["radii"].reshape(len(splats), -1).amax(1).float().cpu()
    return Rendered(image[0].cpu(), alpha[0, :, :, 0].cpu(), radii, probe)


def check_cuda() -> Any:
    """gsplat's `rasterization`, or a refusal with the command to run where the CUDA path cannot work.

    Raises:
        HostError: no CUDA device, or gsplat is missing.
    """
    if DEVICE == "cuda" and not torch.cuda.is_available():
        raise HostError(
            "there is no CUDA device for --device cuda",
            value=f"torch {torch.__version__}",
            cause="no NVIDIA GPU or driver, or a CPU build of torch",
            next="leave --device at cpu, or install the CUDA build of torch",
        )
    try:
        from gsplat import rasterization  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise HostError("--device cuda needs gsplat", cause=str(error), next="pip install 'spikerig[cuda]'") from error
    return rasterization
