"""`spikerig cost effects`: the plan checked on scenes of all kinds, and what its tolerance costs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from spikerig.dataset import machine
from spikerig.dataset.errors import UsageError
from spikerig.dataset.terminal import Progress, emit, jsonable, note

WITHIN = 0.95  # of the pixels stay within the tolerance
MEDIAN = 5.0  # of bound over actual, at most
BELOW = 0.05  # of the bounds may be below what really changed
CLOSE = 0.3  # predicted seconds against measured
EXTRA = 0.05  # over the bare closed form, where nothing is needed


def effects(
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder for effects_check.json, .svg, .md.")] = None,
    scenes: Annotated[str, typer.Option(help="Some of the scenes, by name, with commas between.")] = "",
    seconds: Annotated[bool, typer.Option(help="Also predict and measure CPU seconds.")] = True,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier result.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Check the plan of effects: what it leaves out, its bounds, its predicted seconds, with paired random streams.

    Exit 1 where a promise is not kept; the figures are written all the same.
    """
    from spikerig.rigctl import effects_report
    from spikerig.rigctl.sim.judge import effects_check
    from spikerig.rigctl.sim.judge.check_scenes import CASES, case_named

    if out is not None and (out / "effects_check.json").exists() and not force:
        raise UsageError("an earlier result is there", value=out / "effects_check.json", next="add --force")
    if out is not None and not out.is_dir():
        raise UsageError("there is no such folder", value=out)
    cases = [case_named(name.strip()) for name in scenes.split(",")] if scenes else list(CASES)
    bar = Progress("checking the plan", len(cases), "scenes")
    told: dict[str, Any] = {"scenes": [], "seconds": [], "nothing": None}
    for case in cases:
        told["scenes"].append(effects_check.check(case))
        if seconds:
            told["seconds"].append(effects_check.seconds(case))
        bar.step(extra=case.name)
    if seconds:
        told["nothing"] = effects_check.nothing(cases[0])
    told |= {"found": found(told), "machine": machine.describe(), "command": machine.command()}
    told = jsonable(told)
    if out is not None:
        effects_report.save(told, out)
    if as_json:
        emit("spikerig.cost.effects/1", told)
    else:
        note("\n".join(f"{'kept' if row['kept'] else 'NOT KEPT'}: {row['says']}" for row in told["found"]))
    if not all(row["kept"] for row in told["found"]):
        raise typer.Exit(1)


def found(told: dict[str, Any]) -> list[dict[str, Any]]:
    """Each promise, whether it was kept, and the figures."""
    autos = [(scene["scene"], row) for scene in told["scenes"] for row in scene["auto"]]
    rows = []
    for key, words in (("spikes", "spike counts"), ("dn", "RGB values")):
        share, name, at = min((row[f"within_{key}"], name, row["tolerance"]) for name, row in autos)
        rows.append(
            _row(
                share >= WITHIN,
                f"auto within the tolerance of all effects in at least {100 * share:.2f} % of {words} (worst: {name} "
                f"at {at:g}); {len(told['scenes'])} scenes x {len(autos) // len(told['scenes'])} "
                "tolerances",
            )
        )
    rows.append(_ratios(told))
    rows.append(_samples(told))
    if told["seconds"]:
        off = [row["predicted"] / row["measured"] for row in told["seconds"]]
        inside = sum(abs(q - 1) <= CLOSE for q in off)
        rows.append(
            _row(inside == len(off), f"predicted CPU seconds are {min(off):.2f} to {max(off):.2f} of measured ones")
        )
        bare = told["nothing"]
        more = bare["planned"] / bare["bare"] - 1
        rows.append(
            _row(
                more <= EXTRA and not bare["modules"],
                f"a scene that needs nothing costs {100 * more:+.1f} % over the bare closed form, and a fresh process "
                f"that takes it imports {len(bare['modules'])} modules of effects",
            )
        )
    return rows


def _row(kept: bool, says: str) -> dict[str, Any]:
    return {"kept": kept, "says": says}


def ratios(told: dict[str, Any]) -> tuple[list[float], int]:
    """bound / actual of every effect, scene and output that leaving it out changed; and how many it did not change
    (there any bound holds)."""
    rows = [row for scene in told["scenes"] for row in scene["effects"]]
    return [row["bound"] / row["actual"] for row in rows if row["actual"]], sum(not row["actual"] for row in rows)


def _samples(told: dict[str, Any]) -> dict[str, Any]:
    """The errors that light samples leave, against their bounds."""
    pairs = [
        (s[key], s[f"{key}_off"]) for s in (scene["samples"] for scene in told["scenes"]) for key in ("spikes", "dn")
    ]
    real = sorted(bound / actual for bound, actual in pairs if actual)
    if not real:
        return _row(True, "light samples leave no error in these scenes")
    return _row(
        sum(q < 1 for q in real) <= BELOW * len(real) and real[len(real) // 2] <= MEDIAN,
        f"bound over actual error of the light samples: {real[0]:.2f} to {real[-1]:.2f}, median "
        f"{real[len(real) // 2]:.2f} of {len(real)}",
    )


def _ratios(told: dict[str, Any]) -> dict[str, Any]:
    import numpy as np

    real, none = ratios(told)
    below = sum(q < 1 for q in real)
    median = float(np.median(real)) if real else 1.0
    share = below / max(len(real), 1)
    return _row(
        median <= MEDIAN and share <= BELOW,
        f"bound over actual: median {median:.2f} of {len(real)} cases that changed something, below 1 in {below} of "
        f"them ({100 * share:.1f} %); in {none} more nothing changed",
    )
