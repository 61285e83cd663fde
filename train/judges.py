"""Trained judges of pictures, LPIPS and RankIQA, with weights that the user gives; nothing ever stands in for them.

A file is either TorchScript, which is a program and needs to be trusted, or safetensors, which is numbers only.
Layouts (docs/researcher.md, "Measuring"): LPIPS is the state dict of the lpips package's LPIPS(net="alex" | "vgg");
RankIQA is a VGG16 with one output, in torchvision's names or in Caffe's.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional as F

from spikerig.dataset.errors import DataError, UsageError

Tensors = dict[str, torch.Tensor]
CROP, CROPS = 224, 30  # RankIQA: pixels of a crop, and how many make a score
LEAST = 32  # LPIPS: pixels a side; below, its last layers see nothing
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # LPIPS: of each channel in [-1, 1]
ALEX = {0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3), 10: (256, 256, 3)}
VGG_AT = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)  # indices of the convolutions in torchvision's VGG16
VGG_WIDTH = (64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512)
VGG_CAFFE = ("1_1", "1_2", "2_1", "2_2", "3_1", "3_2", "3_3", "4_1", "4_2", "4_3", "5_1", "5_2", "5_3")
VGG_TAPS = (2, 7, 14, 21, 28)  # LPIPS looks after the ReLU of these
POOL_BEFORE = (5, 10, 17, 24)


@dataclass(frozen=True, slots=True, eq=False)
class Judge:
    """A loaded network: `about` names it and hashes its file."""

    run: Callable[..., float]
    about: dict[str, Any]

    def __call__(self, *pictures: NDArray[np.uint8]) -> float:
        """The score of uint8[H,W,3] sRGB codes: two for LPIPS, one for RankIQA."""
        return self.run(*pictures)


def open_lpips(path: Path, *, trust: bool) -> Judge:
    """LPIPS from a file: 0 for equal pictures, larger is farther apart.

    Args:
        path: safetensors in the lpips package's layout, or TorchScript of a module (a, b) -> a number, for float32
            [1,3,H,W] in R, G, B order and [-1, 1].
        trust: TorchScript may run.

    Raises:
        UsageError: TorchScript without trust.
        DataError: not such a network; or two equal pictures are not at distance 0.
    """
    network, about = _open(path, trust, _lpips_of)

    def run(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
        if min(a.shape[:2]) < LEAST:
            raise UsageError("too small for LPIPS", value=a.shape[:2], expected=f"at least {LEAST}x{LEAST}")
        pair = (torch.from_numpy(x.transpose(2, 0, 1)[None].astype(np.float32) / 127.5 - 1) for x in (a, b))
        return _number(network, path, *pair)

    x, y = np.random.default_rng(0).integers(0, 256, (2, 64, 64, 3), np.uint8)
    same, apart = run(x, x), run(x, y)
    if abs(same) > 1e-5 or apart <= same:
        raise DataError("this network is no distance between pictures", value=f"equal: {same:g}, noise: {apart:g}")
    return Judge(run, about)


def open_rankiqa(path: Path, *, trust: bool) -> Judge:
    """RankIQA from a file: the mean over 30 crops; the scale is that of the weights (LIVE's: lower is better).

    Args:
        path: safetensors of its VGG16, or TorchScript of a module float32[1,3,224,224] -> a number. Both get what its
            authors feed: B, G, R, 0..255, no mean taken away.
        trust: TorchScript may run.

    Raises:
        UsageError: TorchScript without trust, or later a picture with a side under 224 pixels.
        DataError: not such a network.

    Edges:
        The authors draw 30 crops at random; here they are 30 places spread evenly, so that a score repeats.
    """
    network, about = _open(path, trust, _rankiqa_of)

    def run(codes: NDArray[np.uint8]) -> float:
        scores = []
        for y, x in crops(*codes.shape[:2]):
            crop = codes[y : y + CROP, x : x + CROP, ::-1].transpose(2, 0, 1)[None].astype(np.float32)
            scores.append(_number(network, path, torch.from_numpy(crop)))
        return float(np.mean(scores))

    run(np.random.default_rng(0).integers(0, 256, (CROP, CROP, 3), np.uint8))
    return Judge(run, about | {"crops": f"{CROPS} of {CROP}x{CROP}, spread evenly", "average": "mean"})


def crops(height: int, width: int) -> list[tuple[int, int]]:
    """Upper left corners of RankIQA's crops, 5 rows by 6; each once, so fewer where the picture leaves no room."""
    if min(height, width) < CROP:
        raise UsageError("too small for RankIQA", value=f"{width}x{height}", expected=f"at least {CROP}x{CROP}")
    rows = np.unique(np.rint(np.linspace(0, height - CROP, 5)).astype(int))
    columns = np.unique(np.rint(np.linspace(0, width - CROP, 6)).astype(int))
    return [(int(y), int(x)) for y in rows for x in columns]


def _open(path: Path, trust: bool, build: Callable[[Tensors, Path], tuple[Any, str]]) -> tuple[Any, dict[str, Any]]:
    from spikerig.train.record import scene_hash

    if not path.is_file():
        raise DataError("there are no weights here", value=path)
    with path.open("rb") as file:
        script = file.read(2) == b"PK"
    if script and not trust:
        raise UsageError(
            "a TorchScript file is a program: it runs only when you say so",
            value=path,
            next="--trust, for a file you know; or give the weights as safetensors, which cannot run",
        )
    if script:
        network, name = _script(path), "TorchScript"
    else:
        network, name = build(_tensors(path), path)
    return network, {"network": name, "file": path.name, "sha256": scene_hash(path)}


def _script(path: Path) -> Any:
    try:
        return torch.jit.load(str(path), map_location="cpu").eval()
    except (RuntimeError, ValueError, OSError) as error:
        raise DataError("not TorchScript", value=path, cause=str(error).splitlines()[0]) from error


def _tensors(path: Path) -> Tensors:
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        found = load_file(path)
    except (SafetensorError, OSError, ValueError) as error:
        raise DataError("neither TorchScript nor safetensors", value=path, cause=str(error)) from error
    if bad := [k for k, t in found.items() if t.is_floating_point() and not torch.isfinite(t).all()]:
        raise DataError("weights that are not finite", value=f"{path}: {', '.join(bad[:5])}")
    return {k: t.float() for k, t in found.items()}


def _number(network: Any, path: Path, *inputs: torch.Tensor) -> float:
    try:
        with torch.no_grad():
            out = network(*inputs)
    except (RuntimeError, TypeError, NotImplementedError) as error:
        raise DataError("the network does not take such pictures", value=path, cause=str(error)[-300:]) from error
    if not isinstance(out, torch.Tensor) or out.numel() != 1 or not torch.isfinite(out).all():
        raise DataError("the network does not give one finite number", value=path)
    return float(out)


def take(found: Tensors, name: str, shape: tuple[int, ...], faults: list[str]) -> torch.Tensor:
    """A tensor of a file by name and shape; a fault is noted and a stand-in returned where it is not there."""
    tensor = found.get(name)
    if tensor is None or tensor.shape != shape:
        faults.append(f"{name} {list(shape)}" + ("" if tensor is None else f", found {list(tensor.shape)}"))
        return torch.zeros(()).expand(shape)
    return tensor


def _check(faults: list[str], path: Path, what: str) -> None:
    if faults:
        more = f" and {len(faults) - 6} more" if len(faults) > 6 else ""
        raise DataError(f"these are not the weights of {what}", value=path, expected="; ".join(faults[:6]) + more)


def _alex(x: torch.Tensor, i: int, weight: torch.Tensor, bias: torch.Tensor) -> torch.Tensor:
    x = F.max_pool2d(x, 3, 2) if i in (3, 6) else x
    return F.relu(F.conv2d(x, weight, bias, stride=4 if i == 0 else 1, padding={0: 2, 3: 2}.get(i, 1)))


def _vgg(x: torch.Tensor, i: int, weight: torch.Tensor, bias: torch.Tensor) -> torch.Tensor:
    return F.relu(F.conv2d(F.max_pool2d(x, 2) if i in POOL_BEFORE else x, weight, bias, padding=1))


def _lpips_of(found: Tensors, path: Path) -> tuple[Any, str]:
    found = {re.sub(r"^net\.slice\d\.", "net.", k): t for k, t in found.items()}
    first = found.get("net.0.weight")
    alex = first is not None and first.shape[-1] == 11
    shapes = ALEX if alex else {i: (w, c, 3) for i, w, c in zip(VGG_AT, VGG_WIDTH, (3, *VGG_WIDTH), strict=False)}
    taps = tuple(ALEX) if alex else VGG_TAPS
    faults: list[str] = []
    layers = [
        (i, take(found, f"net.{i}.weight", (w, c, k, k), faults), take(found, f"net.{i}.bias", (w,), faults))
        for i, (w, c, k) in shapes.items()
    ]
    lins = [take(found, f"lin{n}.model.1.weight", (1, shapes[t][0], 1, 1), faults) for n, t in enumerate(taps)]
    _check(faults, path, "LPIPS (the lpips package's LPIPS().state_dict())")

    def features(x: torch.Tensor) -> list[torch.Tensor]:
        x = (x - torch.tensor(SHIFT).view(1, 3, 1, 1)) / torch.tensor(SCALE).view(1, 3, 1, 1)
        out = []
        for i, weight, bias in layers:
            x = (_alex if alex else _vgg)(x, i, weight, bias)
            if i in taps:
                out.append(x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10))
        return out

    def distance(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        pairs = zip(features(a), features(b), lins, strict=True)
        return torch.stack([F.conv2d((x - y).square(), lin).mean() for x, y, lin in pairs]).sum()

    return distance, "LPIPS 0.1, " + ("AlexNet" if alex else "VGG16")


def _rankiqa_of(found: Tensors, path: Path) -> tuple[Any, str]:
    caffe = {f"features.conv{c}": f"features.{i}" for i, c in zip(VGG_AT, VGG_CAFFE, strict=True)}
    caffe |= {f"classifier.fc{n}_m": f"classifier.{k}" for n, k in ((6, 0), (7, 3), (8, 6))}
    found = {".".join((caffe.get(k.rpartition(".")[0], k.rpartition(".")[0]), k.rpartition(".")[2])): t
             for k, t in found.items()}  # fmt: skip
    faults: list[str] = []
    convs = [
        (i, take(found, f"features.{i}.weight", (w, c, 3, 3), faults), take(found, f"features.{i}.bias", (w,), faults))
        for i, w, c in zip(VGG_AT, VGG_WIDTH, (3, *VGG_WIDTH), strict=False)
    ]
    ends = [
        (take(found, f"classifier.{k}.weight", (o, n), faults), take(found, f"classifier.{k}.bias", (o,), faults))
        for k, o, n in ((0, 4096, 25088), (3, 4096, 4096), (6, 1, 4096))
    ]
    _check(faults, path, "RankIQA's VGG16 (features.N, classifier.0, 3, 6; or Caffe's names)")

    def score(x: torch.Tensor) -> torch.Tensor:
        for i, weight, bias in convs:
            x = _vgg(x, i, weight, bias)
        x = F.max_pool2d(x, 2).flatten(1)
        for n, (weight, bias) in enumerate(ends):
            x = F.linear(x, weight, bias)
            x = F.relu(x) if n < 2 else x
        return x

    return score, "RankIQA, VGG16"
