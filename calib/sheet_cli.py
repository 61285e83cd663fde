"""`spikerig data sheet`: every view of a scene at a glance."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spikerig.dataset.errors import UsageError
from spikerig.dataset.info_cli import Force, Json
from spikerig.dataset.terminal import Progress, emit, note


def sheet(
    file: Annotated[Path, typer.Argument(help="A scene file (RS-3D HDF5).")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The page to write (.html).")],
    limit_mb: Annotated[float, typer.Option(help="About how large; pictures are made smaller to fit.")] = 9.0,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Write a contact sheet: RGB, TFP, TFI and overlays of every view, cameras from two sides, residuals."""
    from spikerig.calib.pose_sheet import write_sheet

    if not 0.1 <= limit_mb <= 1000:
        raise UsageError("a page is of 0.1 to 1000 MB", value=limit_mb)
    bar = Progress("drawing views", 0, "views")
    told = {"file": str(file), **write_sheet(file, out, force=force, done=bar.step, limit=round(1e6 * limit_mb))}
    if as_json:
        emit("spikerig.data.sheet/1", told)
    note(f"{out}: {told['views']} views, {told['bytes'] / 1e6:.1f} MB")
