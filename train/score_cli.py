"""`spikerig train score`: how good a run is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from spikerig.dataset.terminal import emit, note
from spikerig.train.cli import picture_folder


def score(
    run: Annotated[Path, typer.Argument(help="Folder of a run.")],
    scene: Annotated[Path | None, typer.Argument(help="Scene to score on; the run's own where not given.")] = None,
    ssim: Annotated[str, typer.Option(help="SSIM variant: torchmetrics, tf, skimage, inria.")] = "torchmetrics",
    pictures: Annotated[Path | None, typer.Option(help="Folder for the held-out renders, NAME.png.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace what is there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Score a run: PSNR, SSIM and luma PSNR of sharp held-out views, and of the training views' mid-exposure.

    Scenes without truth are scored on their held-out frames as stored, and the result says so.
    """
    from spikerig.dataset.images import write_image
    from spikerig.dataset.store import open_scene
    from spikerig.train.record import open_run, scene_hash
    from spikerig.train.score import score_run

    opened = open_run(run)
    path = opened.scene if scene is None else scene
    if pictures is not None:
        picture_folder(pictures, force)
    same = scene_hash(path) == opened.record["scene"]["sha256"] if path.exists() else True
    if not same:
        note(f"note: {path} is not the file this run was trained on")

    def keep(name: str, picture: Any) -> None:
        if pictures is not None:
            write_image(pictures / f"{name}.png", picture, force=True)

    with open_scene(path) as file:
        result = score_run(opened.model, file, ssim=ssim, keep=keep)
    result |= {"run": str(run), "scene": str(path), "scene_matches": same, "machine": opened.record["machine"]}
    result |= {key: opened.record.get(key) for key in ("steps", "train_seconds")}
    for label, key in (("novel view", "novel_view"), ("blur view", "blur_view")):
        if (part := result[key]) is not None:
            note(
                f"{label}: PSNR {part['psnr']:.2f} dB, luma {part['luma_psnr']:.2f}, SSIM {part['ssim']:.4f} "
                f"over {len(part['views'])} views, against {part['against']}"
            )
    note(f"method {result['method']}, pose label '{result['pose_label']}', SSIM {result['ssim_variant']}")
    if as_json:
        emit("spikerig.train.score/1", result)
