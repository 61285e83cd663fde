"""What `spikerig cost effects` found, as a page with tables, a plot and the numbers."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from pathlib import Path
from typing import Any

from spikerig.dataset import machine
from spikerig.dataset.errors import HostError
from spikerig.dataset.outfile import whole_file

NAME = "effects_check"
HEAD = """# The plan of effects, checked

What `effects = "auto"` leaves out, what that changes, and what the plan says it costs; made by
`{command}` ({caption}).

Every scene chooses among all the effects there are, at their defaults or, where it says *faint*, mostly at a small
fraction of them, so that there is something to leave out and something to keep. All random streams are paired: runs
differ only by the effects that one of them leaves out.
"""
ACTUAL = """A bound is set against what leaving that one effect out of all of them changes. Counts and RGB values are
whole, so both are told as bounds are: the least whole number that 95 % of the pixels stay within; where 95 % do not
change at all, the share that does, over 5 % (0.2 is 1 % of the pixels). Cases in which not one pixel changed hold any
bound; they are counted, and not part of the median. All cases are in `effects_check.json`.
"""


def save(told: dict[str, Any], folder: Path) -> None:
    """Write effects_check.json, .md and, where matplotlib is there, .svg into a folder; earlier ones are replaced."""
    with whole_file(folder / f"{NAME}.json", force=True) as part:
        part.write_text(json.dumps(told, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    with whole_file(folder / f"{NAME}.md", force=True) as part:
        part.write_text(page(told), encoding="utf-8")
    try:
        plot(told, folder / f"{NAME}.svg")
    except HostError:
        pass  # the numbers are the result; the picture is for people who installed the extra


def page(told: dict[str, Any]) -> str:
    """docs/effects_check.md from the numbers."""
    kept = [f"- {'Kept' if row['kept'] else '**Not kept**'}: {row['says']}." for row in told["found"]]
    parts = [HEAD.format(command=told["command"], caption=machine.caption(told["machine"])), "\n".join(kept) + "\n"]
    parts.append(f"![Bounds and what changed; seconds]({NAME}.svg)\n")
    parts += ["## Auto against all effects\n", _autos(told["scenes"])]
    parts += ["## Bounds against what changed\n", ACTUAL, _effects(told["scenes"])]
    parts += ["## Light samples\n", _samples(told["scenes"])]
    if told["seconds"]:
        parts += ["## CPU seconds of a capture\n", _seconds(told["seconds"]), _nothing(told["nothing"])]
    return "\n".join(parts)


def _autos(scenes: list[dict[str, Any]]) -> str:
    tolerances = [row["tolerance"] for row in scenes[0]["auto"]]
    head = ["scene", "what", "light samples", *(f"tolerance {t:g}" for t in tolerances)]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for scene in scenes:
        s = scene["samples"]
        count = f"{s['least']}" if s["least"] == s["most"] else f"{s['least']} to {s['most']}"
        words = scene["words"] + (", faint" if scene["faint"] else "")
        cells = [
            f"{row['on']} on, {len(row['off'])} off: {_percent(row['within_spikes'])}, {_percent(row['within_dn'])}"
            for row in scene["auto"]
        ]
        lines.append("| " + " | ".join([scene["scene"], words, count, *cells]) + " |")
    return "\n".join(lines) + (
        "\n\nA cell: effects on and off; then the share of spike counts, and of RGB values, that differ from those of "
        "all effects by no more than the tolerance (in spikes an exposure, and in digital numbers).\n"
    )


def _percent(share: float) -> str:
    return f"{math.floor(1e4 * share) / 100:g} %"  # never rounded up


def _effects(scenes: list[dict[str, Any]]) -> str:
    cases: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for scene in scenes:
        for row in scene["effects"]:
            cases[row["effect"], row["output"]].append(row)
    lines = [
        "| effect | output | cases | nothing changed | bound / actual, least | median | most | below 1 |",
        "|---" * 8 + "|",
    ]
    for (effect, output), rows in sorted(cases.items()):
        real = sorted(row["bound"] / row["actual"] for row in rows if row["actual"])
        told = [f"{v:.2f}" for v in (real[0], real[len(real) // 2], real[-1])] if real else ["", "", ""]
        numbers = [str(len(rows)), str(len(rows) - len(real)), *told, str(sum(q < 1 for q in real) or "")]
        lines.append("| " + " | ".join([f"`{effect}`", output, *numbers]) + " |")
    return "\n".join(lines) + "\n"


def _samples(scenes: list[dict[str, Any]]) -> str:
    lines = [
        "| scene | motion px | px a step | samples | spikes: bound | actual | DN: bound | actual |",
        "|---" * 8 + "|",
    ]
    for scene in scenes:
        s = scene["samples"]
        lines.append(
            f"| {scene['scene']} | {s['motion_px']:.1f} | {s['step_px']:.2f} | {s['view']} | {s['spikes']:.3g} | "
            f"{s['spikes_off']:.3g} | {s['dn']:.3g} | {s['dn_off']:.3g} |"
        )
    return "\n".join(lines) + (
        "\n\nThe longest motion of a pixel in the views looked at, its step between light samples (the paper's "
        "protocol has 18 whatever the motion; a sample a tick is the most), the first view's samples; then what they "
        "leave in 95 % of the pixels: the plan's bound, and one view against four times as many. Spikes: the light of "
        "an exposure in thresholds, at most one a tick; DN before rounding.\n"
    )


def _seconds(rows: list[dict[str, Any]]) -> str:
    lines = [
        "| scene | effects on | predicted s | measured s | predicted / measured | plan s | prediction s |",
        "|---" * 7 + "|",
    ]
    for row in rows:
        lines.append(
            f"| {row['scene']} | {row['on']} | {row['predicted']:.3f} | {row['measured']:.3f} | "
            f"{row['predicted'] / row['measured']:.2f} | {row['judging']:.2f} | {row['predicting']:.2f} |"
        )
    return "\n".join(lines) + (
        "\n\nCPU seconds of one process, the light samples as the motion asks, without the start of Python; measured: "
        "the lesser of two runs. The plan (the looks at the scene, the bounds) and the prediction are not in them; "
        "`sim capture` makes the plan, and predicts nothing.\n"
    )


def _nothing(row: dict[str, Any]) -> str:
    return (
        f"A scene that needs nothing ('{row['scene']}' at a tolerance of 1e9): {1e3 * row['planned']:.3f} ms a view "
        f"with its resolved list of effects, {1e3 * row['bare']:.3f} ms by the bare closed form (light to thresholds, "
        f"fire, mean over the exposure, encode); the least of nine runs each, in turn. Judging it took "
        f"{row['judging']:.2f} s, and imports the effects it judges; a fresh process that takes a view of the resolved "
        f"scene file imports {len(row['modules'])} of their modules.\n"
    )


def plot(told: dict[str, Any], path: Path) -> None:
    """Bounds over what changed, predicted over measured seconds, and the effects left on over the tolerance.

    Raises:
        HostError: matplotlib (extra `plot`) is not installed.
    """
    try:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise HostError("plots need matplotlib", next="pip install 'spikerig[plot]'") from error
    matplotlib.rcParams["svg.hashsalt"] = NAME  # the same numbers give the same file
    figure, axes = plt.subplots(1, 3, figsize=(12, 4), layout="constrained")
    for output, mark in (("spikes", "o"), ("dn", "^")):
        rows = [r for s in told["scenes"] for r in s["effects"] if r["output"] == output and r["actual"] and r["bound"]]
        axes[0].plot([r["actual"] for r in rows], [r["bound"] for r in rows], mark, markersize=3, label=output)
    _diagonal(axes[0], (1e-3, 1e3), "what leaving an effect out changes", "its bound")
    axes[0].legend(fontsize=7)
    rows = told["seconds"]
    if rows:
        axes[1].plot([r["measured"] for r in rows], [r["predicted"] for r in rows], "o", markersize=3)
        spread = [r[key] for r in rows for key in ("measured", "predicted")]
        _diagonal(axes[1], (0.8 * min(spread), 1.25 * max(spread)), "measured CPU seconds", "predicted")
    for scene in told["scenes"]:
        axes[2].plot([r["tolerance"] for r in scene["auto"]], [r["on"] for r in scene["auto"]], lw=0.8, alpha=0.7)
    axes[2].set_xscale("symlog", linthresh=0.5)
    axes[2].set(xlabel="tolerance, spikes and digital numbers", ylabel="effects on")
    for each in axes:
        each.grid(True, which="both", alpha=0.2)
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)
    plt.close(figure)


def _diagonal(axes: Any, span: tuple[float, float], across: str, up: str) -> None:
    axes.plot(span, span, "k-", lw=0.6)
    axes.set(xscale="log", yscale="log", xlabel=across, ylabel=up)
