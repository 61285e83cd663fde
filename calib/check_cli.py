"""`spikerig data check`: is a scene fit to train on? Every check of `dataset` and `calib`, put together."""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spikerig.dataset.errors import UsageError
from spikerig.dataset.info_cli import Json
from spikerig.dataset.terminal import Progress, emit, note

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from spikerig.dataset.check import Check, Result
    from spikerig.dataset.scene import Finding

SHOWN = 12  # findings of one check that are told to people; the document has all


def check(
    file: Annotated[Path, typer.Argument(help="A scene file (RS-3D HDF5).")],
    profile: Annotated[str, typer.Option(help="capture (not yet aligned or posed), scene, or release.")] = "scene",
    strict: Annotated[bool, typer.Option("--strict", help="Warnings count as errors do.")] = False,
    only: Annotated[str, typer.Option(help="Groups or checks to run, by comma; default: all.")] = "",
    as_json: Json = False,
) -> None:
    """Check that a scene makes sense: structure, ticks against exposures, sync, alignment, poses, provenance.

    Exit 0: no errors (warnings and notes are told); 1: errors, or with --strict warnings; 4: the file cannot be read.
    """
    from spikerig.dataset.check import PROFILES

    if profile not in PROFILES:
        raise UsageError("no such profile", value=profile, expected=", ".join(PROFILES))
    wanted = chosen(only)
    began = time.perf_counter()
    bar = Progress(f"checking {file.name}", 0, "views")
    results = check_scene(file, wanted, profile, lambda name: bar.step(1, name))
    told = document(results)
    bad = told["counts"]["error"] + (told["counts"]["warning"] if strict else 0)
    told = {"file": str(file), "profile": profile, "strict": strict, "ok": not bad, **told}
    told["seconds"] = time.perf_counter() - began
    if as_json:
        emit("spikerig.data.check/1", told)
    _say(file, results, told)
    raise typer.Exit(1 if bad else 0)


def all_checks() -> tuple[Check, ...]:
    """Every check, in the order in which they are run and told."""
    from spikerig.calib.check_light import LIGHT
    from spikerig.dataset.check_file import FILE
    from spikerig.dataset.check_poses import POSES
    from spikerig.dataset.check_provenance import PROVENANCE
    from spikerig.dataset.check_structure import STRUCTURE
    from spikerig.dataset.check_time import TIME

    every = (*FILE, *STRUCTURE, *TIME, *LIGHT, *POSES, *PROVENANCE)
    groups = ("structure", "ticks", "sync", "alignment", "poses", "provenance")
    return tuple(sorted(every, key=lambda c: groups.index(c.group)))


def chosen(only: str) -> tuple[Check, ...]:
    """The checks of some groups or names, all for ""."""
    every, words = all_checks(), [w.strip() for w in only.split(",") if w.strip()]
    known = {c.name for c in every} | {c.group for c in every}
    if wrong := [w for w in words if w not in known]:
        groups = ", ".join(dict.fromkeys(c.group for c in every))
        raise UsageError("no such check", value=", ".join(wrong), expected=f"{groups}, or a name of docs/checks.md")
    return tuple(c for c in every if not words or c.name in words or c.group in words)


def check_scene(
    path: Path, checks: Sequence[Check], profile: str = "scene", done: Callable[[str], object] = lambda name: None
) -> list[Result]:
    """Run checks on a scene file.

    Args:
        path: of the file; it is guarded as in `open_scene`.
        checks: to run.
        profile: "capture", "scene" or "release".
        done: called with the name of each view that was looked at.

    Raises:
        DataError: the file cannot be opened at all.
    """
    from spikerig.dataset.check import run_checks
    from spikerig.dataset.check_look import SceneLook
    from spikerig.dataset.store import open_scene

    with open_scene(path, partial=True) as scene:
        return run_checks(checks, SceneLook(scene), profile, done)


def document(results: Sequence[Result]) -> dict[str, Any]:
    """What `--json` prints of the results."""
    found = [f for r in results for f in r.findings]
    return {
        "counts": {kind: sum(f.importance == kind for f in found) for kind in ("error", "warning", "note")},
        "undecided": [r.check.name for r in results if r.status == "undecided"],
        "checks": [r.as_json() for r in results],
        "findings": [asdict(f) for f in found],
    }


def _say(file: Path, results: Sequence[Result], told: dict[str, Any]) -> None:
    for r in results:
        for name, value in r.figures.items():
            note(f"measured: {r.check.name}: {name} {value:.3g}")
        if r.status == "undecided":
            note(f"undecided: {r.check.name}: {_why(r)}")
        for f in r.findings[:SHOWN]:
            note(_line(f))
        if len(r.findings) > SHOWN:
            note(f"  .. and {len(r.findings) - SHOWN} more of {r.check.name}")
        if r.findings and r.check.fix:
            note(f"  fix: {r.findings[0].fix or r.check.fix}")
    passed = sum(r.status == "passed" for r in results)
    c = told["counts"]
    note(f"{file}: {passed} of {len(results)} checks passed, {len(told['undecided'])} undecided; "
         f"{c['error']} errors, {c['warning']} warnings, {c['note']} notes, {told['seconds']:.1f} s")  # fmt: skip


def _why(result: Result) -> str:
    """Why a check did not decide: by itself, or what kept it from most of the views."""
    from spikerig.dataset.check import NO_VIEW

    if result.undecided[""] != NO_VIEW:
        return result.undecided[""]
    reasons = [why for name, why in result.undecided.items() if name]
    return max(sorted(set(reasons)), key=reasons.count) if reasons else NO_VIEW


def _line(f: Finding) -> str:
    return f"{f.importance}: {f.check}: {f.where}: {f.message}"


def page() -> str:
    """docs/checks.md, of the checks themselves."""
    from spikerig.dataset.check import PROFILES, table

    profiles = "\n".join(f"- `{name}`: {what}." for name, what in PROFILES.items())
    return PAGE.format(count=len(all_checks()), profiles=profiles, table=table(all_checks()))


PAGE = """# What `spikerig data check` looks at

    spikerig data check SCENE.h5 [--profile capture|scene|release] [--strict] [--only sync,poses] [--json]

{count} checks, each one function in `dataset/check_*.py` and `calib/check_light.py`. This page is made of them
(`python -m spikerig.calib.check_cli > docs/checks.md`; a test compares).

A check passes, fails, or says that it cannot decide, and why: an unmoved camera shows no lag, a picture without edges
no misalignment. What it finds is an **error** (wrong: do not train on it), a **warning** (it costs quality, or is
seldom meant) or a **note**. Exit 0: no errors; 1: errors, with `--strict` warnings too; 4: the file cannot be read
at all, or breaks the rules of [formats](format.md).

{profiles}

Memory is bounded by one view: spikes are summed up 8 MB at a time, and the checks of light hold those around one
exposure. The demo's scene at 400x250, 50 views, 517 MB: 19 CPU seconds and 193 MB at most, nearly all of it in
`edges-lie-together` and `frames-are-in-step` (`spikerig data check demo400.h5`, of `spikerig sim capture
docs/demo400.toml --views 50`; 2 cores of an AMD EPYC, AVX-512, commit 6dee168).

`frames-are-in-step` measures: it makes the exposure's blur of the spikes at 13 lags and asks which fits the picture
best. In that scene it finds 0.01 ticks, with a standard deviation of 0.03, where the truth is 0. A shift of all
pictures against the spikes is fitted beside the lag, so that a misaligned rig does not look late where views move in
different ways. The standard deviation is that of leaving out each view in turn.

{table}
The document of `--json` has `checks` (each with `status`, `seconds`, and by view why it was undecided) and `findings`
(`check`, `importance`, `where`, `message`, `fix`).

## Looking at it

    spikerig data sheet SCENE.h5 -o sheet.html
    spikerig calib poses SCENE.h5 --write --sheet sheet.html

One page without scripts or anything outside it: of every view the picture, TFP and TFI at mid-exposure, and both arms
laid over each other; the cameras from above and from the side with their paths over the exposures; edges of both arms,
reprojection errors and observations of each view. Pictures are made smaller until the page fits `--limit-mb` (9). The
scene above: 7.8 MB, 22 CPU seconds, 140 MB of memory.
"""


if __name__ == "__main__":
    print(page(), end="")
