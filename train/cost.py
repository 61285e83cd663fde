"""`spikerig cost train`: what steps, sub-poses, textures, their kind and the weight w cost and give, on one scene."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import typer

from spikerig.dataset import cost, machine
from spikerig.dataset.errors import UsageError
from spikerig.dataset.terminal import Progress
from spikerig.dataset.texture_cost import finish
from spikerig.train.onerun import run_apart

STEPS = (125, 250, 500, 1000, 2000)
COUNTS = (1, 2, 3, 5, 10)
# The paper's w = 1e-4 under each reading of Eq. TfS; WEIGHTS are mean-equivalent.
READINGS = ("mean", "sum-batch", "sum-image", "u8")
WEIGHTS = (0.0, 0.1, 1.0, 5.0, 20.0, 100.0, 1000.0)
KINDS = ("raw", "tfp", "tfi", "both", "tfi-window")
Setting = tuple[str, Any, Any]  # series, value of the knob, config


def _steps(field: str, steps: int) -> Iterator[Setting]:
    from spikerig.train.methods import configure

    for method in ("plain", "average", "spikenerf", "spike-ratio", "spike-hybrid", "oracle"):
        for n in STEPS:
            yield f"{method}: steps", n, configure(method, "draft", field, steps=n)


def _poses(field: str, steps: int) -> Iterator[Setting]:
    from spikerig.train.methods import configure

    average = configure("average", "draft", field, steps=steps)
    for n in COUNTS:
        every = replace(average, poses_per_view=n, fresh_poses=0)
        yield f"average: poses_per_view, all rendered, {steps} steps", n, every
        if field == "splat":
            yield f"average: poses_per_view, one rendered, {steps} steps", n, replace(every, fresh_poses=1)


def _counts(field: str, steps: int) -> Iterator[Setting]:
    from spikerig.train.methods import configure

    five = configure("spikenerf-5x", "draft", field, steps=steps)
    for n in COUNTS[:-1]:
        both = replace(five, poses_per_view=n, textures_per_view=n)
        yield f"spikenerf: poses_per_view = textures_per_view, {steps} steps", n, both


def _kinds(field: str, steps: int) -> Iterator[Setting]:
    from spikerig.train.methods import configure

    one = configure("spikenerf", "draft", field, steps=steps)
    for kind in KINDS:
        yield f"spikenerf: spike reconstruction, {steps} steps", kind, replace(one, textures=kind)
    # a spike is 0 or 1: encoding or clipping it moves its mean, so it can only be right in linear light, kept whole
    fair = replace(one, textures="raw", tfs_domain="linear", highlights="keep")
    yield f"spikenerf: spike reconstruction, {steps} steps", "raw, linear", fair


def _weights(field: str, steps: int) -> Iterator[Setting]:
    from spikerig.train.methods import configure

    one = configure("spikenerf", "draft", field, steps=steps)
    for w in WEIGHTS:
        yield f"spikenerf: mean-equivalent w, {steps} steps", w, replace(one, tfs_weight=w)


def _readings(field: str, steps: int) -> Iterator[Setting]:
    from spikerig.train.methods import configure

    one = configure("spikenerf", "draft", field, steps=steps)
    for reading in READINGS:
        again = replace(one, tfs_weight=1e-4, weight_reading=reading)
        yield f"spikenerf: w = 1e-4 read as, {steps} steps", reading, again


SERIES: dict[str, Callable[[str, int], Iterator[Setting]]] = {
    "steps": _steps,
    "poses": _poses,
    "n": _counts,
    "textures": _kinds,
    "w": _weights,
    "readings": _readings,
}


def plan(steps: int, series: tuple[str, ...] = tuple(SERIES), field: str = "splat") -> Iterator[Setting]:
    """Every run of some series: (series, knob value, config).

    Raises:
        UsageError: no such series.
    """
    if strange := sorted(set(series) - set(SERIES)):
        raise UsageError("no such series", value=", ".join(strange), expected=", ".join(SERIES))
    for name in series:
        yield from SERIES[name](field, steps)


def sweep(scene: Path, settings: list[Setting], seeds: int, kept: Path | None) -> cost.Sweep:
    """Train every setting `seeds` times, each in a process of its own.

    Args:
        scene: a scene file with truth.
        settings: of `plan`.
        seeds: runs of each setting, seeds 0, 1, ...
        kept: folder of finished runs: those there are not run again, so a sweep that was stopped goes on.

    Returns:
        Medians of held-out RMS error, CPU and wall seconds of training, the most memory of any.
    """
    from spikerig.train.record import scene_hash

    bar, rows, hashed = Progress("cost train", len(settings) * seeds, "runs"), [], scene_hash(scene)
    for series, value, config in settings:
        runs = []
        for seed in range(seeds):
            runs.append(_kept(scene, hashed, replace(config, seed=seed).as_json(), kept))
            bar.step(extra=f"{series} {value}")
        psnr, cpu, wall = (median(run[key] for run in runs) for key in ("psnr", "cpu_seconds", "train_seconds"))
        peak = max(run["peak_bytes"] for run in runs)
        rows.append(cost.Row(series, value, 10 ** (-psnr / 20), cpu, wall, peak, f"{psnr:.2f} dB"))
    return cost.Sweep(
        "train", f"Training on '{scene.stem}': held-out views, pose label mid", "setting", "RMS, 1 = white",
        f"the sharp truth of held-out views, median of {seeds} seed(s)", 0, tuple(rows), machine.describe(),
        machine.command(),
        ("the memory of a run alone: the peak is of its whole process, some 300 MB of which are torch's libraries",),
    )  # fmt: skip


def _kept(scene: Path, hashed: str, config: dict[str, Any], kept: Path | None) -> dict[str, Any]:
    """A run's result, from `kept` where a run of this scene with these settings has left one."""
    if kept is None:
        return run_apart(scene, config)
    key = hashlib.sha256(json.dumps([hashed, config], sort_keys=True).encode()).hexdigest()[:20]
    path = kept / f"{key}.json"
    if not path.exists():
        done = {**run_apart(scene, config), "scene_sha256": hashed, "config": config, "machine": machine.describe()}
        kept.mkdir(parents=True, exist_ok=True)
        beside = path.with_suffix(".part")
        beside.write_text(json.dumps(done, indent=1), encoding="utf-8")
        os.replace(beside, path)
    return json.loads(path.read_text(encoding="utf-8"))


def train(
    scene: Annotated[Path, typer.Argument(help="A scene file with truth, e.g. runs/demo/demo.h5.")],
    steps: Annotated[int, typer.Option(help="Steps of the series that do not sweep them.")] = 600,
    seeds: Annotated[int, typer.Option(help="Runs of each setting; medians are reported.")] = 1,
    series: Annotated[str, typer.Option(help="Any of steps, poses, n, textures, w, readings; commas.")] = "",
    field: Annotated[str, typer.Option(help="splat, nerf-fast or nerf, the same for all runs.")] = "splat",
    runs: Annotated[Path | None, typer.Option(help="Folder of finished runs, kept for going on later.")] = None,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder for train.json and train.svg.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier result (finished runs stay).")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Sweep steps, sub-poses, textures, their kind and w: held-out error over seconds; goes on where it stopped."""
    if steps < 1 or seeds < 1:
        raise UsageError("steps and seeds must be at least 1", value=(steps, seeds))
    settings = list(plan(steps, tuple(series.split(",")) if series else tuple(SERIES), field))
    kept = runs or (None if out is None else out / "train.runs")
    finish("train", lambda: sweep(scene, settings, seeds, kept), out, force, as_json)
