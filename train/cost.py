"""`spikerig cost train`: what steps, sub-poses, textures and the weight w cost and give, on one scene."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import typer

from spikerig.dataset import cost, machine
from spikerig.dataset.errors import UsageError
from spikerig.dataset.terminal import Progress
from spikerig.dataset.texture_cost import finish

STEPS = (125, 250, 500, 1000, 2000)
COUNTS = (1, 2, 3, 5, 10)
# The paper's w = 1e-4 under each reading of Eq. TfS; WEIGHTS are mean-equivalent.
READINGS = ("mean", "sum-batch", "sum-image", "u8")
WEIGHTS = (0.0, 0.1, 1.0, 5.0, 20.0, 100.0, 1000.0)


def plan(steps: int) -> Iterator[tuple[str, Any, Any]]:
    """Every run of the sweep: (series, knob value, config)."""
    from spikerig.train.methods import configure

    for method in ("plain", "average", "spikenerf", "spike-ratio", "spike-hybrid", "oracle"):
        for n in STEPS:
            yield f"{method}: steps", n, configure(method, "draft", steps=n)
    for n in COUNTS:
        every = configure("average", "draft", steps=steps, poses_per_view=n, fresh_poses=0)
        yield f"average: poses_per_view, all rendered, {steps} steps", n, every
        yield f"average: poses_per_view, one rendered, {steps} steps", n, replace(every, fresh_poses=1)
    five = configure("spikenerf-5x", "draft", steps=steps)
    for n in COUNTS[:-1]:
        both = replace(five, poses_per_view=n, textures_per_view=n)
        yield f"spikenerf: poses_per_view = textures_per_view, {steps} steps", n, both
    one = configure("spikenerf", "draft", steps=steps)
    for w in WEIGHTS:
        yield f"spikenerf: mean-equivalent w, {steps} steps", w, replace(one, tfs_weight=w)
    for reading in READINGS:
        again = replace(one, tfs_weight=1e-4, weight_reading=reading)
        yield f"spikenerf: w = 1e-4 read as, {steps} steps", reading, again


def sweep(scene: Path, steps: int, seeds: int) -> cost.Sweep:
    """Train every setting `seeds` times; medians of held-out RMS error and of CPU and wall seconds of training.

    Args:
        scene: a scene file with truth.
        steps: of the series that do not sweep them.
        seeds: runs of each setting, seeds 0, 1, ...
    """
    settings = list(plan(steps))
    bar = Progress("cost train", len(settings) * seeds, "runs")
    rows = []
    for series, value, config in settings:
        runs = []
        for seed in range(seeds):
            runs.append(_one(scene, replace(config, seed=seed)))
            bar.step(extra=f"{series} {value}")
        psnr, cpu, wall = (median(column) for column in zip(*runs, strict=True))
        rows.append(cost.Row(series, value, 10 ** (-psnr / 20), cpu, wall, 0, f"{psnr:.2f} dB"))
    return cost.Sweep(
        "train", f"Training on '{scene.stem}': held-out views, pose label mid", "setting", "RMS, 1 = white",
        "the sharp truth of held-out views", seeds, tuple(rows), machine.describe(), machine.command(),
        ("peak memory, which a sweep in one process cannot tell apart run by run",),
    )  # fmt: skip


def _one(scene: Path, config: Any) -> tuple[float, float, float]:
    from spikerig.train.run import run_fit

    with tempfile.TemporaryDirectory(prefix="spikerig-cost-") as folder:
        start = time.process_time()
        done = run_fit(scene, config, Path(folder) / "run", eval_every=0)
        cpu = time.process_time() - start
    if done["psnr"] is None:
        raise UsageError("this scene has no sharp held-out views to score", value=scene, next="spikerig sim capture")
    return done["psnr"], cpu, done["train_seconds"]


def train(
    scene: Annotated[Path, typer.Argument(help="A scene file with truth, e.g. runs/demo/demo.h5.")],
    steps: Annotated[int, typer.Option(help="Steps of the series that do not sweep them.")] = 600,
    seeds: Annotated[int, typer.Option(help="Runs of each setting; medians are reported.")] = 1,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder for train.json and train.svg.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier result.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Sweep training steps, poses_per_view, textures_per_view and w: held-out error over seconds."""
    if steps < 1 or seeds < 1:
        raise UsageError("steps and seeds must be at least 1", value=(steps, seeds))
    finish("train", lambda: sweep(scene, steps, seeds), out, force, as_json)
