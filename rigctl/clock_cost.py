"""`spikerig cost clock`: marks, probe rate and seconds of a take; how far clocks are off, and what they claim."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spikerig.dataset import cost, machine
from spikerig.dataset.terminal import Progress
from spikerig.dataset.texture_cost import finish

if TYPE_CHECKING:
    from spikerig.dataset.marks import Mark
    from spikerig.rigctl.sim.emulate.clockworld import Link, World

SECONDS = 300
BURSTS = (1, 2, 4, 8, 16, 32)
SIGHTS = (0.2, 1, 5, 20)
FRAMES = (1, 5, 20, 60)
STAMPS = (1, 10, 100)
LENGTHS = (5, 20, 60, 300)
HOLD_S = 60.0


@dataclass(frozen=True)
class Trial:
    """One setting: how to make the marks of a world, which clock to judge, and how long the take is."""

    series: str
    value: Any
    marks: Callable[[World], Sequence[Mark]]
    clock: str
    seconds: float = SECONDS


def trials() -> Iterator[Trial]:
    """All settings."""
    from spikerig.rigctl.sim.emulate.clockworld import FULL_SPEED, HIGH_SPEED

    links: dict[str, Link] = {"full-speed USB": FULL_SPEED, "high-speed USB": HIGH_SPEED}
    for name, link in links.items():
        for n in BURSTS:
            yield Trial(
                f"host to box, {name}: probes a second", n, lambda w, n=n, k=link: w.probes(SECONDS, k, burst=n), "host"
            )
    for s in LENGTHS:
        yield Trial(
            "host to box, full-speed USB, 16 a second: seconds", s, lambda w, s=s: w.probes(s, FULL_SPEED), "host", s
        )
    for n in SIGHTS:
        yield Trial("spike camera by sights: marks a second", n,
                    lambda w, n=n: [*_few(w), *w.sights("spike", SECONDS, n, response_ns=20_000)], "spike")  # fmt: skip
    for n in FRAMES:
        yield Trial("GoPro by sights: marks a second", n, lambda w, n=n: [*_few(w), *w.rgb_sights(SECONDS, n)], "rgb")
    for n in STAMPS:
        yield Trial("spike camera by stamps alone: stamps a second", n,
                    lambda w, n=n: [*w.probes(SECONDS, burst=8), *w.stamps(SECONDS, 1 / n)], "spike")  # fmt: skip


def _few(world: World) -> list[Mark]:
    """Some probes: they say whose time rig time is, and nothing of a camera that saw the panel."""
    return list(world.probes(30, burst=2))


def judged(trial: Trial, seeds: int) -> cost.Row:
    """Errors over seeds: p99 at instants of the take; hold-over and coverage in the note. Seconds are of one fit."""
    import numpy as np

    from spikerig.calib.clock import fit_rig
    from spikerig.dataset.clocktime import NS
    from spikerig.rigctl.sim.emulate.clockworld import World

    off, claimed, held, promised, bounds = [], [], [], [], []
    wall, cpu = 0.0, 0.0
    at = (np.linspace(0.005, 0.995, 500) * trial.seconds * NS).astype(np.int64)
    after = np.array([round((trial.seconds + HOLD_S) * NS)])
    for seed in range(seeds):
        world = World(seed)
        marks = list(trial.marks(world))
        began, used = time.perf_counter(), time.process_time()
        clocks = fit_rig(marks)
        wall, cpu = wall + time.perf_counter() - began, cpu + time.process_time() - used
        fit = clocks.fit(trial.clock)
        for instants, errors, claims in ((at, off, claimed), (after, held, promised)):
            errors.append(np.abs(world.off_ns(fit.model, trial.clock, instants, clocks.origin_ns)))
            claims.append(fit.uncertainty_ns(world.at(trial.clock, instants)))
        bounds.append(fit.bias_ns)
    e, u, h, p = (np.concatenate(v) / 1e3 for v in (off, claimed, held, promised))
    note = (
        f"(claimed {np.median(u):.1f}, bias bound {np.median(bounds) / 1e3:.1f}, covers {100 * np.mean(e <= u):.1f} %; "
        f"60 s after: rms {np.sqrt(np.mean(h**2)):.1f}, worst {h.max():.1f}, covers {100 * np.mean(h <= p):.0f} %)"
    )
    return cost.Row(trial.series, trial.value, float(np.percentile(e, 99)), cpu / seeds, wall / seeds, 0, note)


def sweep(seeds: int, only: str = "") -> cost.Sweep:
    """Run every setting whose series contains `only`."""
    chosen = [t for t in trials() if only in t.series]
    bar = Progress("cost clock", len(chosen), "settings")
    rows = []
    for trial in chosen:
        rows.append(judged(trial, seeds))
        bar.step(extra=f"{trial.series} {trial.value}")
    done = cost.Sweep(
        "clock", f"Clocks of emulated takes of {SECONDS} s, {seeds} seeds each", "rate or length", "us, p99",
        "the emulated oscillators", 1, tuple(rows), machine.describe(), machine.command(),
        ("peak memory", "the capture itself; seconds are those of one fit"),
    )  # fmt: skip
    return replace(done, repeats=0)


def clock(
    seeds: Annotated[int, typer.Option(min=1, help="Emulated rigs a setting.")] = 20,
    only: Annotated[str, typer.Option(help="Only series with this in their name.")] = "",
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder for clock.json and clock.svg.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier result.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Sweep probe rate, sights and seconds of clock fits: error against emulated truth, claims and hold-over."""
    finish("clock", lambda: sweep(seeds, only), out, force, as_json)
