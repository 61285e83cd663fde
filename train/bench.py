"""Speed of the train kernels beside their pure-torch oracles, on one thread: rows of `cost kernels`.

The scene of `raster`: three wavy surfaces one behind the other across the whole picture, a third of the splats on
each, flat along the surface (the third axis 0.3 x), sizes log-normal (sigma 0.4) round the mean distance of
neighbours on their surface, opacities uniform in 0.1..0.95, degree-0 colour: at 50,000 splats on 400 x 250 pixels a
pixel consults some 320 splats of its tile's list before it is finished. The picture's gradient is random.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from statistics import median
from typing import Any

import numpy as np
import torch

from spikerig import _native
from spikerig.train import oracles
from spikerig.train.splat import Rendered, Splats, render
from spikerig.train.ssim import l1_ssim

WIDTH, HEIGHT, SPLATS = 400, 250, 50_000


def surface(n: int, width: int, height: int, *, degree: int = 0, seed: int = 0) -> tuple[Splats, np.ndarray]:
    """The scene described above and its K [3,3], seen from the identity pose; float32 leaves that require grad."""
    rng = np.random.default_rng(seed)
    layers, across = 3, height / width
    xy = rng.uniform(-0.525, 0.525, (n, 2)) * [1, across]
    layer = rng.integers(0, layers, n)
    z = 2.0 + layer + 0.15 * np.sin(7 * xy[:, 0] + layer) * np.cos(9 * xy[:, 1]) + 0.01 * rng.standard_normal(n)
    spacing = z * math.sqrt(1.05**2 * across * layers / n)
    opacity = rng.uniform(0.1, 0.95, n)
    parts = (
        np.column_stack([xy * z[:, None], z]),
        np.column_stack([np.ones(n), 0.3 * rng.standard_normal((n, 2)), rng.uniform(-3, 3, n)]),
        np.log(spacing)[:, None] + 0.4 * rng.standard_normal((n, 3)) + np.log([1, 1, 0.3]),
        np.log(opacity / (1 - opacity)),
        0.3 * rng.standard_normal((n, (degree + 1) ** 2, 3)),
    )
    leaves = (torch.tensor(p, dtype=torch.float32).requires_grad_() for p in parts)
    return Splats(*leaves), np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])


def rows(quick: bool = False) -> list[dict[str, Any]]:
    """A row a kernel.

    Args:
        quick: fewer repeats, and 2,000 splats.

    Returns:
        Dicts with kernel, seconds (CPU of forward and backward with the autograd around it, median), oracle_seconds
        (the same through the tiled pure-torch oracle in float32, one run), ratio, size, isa, threads; `raster` also
        has absgrad_seconds (with `absgrad`, the median ratio of calls in turns), consulted_per_pixel and
        splat_pixels_per_second (consulted, per second of one core).
    """
    with one_thread():
        return [_raster(5 if quick else 15, 2_000 if quick else SPLATS), _ssim(5 if quick else 15)]


@contextmanager
def one_thread() -> Iterator[None]:
    """The kernels and torch on one thread each, for as long as the block lasts."""
    mine, theirs = _native.threads(), torch.get_num_threads()
    _native.set_threads(1)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        _native.set_threads(mine)
        torch.set_num_threads(theirs)


def consulted(picture: Rendered) -> int:
    """Sum over pixels of the splats of the tile's list up to where the pixel was finished."""
    return picture.image.grad_fn.state.consulted()  # type: ignore[union-attr]


def _raster(repeats: int, n: int) -> dict[str, Any]:
    splats, K = surface(n, WIDTH, HEIGHT)
    leaves = list(splats.tensors().values())
    pose = torch.eye(4)[:3]
    grad = torch.from_numpy(np.random.default_rng(1).standard_normal((HEIGHT, WIDTH, 3)).astype(np.float32))

    def mine() -> None:
        torch.autograd.grad(render(splats, K, WIDTH, HEIGHT, pose).image, leaves, grad)

    def oracle() -> None:
        torch.autograd.grad(oracles.render(splats, K, WIDTH, HEIGHT, pose, tiled=True)[0], leaves, grad)

    def absolute() -> None:
        torch.autograd.grad(render(splats, K, WIDTH, HEIGHT, pose, absgrad=True).image, leaves, grad)

    row = _row("raster", f"{n} splats, {WIDTH}x{HEIGHT}, forward+backward", mine, oracle, repeats)
    pairs = consulted(render(splats, K, WIDTH, HEIGHT, pose))
    turns = [(_seconds(mine, 1), _seconds(absolute, 1)) for _ in range(repeats)]
    return row | {
        "absgrad_seconds": row["seconds"] * median(b / a for a, b in turns),
        "consulted_per_pixel": pairs / (WIDTH * HEIGHT),
        "splat_pixels_per_second": pairs / row["seconds"],
    }


def _ssim(repeats: int) -> dict[str, Any]:
    rng = np.random.default_rng(2)
    image, target = (torch.from_numpy(rng.random((HEIGHT, WIDTH, 3), dtype=np.float32)) for _ in range(2))
    image.requires_grad_()

    def mine() -> None:
        torch.autograd.grad(l1_ssim(image, target), image)

    def oracle() -> None:
        torch.autograd.grad(oracles.l1_ssim(image, target), image)

    return _row("ssim", f"{WIDTH}x{HEIGHT}x3, value+gradient", mine, oracle, repeats)


def _row(kernel: str, size: str, mine: Callable[[], None], oracle: Callable[[], None], repeats: int) -> dict[str, Any]:
    seconds, reference = _seconds(mine, repeats), _seconds(oracle, 1)
    return {
        "kernel": kernel,
        "seconds": seconds,
        "oracle_seconds": reference,
        "ratio": reference / seconds,
        "size": size,
        "isa": _native.isa(),
        "threads": 1,
    }


def _seconds(run: Callable[[], None], repeats: int) -> float:
    """Median CPU seconds of this process over a call, after one call that is not counted where there are several."""
    if repeats > 1:
        run()
    found = []
    for _ in range(repeats):
        start = time.process_time()
        run()
        found.append(time.process_time() - start)
    return median(found)
