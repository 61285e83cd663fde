"""`spikerig cost densify`: which splats to clone and split, row by row at the same final number, and what it costs."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from statistics import mean
from typing import Annotated, Any

import typer

from spikerig.dataset import machine
from spikerig.dataset.errors import UsageError
from spikerig.dataset.terminal import Progress, emit, note

FAINTEST = 1e-7  # threshold of the screen gradient: every row grows to the same number, only the choice differs
DELAY = 0.5  # of the run, without TfS before


def plan(method: str, steps: int, splats: int, most: int) -> dict[str, Any]:
    """The config of each row: no growth from both numbers, MCMC, and default growth by different gradients."""
    from spikerig.train.methods import configure

    base = configure(method, "draft", steps=steps, splats=splats)
    every = max(steps // 40, 1)
    grown = replace(base, densify="default", densify_every=every, splats_most=most, densify_share=0.1)
    grown = replace(grown, densify_grad=FAINTEST)
    rows = {
        f"off, {splats} from the start": base,
        f"off, {most} from the start": replace(base, splats=most),
        "mcmc": replace(base, densify="mcmc", densify_every=every, splats_most=most),
        "default, whole gradient": grown,
        "default, whole, absgrad": replace(grown, absgrad=True),
    }
    if base.tfs_weight > 0:
        rows |= {
            "default, colour alone": replace(grown, densify_by="colour"),
            "default, TfS alone": replace(grown, densify_by="tfs"),
            f"default, TfS from {DELAY:g} of the run": replace(grown, tfs_from=DELAY),
            f"off, {most}, TfS from {DELAY:g}": replace(base, splats=most, tfs_from=DELAY),
        }
    return rows


def ablation(
    scene: Path, *, methods: tuple[str, ...], steps: int, splats: int, most: int, seeds: int
) -> list[dict[str, Any]]:
    """Train every row of every method.

    Args:
        scene: a scene file with held-out views.
        methods: losses.
        steps: of each run.
        splats, most: to start with and to grow to.
        seeds: runs of each row, seeds 0, 1, ...

    Returns:
        Rows: method, row, psnr (mean over seeds, and of each), splats at the end, cpu_seconds a step.
    """
    from spikerig.dataset.store import open_scene
    from spikerig.train.fit import new_state, train
    from spikerig.train.run import prepare
    from spikerig.train.score import mean_psnr, novel_views

    rows, plans = [], {m: plan(m, steps, splats, most) for m in methods}
    bar = Progress("cost densify", seeds * sum(map(len, plans.values())), "runs")
    with open_scene(scene) as file:
        exams, against = novel_views(file)
        if not exams:
            raise UsageError("this scene has no held-out views to score", value=scene)
        for method, settings in plans.items():
            task, _ = prepare(file, scene, next(iter(settings.values())))
            for name, config in settings.items():
                runs = []
                for seed in range(seeds):
                    own = replace(task, config=replace(config, seed=seed))
                    state, begin = new_state(file.points, own), time.process_time()
                    train(state, own)
                    cpu = time.process_time() - begin
                    runs.append((mean_psnr(own.model(state), exams), len(state.params["means"]), cpu / steps))
                    bar.step(extra=f"{method}: {name}")
                psnr, count, cpu = zip(*runs, strict=True)
                found = {"psnr": mean(psnr), "psnr_each": list(psnr), "splats": round(mean(count))}
                rows.append({"method": method, "row": name, **found, "cpu_seconds": mean(cpu), "against": against})
    return rows


def densify(
    scene: Annotated[Path, typer.Argument(help="A scene file (.h5) with held-out views.")],
    methods: Annotated[str, typer.Option(help="Losses, separated by commas.")] = "spikenerf,spike-hybrid",
    steps: Annotated[int, typer.Option(help="Of each run.")] = 1000,
    splats: Annotated[int, typer.Option(help="To start with.")] = 3000,
    most: Annotated[int, typer.Option(help="To grow to.")] = 9000,
    seeds: Annotated[int, typer.Option(help="Runs of each row.")] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Held-out dB of densification rules at the same number of splats: which gradient to watch, and when TfS begins."""
    if min(steps, splats, seeds) < 1 or most < splats:
        raise UsageError("steps, splats and seeds are at least 1, most at least splats", value=(steps, splats, most))
    names = tuple(methods.split(","))
    rows = ablation(scene, methods=names, steps=steps, splats=splats, most=most, seeds=seeds)
    where = machine.describe()
    if as_json:
        emit("spikerig.cost.densify/1", {"rows": rows, "machine": where, "command": machine.command()})
        return
    typer.echo(f"{'method':<14}{'row':<34}{'dB':>7}{'splats':>8}{'CPU-ms':>8}")
    for row in rows:
        typer.echo(
            f"{row['method']:<14}{row['row']:<34}{row['psnr']:>7.2f}{row['splats']:>8}{row['cpu_seconds'] * 1e3:>8.2f}"
        )
    note(f"held-out views against {rows[0]['against']}; {steps} steps, {seeds} seed(s); {machine.caption(where)}")
