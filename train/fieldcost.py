"""`spikerig cost fields`: what one step costs with each field, in turn, in one process."""

from __future__ import annotations

import gc
import time
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import typer

from spikerig.dataset import machine
from spikerig.dataset.errors import UsageError
from spikerig.dataset.terminal import Progress, emit, note

FAST_STEPS = 30  # of the other fields for each of the slow one
WARM = 3  # untimed


def field_cost(scene: Path, *, method: str, preset: str, rounds: int, seed: int = 0) -> list[dict[str, Any]]:
    """CPU and wall seconds of a step with each field, on the same scene and method, interleaved.

    Args:
        scene: a scene file with what the method needs.
        method: of all rows.
        preset: of splat and nerf-fast; nerf has the paper's shape.
        rounds: each times one step of nerf and 30 of the others; medians are reported.
        seed: of the fits.

    Returns:
        Rows: field, preset, rays (0: a whole view), samples a ray, parameters, cpu_seconds, wall_seconds,
        steps_per_second (of wall time), times_nerf (CPU of nerf's step over this one's).
    """
    from spikerig.dataset.store import open_scene
    from spikerig.train.fit import new_state, one_step, torch_threads
    from spikerig.train.methods import configure
    from spikerig.train.run import prepare

    rows = {"splat": preset, "nerf-fast": preset, "nerf": "paper"}
    configs = {name: configure(method, shape, name, seed=seed) for name, shape in rows.items()}
    with open_scene(scene) as file:
        tasks = {name: prepare(file, scene, config)[0] for name, config in configs.items()}
        states = {name: new_state(file.points, task) for name, task in tasks.items()}
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in tasks}
    bar = Progress("cost fields", rounds * len(tasks), "fields")
    gc.disable()
    try:
        for _ in range(rounds):
            for name, task in tasks.items():
                count = 1 if name == "nerf" else FAST_STEPS
                with torch_threads(task.field.torch_threads()):
                    for number in range(count if name == "nerf" else count + WARM):
                        cpu, wall = time.process_time(), time.perf_counter()
                        one_step(states[name], task, 0.5)
                        if name == "nerf" or number >= WARM:
                            found[name].append((time.process_time() - cpu, time.perf_counter() - wall))
                bar.step(extra=name)
    finally:
        gc.enable()
    slow = median(cpu for cpu, _ in found["nerf"])
    return [_row(configs[name], states[name], found[name], slow) for name in tasks]


def _row(config: Any, state: Any, times: list[tuple[float, float]], slow: float) -> dict[str, Any]:
    cpu, wall = (median(column) for column in zip(*times, strict=True))
    samples = {"splat": 0, "nerf-fast": config.fine, "nerf": 2 * config.coarse + config.fine}[config.field]
    return {
        "field": config.field,
        "preset": config.preset,
        "rays": 0 if config.field == "splat" else config.rays,
        "samples": samples,
        "parameters": sum(p.numel() for p in state.params.values()),
        "cpu_seconds": cpu,
        "wall_seconds": wall,
        "steps_per_second": 1 / wall,
        "times_nerf": slow / cpu,
        "timed_steps": len(times),
    }


def fields(
    scene: Annotated[Path, typer.Argument(help="A scene file (.h5).")],
    method: Annotated[str, typer.Option(help="Of all rows; plain and oracle need no spikes.")] = "plain",
    preset: Annotated[str, typer.Option(help="Of splat and nerf-fast: draft, standard, full.")] = "draft",
    rounds: Annotated[int, typer.Option(help="A step of nerf (the paper's shape) and 30 of the others in each.")] = 2,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Cost of one training step with each field: splat, nerf-fast, and nerf as the paper has it."""
    if rounds < 1:
        raise UsageError("rounds must be at least 1", value=rounds)
    rows, where = field_cost(scene, method=method, preset=preset, rounds=rounds), machine.describe()
    if as_json:
        emit("spikerig.cost.fields/1", {"rows": rows, "machine": where, "command": machine.command()})
        return
    for row in rows:
        typer.echo(
            f"{row['field']:<10}{row['preset']:<10}{row['cpu_seconds'] * 1e3:>10.1f} CPU-ms "
            f"{row['wall_seconds'] * 1e3:>10.1f} wall-ms {row['steps_per_second']:>8.2f} steps/s "
            f"{row['times_nerf']:>7.1f} x nerf   {row['parameters']:>9,} parameters"
        )
    note(f"{method}; {machine.caption(where)}")
