"""A small scene with everything in it, and an exact comparison of records, for the tests of the scene file."""

from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from spikerig.dataset.clocktime import ClockModel
from spikerig.dataset.scene import Camera, Frame, Points, Pose, Scene, Trajectory, Truth, View
from spikerig.dataset.spikes import SpikeStream

H, W = 13, 21


def turn(angle: float, shift: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s, shift], [0, 1, 0, -shift], [-s, 0, c, 2.0]])


def path(k: int, cov: bool) -> Trajectory:
    poses = np.stack([turn(0.1 * i, 0.01 * i) for i in range(k)])
    noise = np.random.default_rng(k).random((k, 6, 6)) if cov else None
    return Trajectory(np.arange(k) * 1_000_003 - 7, poses, noise)


def stream(ticks: int, seed: int, rate_hz: float | None = 40_000.0) -> SpikeStream:
    on = np.random.default_rng(seed).random((ticks, H, W)) < 0.2
    lost = np.array([[3, 9], [20, 21]]) if ticks > 30 else np.zeros((0, 2), int)
    for a, b in lost:
        on[a:b] = False
    return SpikeStream(np.packbits(on, axis=2, bitorder="little"), W, rate_hz, -1234567, "spike-clock", lost)


def view(i: int) -> View:
    rng = np.random.default_rng(100 + i)
    shape = (H, W)
    frame = Frame(
        rng.integers(0, 256, (*shape, 3), dtype=np.uint8), ["srgb", "linear"][i % 2], 5_000 + i, 7_500_000, 21, "cam"
    )
    spikes = None if i == 3 else stream(40 if i else 0, i, None if i == 2 else 40_000.1)
    return View(
        ["a", "v-01.x", "_b", "Z9"][i],
        frame,
        spikes,
        rng.random(shape, dtype=np.float32) * 100,
        rng.random(shape) < 0.5,
        Pose(turn(0.3 * i, i)),
        None if i == 1 else path(4, cov=i == 0),
        "test" if i == 3 else "train",
    )


def full_scene() -> Scene:
    rng = np.random.default_rng(5)
    views = tuple(view(i) for i in range(4))
    clock = ClockModel(np.array([0, 10**15]), np.array([5, 10**15 + 30_000]), np.array([1.5, 2.5]), 12.5)
    truth = Truth(
        {name: rng.standard_normal((H, W, 3)).astype(np.float32) for name in ("a", "Z9")},
        {"a": 2**60 + 1, "_b": -3},
        {"a": path(9, cov=False)},
        clock,
        {"shot": {"threshold_e": 560.25}, "list": [1, None, True, "ü"]},
        2**62,
        "first",
    )
    points = Points(rng.standard_normal((17, 3)), rng.integers(0, 256, (17, 3), dtype=np.uint8), "simulator")
    camera = Camera(np.array([[30.0, 0, 10.5], [0, 31, 6.5], [0, 0, 1]]), np.array([0.1, -0.2, 0.3, 1e-17]), W, H)
    info = {"made": "üß", "n": [1, 2.5, None], "deep": {"k": True}}
    return Scene("scène 1", camera, views, points, truth, 0.1 + 0.2, info, clock, {"id": "cal-1", "mirror": {"arm": 1}})


def same(a: Any, b: Any, where: str = "scene") -> None:
    """Assert that two records are equal to the last bit, dtypes included."""
    assert type(a) is type(b) or (isinstance(a, dict) and isinstance(b, dict)), where
    if is_dataclass(a):
        for f in fields(a):
            same(getattr(a, f.name), getattr(b, f.name), f"{where}.{f.name}")
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes(), where
    elif isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            same(a[key], b[key], f"{where}[{key}]")
    elif isinstance(a, tuple):
        assert len(a) == len(b), where
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            same(x, y, f"{where}[{i}]")
    else:
        assert a == b, where
