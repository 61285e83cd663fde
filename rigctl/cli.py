"""The rig's verbs: simulated captures."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from spikerig.dataset.errors import UsageError
from spikerig.dataset.terminal import Progress, emit, note

RigName = Annotated[str, typer.Option("--rig", help="Arms that differ: splitter (RGB mirrored, off axis; a barrel).")]


def cores(asked: int) -> int:
    """How many processes to start: as asked, or for 0 one a core that this process may use."""
    if asked < 0:
        raise UsageError("workers are counted from 1; 0 means one a core", value=asked)
    return asked or (len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


def capture(
    scene: Annotated[str, typer.Argument(help="A scene file (TOML), or a built-in scene such as demo or chroma.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The scene file to write (.h5).")],
    seed: Annotated[int | None, typer.Option(help="Of shake, noise and points, in place of the scene's.")] = None,
    views: Annotated[int | None, typer.Option(help="Viewpoints on the same arc, in place of the scene's.")] = None,
    rig: RigName = "",
    workers: Annotated[int, typer.Option(help="Processes; 0: one a core. The bits do not depend on it.")] = 0,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Simulate a capture: shaken viewpoints of an analytic world, as spikes and blurry pictures, with the truth.

    Interrupted or killed, it goes on where it was when the same command is given again; the demo takes seconds.
    """
    from spikerig.rigctl.sim.capture import capture as play
    from spikerig.rigctl.sim.spec import load_scene_toml, with_changes

    began = time.monotonic()
    spec = with_changes(load_scene_toml(scene), seed=seed, views=views, rig=rig)
    bar = Progress(f"simulating '{spec.name}'", spec.orbit.views, "views")
    told = play(spec, out, workers=cores(workers), force=force, done=bar.step)
    tell("spikerig.sim.capture/1", out, told, began, as_json)


def frames(
    folder: Annotated[Path, typer.Argument(help="Sub-frames with poses, laid out as in docs/sim_frames.md.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The scene file to write (.h5).")],
    settings: Annotated[
        Path | None, typer.Option(help="TOML with exposure, sensor, effects, points; else FOLDER/capture.toml.")
    ] = None,
    protocol: Annotated[str, typer.Option(help="rig or paper, in place of the settings'.")] = "",
    seed: Annotated[int | None, typer.Option(help="Of noise and points, in place of the settings'.")] = None,
    bad_values: Annotated[
        str, typer.Option(help="NaN, infinite and negative light: refuse; zero; clip (infinite to the picture's most).")
    ] = "refuse",
    workers: Annotated[int, typer.Option(help="Processes; 0: one a core. The bits do not depend on it.")] = 0,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Simulate a capture from rendered sub-frames: linear EXR (or sRGB PNG) sequences with poses become a scene."""
    from spikerig.rigctl.sim.sources.folder import read_folder
    from spikerig.rigctl.sim.sources.frames import capture_folder

    began = time.monotonic()
    found = read_folder(folder, settings, protocol=protocol, seed=seed, bad_values=bad_values)
    bar = Progress(f"simulating '{found.rig.name}'", len(found.views), "views")
    told = capture_folder(found, out, workers=cores(workers), force=force, done=lambda taken: bar.step())
    tell("spikerig.sim.frames/1", out, told, began, as_json)
    if told["points"] == 0:
        note("no initial points: training will start from random ones, some 10 dB worse; give points or depth")


def tell(schema: str, out: Path, told: dict[str, Any], began: float, as_json: bool) -> None:
    """Say what a simulation made: one JSON document, and a line for people."""
    told = {"out": str(out), **told, "seconds": time.monotonic() - began}
    if as_json:
        emit(schema, told)
    if "plan_line" in told:
        note(told["plan_line"])
    blur = f", blurry pictures {told['blurry_psnr_db']:.2f} dB from sharp" if told["train_views"] else ""
    note(
        f"{out}: {told['train_views']} train and {told['test_views']} test views of {told['size'][0]}x"
        f"{told['size'][1]}, {told['ticks']} ticks an exposure, {told['spikes_mean']:.1f} spikes a pixel (most "
        f"{told['spikes_max']}){blur}, pose label '{told['pose_label']}', seed {told['seed']}, {told['seconds']:.1f} s"
    )
    bad = told.get("bad_values", {"pictures": 0})
    if bad["pictures"]:
        note(
            f"mended ({bad['how']}) in {bad['pictures']} pictures: {bad['nan']} NaN, {bad['infinite']} infinite, "
            f"{bad['negative']} negative values"
        )
