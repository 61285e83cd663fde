"""`spikerig data ingest`: a raw take becomes a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spikerig.dataset.errors import UsageError
from spikerig.dataset.terminal import Progress, emit, note


def ingest(
    take: Annotated[Path, typer.Argument(help="Folder of a raw take, as `rig record` left it.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The scene to write (.h5).")],
    frames: Annotated[int, typer.Option(help="Pictures a viewpoint, those about its middle.")] = 1,
    margin_ticks: Annotated[int, typer.Option(help="Spikes kept at least on each side of an exposure.")] = 256,
    test_every: Annotated[
        int | None, typer.Option(help="Hold out every Nth viewpoint, in place of what the plan says; 0: none.")
    ] = None,
    fov_deg: Annotated[float, typer.Option(help="Horizontal, of the spike camera: a guess until calibrated.")] = 60.0,
    truth: Annotated[
        bool | None, typer.Option(help="Poses, sharp pictures and points of an emulated rig; default: where known.")
    ] = None,
    name: Annotated[str, typer.Option(help="Of the scene; default: the plan's.")] = "",
    force: Annotated[bool, typer.Option("--force", help="Replace an existing scene.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Make a scene of a take: frames cut by the clock map, each with the spikes around it.

    Exit codes: 1 where views are left out or ticks are lost; the scene is made all the same.
    """
    from spikerig.rigctl.ingest import IngestConfig
    from spikerig.rigctl.ingest import ingest as run

    if not (1 <= frames <= 1000 and 0 <= margin_ticks <= 1_000_000 and (test_every or 0) >= 0):
        raise UsageError("a number is out of range", value=(frames, margin_ticks, test_every),
                         expected="1 to 1000 frames, 0 to 1000000 ticks, test-every from 0")  # fmt: skip
    config = IngestConfig(frames, margin_ticks, test_every, fov_deg, truth, name)
    told = run(take, out, config, force=force, begin=lambda what, n: Progress(what, n, "viewpoints").step)
    if as_json:
        emit("spikerig.data.ingest/1", told)
    for view, why in told["panel_unread"].items():
        note(f"  the panel was not read: {view}: {why}")
    for view, why in told["left_out"].items():
        note(f"  left out: {view}: {why}")
    note(
        f"{out}: {told['views']} views ({len(told['test'])} held out), {told['lost_ticks']} ticks lost, frames timed "
        f"by {' and '.join(told['rgb_times'])}, clocks good to {2 * told['sigma_us']:.0f} us"
    )
    if told["left_out"] or told["lost_ticks"]:
        raise typer.Exit(1)
