"""Speed of the spike kernels beside their oracles, at the Vidar's size, on one thread: rows of `cost kernels`."""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median
from typing import Any

import numpy as np

from spikerig import _native
from spikerig.dataset import kernels, oracles, sim_kernels, sim_oracles

HEIGHT, WIDTH, WINDOW, STREAM = 250, 400, 41, 1000
KNOT, KNOTS, FEW = 32, 11, 8  # ticks between light samples, how many of them; ticks that slow oracles are timed on
NOISE = {
    "shot": {"shot": (560.0, (1, 2))},
    "few shot": {"shot": (10.0, (1, 2))},
    "comparator": {"comparator": (0.006, (3, 4))},
    "reset": {"reset_loss": 0.002},
    "all": {"shot": (560.0, (1, 2)), "comparator": (0.006, (3, 4)), "reset_loss": 0.002},
}


def rows(quick: bool = False) -> list[dict[str, Any]]:
    """A row a kernel.

    Args:
        quick: fewer repeats.

    Returns:
        Dicts with kernel, seconds (CPU, median), oracle_seconds, ratio, size, isa, threads, ticks_per_second. Those
        that fire have ns_per_pixel_tick (their oracles that step are timed on 8 ticks and scaled). `count` has
        memcpy_fraction, bytes of spikes a second over those of a plain copy of the same bytes; its reference is fixed:
        np.unpackbits(bits, axis=2, bitorder="little").sum(0).
    """
    threads = _native.threads()
    _native.set_threads(1)
    try:
        return _rows(5 if quick else 15)
    finally:
        _native.set_threads(threads)


def _rows(repeats: int) -> list[dict[str, Any]]:
    rng = np.random.default_rng(0)
    shape = (HEIGHT, WIDTH)
    charge = rng.integers(0, 2**32, shape, dtype=np.uint32)
    rate = (0.01 + 0.6 * rng.random((1, *shape)) ** 2).astype(np.float32)
    bits, _, _ = kernels.fire(rate, np.array([0, STREAM]), charge, hold=True)
    middle = STREAM // 2 - WINDOW // 2
    window, some = bits[middle : middle + WINDOW], bits[:64]

    def row(kernel: str, ticks: int, run: Callable[[], object], oracle: Callable[[], object]) -> dict[str, Any]:
        mine, reference = _seconds(run, repeats), _seconds(oracle, 3)
        return {
            "kernel": kernel, "seconds": mine, "oracle_seconds": reference, "ratio": reference / mine,
            "size": f"{WIDTH}x{HEIGHT}, {ticks} ticks", "isa": _native.isa(), "threads": 1,
            "ticks_per_second": ticks / mine,
        }  # fmt: skip

    def plain_count() -> object:
        return np.unpackbits(window, axis=2, bitorder="little").sum(0)

    copy = np.empty_like(window)
    counted = row("count", WINDOW, lambda: kernels.count(bits, WIDTH, middle, middle + WINDOW), plain_count)
    counted["memcpy_fraction"] = _seconds(lambda: np.copyto(copy, window), 4 * repeats) / counted["seconds"]
    return [
        row("unpack", 64, lambda: kernels.unpack(some, WIDTH), lambda: oracles.unpack(some, WIDTH)),
        counted,
        row("tfi_at", STREAM, lambda: kernels.tfi_at(bits, WIDTH, STREAM // 2),
            lambda: oracles.tfi_at(bits, WIDTH, STREAM // 2)),
        row("tfi_all", 64, lambda: kernels.tfi_all(some, WIDTH), lambda: oracles.tfi_all(some, WIDTH)),
        *_firing(rng, charge, repeats),
    ]  # fmt: skip


def _firing(rng: np.random.Generator, charge: Any, repeats: int) -> list[dict[str, Any]]:
    """Light of 0.01 to 0.6 thresholds a tick, linear between samples 32 ticks apart; `bright` has all of it up to 3."""
    dim = (0.01 + 0.6 * rng.random((KNOTS, *charge.shape)) ** 2).astype(np.float32)
    bright = dim * np.float32(5)
    knots = np.arange(KNOTS) * KNOT
    ticks = int(knots[-1])

    def row(name: str, kernel: Any, oracle: Any, light: Any, options: dict[str, Any]) -> dict[str, Any]:
        mine = _seconds(lambda: kernel(light, knots, charge, hold=False, **options), repeats)
        stepped = oracle is sim_oracles.fire_noisy or "carry" in options
        some = knots[:2] // (KNOT // FEW) if stepped else knots
        theirs = _seconds(lambda: oracle(light[: len(some)], some, charge, hold=False, **options), 1 if stepped else 3)
        theirs *= ticks / int(some[-1])
        return {
            "kernel": name, "seconds": mine, "oracle_seconds": theirs, "ratio": theirs / mine,
            "size": f"{WIDTH}x{HEIGHT}, {ticks} ticks", "isa": _native.isa(), "threads": 1,
            "ticks_per_second": ticks / mine, "ns_per_pixel_tick": 1e9 * mine / (ticks * charge.size),
        }  # fmt: skip

    return [
        row("fire", kernels.fire, oracles.fire, dim, {}),
        row("fire bright", kernels.fire, oracles.fire, bright, {}),
        row("fire carried", kernels.fire, oracles.fire, bright, {"carry": True}),
        *(
            row(f"noisy {name}", sim_kernels.fire_noisy, sim_oracles.fire_noisy, dim, options)
            for name, options in NOISE.items()
        ),
    ]


def _seconds(run: Callable[[], object], repeats: int) -> float:
    """Median CPU seconds of a call, after one that is not counted; short calls are timed several at a time."""
    run()
    start = time.process_time()
    run()
    inner = max(1, int(0.01 / max(time.process_time() - start, 1e-6)))
    found = []
    for _ in range(repeats):
        start = time.process_time()
        for _ in range(inner):
            run()
        found.append((time.process_time() - start) / inner)
    return median(found)
