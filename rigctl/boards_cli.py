"""`spikerig sim boards`: what an operator would shoot to calibrate a scene's rig."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spikerig.dataset.errors import UsageError
from spikerig.dataset.terminal import Progress, emit, note
from spikerig.rigctl.cli import RigName


def boards(
    scene: Annotated[str, typer.Argument(help="A scene file (TOML), or a built-in scene: whose rig.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for spike/, rgb/ and true.json.")],
    pattern: Annotated[str, typer.Option(help="Inner corners, COLSxROWS: squares less one.")] = "9x6",
    square_mm: Annotated[float, typer.Option(help="Edge of a square, mm.")] = 24.0,
    views: Annotated[int, typer.Option(help="How many times the board is held up.")] = 14,
    rig: RigName = "",
    seed: Annotated[int | None, typer.Option(help="Of the board's poses and noise, in place of the scene's.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Simulate recordings of a checkerboard through the rig of a scene, for `calib board`; true.json is the truth.

    Same sensors, same effects, same size as the scene's capture: one world unit of the scene counts as a metre.
    """
    from spikerig.calib.boards import board_of
    from spikerig.rigctl.sim.boards import record_boards
    from spikerig.rigctl.sim.capture import settled
    from spikerig.rigctl.sim.spec import load_scene_toml, with_changes

    if not 1 <= views <= 1000:
        raise UsageError("a board is held up at least once", value=views, expected="1 to 1000")
    board = board_of(pattern, square_mm, "", 0.0)
    taken = [p for p in (out / "true.json", out / "spike", out / "rgb") if p.exists()]
    if taken and not force:
        raise UsageError("the folder holds boards already", value=taken[0], next="give --force to replace them")
    spec, _ = settled(with_changes(load_scene_toml(scene), seed=seed, rig=rig))
    bar = Progress(f"boards before '{spec.name}'", views, "views")
    told = {"scene": spec.name, "seed": spec.seed, **record_boards(spec, board, views, out, force=force, done=bar.step)}
    if as_json:
        emit("spikerig.sim.boards/1", told)
    note(f"{out}: {views} views of a {board}; spikerig calib board {told['spike']} {told['rgb']} "
         f"--pattern {told['pattern']} --square-mm {square_mm:g} -o calib.json")  # fmt: skip
