"""`spikerig cost overexposure`: what spikes keep where RGB clips (the paper's Fig. 8), in numbers and a picture."""

from __future__ import annotations

import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from spikerig.dataset import machine
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.outfile import refuse_existing, whole_file
from spikerig.dataset.terminal import emit, note

if TYPE_CHECKING:
    from spikerig.dataset.scene import Floats
    from spikerig.dataset.store import SceneFile

# Rows of the table: a name, its method, and what is set beside it.
ROWS: dict[str, tuple[str, dict[str, Any]]] = {
    "plain": ("plain", {}),
    "spikenerf": ("spikenerf", {"highlights": "keep"}),
    "spike-ratio": ("spike-ratio", {}),
    "ours": ("ours", {}),
    "oracle": ("oracle", {"highlights": "keep"}),
}
MU = 5000.0  # of the mu-law, as HDR papers have it
SIGMA = 3.0  # pixels: detail is what a Gaussian of this width takes away
REC601 = np.array([0.299, 0.587, 0.114])
CROP = (70, 100)  # rows and columns of the picture's cells
ZOOM = 3
DIM = 1e-3  # light added before a logarithm


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """A held-out view: pose [3,4], linear light [H,W,3] that may be brighter than white."""

    name: str
    pose: Floats
    light: NDArray[np.float64]


def looks(scene: SceneFile) -> list[Look]:
    """The held-out views with their true light.

    Raises:
        DataError: the scene has no truth, no held-out views, or nothing brighter than white.
    """
    from spikerig.train.targets import truth_pose

    if not scene.has_truth or not scene.test:
        raise DataError(
            "this study needs held-out views and their truth", value=scene.name, next="spikerig sim capture"
        )
    found = [
        Look(n, truth_pose(scene, scene.view(n, spikes=False)), np.asarray(scene.truth_light(n), np.float64))
        for n in scene.test
    ]
    if not any(highlights(look.light).any() for look in found):
        raise DataError(
            "nothing in this scene is brighter than RGB white",
            value=scene.name,
            expected="a scene that overexposes its frames",
            next="spikerig sim capture docs/overexposure.toml -o overexposure.h5",
        )
    return found


def highlights(light: NDArray) -> NDArray[np.bool_]:
    """bool[H,W]: where a channel is brighter than white."""
    return np.asarray(light.max(-1) > 1)


def smooth(picture: NDArray, mask: NDArray) -> NDArray:
    """A picture [H,W] under a Gaussian of SIGMA pixels that sees the pixels of a mask only; 0 where it sees none."""
    reach = int(3 * SIGMA)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / SIGMA) ** 2)

    def both(x: NDArray) -> NDArray:
        for axis in (0, 1):
            x = np.apply_along_axis(lambda row: np.convolve(row, kernel, "same"), axis, x)
        return x

    return both(picture * mask) / both(mask * 1.0).clip(1e-9)


def mu_law(light: NDArray, peak: float) -> NDArray:
    """Light 0..peak on 0..1, dark parts stretched: log(1 + mu x) / log(1 + mu)."""
    return np.log1p(MU * np.clip(light / peak, 0, 1)) / np.log1p(MU)


def grade_light(pairs: list[tuple[NDArray, NDArray]]) -> dict[str, float]:
    """Numbers of (rendered, true) linear light [H,W,3], pooled over views.

    Returns:
        `mu_psnr` of all pixels, `mu_psnr_highlights` where the truth is brighter than white, both of the mu-law of all
        channels; `light_ratio`, the median of rendered over true gray there; `detail`, the correlation there of log
        gray less its own Gaussian (0: a white patch, 1: all of the truth's).
    """
    peak = max(float(true.max()) for _, true in pairs)
    squares, inside, ratios, details = [], [], [], ([], [])
    for made, true in pairs:
        error = (mu_law(made, peak) - mu_law(true, peak)) ** 2
        mask = highlights(true)
        grays = [np.clip(x, 0, None) @ REC601 for x in (made, true)]
        logs = [np.log(g + DIM) for g in grays]
        squares.append(error.ravel())
        inside.append(error[mask].ravel())
        ratios.append((grays[0] / grays[1].clip(DIM))[mask])
        for kept, log in zip(details, logs, strict=True):
            kept.append((log - smooth(log, mask))[mask])
    one, other = (np.concatenate(d) - np.concatenate(d).mean() for d in details)
    spread = float(np.sqrt((one**2).sum() * (other**2).sum()))
    return {
        "mu_psnr": float(-10 * np.log10(np.concatenate(squares).mean().clip(1e-12))),
        "mu_psnr_highlights": float(-10 * np.log10(np.concatenate(inside).mean().clip(1e-12))),
        "light_ratio": float(np.median(np.concatenate(ratios))),
        "detail": float((one * other).sum() / spread) if spread > 1e-9 else 0.0,
    }


def train_row(scene: Path, name: str, steps: int, preset: str, seed: int) -> tuple[dict[str, Any], list[NDArray]]:
    """Train a row of the table: its numbers, and the linear light of the held-out views as rendered."""
    import torch

    from spikerig.dataset.store import open_scene
    from spikerig.train.losses import linear_from_srgb
    from spikerig.train.methods import configure
    from spikerig.train.record import open_run
    from spikerig.train.run import run_fit

    method, changes = ROWS[name]
    config = configure(method, preset, steps=steps, seed=seed, **changes)
    with tempfile.TemporaryDirectory(prefix="spikerig-overexposure-") as folder:
        begin = time.process_time()
        done = run_fit(scene, config, Path(folder) / "run", eval_every=0)
        cpu = time.process_time() - begin
        model = open_run(Path(folder) / "run").model
        with open_scene(scene) as file:
            views = looks(file)
        drawn = [linear_from_srgb(torch.from_numpy(model.picture(v.pose)).double()).clamp(min=0).numpy() for v in views]
    pairs = [(made, view.light) for made, view in zip(drawn, views, strict=True)]
    numbers = {"row": name, "method": method, "set": changes, "psnr": done["psnr"], **grade_light(pairs)}
    return {**numbers, "cpu_seconds": cpu}, drawn


def sheet(views: list[Look], drawn: dict[str, list[NDArray]]) -> NDArray[np.uint8]:
    """The view with most highlights, cropped about them: a column a row of the table and the truth; above as a display
    shows it, below darkened until the brightest is white."""
    from spikerig.dataset.images import srgb8_from_linear

    k = int(np.argmax([highlights(v.light).sum() for v in views]))
    light = views[k].light
    rows, columns = (min(c, s) for c, s in zip(CROP, light.shape[:2], strict=True))
    middle = np.argwhere(highlights(light)).mean(0)
    top, left = (
        int(np.clip(m - size / 2, 0, whole - size))
        for m, size, whole in zip(middle, (rows, columns), light.shape[:2], strict=True)
    )
    cells = [pictures[k][top : top + rows, left : left + columns] for pictures in drawn.values()]
    cells.append(light[top : top + rows, left : left + columns])
    dark = 1 / float(np.percentile(cells[-1].max(-1), 99.5))
    lines = [[srgb8_from_linear(np.clip(gain * cell, 0, 1)) for cell in cells] for gain in (1.0, dark)]
    large = [[np.repeat(np.repeat(c, ZOOM, 0), ZOOM, 1) for c in line] for line in lines]
    gap = 4
    framed = [[np.pad(c, ((0, gap), (0, gap), (0, 0)), constant_values=255) for c in line] for line in large]
    return np.concatenate([np.concatenate(line, 1) for line in framed], 0)


def overexposure(
    scene: Annotated[Path, typer.Argument(help="A scene whose frames clip, e.g. of docs/overexposure.toml.")],
    methods: Annotated[str, typer.Option(help="Rows, with commas: " + ", ".join(ROWS) + ".")] = ",".join(ROWS),
    steps: Annotated[int, typer.Option(help="Of each fit.")] = 1500,
    preset: Annotated[str, typer.Option(help="Of each fit.")] = "draft",
    seed: Annotated[int, typer.Option(help="Of each fit.")] = 0,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder for overexposure.json and .png.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier result.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Train on overexposed frames: what of the light above white each method brings back."""
    from spikerig.dataset.images import write_image
    from spikerig.dataset.store import open_scene

    names = [name.strip() for name in methods.split(",")]
    if strange := [name for name in names if name not in ROWS]:
        raise UsageError("no such row", value=", ".join(strange), expected=", ".join(ROWS))
    if steps < 1:
        raise UsageError("a fit has at least one step", value=steps)
    files = [] if out is None else [out / "overexposure.json", out / "overexposure.png"]
    for file in files:
        refuse_existing(file, force)
    with open_scene(scene) as opened:
        views = looks(opened)
        clipped = float(np.mean([highlights(v.light).mean() for v in views]))
        frames = [(opened.view(n, spikes=False).frame.pixels8 > 250).any(-1).mean() for n in opened.train]
    rows, drawn = [], {}
    for name in names:
        row, drawn[name] = train_row(scene, name, steps, preset, seed)
        rows.append(row)
        note(
            f"{name}: mu-law PSNR {row['mu_psnr']:.2f} dB, in highlights {row['mu_psnr_highlights']:.2f} dB, light "
            f"{row['light_ratio']:.2f} of the truth's, detail {row['detail']:.2f}, {row['cpu_seconds']:.0f} CPU s"
        )
    doc = {
        "scene": str(scene), "steps": steps, "preset": preset, "seed": seed, "rows": rows,
        "frames_clipped": float(np.mean(frames)), "held_out_above_white": clipped,
        "brightest": max(float(v.light.max()) for v in views), "machine": machine.describe(),
        "command": machine.command(),
    }  # fmt: skip
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        with whole_file(files[0], force=force) as part:
            part.write_text(json.dumps({"schema": "spikerig.cost.overexposure/1", **doc}, indent=1) + "\n")
        write_image(files[1], sheet(views, drawn), force=force)
        note(f"columns of {files[1]}: {', '.join([*names, 'truth'])}; below, darkened until the brightest is white")
    if as_json:
        emit("spikerig.cost.overexposure/1", doc)
