"""What accuracy costs in time: one sweep harness for every knob, and the page made from its results.

A sweep is a list of settings of one knob. Each is run `repeats` times after one discarded run; the median CPU
and wall seconds stand beside the error against truth (or against a far tighter setting, said in `reference`).
"""

from __future__ import annotations

import json
import os
import time
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from spikerig.dataset import machine
from spikerig.dataset.errors import DataError, HostError, UsageError
from spikerig.dataset.terminal import Progress, jsonable


@dataclass(frozen=True, slots=True)
class Setting:
    """One point of a sweep.

    Args:
        series: which curve it belongs to, e.g. "TFP, static".
        value: the knob's value; a number where it can be (it becomes the label on the plot).
        run: does the work once and returns its result.
        error: result -> error, lower is better, in the sweep's `error_unit`.
    """

    series: str
    value: Any
    run: Callable[[], Any]
    error: Callable[[Any], float]


@dataclass(frozen=True, slots=True)
class Row:
    """One measured setting; seconds are medians over repeats, `peak_bytes` is what Python and NumPy allocated
    (0: not measured)."""

    series: str
    value: Any
    error: float
    cpu_seconds: float
    wall_seconds: float
    peak_bytes: int
    note: str = ""


@dataclass(frozen=True, slots=True)
class Sweep:
    """A finished sweep: what was turned, what was measured, where, and by which command; repeats 0: all ran once."""

    name: str
    title: str
    knob: str
    error_unit: str
    reference: str
    repeats: int
    rows: tuple[Row, ...]
    machine: dict[str, Any]
    command: str
    omissions: tuple[str, ...] = field(default=())


def measure(setting: Setting, repeats: int) -> Row:
    """Time one setting: one discarded run (which also gives error and peak memory), then `repeats` timed ones."""
    tracemalloc.start()
    try:
        result = setting.run()
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    error = float(setting.error(result))
    cpu, wall = [], []
    for _ in range(repeats):
        c, w = time.process_time(), time.perf_counter()
        setting.run()
        cpu.append(time.process_time() - c)
        wall.append(time.perf_counter() - w)
    return Row(setting.series, setting.value, error, median(cpu), median(wall), peak)


def sweep(
    name: str,
    title: str,
    settings: Sequence[Setting],
    *,
    knob: str,
    error_unit: str,
    reference: str,
    repeats: int = 5,
    omissions: Sequence[str] = (),
) -> Sweep:
    """Measure every setting, with progress; see `Sweep` for what comes back."""
    if not settings or repeats < 1:
        raise UsageError("a sweep needs settings and at least one repeat", value=(len(settings), repeats))
    bar = Progress(f"cost {name}", len(settings), "settings")
    rows = []
    for setting in settings:
        rows.append(measure(setting, repeats))
        bar.step(extra=f"{setting.series} {setting.value}")
    return Sweep(
        name, title, knob, error_unit, reference, repeats, tuple(rows), machine.describe(), machine.command(),
        tuple(omissions),
    )  # fmt: skip


def table(done: Sweep) -> str:
    """The sweep as a Markdown table with its caption (machine, commit, command, repeats, reference)."""
    lines = [
        f"### {done.title}",
        "",
        f"| series | {done.knob} | error ({done.error_unit}) | CPU s | wall s | peak MB |",
        "|---|---|---|---|---|---|",
    ]
    for r in done.rows:
        tail = f" {r.note}" if r.note else ""
        peak = f"{r.peak_bytes / 1e6:.1f}" if r.peak_bytes else "not measured"
        lines.append(
            f"| {r.series} | {r.value} | {r.error:.4g}{tail} | {r.cpu_seconds:.3g} | {r.wall_seconds:.3g} | {peak} |"
        )
    ran = f"median of {done.repeats} after one discarded run" if done.repeats else "each ran once"
    lines += ["", f"Error against {done.reference}; {ran}."]
    lines += [f"Left out: {text}" for text in done.omissions]
    lines += [f"Command: `{done.command}`. {machine.caption(done.machine)}.", ""]
    return "\n".join(lines)


def plot(done: Sweep, path: Path) -> None:
    """Error over CPU seconds, log-log, a curve a series, the knob's value at each point; SVG or PNG by suffix.

    Raises:
        HostError: matplotlib (extra `plot`) is not installed.
    """
    try:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise HostError("plots need matplotlib", next="pip install 'spikerig[plot]'") from error
    matplotlib.rcParams["svg.hashsalt"] = done.name  # the same numbers give the same file
    figure, axes = plt.subplots(figsize=(7, 4.5), layout="constrained")
    log = any(r.error > 0 for r in done.rows)  # points without error are then left out
    for series in dict.fromkeys(r.series for r in done.rows):
        rows = [r for r in done.rows if r.series == series]
        style = "o-" if all(isinstance(r.value, int | float) for r in rows) else "o"  # names have no order
        axes.plot([r.cpu_seconds for r in rows], [r.error for r in rows], style, label=series, markersize=4)
        for r in [r for r in rows if not log or r.error > 0]:
            axes.annotate(str(r.value), (r.cpu_seconds, r.error), fontsize=6, xytext=(2, 3), textcoords="offset points")
    axes.set(xscale="log", xlabel="CPU seconds", ylabel=f"error ({done.error_unit})", title=done.title)
    if log:
        axes.set_yscale("log", nonpositive="mask")
    axes.grid(True, which="both", alpha=0.2)
    axes.legend(fontsize=7)
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)
    plt.close(figure)


def save(done: Sweep, folder: Path) -> Path:
    """Write `NAME.json` and, where matplotlib is there, `NAME.svg` into `folder`; returns the JSON's path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{done.name}.json"
    part = path.with_suffix(".json.partial")
    part.write_text(json.dumps(jsonable(asdict(done)), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    os.replace(part, path)
    try:
        plot(done, folder / f"{done.name}.svg")
    except HostError:
        pass  # the numbers are the result; the picture is for people who installed the extra
    return path


def load(path: Path) -> Sweep:
    """A sweep as `save` wrote it.

    Raises:
        DataError: not such a file.
    """
    try:
        raw = json.loads(path.read_text(encoding="utf-8"))
        raw["rows"] = tuple(Row(**{**r, "error": _number(r["error"])}) for r in raw["rows"])
        raw["omissions"] = tuple(raw["omissions"])
        return Sweep(**raw)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError("not a saved sweep", value=path, cause=str(error), next="spikerig cost NAME -o DIR") from error


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)


def page(folder: Path) -> str:
    """The cost page: every saved sweep in `folder` as table and plot, in file-name order."""
    parts = [
        "# What accuracy costs in time",
        "",
        "Made from the JSON files in `docs/cost/` by `spikerig cost page`; each names its command.",
        "Machines are shared and noisy: compare rows of one table, not tables of different runs.",
        "",
    ]
    for path in sorted(folder.glob("*.json")):
        done = load(path)
        parts.append(table(done))
        if path.with_suffix(".svg").exists():
            parts.append(f"![{done.title}](cost/{done.name}.svg)\n")
    return "\n".join(parts)
