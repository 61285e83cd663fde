"""`spikerig cost kernels`: every native kernel beside its oracle."""

from __future__ import annotations

from typing import Annotated

import typer

from spikerig.dataset import bench as spike_bench
from spikerig.dataset import machine
from spikerig.dataset.terminal import emit, note


def kernels(
    quick: Annotated[bool, typer.Option("--quick", help="Fewer repeats and a smaller raster scene.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """CPU seconds of the native kernels on one thread, beside their oracles in the same run."""
    from spikerig.train import bench as train_bench  # torch

    note("spike kernels, then raster and ssim (their oracles take seconds) ...")
    rows = spike_bench.rows(quick) + train_bench.rows(quick)
    where = machine.describe()
    if as_json:
        emit("spikerig.cost.kernels/1", {"kernels": rows, "machine": where, "command": machine.command()})
        return
    typer.echo(f"{'kernel':<17}{'ms':>9}{'oracle ms':>12}{'ratio':>8}  size")
    for row in rows:
        more = ""
        if "splat_pixels_per_second" in row:
            more = (
                f", {row['consulted_per_pixel']:.0f} splats consulted a pixel, "
                f"{row['splat_pixels_per_second'] / 1e6:.0f} M splat-pixels/s, with absgrad "
                f"{row['absgrad_seconds'] * 1e3:.2f} ms"
            )
        if "ns_per_pixel_tick" in row:
            more = f", {row['ticks_per_second']:.0f} ticks/s, {row['ns_per_pixel_tick']:.2f} ns a pixel and tick"
        typer.echo(
            f"{row['kernel']:<17}{row['seconds'] * 1e3:>9.3f}{row['oracle_seconds'] * 1e3:>12.2f}"
            f"{row['ratio']:>8.1f}  {row['size']}{more}"
        )
    typer.echo(machine.caption(where | {"threads": 1}))
