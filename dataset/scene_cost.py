"""`spikerig cost scene`: how long a scene file takes to write, verify, open and read from."""

from __future__ import annotations

import os
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

HEIGHT, WIDTH, TICKS, WINDOW, REPEATS = 250, 400, 812, 41, 40


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
    """Median wall and mean CPU milliseconds of each thing done with a scene file; warm page cache."""
    from spikerig.dataset.hdf5_guard import ask_child
    from spikerig.dataset.store import open_scene, verify_scene, write_scene

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.h5"
        whole = made_up_scene(views)
        done = {"write": _median(lambda _: write_scene(path, whole, force=True), 3)}
        done["verify (in a child)"] = _median(lambda _: verify_scene(path), 3)
        done["open, never seen (a child looks)"] = _median(lambda _: (ask_child("probe", path), open_scene(path)), 5)
        done["open"] = _median(lambda _: open_scene(path).close())
        with open_scene(path) as file:
            name = [file.names[i % views] for i in range(REPEATS)]
            done[f"{WINDOW} ticks of a view"] = _median(lambda i: file.spikes(name[i], 400, 400 + WINDOW))
            done[f"all {TICKS} ticks of a view"] = _median(lambda i: file.spikes(name[i]))
            done["a view without its spikes"] = _median(lambda i: file.view(name[i], spikes=False))
        return {"views": views, "bytes": path.stat().st_size, "rows": done}


def _median(run: Callable[[int], object], repeats: int = REPEATS) -> dict[str, float]:
    wall, cpu = [], []
    for i in range(repeats):
        before, start = os.times(), time.perf_counter()
        run(i)
        wall.append(time.perf_counter() - start)
        after = os.times()
        cpu.append(sum(after[:4]) - sum(before[:4]))  # with children; in steps of the system's clock tick
    return {"wall_ms": 1e3 * median(wall), "cpu_ms": 1e3 * sum(cpu) / repeats}


def scene(
    views: int = typer.Option(40, min=1, help="Views of the scene measured."),
    as_json: bool = typer.Option(False, "--json", help="One JSON document on stdout."),
) -> None:
    """Time the scene file: write, verify, open, one view's window of spikes (400x250, 812 ticks a view)."""
    found = measure(views)
    here = machine.describe()
    if as_json:
        emit("spikerig.cost.scene/1", {**found, "machine": here, "command": machine.command()})
    note(f"{found['views']} views, {found['bytes'] / 1e6:,.0f} MB; wall and CPU milliseconds")
    for name, row in found["rows"].items():
        note(f"{name:34} {row['wall_ms']:10,.1f} {row['cpu_ms']:10,.1f}")
    note(machine.caption(here))
