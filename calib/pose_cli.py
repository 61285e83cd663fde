"""`spikerig calib poses`: camera poses from spike textures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from spikerig.dataset.errors import RefusedError, UsageError
from spikerig.dataset.terminal import Progress, emit, note


def poses(
    source: Annotated[Path, typer.Argument(help="A scene file, or a folder of pictures.")],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder for poses.json and COLMAP's model.")] = None,
    write: Annotated[bool, typer.Option("--write", help="Put the poses into the scene, in place.")] = False,
    write_to: Annotated[Path | None, typer.Option(help="Put the poses into a copy of the scene.")] = None,
    arms: Annotated[str, typer.Option(help="spike, rgb, or both (a rig of fixed relative pose).")] = "spike",
    kinds: Annotated[
        str, typer.Option(help="Textures, e.g. tfp96,adaptive; default: whose features are found again best.")
    ] = "",
    maps: Annotated[int, typer.Option(help="Kinds mapped independently; they must agree.")] = 3,
    instants: Annotated[int, typer.Option(help="Poses over each exposure; 1: the middle alone.")] = 5,
    min_share: Annotated[float, typer.Option(help="Of the views that must be placed.")] = 0.8,
    max_error_px: Annotated[
        float | None, typer.Option(help="Of a match and of an observation; scenes 1.5, folders 4.")
    ] = None,
    pairs: Annotated[str, typer.Option(help="auto, exhaustive or sequential.")] = "auto",
    mapper: Annotated[str, typer.Option(help="incremental or global.")] = "incremental",
    peak_threshold: Annotated[
        float | None, typer.Option(help="Of SIFT; lower finds more in low contrast; scenes 0.0033, folders 0.0067.")
    ] = None,
    max_features: Annotated[int, typer.Option(help="A picture.")] = 4096,
    max_image_size: Annotated[int, typer.Option(help="Longer sides are made smaller; -1: never.")] = -1,
    tries: Annotated[int, typer.Option(min=1, max=9, help="At mapping; the largest map is kept.")] = 2,
    pattern: Annotated[bool, typer.Option(help="Divide out the sensor's fixed pattern, as the views show it.")] = True,
    shared_camera: Annotated[bool, typer.Option(help="A folder's pictures are of one camera.")] = False,
    board: Annotated[str, typer.Option(help="Inner corners of a board in view, e.g. 9x6: gives millimetres.")] = "",
    square_mm: Annotated[float, typer.Option(help="Its squares.")] = 0.0,
    rescale: Annotated[
        bool, typer.Option("--rescale", help="Write an earlier world in metres too, by --board.")
    ] = False,
    seed: Annotated[int, typer.Option(help="Of RANSAC and of the mapper.")] = 1,
    threads: Annotated[int, typer.Option(help="Of features and matches; 0: one a core.")] = 0,
    sheet: Annotated[Path | None, typer.Option(help="A contact sheet of the scene written (.html).")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace earlier results; keep refused ones.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Estimate camera poses by COLMAP on sharp spike textures; several kinds are mapped, and must agree.

    A poor result is refused (exit 4) and not written, unless --force says so, which is recorded.
    """
    from spikerig.calib.mapping import Options
    from spikerig.calib.poses import Wanted

    # A folder's pictures are of unknown cameras and any size: COLMAP's own defaults.
    peak, off = (0.0067, 4.0) if source.is_dir() else (Options().peak_threshold, Options().max_error_px)
    off = off if max_error_px is None else max_error_px
    options = Options(
        peak if peak_threshold is None else peak_threshold, max_features, pairs=pairs, mapper=mapper, seed=seed,
        threads=threads, max_error_px=off, max_image_size=max_image_size, tries=tries,
    )  # fmt: skip
    if out is not None and (out / "poses.json").exists() and not force:
        raise UsageError("there is an earlier result", value=out / "poses.json", next="give --force to replace it")
    draw = None if sheet is None else _sheet(sheet, bool(write or write_to), force)
    if source.is_dir():
        if write or write_to:
            raise UsageError("--write is for scene files", value=source)
        told = _folder(source, out, options, shared_camera, min_share)
    else:
        if write and write_to:
            raise UsageError("give --write or --write-to, not both")
        listed = tuple(k for k in kinds.split(",") if k)
        wanted = Wanted(arms, listed, min(maps, len(listed)) if listed else maps, instants, min_share, off, pattern)
        sized = _board(board, square_mm)
        if rescale and (sized is None or not (write or write_to)):
            raise UsageError("--rescale needs --board, and --write or --write-to", value=source)
        told = _scene(source, out, wanted, options, write, write_to, force, sized, rescale)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "poses.json").write_text(json.dumps(told, indent=1), encoding="utf-8")
    refused = None
    if not told["accepted"] and not force:
        refused = RefusedError(
            "these poses are not good enough to keep",
            value="; ".join(told["reasons"]),
            cause="too little overlap or texture, too much blur, or too short a baseline",
            next="try --peak-threshold 0.0015, other --kinds, or capture more views; --force keeps them, and says so",
        )
    _tell(told)
    if draw is not None and told.get("written"):
        draw(Path(told["written"]))
    if as_json:
        emit("spikerig.calib.poses/1", told | ({"error": refused.as_json()} if refused else {}))
        raise typer.Exit(refused.exit_code if refused else 0)
    if refused:
        raise refused


def _sheet(out: Path, writes: bool, force: bool) -> Any:
    """What draws the contact sheet of the scene written; a wish that cannot be met is refused before the work."""
    from spikerig.calib.pose_sheet import write_sheet
    from spikerig.dataset.outfile import refuse_existing

    if not writes:
        raise UsageError("a sheet shows the scene that was written", value=out, next="give --write or --write-to")
    refuse_existing(out, force)
    return lambda scene: write_sheet(scene, out, force=force)


def _scene(
    source: Path,
    out: Path | None,
    wanted: Any,
    options: Any,
    write: bool,
    write_to: Path | None,
    force: bool,
    board: Any,
    rescale: bool,
) -> dict[str, Any]:
    from dataclasses import asdict

    from spikerig.calib.posed_scene import write_poses
    from spikerig.calib.poses import estimate_poses
    from spikerig.calib.straight import straight_of
    from spikerig.dataset.provenance import origin_of
    from spikerig.dataset.store import open_scene

    with open_scene(source) as scene:
        views = [scene.view(n) for n in scene.names]
        views = [v for v in views if v.spikes is not None or (wanted.arms == "rgb" and v.split == "train")]
        bar = Progress("mapping", 0, "steps")
        keep = None if out is None else out / "colmap"
        estimate = estimate_poses(
            views, scene.camera, wanted, options, straight=straight_of(scene), keep=keep,
            done=lambda step: bar.step(1, step),
        )  # fmt: skip
        known = {v.name: v.pose.cam_from_world for v in views}
        size = _size(views, estimate, scene.camera, board, straight_of(scene))
        origin = origin_of(scene, "h5py")
        simulated = scene.has_truth and "poses" not in scene.info
    told = report(estimate, options)
    told["source"] = str(source)
    told["wanted"] = asdict(wanted)
    told["board"] = size
    told["truth"] = against(estimate, known) if simulated else None
    told["forced"] = bool(estimate.reasons) and force
    if (write or write_to) and (told["accepted"] or force):
        left_out = ("poses", "source", "seconds")
        record = {k: v for k, v in told.items() if k not in left_out} | origin
        record["versions"] |= told["versions"]
        unit = size["mm_per_unit"] if size else None
        told |= write_poses(source, estimate, record, out=write_to, force=force, mm_per_unit=unit, rescale=rescale)
        _tell_world(told["world"], size)
    return told


def _tell_world(world: dict[str, Any], size: dict[str, Any] | None) -> None:
    metres, sure = world["metres_per_unit"], ""
    if size and size["mm_per_unit"]:
        sure = f" (+- {size['sd'] / size['mm_per_unit']:.1%}, by the board)"
    elif size:
        note(f"no metres by the board: {size['reason']}")
    unit = "its unit is of no known length" if metres is None else f"its unit is {metres:.4g} m{sure}"
    note(f"the world is that of {world['of']}; {unit}")


def _board(pattern: str, square_mm: float) -> Any:
    from spikerig.calib.boards import board_of

    if bool(pattern) != (square_mm > 0):
        raise UsageError("a board needs --board and --square-mm", value=(pattern, square_mm))
    return board_of(pattern, square_mm) if pattern else None


def _size(views: Any, estimate: Any, camera: Any, board: Any, straight: Any) -> dict[str, Any] | None:
    """Millimetres a unit of the estimate's world, or why not; None where no board was named."""
    from dataclasses import asdict

    from spikerig.calib.boards import find
    from spikerig.calib.poses import texture_at
    from spikerig.calib.scale import Scale, scale_of

    if board is None:
        return None
    seen = {
        v.name: find(texture_at(v, 0.5, "tfp128", None, straight).light, board)
        for v in views
        if v.name in estimate.poses
    }
    found = scale_of(estimate.poses, {n: f for n, f in seen.items() if f is not None}, camera, board)
    return asdict(found) if isinstance(found, Scale) else {"mm_per_unit": None, "reason": found}


def _folder(source: Path, out: Path | None, options: Any, shared: bool, min_share: float) -> dict[str, Any]:
    from spikerig.calib.mapping import build_map
    from spikerig.calib.poses import Estimate

    files = sorted(p for p in source.iterdir() if p.suffix.lower() in (".png", ".jpg", ".jpeg"))
    if not files:
        raise UsageError("no pictures in this folder", value=source, expected=".png, .jpg")
    stems = [p.stem for p in files]
    double = sorted({s for s in stems if stems.count(s) > 1})
    if double:
        raise UsageError("two pictures have the same stem", value=", ".join(double[:5]))
    bar = Progress("mapping", 0, "steps")
    keep = None if out is None else out / "colmap"
    pictures = {p.stem: p for p in files}
    more = {"separate_cameras": not shared, "keep": keep}
    found = build_map(pictures, None, options, **more, done=lambda step: bar.step(1, step))
    poses = {n: p.pose for n, p in found.poses.items()}
    reasons = ()
    if len(poses) < max(3, min_share * len(files)):
        lost = ", ".join(sorted(set(stems) - poses.keys())[:12])
        reasons = (f"only {len(poses)} of {len(files)} pictures were placed ({min_share:.0%} asked for); not: {lost}",)
    told = report(Estimate(tuple(stems), poses, {}, found, ("pictures",), reasons=reasons), options)
    return told | {"source": str(source), "truth": None, "forced": False}


def report(estimate: Any, options: Any) -> dict[str, Any]:
    """An estimate, JSON-ready."""
    from dataclasses import asdict

    from spikerig.dataset import machine

    best = estimate.best
    inliers = {n: p.inliers for n, p in best.poses.items()}
    return {
        "accepted": not estimate.reasons,
        "reasons": list(estimate.reasons),
        "registered": len(estimate.poses),
        "images": len(estimate.images),
        "not_registered": sorted(set(estimate.images) - estimate.poses.keys()),
        "models": list(best.models),
        "error_px": None if best.error_px != best.error_px else best.error_px,
        "points": len(best.xyz),
        "free_focal": dict(best.focal) or None,
        "weakest_link": None if best.link is None else {"points": best.link, "views": list(best.hanging)},
        "kinds": list(estimate.kinds),
        "textures": [
            {"kind": k.kind, "sharpness": k.sharpness, "noise": k.noise, "refound": k.refound, "spread_px": k.spread}
            for k in estimate.looked
        ],
        "pattern_sd": estimate.pattern_sd,
        "agreement": {
            "maps": estimate.agreeing[1],
            "agree": estimate.agreeing[0],
            "deg": estimate.agreement_deg,
            "share_of_extent": estimate.agreement_share,
        },
        "paths": len(estimate.paths),
        "paths_taken_still": sorted(n for n, p in estimate.paths.items() if p.chi2 is None),
        "path_chi2": {n: p.chi2 for n, p in sorted(estimate.paths.items()) if p.chi2 is not None},
        "observations": dict(sorted(inliers.items())),
        "residual_px": {n: p.error_px for n, p in sorted(best.poses.items()) if p.error_px is not None},
        "point_residuals": quantiles(best.error),
        "poses": {n: p.tolist() for n, p in sorted(estimate.poses.items())},
        "options": asdict(options),
        "versions": machine.describe()["versions"] | {"pycolmap": best.version},
        "seconds": dict(estimate.seconds or best.seconds),
    }


def quantiles(values: Any, count: int = 200) -> list[float]:
    """That many quantiles, evenly spread; all values where there are fewer."""
    import numpy as np

    at = np.sort(np.asarray(values, np.float64))
    return at.tolist() if len(at) <= count else np.quantile(at, (np.arange(count) + 0.5) / count).tolist()


def against(estimate: Any, known: dict[str, Any]) -> dict[str, Any] | None:
    """Errors against known poses, after the best similarity: median and largest degrees, and share of the extent."""
    import numpy as np

    from spikerig.calib.gauge import pose_errors
    from spikerig.dataset.errors import DataError

    shared = sorted(estimate.poses.keys() & known.keys())
    try:
        turned, moved = pose_errors(*(np.stack([m[n] for n in shared]) for m in (estimate.poses, known)))
    except (DataError, ValueError):
        return None
    within = int(np.sum((turned <= 1) & (moved <= 0.02)))
    return {
        "deg": {"median": float(np.median(turned)), "max": float(turned.max())},
        "share_of_extent": {"median": float(np.median(moved)), "max": float(moved.max())},
        "within_1deg_2percent": within,
    }


def _tell(told: dict[str, Any]) -> None:
    error = "" if told["error_px"] is None else f", residual {told['error_px']:.2f} px, {told['points']} points"
    note(f"{told['registered']} of {told['images']} views placed{error}; textures: {', '.join(told['kinds'])}")
    agreement = told["agreement"]
    if agreement["deg"] is not None:
        note(
            f"{agreement['agree']} of {agreement['maps']} maps agree, within {agreement['deg']:.2f} degrees and "
            f"{100 * agreement['share_of_extent']:.2f} % of the extent (medians)"
        )
    if told["truth"]:
        deg, share = told["truth"]["deg"], told["truth"]["share_of_extent"]
        note(f"against truth: {deg['median']:.2f} degrees, {100 * share['median']:.2f} % of the extent (medians)")
    if told["paths_taken_still"]:
        names = ", ".join(told["paths_taken_still"])
        note(f"no path over the exposure was measured for {names}: there the camera is taken to stand still, with an")
        note("uncertainty as large as the other views' motion")
    if told.get("wanted", {}).get("instants", 1) > 1 and not told["paths"]:
        note("no path over an exposure could be measured: methods that need one (average, spike-ratio) will not run")
    for name in told["not_registered"][:20]:
        note(f"not placed: {name}")
    if told.get("written"):
        note(f"{told['written']}: poses written{' although refused' if told['forced'] else ''}")
