"""`spikerig calib clock TAKE`: from raw marks to every clock's map to rig time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spikerig.dataset.errors import UsageError
from spikerig.dataset.outfile import refuse_existing, whole_file
from spikerig.dataset.terminal import emit, jsonable, note

if TYPE_CHECKING:
    from spikerig.calib.clock_maps import ClockFit, Clocks


def clock(
    take: Annotated[Path, typer.Argument(help="Folder of a take, with marks.jsonl in it.")],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="The file to write; else TAKE/clock.json.")] = None,
    assumed_us: Annotated[
        float, typer.Option(min=0, help="Belief about one-way stamps: their fastest took less than this.")
    ] = 5000.0,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier fit.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Fit every clock of a take anew from its raw marks."""
    from spikerig.calib.clock import Options, fit_rig
    from spikerig.calib.clock_maps import as_json as document
    from spikerig.dataset.marks import read_marks

    path = out or take / "clock.json"
    marks = take / "marks.jsonl"
    if not marks.is_file():
        raise UsageError("no marks in this folder", value=marks, expected="a take, as spikerig rig record leaves it")
    refuse_existing(path, force)
    found = list(read_marks(marks))
    fitted = fit_rig(found, Options(assumed_ns=assumed_us * 1e3))
    with whole_file(path, force=force) as part:
        part.write_text(json.dumps(jsonable(document(fitted)), allow_nan=False) + "\n", encoding="utf-8")
    if as_json:
        emit("spikerig.calib.clock/1", {"take": take, "wrote": path, "marks": len(found), **summary(fitted)})
        return
    for line in table(fitted):
        note(line)
    note(f"wrote {path}")


def read_clocks(path: str | Path) -> Clocks:
    """Fitted clocks from a file of `spikerig calib clock`.

    Raises:
        UsageError: there is no such file.
        DataError: it is something else.
    """
    from spikerig.calib.clock_maps import from_json
    from spikerig.dataset.errors import DataError

    try:
        return from_json(json.loads(Path(path).read_text(encoding="utf-8")))
    except OSError as error:
        raise UsageError("no fitted clocks here", value=path, next="spikerig calib clock TAKE") from error
    except (ValueError, RecursionError) as error:
        raise DataError("not a file of fitted clocks", value=path, cause=str(error)) from error


def summary(clocks: Clocks) -> dict[str, Any]:
    """What was found, without the knots."""
    return {
        "rig": clocks.rig,
        "origin_ns": clocks.origin_ns,
        "notes": clocks.notes,
        "clocks": [_row(f) for f in clocks.fits],
    }


def _row(fit: ClockFit) -> dict[str, Any]:
    import numpy as np

    inside = np.linspace(float(fit.valid_ns[0]), float(fit.valid_ns[1]), 201).astype(np.int64)
    after = fit.valid_ns[1] + np.array([60 * 10**9])
    return {
        "clock": fit.clock, "epoch": fit.epoch, "how": fit.how, "first_ns": fit.valid_ns[0], "last_ns": fit.valid_ns[1],
        "marks": fit.marks, "used": fit.used, "skew_ppm": fit.skew_ppm, "skew_sd_ppm": fit.skew_sd_ppm,
        "uncertainty_us": float(np.median(fit.uncertainty_ns(inside))) / 1e3,
        "uncertainty_60s_after_us": float(fit.uncertainty_ns(after)[0]) / 1e3,
        "bias_bound_us": fit.bias_ns / 1e3, "bias_proved": fit.proved, "residual_us": fit.residual_ns / 1e3,
        "constants": dict(fit.constants), "notes": fit.notes,
    }  # fmt: skip


def table(clocks: Clocks) -> list[str]:
    """The fits for people."""
    lines = [f"rig time is the {clocks.rig}'s"]
    lines.append("clock  epoch  how        marks (used)     skew ppm           good to us   after 60 s   seconds")
    for f in map(_row, clocks.fits):
        marks = f"{f['marks']} ({f['used']})"
        skew = f"{f['skew_ppm']:+.3f} +- {f['skew_sd_ppm']:.3f}"
        span = (f["last_ns"] - f["first_ns"]) / 1e9
        lines.append(
            f"{f['clock']:<6} {f['epoch']:>5}  {f['how']:<9}  {marks:<15}  {skew:<17}  {f['uncertainty_us']:>10.1f}"
            f"   {f['uncertainty_60s_after_us']:>10.1f}   {span:>7.1f}"
        )
        lines += [f"       {text}" for text in f["notes"]]
    return lines + list(clocks.notes)
