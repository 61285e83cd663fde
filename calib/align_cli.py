"""`spikerig calib align`: a raw scene's frames onto the spike arm's camera, checked by their edges."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.info_cli import Json
from spikerig.dataset.terminal import Progress, emit, jsonable, note

if TYPE_CHECKING:
    from spikerig.calib.agree import Agreement
    from spikerig.calib.align import Aligned, Region, Warp
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
    from spikerig.calib.flat import read_flat
    from spikerig.calib.plots import spot_of
    from spikerig.calib.rig import read_calibration
    from spikerig.calib.sheet import page
    from spikerig.dataset.outfile import refuse_existing, whole_file
    from spikerig.dataset.provenance import origin_of
    from spikerig.dataset.store import open_scene

    record = read_calibration(calibration)
    wish = Wish(
        depth_mm, () if regions is None else _regions(regions), refine, None if flat is None else read_flat(flat)
    )
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


def _regions(path: Path) -> tuple[Region, ...]:
    from spikerig.calib.align import Region

    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
        return tuple(Region(_arm(row["arm"]), np.array(row["polygon_px"], np.float64)) for row in rows)
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise DataError("the regions cannot be read", value=f"{path}: {error}",
                        expected='[{"arm": "rgb", "polygon_px": [[x, y], ...]}]') from error  # fmt: skip


def _arm(name: str) -> Any:
    if name not in ("spike", "rgb"):
        raise ValueError(f"{name!r} is no arm")
    return name


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
        "valid": float(checked.warp.valid.mean()),
        "refinement": checked.refinement if refine else None,
        "spikes_lie_on_the_camera": checked.warp.same,
        "written": None,
    }


def _provenance(
    told: dict[str, Any], origin: dict[str, Any], wish: Wish, record: RigCalibration, depth_mm: float | None
) -> dict[str, Any]:
    """What the aligned scene keeps of how it was made, as info.align."""
    kept = ("calibration", "model", "edges_px", "valid", "refinement", "accepted", "reasons", "forced")
    shapes = [{"arm": r.arm, "polygon_px": r.polygon_px} for r in wish.regions]
    options = {"depth_mm": depth_mm, "refine": wish.refine, "regions": shapes, "flat": wish.flat is not None}
    residuals = {"board_px": record.residual_px, "crop_px": record.sd.get("crop_px")}
    return {k: told[k] for k in kept} | origin | {"options": options, "residuals": residuals}


def _say(told: dict[str, Any], checked: Checked, record: RigCalibration) -> None:
    n = len(checked.agreement)
    note(
        f"{n} views, {100 * told['valid']:.1f} % of the pixels seen by both arms, edges {checked.median_px:.3f} px off"
    )
    if record.model == "stereo":
        note("note: a stereo rig is aligned at one depth only; elsewhere edges lie apart")
    if not checked.warp.same:
        note("note: spikes stay raw, on a lens that distorts or mirrors: textures made of them must be warped too "
             "(calib.align.warp_texture)")  # fmt: skip
    for text in told["reasons"]:
        note(f"refused: {text}: calibrate again, or try --refine; was the rig touched since?")
    if told["written"]:
        note(f"{told['written']}: written" + (", FORCED" if told["forced"] else ""))
