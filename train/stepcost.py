"""`spikerig cost step`: what the TfS term costs a step, beside the same run with w = 0."""

from __future__ import annotations

import gc
import time
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spikerig.dataset import machine
from spikerig.dataset.errors import UsageError
from spikerig.dataset.terminal import Progress, emit, note

if TYPE_CHECKING:
    from spikerig.train.fit import State, Task


def step_cost(scene: Path, *, splats: int, steps: int) -> list[dict[str, Any]]:
    """CPU and wall seconds of a step for spikenerf with w = 0 and 1x, plain, our methods, and optimised paths.

    Args:
        scene: a scene file.
        splats: of the one model that all rows train in turn, a step each, so that every row draws the same splats.
        steps: timed steps of each row; medians are reported.

    Returns:
        Rows: row, cpu_seconds, wall_seconds, over_w0 (CPU against spikenerf with w = 0), splats, size.
    """
    from spikerig.dataset.store import open_scene
    from spikerig.train.fit import new_state, one_step, torch_threads
    from spikerig.train.methods import configure
    from spikerig.train.run import prepare

    one = configure("spikenerf", "draft", splats=splats)
    configs = {
        "spikenerf, w = 0": replace(one, tfs_weight=0.0),
        "spikenerf 1x": one,
        "plain": configure("plain", "draft", splats=splats),
        "spike-ratio": configure("spike-ratio", "draft", splats=splats),
        "spike-hybrid": configure("spike-hybrid", "draft", splats=splats, ratio_until=0.0),
        "spike-ratio, linear": configure("spike-ratio", "draft", splats=splats, trajectory="linear"),
        "spike-ratio, cubic": configure("spike-ratio", "draft", splats=splats, trajectory="cubic"),
    }
    with open_scene(scene) as file:
        tasks = {name: prepare(file, scene, config)[0] for name, config in configs.items()}
        first = tasks["spikenerf 1x"]
        state = new_state(file.points, first)
        states = {name: _with_parts(state, task) for name, task in tasks.items()}
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in tasks}
    warm = 2 * len(first.targets.views)  # every view's sub-poses are remembered by then
    bar = Progress("cost step", warm + steps, "rounds")
    gc.disable()
    try:
        with torch_threads():
            for number in range(warm + steps):
                for name, task in tasks.items():
                    cpu, wall = time.process_time(), time.perf_counter()
                    one_step(states[name], task, 0.5)
                    if number >= warm:
                        found[name].append((time.process_time() - cpu, time.perf_counter() - wall))
                bar.step()
    finally:
        gc.enable()
    base = median(cpu for cpu, _ in found["spikenerf, w = 0"])
    return [
        {
            "row": name,
            "cpu_seconds": median(cpu for cpu, _ in times),
            "wall_seconds": median(wall for _, wall in times),
            "over_w0": median(cpu for cpu, _ in times) / base - 1,
            "splats": splats,
            "size": f"{first.camera.width}x{first.camera.height}",
        }
        for name, times in found.items()
    ]


def _with_parts(state: State, task: Task) -> State:
    """The same parameters and moments, with those of a task's parts beside them."""
    import torch

    from spikerig.train.parts import parts_of, start_parts

    if not parts_of(task.config):
        return state
    mine = {name: p.requires_grad_() for name, p in start_parts(task).items()}
    moments = {name: (torch.zeros_like(p), torch.zeros_like(p)) for name, p in mine.items()}
    return replace(state, params=state.params | mine, moments=state.moments | moments)


def step(
    scene: Annotated[Path, typer.Argument(help="A scene file (.h5) with spikes and trajectories.")],
    splats: Annotated[int, typer.Option(help="In every row.")] = 12_000,
    steps: Annotated[int, typer.Option(help="Timed steps of each row.")] = 300,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Cost of one training step: TfS 1x beside the same run with w = 0, our methods, and optimised paths."""
    if min(splats, steps) < 1:
        raise UsageError("splats and steps must be at least 1", value=(splats, steps))
    rows, where = step_cost(scene, splats=splats, steps=steps), machine.describe()
    if as_json:
        emit("spikerig.cost.step/1", {"rows": rows, "machine": where, "command": machine.command()})
        return
    for row in rows:
        typer.echo(
            f"{row['row']:<20}{row['cpu_seconds'] * 1e3:>8.2f} CPU-ms {row['wall_seconds'] * 1e3:>8.2f} wall-ms "
            f"{row['over_w0']:>+7.1%} CPU"
        )
    note(f"{rows[0]['size']}, {splats} splats; {machine.caption(where)}")
