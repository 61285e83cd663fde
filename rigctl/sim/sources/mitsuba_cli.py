"""`spikerig sim mitsuba`: a Mitsuba scene rendered along a shaken path becomes a scene file."""

from __future__ import annotations

import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from spikerig.dataset.errors import UsageError
from spikerig.dataset.terminal import Progress


def mitsuba(
    scene: Annotated[Path, typer.Argument(help="A Mitsuba 3 scene (XML).")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The scene file to write (.h5).")],
    settings: Annotated[
        Path | None,
        typer.Option(help="TOML: a scene file without [world], and [mitsuba]; else the one beside the scene."),
    ] = None,
    frames: Annotated[
        Path | None, typer.Option(help="Keep the rendered sub-frames in this folder; a run cut short goes on there.")
    ] = None,
    spp: Annotated[int | None, typer.Option(help="Samples a pixel, in place of the settings'.")] = None,
    variant: Annotated[str | None, typer.Option(help="Of Mitsuba, in place of the settings' (scalar_rgb).")] = None,
    seed: Annotated[int | None, typer.Option(help="Of shake, rendering, noise and points.")] = None,
    bad_values: Annotated[
        str, typer.Option(help="NaN, infinite and negative light: refuse; zero; clip (infinite to the picture's most).")
    ] = "refuse",
    workers: Annotated[int, typer.Option(help="Threads and processes; 0: one a core.")] = 0,
    memory_gb: Annotated[float, typer.Option(help="Address space for Mitsuba, 0 for no limit.")] = 16.0,
    patience: Annotated[float, typer.Option(help="Seconds a picture may take.")] = 600.0,
    force: Annotated[bool, typer.Option("--force", help="Replace what is there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Simulate a capture of a Mitsuba scene: path-traced sub-frames along a shaken orbit become a scene.

    Mitsuba runs in a process of its own. The rendered pictures are a folder as `sim frames` reads it.
    """
    from spikerig.dataset.outfile import refuse_existing
    from spikerig.rigctl.cli import cores, tell
    from spikerig.rigctl.sim.sources.folder import read_folder
    from spikerig.rigctl.sim.sources.frames import capture_folder
    from spikerig.rigctl.sim.sources.mitsuba_scene import plan_scene, render_folder
    from spikerig.rigctl.sim.sources.pictures import check_mending

    began = time.monotonic()
    if not (memory_gb >= 0 and patience > 0):
        raise UsageError("limits are positive", value=f"--memory-gb {memory_gb:g} --patience {patience:g}")
    check_mending(bad_values)
    refuse_existing(out, force)
    if not out.parent.is_dir():
        raise UsageError("there is no such folder", value=out.parent, next=f"mkdir -p {out.parent}")
    plan, count = plan_scene(scene, settings, seed=seed, spp=spp, variant=variant), cores(workers)
    with ExitStack() as stack:
        folder = frames
        if folder is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix=f".{out.stem}.", dir=out.parent)))
        bar = Progress(f"rendering '{plan.spec.name}'", len(plan.shots), "pictures")
        render_folder(
            plan, folder, threads=count, memory_gb=memory_gb, patience_s=patience, force=force,
            done=lambda file: bar.step(),
        )  # fmt: skip
        found = read_folder(folder, bad_values=bad_values)
        bar = Progress(f"simulating '{plan.spec.name}'", len(found.views), "views")
        told = capture_folder(found, out, workers=count, force=force, done=lambda taken: bar.step())
    render = {"spp": plan.renderer.spp, "variant": plan.renderer.variant, "pictures": len(plan.shots)}
    told |= {"mitsuba": render, "frames": None if frames is None else str(frames)}
    tell("spikerig.sim.mitsuba/1", out, told, began, as_json)
