"""`spikerig calib align`: a raw scene's frames onto the spike arm's camera, checked by their edges."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from spikerig.dataset.errors import UsageError
from spikerig.dataset.info_cli import Json
from spikerig.dataset.terminal import Progress, emit, jsonable, note

if TYPE_CHECKING:
    from spikerig.calib.agree import Agreement
    from spikerig.calib.align import Aligned, Warp
    from spikerig.calib.aligned_scene import Checked, Wish
    from spikerig.calib.rig import RigCalibration
    from spikerig.calib.sheet import Row
    from spikerig.dataset.scene import View


def align(
    source: Annotated[Path, typer.Argument(help="A scene file whose frames are as the RGB camera saw them.")],
    calibration: Annotated[Path, typer.Option("--with", help="The rig's calibration (.json).")],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Write here; default: in place.")] = None,
    depth_mm: Annotated[float | None, typer.Option(help="Of the scene, for a stereo rig; default the boards'.")] = None,
    refine: Annotated[bool, typer.Option("--refine", help="Take a small error common to all views out (ECC).")] = False,
    flat: Annotated[
        Path | None, typer.Option(help="The sensor's maps (.npz), to even textures out before edges.")
    ] = None,
    regions: Annotated[
        Path | None, typer.Option(help='JSON of what is not scene: [{"arm": "rgb", "polygon_px": [[x, y], ...]}].')
    ] = None,
    panel_spike: Annotated[
        list[str] | None, typer.Option(help="The clock's LED panel, x0,y0,x1,y1 in raw spike pixels; may be repeated.")
    ] = None,
    panel_rgb: Annotated[
        list[str] | None, typer.Option(help="The same in raw RGB pixels: what one arm sees of it is enough.")
    ] = None,
    find_panel: Annotated[
        bool, typer.Option("--find-panel", help="Find the panel by its blinking, in the spikes of each view.")
    ] = False,
    sheet: Annotated[Path | None, typer.Option(help="A contact sheet to write (.html).")] = None,
    overlays: Annotated[Path | None, typer.Option(help="A folder for an overlay picture of each view.")] = None,
    check: Annotated[bool, typer.Option("--check", help="Only hold edges against edges; write no scene.")] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace files; keep what is refused, and record that.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Align a scene: undistort and crop RGB to the spike field of view, with times and validity of every pixel.

    Spikes stay raw. The result is held edge against edge; where both arms do not agree it is refused (exit 4).
    """
    from spikerig.calib.aligned_scene import WORST_PX, Wish, check_alignment, write_aligned
    from spikerig.calib.plots import spot_of
    from spikerig.calib.regions import check_regions, panel_of, read_regions, regions_json
    from spikerig.calib.rig import read_calibration
    from spikerig.calib.sheet import page
    from spikerig.dataset.flat import read_flat
    from spikerig.dataset.outfile import refuse_existing, whole_file
    from spikerig.dataset.provenance import origin_of
    from spikerig.dataset.store import open_scene

    record = read_calibration(calibration)
    given = (
        *(() if regions is None else read_regions(regions)),
        *(panel_of(text, "spike") for text in panel_spike or ()),
        *(panel_of(text, "rgb") for text in panel_rgb or ()),
    )
    check_regions(given, record)
    wish = Wish(depth_mm, given, refine, None if flat is None else read_flat(flat), find_panel)
    for path in (sheet, None if check else out):
        if path is not None:
            refuse_existing(path, force)
    with open_scene(source) as scene:
        if "align" in scene.info and not force:
            raise UsageError("the scene is aligned already", value=source, next="align the raw recording")
        bar = Progress("aligning", len(scene.names), "views")
        pictures = _Pictures(overlays, record, sheet is not None)
        checked = check_alignment(scene, record, wish, lambda *told: (pictures.take(*told), bar.step())[0])
        spots = [spot_of(scene.view(name, spikes=False)) for name in scene.names]
        name, worst = scene.name, checked.median_px
        origin = origin_of(
            scene, "opencv-contrib-python-headless", "h5py", files={"calibration": calibration, "flat": flat}
        )
    accepted = bool(worst <= WORST_PX)
    told = _report(source, record, checked, accepted, force, refine) | {"versions": origin["versions"]}
    told |= {"regions": regions_json(given), "panels": None if not find_panel else {
        name: regions_json(found) for name, found in checked.panels.items()}}  # fmt: skip
    if sheet is not None:
        with whole_file(sheet, force=force) as part:
            part.write_text(page(name, record, pictures.rows, spots), encoding="utf-8")
    if (accepted or force) and not check:
        provenance = _provenance(told, origin, wish, record, depth_mm)
        told |= write_aligned(source, record, checked, jsonable(provenance), out=out, force=force)
    if as_json:
        emit("spikerig.calib.align/1", told)
    _say(told, checked, record)
    if not accepted and not force:
        raise typer.Exit(4)


class _Pictures:
    """Overlays on disk and rows of the sheet, made as views go by."""

    def __init__(self, folder: Path | None, record: RigCalibration, rows: bool) -> None:
        self.folder, self.record, self.wanted = folder, record, rows
        self.rows: list[Row] = []

    def take(self, view: View, aligned: Aligned, warp: Warp, agreement: Agreement) -> None:
        from spikerig.calib.overlay import KINDS, overlay
        from spikerig.calib.sheet import row_of, sharp_textures
        from spikerig.dataset.images import write_image

        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
            for kind in KINDS:
                write_image(self.folder / f"{view.name}.{kind}.png", overlay(aligned, kind), force=True)
        if self.wanted:
            self.rows.append(row_of(view.name, aligned, agreement, sharp_textures(view, self.record, warp)))


def _report(
    source: Path, record: RigCalibration, checked: Checked, accepted: bool, force: bool, refine: bool
) -> dict[str, Any]:
    from spikerig.calib.aligned_scene import WORST_PX

    edges = {name: a.rms_px for name, a in checked.agreement.items()}
    reason = f"edges of the two arms lie {checked.median_px:.2f} px apart, at most {WORST_PX:g} are kept"
    if not np.isfinite(checked.median_px):
        reason = "no view has edges by which the arms could be compared"
    return {
        "source": str(source),
        "accepted": accepted,
        "forced": force and not accepted,
        "reasons": [] if accepted else [reason],
        "calibration": record.id,
        "model": record.model,
        "edges_px": {"median": checked.median_px, "views": edges},
        "valid": float(np.mean([checked.warp_of(name).valid.mean() for name in checked.agreement] or [0.0])),
        "refinement": checked.refinement if refine else None,
        "spikes_lie_on_the_camera": checked.warp.same,
        "written": None,
    }


def _provenance(
    told: dict[str, Any], origin: dict[str, Any], wish: Wish, record: RigCalibration, depth_mm: float | None
) -> dict[str, Any]:
    """What the aligned scene keeps of how it was made, as info.align."""
    kept = ("calibration", "model", "edges_px", "valid", "refinement", "accepted", "reasons", "forced")
    options = {"depth_mm": depth_mm, "refine": wish.refine, "flat": wish.flat is not None}
    residuals = {"board_px": record.residual_px, "crop_px": record.sd.get("crop_px")}
    parts = {k: told[k] for k in (*kept, "regions", "panels")}
    return parts | origin | {"options": options, "residuals": residuals}


def _say(told: dict[str, Any], checked: Checked, record: RigCalibration) -> None:
    n = len(checked.agreement)
    note(
        f"{n} views, {100 * told['valid']:.1f} % of the pixels seen by both arms, edges {checked.median_px:.3f} px off"
    )
    if told["panels"] is not None:
        n = sum(bool(found) for found in told["panels"].values())
        note(f"a blinking panel was found in {n} views, and is not valid there")
    if record.model == "stereo":
        note("note: a stereo rig is aligned at one depth only; elsewhere edges lie apart")
    if not checked.warp.same:
        note("note: spikes stay raw, on a lens that distorts or mirrors: `train` and `calib poses` straighten them; "
             "in code of your own, calib.straight does")  # fmt: skip
    for text in told["reasons"]:
        note(f"refused: {text}: calibrate again, or try --refine; was the rig touched since?")
    if told["written"]:
        note(f"{told['written']}: written" + (", FORCED" if told["forced"] else ""))
