"""`spikerig rig panel TAKE SPOTS.json`: read the LED panel in a take."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spikerig.dataset.terminal import emit, note


def panel(
    take: Annotated[Path, typer.Argument(help="Folder of a take.")],
    spots: Annotated[
        Path | None, typer.Argument(help="The panel and its LEDs' places in both pictures (JSON); default: the plan's.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace sights that are there already.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> int:
    """Read the LED panel in a take's spikes and clips; its sights go to marks.jsonl. Exit 1: some could not be read."""
    from spikerig.rigctl.panel_take import read_panel, read_spots

    told = read_panel(take, None if spots is None else read_spots(spots), force=force)
    if as_json:
        emit("spikerig.rig.panel/1", {"take": take, **told})
    else:
        for line in told["trouble"]:
            note(line)
        note(f"{told['spike']} sights in spikes, {told['rgb']} in clips; next: spikerig calib clock {take}")
    return 1 if told["trouble"] else 0
