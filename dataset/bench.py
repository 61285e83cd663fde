"""Speed of the spike kernels beside their oracles, at the Vidar's size, on one thread: rows of `cost kernels`."""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median
from typing import Any

import numpy as np

from spikerig import _native
from spikerig.dataset import kernels, oracles

HEIGHT, WIDTH, WINDOW, STREAM = 250, 400, 41, 1000


def rows(quick: bool = False) -> list[dict[str, Any]]:
    """A row a kernel.

    Args:
        quick: fewer repeats.

    Returns:
        Dicts with kernel, seconds (CPU, median), oracle_seconds, ratio, size, isa, threads, ticks_per_second; `count`
        also has memcpy_fraction (bytes of spikes a second over those of a plain copy of the same bytes). The reference
        of `count` is fixed: np.unpackbits(bits, axis=2, bitorder="little").sum(0).
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
    rate = (0.01 + 0.6 * rng.random((11, *shape)) ** 2).astype(np.float32)
    bits, _, _ = kernels.fire(rate[:1], np.array([0, STREAM]), charge, hold=True)
    middle = STREAM // 2 - WINDOW // 2
    window, some = bits[middle : middle + WINDOW], bits[:64]
    knots = np.arange(11) * 32

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
        row("fire", 320, lambda: kernels.fire(rate, knots, charge, hold=False),
            lambda: oracles.fire(rate, knots, charge, hold=False)),
    ]  # fmt: skip


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
