"""`spikerig train diverged`: the step at which a run stopped being finite, taken again slowly."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spikerig.dataset.errors import DataError
from spikerig.dataset.terminal import emit, note


def diverged(
    run: Annotated[Path, typer.Argument(help="Folder of a run that ended with 'training diverged'.")],
    scene: Annotated[Path | None, typer.Option(help="The scene, where it has moved.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Take the step that broke a run again, from the state before it, and say what is finite in it.

    Exits 1 where the step breaks again, 0 where it does not.
    """
    from spikerig.train import record as records
    from spikerig.train.config import from_json
    from spikerig.train.fit import load_state
    from spikerig.train.guard import examine
    from spikerig.train.run import prepare_again

    if not (run / records.DIVERGED).exists():
        raise DataError(
            "this run has not diverged",
            value=run,
            expected=f"{records.DIVERGED}, written when a value stops being finite",
            next="spikerig train score RUN",
        )
    stored = records.read_json(run / records.RECORD)
    state, config = load_state(run / records.DIVERGED)
    task = prepare_again(stored, from_json(config), scene)
    found = examine(state, task)
    rows = [
        (name, kind, about)
        for name, kinds in found["tensors"].items()
        for kind, about in kinds.items()
        if about is not None
    ]
    broken = [row for row in rows if row[2]["not_finite"]]
    note(f"step {found['step']}, view '{found['view']}', loss {found['loss']}")
    for name, kind, about in rows:
        bad = f", {about['not_finite']} not finite, first at {about['first']}" if about["not_finite"] else ""
        note(f"  {name} {kind}: largest {about['largest']:.4g}{bad}")
    if found["error"]:
        note(found["error"])
    again = bool(broken or found["error"])
    note("it breaks again" if again else "it does not break again")
    if as_json:
        emit("spikerig.train.diverged/1", {"run": str(run), "breaks": again, **found})
    if again:
        raise typer.Exit(1)
