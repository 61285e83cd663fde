"""The CUDA path: refused with the fix where it cannot work, and handing gsplat what the native rasteriser gets."""

import sys
import types
from typing import Any

import numpy as np
import pytest
import torch

from spikerig.dataset.errors import HostError
from spikerig.train import cuda
from spikerig.train.model import renderer
from spikerig.train.splat import Splats, render

K = np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]])
POSE = np.concatenate([np.eye(3), [[0.1], [-0.1], [2.0]]], 1).astype(np.float32)


def _splats() -> Splats:
    g = torch.Generator().manual_seed(3)
    draw = [torch.randn(s, generator=g) for s in ((40, 3), (40, 4), (40, 3), (40,), (40, 4, 3))]
    draw[0] = draw[0] * 0.5
    draw[2] = draw[2] * 0.2 - 2.5
    return Splats(*[d.requires_grad_() for d in draw])


def fake_rasterization(
    means: Any, quats: Any, scales: Any, opacities: Any, colors: Any, viewmats: Any, Ks: Any, width: int, height: int,
    **more: Any,
) -> Any:  # fmt: skip
    """gsplat's calling convention, answered by the native rasteriser."""
    assert more["packed"] is False
    splats = Splats(means, quats, scales.log(), torch.logit(opacities), colors)
    drawn = render(
        splats, Ks[0].numpy().astype(np.float64), width, height, viewmats[0, :3],
        background=more["backgrounds"][0].tolist(), sh_degree=more["sh_degree"],
        antialias=more["rasterize_mode"] == "antialiased", near=more["near_plane"],
    )  # fmt: skip
    probe = torch.zeros(len(splats), 2, requires_grad=True) * 1.0
    return drawn.image[None], drawn.alpha[None, :, :, None], {"means2d": probe, "radii": drawn.radii[None, :, None]}


def test_without_a_gpu_it_says_so_and_what_to_do() -> None:
    if torch.cuda.is_available():
        renderer("cuda")
        return
    with pytest.raises(HostError, match="no CUDA device") as caught:
        renderer("cuda")
    assert caught.value.exit_code == 6
    assert "--device" in caught.value.next


def test_without_gsplat_it_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda, "DEVICE", "cpu")
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(HostError, match="gsplat") as caught:
        renderer("cuda")
    assert "spikerig[cuda]" in caught.value.next


@pytest.mark.parametrize("antialias", [False, True])
def test_gsplat_gets_the_same_scene(monkeypatch: pytest.MonkeyPatch, antialias: bool) -> None:
    module = types.ModuleType("gsplat")
    module.rasterization = fake_rasterization  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "gsplat", module)
    monkeypatch.setattr(cuda, "DEVICE", "cpu")
    mine, theirs = _splats(), _splats()
    options: dict[str, Any] = {"background": (0.2, 0.4, 0.6), "antialias": antialias, "near": 0.05}
    a, b = render(mine, K, 32, 24, POSE, **options), cuda.render_cuda(theirs, K, 32, 24, POSE, **options)
    torch.testing.assert_close(b.image, a.image, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(b.alpha, a.alpha, rtol=1e-5, atol=1e-5)
    weight = torch.linspace(0, 1, a.image.numel()).reshape(a.image.shape)
    for picture in (a, b):
        (picture.image * weight).sum().backward()
    for name, tensor in mine.tensors().items():
        torch.testing.assert_close(theirs.tensors()[name].grad, tensor.grad, rtol=1e-3, atol=1e-4)
