"""`spikerig cost scene`: how long a scene file takes to write, verify, open and read from."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import typer

from spikerig.dataset import machine
from spikerig.dataset.scene import Camera, Frame, Pose, Scene, Trajectory, Truth, View
from spikerig.dataset.terminal import emit, note

HEIGHT, WIDTH, TICKS, WINDOW, REPEATS = 250, 400, 812, 41, 30


def made_up_scene(views: int) -> Scene:
    """A scene of random numbers with truth: 400x250, 812 ticks a view (300 of exposure, 256 of margin each side)."""
    from spikerig.dataset.clocktime import ClockModel
    from spikerig.dataset.spikes import SpikeStream

    rng = np.random.default_rng(0)
    bits = rng.integers(0, 256, (TICKS, HEIGHT, WIDTH // 8), np.uint8)
    light = rng.random((HEIGHT, WIDTH, 3), np.float32)
    rows = np.repeat(np.arange(HEIGHT, dtype=np.float32)[:, None], WIDTH, 1)
    still = np.eye(4)[:3]
    path = Trajectory(np.arange(9) * 937_500, np.tile(still, (9, 1, 1)))
    names = [f"v{i:03d}" for i in range(views)]
    frame = Frame(rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8), exposure_ns=7_500_000)
    stream = SpikeStream(bits, WIDTH, 40_000.0, -6_400_000)
    made = tuple(View(n, frame, stream, rows, np.ones((HEIGHT, WIDTH), bool), Pose(still), path) for n in names)
    truth = Truth(dict.fromkeys(names, light), dict.fromkeys(names, 0), {}, ClockModel.identity(), {}, 0)
    return Scene("made up", Camera.pinhole(WIDTH, HEIGHT, 50.0), made, truth=truth)


def measure(views: int) -> dict[str, Any]:
    """Median milliseconds of opening and reading, megabytes a second of writing and verifying; warm page cache."""
    from spikerig.dataset.store import open_scene, verify_scene, write_scene

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.h5"
        scene = made_up_scene(views)
        write_s = _seconds(lambda _: write_scene(path, scene), 1)
        size = path.stat().st_size
        verify_s = _seconds(lambda _: verify_scene(path), 1)
        with open_scene(path) as file:
            names = file.names
            return {
                "views": views,
                "bytes": size,
                "open_ms": 1e3 * _seconds(lambda _: open_scene(path).close()),
                "window_ms": 1e3 * _seconds(lambda i: file.spikes(names[i % views], 400, 400 + WINDOW)),
                "view_spikes_ms": 1e3 * _seconds(lambda i: file.spikes(names[i % views])),
                "view_without_spikes_ms": 1e3 * _seconds(lambda i: file.view(names[i % views], spikes=False)),
                "write_mb_per_s": size / 1e6 / write_s,
                "verify_mb_per_s": size / 1e6 / verify_s,
                "first_open_ms": 1e3 * _first_open(path),
            }


def _seconds(run: Callable[[int], object], repeats: int = REPEATS) -> float:
    spent = []
    for i in range(repeats):
        start = time.perf_counter()
        run(i)
        spent.append(time.perf_counter() - start)
    return median(spent)


def _first_open(path: Path) -> float:
    """Opening a file that nothing is known of: a child process looks at it first."""
    from spikerig.dataset.hdf5_guard import ask_child

    return _seconds(lambda _: ask_child("probe", path), 5)


def scene(
    views: int = typer.Option(40, min=1, help="Views of the scene measured."),
    as_json: bool = typer.Option(False, "--json", help="One JSON document on stdout."),
) -> None:
    """Time the scene file: write, verify, open, one view's window of spikes (400x250, 812 ticks a view)."""
    found = measure(views)
    here = machine.describe()
    if as_json:
        emit("spikerig.cost.scene/1", {**found, "machine": here, "command": machine.command()})
    for name, value in found.items():
        note(f"{name:24} {value:,.2f}" if isinstance(value, float) else f"{name:24} {value:,}")
    note(machine.caption(here))
