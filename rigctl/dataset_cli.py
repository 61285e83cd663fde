"""`spikerig sim dataset`: the built-in synthetic scenes as a dataset with truth."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from spikerig.dataset.errors import UsageError
from spikerig.dataset.terminal import Progress, emit, note
from spikerig.rigctl.cli import cores


def dataset(
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder to make, or to go on with.")],
    scenes: Annotated[str, typer.Option(help="Built-in scenes, with commas between them; all six if not given.")] = "",
    views: Annotated[int | None, typer.Option(help="Viewpoints a scene, in place of its own (30).")] = None,
    test_every: Annotated[
        int | None,
        typer.Option(help="Every N-th view is for testing, in place of 5; 2 gives the half and half of the paper."),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of shake, noise and points, in place of the scenes'.")] = None,
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT in pixels, in place of 400x250.")] = "",
    workers: Annotated[int, typer.Option(help="Processes; 0: one a core. The bytes do not depend on it.")] = 0,
    scheduler: Annotated[
        str, typer.Option(help="Let a Dask cluster make the views, as in tcp://host:8786; its scheduler is trusted.")
    ] = "",
    force: Annotated[bool, typer.Option("--force", help="Make a dataset with other settings anew.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Make the six synthetic scenes: spikes, blurry pictures, poses and the truth, one scene file each.

    Interrupted or killed, it goes on where it was when the same command is given again; the bytes are the same.
    """
    from spikerig.rigctl.sim.dataset import SIX, Order, make

    began = time.monotonic()
    names = tuple(name.strip() for name in scenes.split(",") if name.strip()) if scenes else SIX
    order = Order(names, views, test_every, seed, _size(size))

    def begin(name: str, count: int, kept: int) -> Callable[[], None]:
        if kept:
            note(f"{name}: {kept} of {count} views are finished already")
        return Progress(f"simulating '{name}'", count - kept, "views").step

    told = make(out, order, workers=cores(workers), scheduler=scheduler, force=force, begin=begin)
    told = {"out": str(out), **told, "seconds": time.monotonic() - began}
    if as_json:
        emit(told["schema"], told)
    for name, row in told["scenes"].items():
        note(
            f"{out / row['file']}: {row['train_views']} train and {row['test_views']} test views, "
            f"{row['spikes_mean']:.1f} spikes a pixel, blurry pictures {row['blurry_psnr_db']:.2f} dB from sharp, "
            f"sha256 {row['sha256'][:16]}{', there already' if name in told['kept'] else ''}"
        )
    note(f"{out}: {len(told['scenes'])} scenes, sha256 of all {told['sha256'][:16]}, {told['seconds']:.1f} s")


def _size(text: str) -> tuple[int, int] | None:
    if not text:
        return None
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if not match:
        raise UsageError("not a size", value=text, expected="WIDTHxHEIGHT, as in 400x250")
    return int(match[1]), int(match[2])
