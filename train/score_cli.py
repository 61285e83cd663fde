"""`spikerig train score`: how good a run is."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.terminal import emit, note
from spikerig.train.cli import picture_folder
from spikerig.train.quality_cli import BrisqueModel, BrisqueRange, Lpips, RankIqa, Trust, judges_of

if TYPE_CHECKING:
    from spikerig.train.bridge import Cameras
    from spikerig.train.record import Run


def score(
    run: Annotated[Path, typer.Argument(help="Folder of a run.")],
    scene: Annotated[Path | None, typer.Argument(help="Scene to score on; the run's own where not given.")] = None,
    ssim: Annotated[str, typer.Option(help="SSIM variant: torchmetrics, tf, skimage, inria.")] = "torchmetrics",
    align_steps: Annotated[
        int | None,
        typer.Option(help="Also score with each held-out camera moved onto its picture, in so many steps; 0: not. "
                     "Default: 60 where poses are estimates."),
    ] = None,
    quality: Annotated[
        bool, typer.Option("--quality", help="Also measure renders without a reference; always done without truth.")
    ] = False,
    brisque_model: BrisqueModel = None,
    brisque_range: BrisqueRange = None,
    rankiqa: RankIqa = None,
    lpips: Lpips = None,
    trust: Trust = False,
    pictures: Annotated[Path | None, typer.Option(help="Folder for the held-out renders, NAME.png.")] = None,
    nerfbaselines: Annotated[
        Path | None, typer.Option(help="Folder for predictions and results.json as nerfbaselines lays them out.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Write into --pictures although it holds files.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:  # fmt: skip
    """Score a run: PSNR, SSIM, luma PSNR, LPIPS of sharp held-out views, and of the training views' mid-exposure.

    Scenes without truth are scored on their held-out frames as stored, and the result says so. Where poses are
    estimates, held-out ones are brought over by the training cameras alone, and scored raw and, apart, aligned.
    """
    from spikerig.dataset.images import write_image
    from spikerig.dataset.store import open_scene
    from spikerig.train.record import open_run, scene_hash
    from spikerig.train.score import score_run

    if align_steps is not None and not 0 <= align_steps <= 10_000:
        raise UsageError("no such number of steps", value=align_steps, expected="0 to 10000")
    if nerfbaselines is not None and nerfbaselines.exists():
        raise UsageError("there are results already", value=nerfbaselines, next="give another folder")
    judges = judges_of(brisque_model, brisque_range, rankiqa, lpips, trust)
    opened = open_run(run)
    path = opened.scene if scene is None else scene
    if pictures is not None:
        picture_folder(pictures, force)
    same = scene_hash(path) == opened.record["scene"]["sha256"] if path.exists() else True
    if not same:
        note(f"note: {path} is not the file this run was trained on")
    renders: dict[str, Any] = {}

    def keep(name: str, picture: Any) -> None:
        renders[name] = picture
        if pictures is not None:
            write_image(pictures / f"{name}.png", picture, force=True)

    trained, estimated = trained_cameras(opened)
    with open_scene(path) as file:
        result = score_run(
            opened.model, file, ssim=ssim, judges=judges, trained=trained, estimated=estimated,
            align_steps=align_steps, quality=quality, keep=keep,
        )  # fmt: skip
        if nerfbaselines is not None:
            result["nerfbaselines"] = str(_write(nerfbaselines, opened, file, renders, judges))
    result |= {"run": str(run), "scene": str(path), "scene_matches": same, "machine": opened.record["machine"]}
    result |= {key: opened.record.get(key) for key in ("steps", "train_seconds")}
    _tell(result)
    if as_json:
        emit("spikerig.train.score/1", result)


def trained_cameras(run: Run) -> tuple[Cameras | None, bool]:
    """The cameras [3,4] that a run was trained with, by name, and whether they are estimates.

    A run that moved its cameras records them as `cameras` in run.json; of others they are those of its scene, and
    None where that file is gone.
    """
    import numpy as np

    from spikerig.dataset.store import open_scene
    from spikerig.train.bridge import estimated_poses, stored_cameras

    if (moved := run.record.get("cameras")) is not None:
        try:
            found = {str(name): np.array(pose, np.float64).reshape(3, 4) for name, pose in moved.items()}
        except (AttributeError, TypeError, ValueError) as error:
            raise DataError("the run's cameras are damaged", value=run.folder, cause=repr(error)) from error
        if not all(np.isfinite(pose).all() for pose in found.values()):
            raise DataError("the run's cameras are not finite", value=run.folder)
        return found, True
    if not run.scene.exists():
        note(f"note: {run.scene} is gone, so poses are taken to be of the world the run was trained in")
        return None, False
    with open_scene(run.scene) as scene:
        return stored_cameras(scene), estimated_poses(scene)


def _write(out: Path, run: Run, scene: Any, renders: dict[str, Any], judges: Any) -> Path:
    from spikerig.train.model import BACKGROUNDS
    from spikerig.train.nerfbaselines import write_results
    from spikerig.train.record import CHECKPOINT, scene_hash
    from spikerig.train.score import novel_views

    truth = {exam.name: exam.picture for exam in novel_views(scene)[0]}
    if not truth:
        raise DataError("nerfbaselines scores held-out views, and this scene has none", value=scene.name)
    config = run.config
    about = {
        "method": f"spikerig-{config.field}-{config.method}",
        "dataset": "rs-3d",
        "scene": scene.name,
        "steps": run.record.get("steps"),
        "seconds": run.record.get("train_seconds"),
        "config": config.as_json(),
        "checkpoint_sha256": scene_hash(run.folder / CHECKPOINT),
        "background": [round(255 * x) for x in BACKGROUNDS[config.background]],
    }
    return write_results(out, [(name, renders[name], truth[name]) for name in truth], about, judges.lpips)


def _tell(result: dict[str, Any]) -> None:
    for label, key in (
        ("novel view", "novel_view"), ("novel view, cameras aligned to it", "novel_view_aligned"),
        ("blur view", "blur_view"),
    ):  # fmt: skip
        if (part := result[key]) is not None:
            shown = [
                f"{name} {part[k]:{form}}" + unit
                for k, name, form, unit in (
                    ("psnr", "PSNR", ".2f", " dB"), ("luma_psnr", "luma", ".2f", ""), ("ssim", "SSIM", ".4f", ""),
                    ("lpips", "LPIPS", ".4f", ""),
                )
                if part[k] is not None
            ]  # fmt: skip
            note(f"{label}: {', '.join(shown)} over {len(part['views'])} views, against {part['against']}")
    if (alone := result["quality"]) is not None:
        shown = ", ".join(f"{name} {each['mean']:.4g}" for name, each in alone["mean"].items())
        note(f"{alone['of']}: {shown}")
    if result["worlds"] is not None and not result["worlds"]["same_world"]:
        near = result["worlds"]
        apart = (
            f"{near['apart_deg_median']:.3f} degrees, {100 * near['apart_share_of_extent_median']:.2f} % of the extent"
        )
        note(f"poses brought over by {near['training_cameras']} training cameras, which are apart by {apart} (medians)")
    for remark in result["remarks"]:
        note(f"note: {remark}")
    note(f"method {result['method']}, pose label '{result['pose_label']}', SSIM {result['ssim_variant']}")
