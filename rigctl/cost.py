"""`spikerig cost sim`: light samples an exposure, and rays a pixel, against the error they leave."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from spikerig.dataset import cost
from spikerig.dataset.texture_cost import finish

SUB_POSES = (2, 3, 5, 9, 18, 33, 65)
REFERENCE = 321
SAMPLES = (1, 2, 3, 4, 6)
FINEST = 12


def settings(scene: str, view: int) -> list[cost.Setting]:
    """Sub-poses an exposure (error of counts and of the picture), then rays a pixel (error of the sharp picture)."""
    import numpy as np

    from spikerig.dataset.kernels import count
    from spikerig.rigctl.sim.capture import camera_of, take_view, view_path
    from spikerig.rigctl.sim.light import Stage
    from spikerig.rigctl.sim.spec import load_scene_toml

    # Without noise, and with every pixel starting empty, what differs is the light alone.
    spec = replace(load_scene_toml(scene), effects=())
    stage = Stage(spec.world)
    lens = replace(spec.lens, samples=1)

    def take(n: int) -> Any:
        return take_view(replace(spec, lens=lens, exposure=replace(spec.exposure, sub_poses=n)), view, stage)

    def counts(taken: Any) -> Any:
        margin = spec.exposure.margin_ticks
        return count(taken.view.spikes.bits, lens.width, margin, margin + spec.exposure.ticks).astype(np.float64)

    finest = take(REFERENCE)
    fine_counts, fine_pixels = counts(finest), finest.view.frame.pixels.astype(np.float64)

    def spikes_off(taken: Any) -> float:
        return float(np.sqrt(np.mean((counts(taken) - fine_counts) ** 2)))

    def pixels_off(taken: Any) -> float:
        return float(np.sqrt(np.mean((taken.view.frame.pixels - fine_pixels) ** 2)))

    camera = camera_of(spec)
    pose = view_path(spec, view).poses(0.5)[0]
    truth = stage.picture(camera, pose, FINEST)

    def picture_off(picture: Any) -> float:
        return float(255 * np.sqrt(np.mean((np.clip(picture, 0, 1) - np.clip(truth, 0, 1)) ** 2)))

    poses = [cost.Setting("sub-poses: RMS spikes an exposure", n, lambda n=n: take(n), spikes_off) for n in SUB_POSES]
    poses += [cost.Setting("sub-poses: RMS of the frame, 8-bit", n, lambda n=n: take(n), pixels_off) for n in SUB_POSES]

    def cast(samples: int) -> Any:
        return stage.picture(camera, pose, samples)

    label = "rays along a pixel's side: RMS of 255 x linear light"
    return poses + [cost.Setting(label, s, lambda s=s: cast(s), picture_off) for s in SAMPLES]


def sim(
    scene: Annotated[str, typer.Option(help="A scene file, or the name of a built-in one.")] = "demo",
    view: Annotated[int, typer.Option(help="Which view to simulate.")] = 0,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder for NAME.json and NAME.svg.")] = None,
    repeats: Annotated[int, typer.Option(help="Timed runs of each setting.")] = 3,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier result.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Sweep light samples an exposure and rays a pixel: error against a far finer setting over seconds."""
    finish(
        "sim",
        lambda: cost.sweep(
            "sim",
            f"Simulating a view of '{scene}': light samples",
            settings(scene, view),
            knob="samples",
            error_unit="see series",
            reference=f"{REFERENCE} sub-poses; {FINEST}x{FINEST} rays a pixel",
            repeats=repeats,
        ),
        out,
        force,
        as_json,
    )
