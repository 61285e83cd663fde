"""`spikerig demo`: the whole road as a list of command lines, run as child processes. Files are the joints."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from spikerig.dataset.demo_steps import Step, steps
from spikerig.dataset.errors import DataError, NumericsError, RigError, UsageError
from spikerig.dataset.terminal import emit, note


def demo(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder of the run.")] = Path("runs/demo"),
    seconds: Annotated[float, typer.Option(help="Training seconds of each method on the main scene.")] = 20.0,
    chroma_seconds: Annotated[float, typer.Option(help="The same on the chroma scene; 0 leaves it out.")] = 10.0,
    steps_each: Annotated[
        int | None, typer.Option("--steps", help="Train each method for so many steps instead: for a busy machine.")
    ] = None,
    poses: Annotated[
        str, typer.Option(help="true, or colmap: a rig to calibrate, and poses to estimate; what both cost in dB.")
    ] = "true",
    seed: Annotated[int, typer.Option(help="Seed of the simulation and of training.")] = 0,
    force: Annotated[bool, typer.Option("--force", help="Start over; without it an interrupted demo goes on.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """The whole road on one command: photons to a sharper picture, with the numbers.

    Simulates a shaken capture with a spike camera beside the RGB camera, trains the same 3D scene from the same start
    for equal seconds with and without spikes, scores sharp held-out views, and writes report.html and report.json.
    With --poses colmap the rig's arms differ: boards are recorded and calibrated, the capture is aligned, its poses are
    estimated from spikes; the same methods are trained on that, and on true calibration and poses.
    An interrupted demo goes on where it stopped. Exit codes: 0 ok, else that of the step that failed.
    """
    from spikerig.dataset import report
    from spikerig.dataset.demo_poses import posed_steps

    if not seconds > 0 or chroma_seconds < 0 or (steps_each is not None and steps_each < 1):
        raise UsageError("training seconds and steps must be positive", value=(seconds, chroma_seconds, steps_each))
    if poses not in ("true", "colmap"):
        raise UsageError("no such --poses", value=poses, expected="true or colmap")
    if poses == "colmap":
        plan = posed_steps(out, (seconds, steps_each or 0), seed)
    else:
        budgets = {"demo": seconds} | ({"chroma": chroma_seconds} if chroma_seconds else {})
        plan = steps(out, budgets, seed, steps_each or 0)
    ledger = _ledger(out, plan, force)
    for k, step in enumerate(plan, 1):
        if step.key in ledger["done"]:
            note(f"[{k}/{len(plan)}] {step.says}: done before")
            continue
        note(f"[{k}/{len(plan)}] {step.says}\n    spikerig {shlex.join(step.words)}")
        start = time.monotonic()
        document = run_step(step)
        ledger["done"][step.key] = {"seconds": time.monotonic() - start, "said": document}
        _write(out / "steps.json", ledger)
    result = report.build(out, plan, ledger["done"])
    _write(out / "report.json", result)
    if as_json:
        emit("spikerig.demo/1", result)
    for line in report.summary(result):
        note(line)
    note(f"report: {out / 'report.html'}")


def run_step(step: Step) -> dict[str, Any]:
    """Run one step as a child process; its progress goes to our stderr, its JSON comes back.

    Raises:
        RigError: the step failed; it carries the child's exit code and its own message.
    """
    child = subprocess.run(
        [sys.executable, "-m", "spikerig.dataset", *step.words], stdout=subprocess.PIPE, check=False, text=True
    )
    try:
        document = json.loads(child.stdout)
    except ValueError:
        document = {}
    if child.returncode != 0:
        told = document.get("error", {})
        error = RigError(
            f"the demo stopped at '{step.says}'",
            value=told.get("what") or f"exit code {child.returncode}",
            cause=told.get("cause") or "",
            next=f"spikerig {shlex.join(step.words)}",
        )
        error.exit_code = child.returncode if child.returncode > 0 else 130
        raise error
    return document


def _ledger(out: Path, plan: list[Step], force: bool) -> dict[str, Any]:
    """What was done before with the same plan in the same folder, or a fresh start."""
    path = out / "steps.json"
    commands = [list(step.words) for step in plan]
    if path.exists() and not force:
        try:
            ledger = json.loads(path.read_text(encoding="utf-8"))
            same, finished = ledger["commands"] == commands, (out / "report.json").exists()
        except (ValueError, KeyError, TypeError) as error:
            raise DataError("the demo's ledger is damaged", value=path, next="spikerig demo --force") from error
        if finished or not same:
            what = "a finished demo is there" if finished else "a demo with other settings is there"
            raise UsageError(what, value=out, next="spikerig demo --force replaces it; -o DIR writes beside it")
        return ledger
    if out.exists() and any(out.iterdir()) and not path.exists():
        raise UsageError("the folder holds something that is no demo", value=out, next="spikerig demo -o DIR")
    out.mkdir(parents=True, exist_ok=True)
    for old in ("report.json", "report.html"):
        (out / old).unlink(missing_ok=True)
    ledger = {"commands": commands, "done": {}}
    _write(path, ledger)
    return ledger


def _write(path: Path, document: dict[str, Any]) -> None:
    from spikerig.dataset.terminal import jsonable

    part = path.with_name(path.name + ".partial")
    try:
        part.write_text(json.dumps(jsonable(document), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    except ValueError as error:
        raise NumericsError("a number in the report is not finite", value=error) from error
    os.replace(part, path)
