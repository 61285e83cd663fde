"""`spikerig rig plan` and `spikerig rig record`: from a plan to a take."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from spikerig.dataset.terminal import emit, note

PLAN = typer.Argument(help="A plan (TOML), or a shipped one: example, emulated.")


def plan(
    plan: Annotated[str, PLAN],
    out: Annotated[Path, typer.Option("--out", "-o", help="The take it is for: its disk is looked at.")] = Path("take"),
    save: Annotated[Path | None, typer.Option(help="Copy the plan to this file, to be edited.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the file of --save.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Tell what a plan comes to, and every reason why it cannot be: no device is touched. Exit 1 where it cannot be."""
    from spikerig.rigctl.forecast import forecast
    from spikerig.rigctl.take_plan import load_plan, plan_text

    if save is not None:
        from spikerig.dataset.outfile import whole_file

        with whole_file(save, force=force) as part:
            part.write_text(plan_text(plan), encoding="utf-8")
        note(f"{save}: a copy of {plan}")
    read = load_plan(plan)
    told = forecast(read, out)
    if as_json:
        emit("spikerig.rig.plan/1", {"plan": read.as_json(), "ok": not told.cannot, **asdict(told)})
    wire = read.profile
    note(f"{read.name}: {len(read.viewpoints)} viewpoints of {read.seconds:g} s, {read.advance}, sync {read.sync.mode}")
    note(f"  spikes  {wire.name}, {wire.width}x{wire.height} at {wire.rate_hz:,.0f} Hz: {told.bytes_s / 1e6:.1f} MB/s, "
         f"{told.view_bytes / 1e6:,.0f} MB a viewpoint, {told.spike_bytes / 1e9:.2f} GB in all")  # fmt: skip
    if read.rgb.use:
        note(f"  rgb     {read.rgb.mbit_s:g} Mbit/s: {told.clip_bytes / 1e9:.2f} GB of clips")
    note(
        f"  time    at least {told.seconds:.0f} s"
        + (", and yours between viewpoints" if read.advance == "prompt" else "")
    )
    note(f"  memory  {told.ring_bytes / 1e6:.0f} MB for the ring")
    for line in told.limits:
        note(f"  limit   {line}")
    for reason in told.cannot:
        note(f"  CANNOT  {reason['what']}: {reason['value']}; needs {reason['expected']}; {reason['next']}")
    note("nothing speaks against it" if not told.cannot else f"{len(told.cannot)} reasons against it")
    if told.cannot:
        raise typer.Exit(1)


def record(
    plan: Annotated[str, PLAN],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the take; it is made.")],
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a take where it ended.")] = False,
    emulate: Annotated[
        str, typer.Option(help="An emulated rig in place of the real one: a file (TOML), or demo.")
    ] = "",
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Record a take, viewpoint by viewpoint: exit 1 where some are poor or left, 130 after Ctrl-C; --resume goes on."""
    from spikerig.dataset.errors import UsageError
    from spikerig.rigctl.forecast import forecast
    from spikerig.rigctl.open_rig import open_rig
    from spikerig.rigctl.operator import Nobody, Person
    from spikerig.rigctl.record import record as run
    from spikerig.rigctl.take_plan import load_plan

    read = load_plan(plan)
    told = forecast(read, out)
    if told.cannot:
        reasons = "; ".join(f"{r['what']}: {r['value']}, needs {r['expected']}" for r in told.cannot)
        raise UsageError("this plan cannot be recorded here", value=reasons,
                         next=f"spikerig rig plan {plan} -o {out}")  # fmt: skip
    rig = open_rig(read, out, emulate, resume)
    try:
        with rig.host.worker("main"):
            tally = run(read, rig, out, Person() if read.advance == "prompt" else Nobody(), resume=resume)
    finally:
        rig.close()
    if as_json:
        emit("spikerig.rig.record/1", {"take": str(out), **asdict(tally)})
    note(
        f"{out}: {tally.kept} of {tally.viewpoints} viewpoints, {tally.bytes / 1e9:.2f} GB in {tally.seconds:.0f} s, "
        f"{tally.lost_ticks} ticks lost, ring at most {tally.high_water} of {tally.slots}; {tally.status}"
    )
    for name, amiss in tally.poor.items():
        note(f"  poor: {name}: {'; '.join(amiss)}")
    if tally.status != "complete":
        note(f"  go on: spikerig rig record {plan} -o {out} --resume")
    if tally.poor or tally.status != "complete":
        raise typer.Exit(1)
