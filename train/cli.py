"""The train verbs: fit and render (score and quality have files of their own)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from spikerig.dataset.errors import UsageError
from spikerig.dataset.terminal import emit, note

Json = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]
Force = Annotated[bool, typer.Option("--force", help="Replace what is there.")]


def fit(
    scene: Annotated[Path, typer.Argument(help="A scene file (.h5).")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder of the run.")],
    method: Annotated[
        str,
        typer.Option(help="Loss and camera model: plain, average, spikenerf, spikenerf-5x, spike-ratio, "
                     "spike-hybrid, ours, colour-spikes, oracle; baselines bad, edi, e2-2x, e2-5x, deblur, "
                     "mpr, d2net."),
    ] = "plain",
    field: Annotated[str, typer.Option(help="The model: splat, nerf (the paper's), nerf-fast (hash grid).")] = "splat",
    preset: Annotated[str, typer.Option(help="Effort: draft, standard, full; paper (field nerf).")] = "standard",
    steps: Annotated[int | None, typer.Option(help="Steps; the preset's where not given.")] = None,
    seconds: Annotated[float | None, typer.Option(help="Train for so long instead; scoring and saving aside.")] = None,
    splats: Annotated[int | None, typer.Option(help="How many, and at most.")] = None,
    seed: Annotated[int, typer.Option(help="Of every random draw.")] = 0,
    tfs_weight: Annotated[float | None, typer.Option(help="w of the TfS loss, in --weight-reading.")] = None,
    weight_reading: Annotated[
        str | None,
        typer.Option(help="What w multiplies: mean, sum-batch, sum-image, u8 (the paper does not say)."),
    ] = None,
    gray: Annotated[
        str | None, typer.Option(help="RGB to gray: calibrated, rec601, learned (the paper's), constrained, response.")
    ] = None,
    pose_label: Annotated[
        str | None, typer.Option(help="Pose a blurry view is labelled with: mid or first (of its exposure).")
    ] = None,
    poses_per_view: Annotated[int | None, typer.Option(help="Sub-poses averaged per view.")] = None,
    textures_per_view: Annotated[int | None, typer.Option(help="Instants with textures per view.")] = None,
    background: Annotated[str | None, typer.Option(help="black, white or random.")] = None,
    restorer: Annotated[
        Path | None, typer.Option(help="Deblurring network of mpr and d2net: TorchScript, or torch.export's .pt2.")
    ] = None,
    trust: Annotated[bool, typer.Option("--trust", help="Let the restorer run; it is a program, and runs as you.")]
    = False,
    device: Annotated[str, typer.Option(help="cpu, or cuda through gsplat (extra 'cuda').")] = "cpu",
    setting: Annotated[
        list[str] | None, typer.Option("--set", help="Any other setting as name=value; repeat as needed.")
    ] = None,
    threads: Annotated[int | None, typer.Option(help="Of the kernels; the result's bits do not depend on it.")] = None,
    eval_every: Annotated[
        float | None, typer.Option(help="Seconds of training between held-out scores; 0 for none. Default: a tenth.")
    ] = None,
    score_on: Annotated[
        Path | None, typer.Option(help="Scene whose held-out views make the curve; the scene itself where not given.")
    ] = None,
    points_of: Annotated[
        Path | None, typer.Option(help="Scene whose sparse points to start from; the scene itself where not given.")
    ] = None,
    checkpoint_every: Annotated[float, typer.Option(help="Seconds between checkpoints.")] = 60.0,
    ply: Annotated[bool, typer.Option("--ply", help="Also write splats.ply for 3DGS viewers.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the last checkpoint.")] = False,
    force: Force = False,
    as_json: Json = False,
) -> None:  # fmt: skip
    """Learn a scene from its blurry pictures and spikes.

    The run's folder gets run.json, history.json (held-out dB over training seconds) and checkpoint.safetensors. Same
    seed and steps give the same bits for any number of threads, also after a kill and --resume; a run that stops
    by seconds promises no bits.
    """
    from spikerig.train.config import parse_setting
    from spikerig.train.methods import configure
    from spikerig.train.run import run_fit

    given: dict[str, Any] = {
        "steps": steps, "seconds": seconds, "splats": splats, "tfs_weight": tfs_weight, "gray": gray,
        "weight_reading": weight_reading, "pose_label": pose_label, "poses_per_view": poses_per_view,
        "textures_per_view": textures_per_view, "background": background,
        "restorer": None if restorer is None else str(restorer), "trust": trust or None,
    }  # fmt: skip
    if steps is not None and seconds is not None:
        raise UsageError("a run ends by --steps or by --seconds, not both", value=f"{steps} steps, {seconds} s")
    changes = {name: value for name, value in given.items() if value is not None}
    changes |= dict(parse_setting(text) for text in setting or [])
    config = configure(method, preset, field=field, seed=seed, device=device, **changes)
    if threads is not None:
        from spikerig import _native

        try:
            _native.set_threads(threads)
        except ValueError as error:
            raise UsageError("no such number of threads", value=threads, expected="1 to 256") from error
    result = run_fit(
        scene, config, out,
        resume=resume, force=force, eval_every=eval_every, checkpoint_every=checkpoint_every, ply=ply,
        score_on=score_on, points_of=points_of,
    )  # fmt: skip
    if as_json:
        emit("spikerig.train.fit/1", result)


def render(
    run: Annotated[Path, typer.Argument(help="Folder of a run.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the pictures.")],
    path: Annotated[
        str,
        typer.Option(help="test, train, orbit, shake, or a transforms.json: NeRF's frames, or a layout of sub-frames."),
    ] = "test",
    format: Annotated[
        str | None, typer.Option(help="png (sRGB) or exr (linear light); exr for a shake, else png.")
    ] = None,
    frames: Annotated[int, typer.Option(help="Pictures of an orbit.")] = 60,
    subframes: Annotated[int, typer.Option(help="Sub-exposures of a view on a shake path.")] = 18,
    shake_px: Annotated[tuple[float, float], typer.Option(help="Length of a shake path, from and to, pixels.")] = (
        6.0,
        11.0,
    ),
    seed: Annotated[int, typer.Option(help="Of the shake.")] = 0,
    scene: Annotated[Path | None, typer.Option(help="Scene with the views; the run's own where not given.")] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Draw a run's scene along a path of cameras.

    Every folder gets a transforms.json that `spikerig sim frames` reads. `shake` writes sub-exposures of every view,
    shaken by a seeded hand, with phases, depth and the scene's split: spikes and blurry frames of a scene that moves.
    """
    from spikerig.dataset.store import open_scene
    from spikerig.train.record import open_run
    from spikerig.train.render import render_path

    format = format or ("exr" if path == "shake" else "png")
    if format not in ("png", "exr"):
        raise UsageError("no such picture format", value=format, expected="png or exr")
    opened = open_run(run)
    picture_folder(out, force)
    with open_scene(opened.scene if scene is None else scene) as file:
        written = render_path(
            opened.model, file, path, out,
            suffix=format, frames=frames, subframes=subframes, shake_px=shake_px, seed=seed,
        )  # fmt: skip
    note(f"{len(written) - 1} pictures in {out}, laid out in {written[-1]}")
    if as_json:
        emit("spikerig.train.render/1", {"run": str(run), "path": path, "folder": str(out), "pictures": written})


def picture_folder(folder: Path, force: bool) -> None:
    """Make a folder for pictures; one that holds files is refused unless `force`."""
    if folder.is_dir() and any(folder.iterdir()) and not force:
        raise UsageError("the folder holds files", value=folder, next="--force writes into it")
    folder.mkdir(parents=True, exist_ok=True)
