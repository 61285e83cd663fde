"""Splats as trained tensors, with moments, and their picture."""

import numpy as np
import torch

from spikerig.train.splat import Splats, render


def params(n: int, opacity: float = 0.6) -> dict[str, torch.Tensor]:
    rng = np.random.default_rng(0)

    def tensor(*shape: int, scale: float = 1.0) -> torch.Tensor:
        return torch.from_numpy((scale * rng.standard_normal(shape)).astype(np.float32))

    return {
        "means": tensor(n, 3, scale=0.4),
        "quats": tensor(n, 4),
        "log_scales": tensor(n, 3, scale=0.2) - 2,
        "logit_opacities": torch.full((n,), float(np.log(opacity / (1 - opacity)))),
        "sh": tensor(n, 1, 3, scale=0.3),
    }


def moments(p: dict[str, torch.Tensor]) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    return {name: (torch.ones_like(t), torch.ones_like(t)) for name, t in p.items()}


def picture(p: dict[str, torch.Tensor]) -> torch.Tensor:
    pose = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2.0]])
    K = np.array([[60.0, 0, 32], [0, 60, 20], [0, 0, 1]])
    with torch.no_grad():
        return render(Splats(**p), K, 64, 40, pose).image
