"""The calibration verbs: boards to a rig, uniform recordings to a flat field."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spikerig.dataset.errors import UsageError
from spikerig.dataset.info_cli import Axes, Height, Json, RowBits, Width
from spikerig.dataset.terminal import Progress, emit, note

if TYPE_CHECKING:
    from spikerig.calib.measure import Measured


def board(
    spike_dir: Annotated[Path, typer.Argument(help="Pictures or spike files of the spike arm, one a view.")],
    rgb_dir: Annotated[Path, typer.Argument(help="Pictures (or spike files) of the RGB arm, one a view.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The calibration to write (.json).")],
    pattern: Annotated[str, typer.Option(help="Inner corners, COLSxROWS: squares less one.")] = "9x6",
    square_mm: Annotated[float, typer.Option(help="Edge of a square, mm.")] = 24.0,
    charuco: Annotated[str, typer.Option(help="A ChArUco board's dictionary, e.g. DICT_5X5_100.")] = "",
    marker_mm: Annotated[float, typer.Option(help="Edge of a ChArUco marker; 0: three quarters of a square.")] = 0.0,
    mirror: Annotated[
        str, typer.Option(help="auto | none | spike | rgb: the arm whose pictures are mirror pictures.")
    ] = "auto",
    model: Annotated[str, typer.Option(help="auto | common | stereo: one centre or two; auto goes by evidence.")] = (
        "auto"
    ),
    lens: Annotated[str, typer.Option(help="auto, or how many coefficients: 0, 1, 4, 5 or 8.")] = "auto",
    at: Annotated[float | None, typer.Option(help="Spike files: the instant, in ticks; default the middle.")] = None,
    window: Annotated[int, typer.Option(help="Spike files: ticks of a short texture.")] = 128,
    windows: Annotated[int, typer.Option(help="Short textures averaged at most, while the picture is still.")] = 8,
    overlays: Annotated[Path | None, typer.Option(help="A folder for an overlay picture of each view.")] = None,
    sheet: Annotated[
        Path | None, typer.Option(help="A page of coverage, tilts and stability to write (.html), or (.svg).")
    ] = None,
    height: Height = None,
    width: Width = None,
    row_bits: RowBits = None,
    axes: Axes = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace a file; keep what is refused (and record that it was).")
    ] = False,
    as_json: Json = False,
) -> None:
    """Calibrate the rig's optics from views of a checkerboard: lenses, mirror, the step between the arms.

    A calibration that cannot be trusted is refused (exit 4) with every reason at once.
    """
    from spikerig.calib.boards import board_of
    from spikerig.calib.lens import LENSES
    from spikerig.calib.measure import look, measure, report
    from spikerig.calib.rig import write_calibration
    from spikerig.calib.shots import Reading, pair_up, unpaired
    from spikerig.dataset.outfile import refuse_existing

    made = board_of(pattern, square_mm, charuco, marker_mm)
    _one_of("mirror", mirror, ("auto", "none", "spike", "rgb"))
    _one_of("model", model, ("auto", "common", "stereo"))
    _one_of("lens", lens, ("auto", *map(str, LENSES)))
    if window < 8 or windows < 1:
        raise UsageError("a short texture has at least 8 ticks, and there is at least one", value=(window, windows))
    refuse_existing(out, force)
    _folders(out.parent, sheet and sheet.parent, made=overlays)
    if sheet is not None:
        refuse_existing(sheet, force)
        if sheet.suffix.lower() not in (".html", ".svg"):
            raise UsageError("a sheet is written as .html or .svg", value=sheet)
    pairs, how = pair_up(spike_dir, rgb_dir)
    alone = unpaired(pairs, spike_dir, rgb_dir)
    if how != "stem":
        note(f"files are paired by {how}: {pairs[0].spike.name} with {pairs[0].rgb.name}, ...")
    bar = Progress("finding boards", len(pairs), "views")
    reading = Reading(height, width, row_bits, axes, at, window, windows)
    seen, in_mirror = look(pairs, made, reading, reading, bar.step)
    lenses = LENSES if lens == "auto" else (int(lens),)
    told = measure(made, seen, in_mirror, mirror=mirror, model=model, lenses=lenses)  # type: ignore[arg-type]
    document = {"out": None, "paired_by": how, "unpaired": alone, **report(told, forced=force)}
    if alone:
        document["warnings"] = [f"without a partner, and left out: {', '.join(alone[:8])}", *document["warnings"]]
    keep = told.fit is not None and (told.verdict.accepted or force)
    if told.fit is not None and keep:
        record = replace(told.fit.calibration, forced=tuple(document["reason_codes"]))
        write_calibration(out, record, document, force=force)
        document |= {"out": str(out), "id": record.id}
    if told.fit is not None and overlays is not None:
        from spikerig.calib.overlay import shot_overlays

        depths = [row.get("depth_mm") for row in document["views"]]
        shot_overlays(overlays, pairs, reading, told.fit.calibration, depths)
    if sheet is not None:
        from spikerig.calib.board_sheet import write_sheet

        write_sheet(sheet, told, document, force=force)
    if as_json:
        emit("spikerig.calib.board/1", document)
    _say(told, document, out if keep else None)
    if not told.verdict.accepted and not keep:
        raise typer.Exit(4)


def _folders(*needed: Path | None, made: Path | None = None) -> None:
    """Folders to write into, looked at before the work begins: there already, or free to be made."""
    for folder in needed:
        if folder is not None and not folder.is_dir():
            raise UsageError("there is no such folder", value=folder, next=f"mkdir -p {folder}")
    if made is not None and made.exists() and not made.is_dir():
        raise UsageError("the overlays go to a folder, and this is a file", value=made)


def _one_of(name: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise UsageError(f"no such --{name}", value=value, expected=", ".join(allowed))


def _say(told: Measured, document: dict[str, Any], out: Path | None) -> None:
    """The result for people, on stderr."""
    rms = document["rms_px"]
    if told.fit is not None:
        c, sd = told.fit.calibration, told.fit.sure.sd
        unsure = "" if told.verdict.accepted else " (not to be trusted)"
        mirrored = f", the {c.mirrored} arm mirrored" if c.mirrored else ""
        centres = f"baseline {c.baseline_mm:.3f} +- {sd['baseline_mm']:.3f} mm" if c.model == "stereo" else "one centre"
        note(
            f"{document['views_used']} of {document['views_given']} views, model '{c.model}'{mirrored}{unsure}: "
            f"residual spike {rms['spike']:.3f}, rgb {rms['rgb']:.3f}, together {rms['stereo']:.3f} px; focal length "
            f"spike {c.spike.K[0, 0]:.2f} +- {sd['spike.fx_px']:.2f}, rgb {c.rgb.K[0, 0]:.2f} +- {sd['rgb.fx_px']:.2f} "
            f"px; {centres}; crop known to {c.sd['crop_px']:.3f} px"
        )
    for text in document["warnings"]:
        note(f"note: {text}")
    for text in document["reasons"]:
        note(f"refused: {text}")
    if out is not None:
        note(f"{out}: written" + ("" if told.verdict.accepted else ", FORCED: the reasons above are recorded in it"))
    else:
        note("nothing is written" + ("" if told.fit is None else "; --force keeps it all the same, and records that"))


def photometric(
    spike_dir: Annotated[Path, typer.Argument(help="Spike files of an even field, one a level of light.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The sensor's maps to write (.npz).")],
    rgb_dir: Annotated[
        Path | None,
        typer.Option("--rgb", help="The RGB arm's pictures of the same levels, paired as in `calib board`."),
    ] = None,
    dark: Annotated[list[Path] | None, typer.Option(help="A spike file with the cap on; may be given again.")] = None,
    lux: Annotated[str, typer.Option(help="The light of the levels, in any unit, by commas, in natural order.")] = "",
    into: Annotated[
        Path | None, typer.Option(help="A calibration that takes response, split ratio and flat field, in place.")
    ] = None,
    height: Height = None,
    width: Width = None,
    row_bits: RowBits = None,
    axes: Axes = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    as_json: Json = False,
) -> None:
    """Calibrate the sensors' light: flat field, dark rate, vignetting, response, the splitter's ratio."""
    from spikerig.calib.even import measure_even
    from spikerig.calib.rig import read_calibration, write_calibration
    from spikerig.calib.shots import Reading
    from spikerig.dataset.flat import write_flat
    from spikerig.dataset.outfile import refuse_existing

    if out.suffix.lower() != ".npz":
        raise UsageError("maps are written as .npz", value=out)
    refuse_existing(out, force)
    record = None if into is None else read_calibration(into)
    reading = Reading(height, width, row_bits, axes)
    told = measure_even(spike_dir, rgb_dir, tuple(dark or ()), _numbers(lux), reading)
    write_flat(out, told.flat, force=force)
    document = {"out": str(out), "into": None if into is None else str(into), **told.report}
    if into is not None and record is not None:
        changed = replace(
            record,
            flat={"file": out.name, "sha256": told.hash_of(out)},
            split_ratio=record.split_ratio if told.response is None else round(told.response.split_ratio, 9),
            response=record.response if told.response is None else told.response.response,
        )
        write_calibration(into, changed, force=True)
        document["id"] = changed.id
    if as_json:
        emit("spikerig.calib.photometric/1", document)
    _say_even(document, out)


def _numbers(text: str) -> tuple[float, ...] | None:
    if not text:
        return None
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise UsageError("levels of light are numbers with commas between", value=text, expected="153,335") from None


def _say_even(document: dict[str, Any], out: Path) -> None:
    dark, electrons = document["dark_rate"], document["threshold_e"]
    shot = "" if electrons is None else f", about {electrons:.0f} electrons a spike"
    note(
        f"{out}: {document['pixels']} pixels, {document['bad_pixels']} of them bad; pattern "
        f"{100 * document['pattern_sd']:.2f} %, {100 * document['falloff']:.1f} % darker at the corners, dark rate "
        f"{dark['mean']:.5f} +- {dark['sd']:.5f} spikes a tick{shot}"
    )
    for text in document["warnings"]:
        note(f"note: {text}")
    if document["split_ratio"] is not None:
        response = document["response"]
        colour = "colours too alike to tell the response" if response is None else (
            "response to r, g, b " + ", ".join(f"{v:.3f}" for v in response))  # fmt: skip
        note(f"{document['split_ratio']:.4f} spikes a tick at RGB white; {colour}")
