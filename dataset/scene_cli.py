"""Commands on scene files: `spikerig data verify` and `spikerig data build`."""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

import typer

from spikerig.dataset.terminal import emit, note


def verify(
    file: Path = typer.Argument(..., help="A scene file (RS-3D HDF5), or the folder of a raw take."),
    as_json: bool = typer.Option(False, "--json", help="One JSON document on stdout."),
) -> None:
    """Check a scene file, or every chunk of a take, against all checksums: exit 0 well, 1 findings, 4 unreadable."""
    figures: dict[str, Any] = {}
    if file.is_dir():
        from spikerig.dataset.rawtake import verify_take

        found, figures = verify_take(file)
    else:
        from spikerig.dataset.store import verify_scene

        found = verify_scene(file)
    if as_json:
        told = {"file": str(file), "ok": not found, "findings": [asdict(f) for f in found], **figures}
        emit("spikerig.data.verify/1", told)
    if figures:
        note(", ".join(f"{key.replace('_', ' ')} {value}" for key, value in figures.items()))
    for one in found:
        note(f"{one.importance}: {one.where}: {one.message}" + (f" ({one.fix})" if one.fix else ""))
    note(f"{file}: {f'{len(found)} findings' if found else 'all well'}")
    if found:
        raise typer.Exit(1)


def build(
    rgb: Path = typer.Option(..., help="Folder of pictures: .png, .jpg, .exr."),
    out: Path = typer.Option(..., "--out", "-o", help="The scene to write (.h5)."),
    spikes: Path | None = typer.Option(
        None, help="Folder of spike files: .dat, .bin, .npz, .h5; without it, a scene of pictures only."
    ),
    transforms: Path | None = typer.Option(None, help="Poses: a transforms.json of NeRF or nerfstudio."),
    colmap: Path | None = typer.Option(None, help="Poses and points: the folder of a COLMAP model."),
    rate_hz: float | None = typer.Option(None, help="Ticks a second, where the files do not say."),
    exposure_us: float | None = typer.Option(None, help="Of the pictures, centred in the spikes; default: as long."),
    height: int | None = typer.Option(None, help="Of raw spike files."),
    width: int | None = typer.Option(None, help="Of raw spike files."),
    row_bits: int | None = typer.Option(None, help="Bits a row of raw spike files, e.g. 400 or 416."),
    axes: str | None = typer.Option(None, help="Order of .npz arrays: THW or HWT."),
    test_every: int = typer.Option(0, help="Hold out every Nth view, from the first; 0: none, 1: all."),
    background: str | None = typer.Option(None, help="Behind transparent pixels: black, white, or a gray 0 to 1."),
    resize: bool = typer.Option(False, "--resize", help="Bring pictures to the spikes' size (area average)."),
    size: str | None = typer.Option(None, help="WIDTHxHEIGHT of a scene of pictures only; pictures are brought to it."),
    skip_unmatched: bool = typer.Option(False, "--skip-unmatched", help="Leave out what has no partner."),
    name: str | None = typer.Option(None, help="Of the scene; default: the file's stem."),
    force: bool = typer.Option(False, "--force", help="Replace an existing scene."),
    as_json: bool = typer.Option(False, "--json", help="One JSON document on stdout."),
) -> None:
    """Make a scene of your own spikes, pictures and poses, matched by file stem; everything amiss is listed at once."""
    from spikerig.dataset.build import BuildConfig, build_scene
    from spikerig.dataset.errors import UsageError

    try:
        gray = None if background is None else float({"black": "0", "white": "1"}.get(background, background))
    except ValueError as error:
        raise UsageError("not a background", value=background, expected="black, white, or a gray 0 to 1") from error
    wanted = None
    if size is not None:
        match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", size)
        if match is None:
            raise UsageError("not a size", value=size, expected="WIDTHxHEIGHT, e.g. 400x400")
        wanted = (int(match[1]), int(match[2]))
    layout = {"height": height, "width": width, "row_bits": row_bits, "axes": axes}
    config = BuildConfig(
        rgb, spikes, transforms, colmap, rate_hz, exposure_us, **layout, test_every=test_every, background=gray,
        resize=resize, size=wanted, skip_unmatched=skip_unmatched, name=name,
    )  # fmt: skip
    made = build_scene(config, out, force=force)
    if as_json:
        emit("spikerig.data.build/1", made)
    note(f"{out}: {made['views']} views ({len(made['test'])} held out), {made['points']} points")
