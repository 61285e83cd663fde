"""Commands on scene files: `spikerig data verify` and `spikerig data build`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import typer

from spikerig.dataset.terminal import emit, note


def verify(
    file: Path = typer.Argument(..., help="A scene file (RS-3D HDF5)."),
    as_json: bool = typer.Option(False, "--json", help="One JSON document on stdout."),
) -> None:
    """Check a scene file against its schema and every checksum: exit 0 all well, 1 findings, 4 unreadable."""
    from spikerig.dataset.store import verify_scene

    found = verify_scene(file)
    if as_json:
        emit("spikerig.data.verify/1", {"file": str(file), "ok": not found, "findings": [asdict(f) for f in found]})
    for one in found:
        note(f"{one.importance}: {one.where}: {one.message}" + (f" ({one.fix})" if one.fix else ""))
    note(f"{file}: {f'{len(found)} findings' if found else 'all well'}")
    if found:
        raise typer.Exit(1)
