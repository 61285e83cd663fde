"""Pictures of a trained scene along a path of cameras, laid out so that `spikerig sim frames` reads them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.rigid import between, compose, exp_se3, inverse
from spikerig.dataset.scene import Floats
from spikerig.dataset.terminal import progress
from spikerig.train.field import Model
from spikerig.train.layout import FILE, Layout, frame_row, is_layout, label_of, read_layout, write_layout

if TYPE_CHECKING:
    from spikerig.dataset.store import SceneFile

PATHS = ("test", "train", "orbit", "shake")
MARGIN = 0.2  # of the exposure, on both sides: half a texture window of 32 ticks fits even at 160 ticks an exposure
LOOKS = 65  # instants at which the length of a shake is measured


@dataclass(frozen=True, slots=True)
class Shot:
    """One picture to draw: its file inside the folder, and the camera."""

    file: str
    cam_from_world: Floats


def render_path(
    model: Model,
    scene: SceneFile,
    path: str,
    out: Path,
    *,
    suffix: str = "png",
    frames: int = 60,
    subframes: int = 18,
    shake_px: tuple[float, float] = (6.0, 11.0),
    seed: int = 0,
) -> list[str]:
    """Draw a model along a path and write the pictures.

    Args:
        model: what to draw.
        scene: whose views the paths test, train, orbit and shake go by.
        path: test, train, orbit, shake, or the name of a transforms.json: NeRF's list of frames, or a layout of
            views and sub-frames as in docs/sim_frames.md, which is drawn as it stands (its camera, its files).
        out: an existing folder; pictures in it are replaced.
        suffix: png (8-bit sRGB) or exr (linear light, clipped to 0..1 as the model's colours are); a layout names
            its files itself.
        frames: pictures of an orbit, >= 2.
        subframes: sub-exposures within an exposure of a shake, >= 2; the margins come on top.
        shake_px: range of the path length of the image centre over an exposure, pixels.
        seed: of the shake; view k draws from (seed, k).

    Returns:
        The files written, relative to `out`.

    Raises:
        UsageError: an unknown path, no such views, counts or lengths out of range.
        DataError: a transforms.json that is none.
    """
    if frames < 2 or subframes < 2 or not 0 <= shake_px[0] <= shake_px[1] <= 1000:
        raise UsageError(
            "counts are at least 2 and a shake goes from 0 to 1000 pixels, the smaller end first",
            value=f"--frames {frames} --subframes {subframes} --shake-px {shake_px[0]:g} {shake_px[1]:g}",
        )
    if path == "shake":
        return _shake(model, scene, out, suffix, subframes, shake_px, seed)
    if path.endswith(".json") and is_layout(record := _load(Path(path))):
        return _layout(model, read_layout(Path(path), record, model.camera), out)
    if path.endswith(".json") and Path(path).resolve() == (out / FILE).resolve():
        raise UsageError("the pictures' own transforms.json would replace this file", value=path, next="another folder")
    shots = list(_shots(model, scene, path, frames, suffix))
    for shot in progress(shots, "rendering", "picture"):
        _write(out / shot.file, model.picture(shot.cam_from_world))
    split = "test" if path == "test" else "train"
    views = [
        {"name": Path(s.file).stem, "split": split, "frames": [frame_row(s.file, s.cam_from_world)]} for s in shots
    ]
    return [*(shot.file for shot in shots), write_layout(out, model.camera, views)]


def _layout(model: Model, layout: Layout, out: Path) -> list[str]:
    """Every picture and depth of a layout, with its transforms.json."""
    seen = model.seen_by(layout.camera)
    for file, pose in progress(layout.pictures, "rendering", "picture"):
        (out / file).parent.mkdir(parents=True, exist_ok=True)
        _write(out / file, seen.picture(pose))
    for file, pose in layout.depths:
        (out / file).parent.mkdir(parents=True, exist_ok=True)
        _write_exr(out / file, seen.depth(pose))
    (out / FILE).write_text(json.dumps(layout.document, indent=1) + "\n", encoding="utf-8")
    return [*(file for file, _ in layout.pictures + layout.depths), FILE]


def _load(path: Path) -> Any:
    """What a JSON file holds; None where it cannot be read (whoever reads it next says why)."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None


def _shots(model: Model, scene: SceneFile, path: str, frames: int, suffix: str) -> Iterator[Shot]:
    if path in ("test", "train"):
        names = scene.test if path == "test" else scene.train
        if not names:
            raise UsageError(f"this scene has no views for {path}", value=scene.name)
        for name in names:
            yield Shot(f"{name}.{suffix}", scene.view(name, spikes=False).pose.cam_from_world)
    elif path == "orbit":
        for k, pose in enumerate(orbit(scene, frames)):
            yield Shot(f"{k:04d}.{suffix}", pose)
    elif path.endswith(".json"):
        from spikerig.dataset.posed import read_transforms

        posed = read_transforms(Path(path), model.camera.width, model.camera.height)
        for stem, pose in posed.poses.items():
            yield Shot(f"{stem}.{suffix}", pose.cam_from_world)
    else:
        raise UsageError("no such path", value=path, expected=", ".join(PATHS) + ", or a transforms.json")


def orbit(scene: SceneFile, frames: int) -> list[Floats]:
    """Poses [3,4] evenly spread (by number) along the views in their order, blended on SE(3)."""
    poses = [scene.view(name, spikes=False).pose.cam_from_world for name in scene.names]
    if not poses:
        raise UsageError("this scene has no views to go along", value=scene.name)
    at = np.linspace(0, len(poses) - 1, frames)
    k = np.minimum(at.astype(int), max(len(poses) - 2, 0))
    return [
        poses[0] if len(poses) == 1 else between(poses[i], poses[i + 1], float(u - i))
        for i, u in zip(k, at, strict=True)
    ]


def shake(model: Model, base: Floats, length_px: float, rng: np.random.Generator) -> Any:
    """A smooth hand shake around `base` as a function phase -> cam_from_world [3,4]; zero at phase 0.5.

    Three harmonics of rotation (mostly across the view) and translation with random phases, scaled so that the image
    centre travels `length_px` pixels over phases 0 to 1 at the depth of the scene's middle.
    """
    K, depth = model.camera.K, _depth_of_middle(model, base)
    size = np.array([1, 1, 0.3, 0.2, 0.2, 0.2]) * rng.normal(size=(3, 6)) / np.array([[1.0], [2.0], [4.0]])
    size[:, 3:] *= depth
    start = rng.uniform(0, 2 * np.pi, (3, 6))
    turns = np.array([[0.5], [1.0], [1.7]])

    def twist(phase: float) -> Floats:
        wave = np.sin(2 * np.pi * turns * phase + start) - np.sin(2 * np.pi * turns * 0.5 + start)
        return (size * wave).sum(0)

    def length(scale: float) -> float:
        middle = inverse(base)[:, :3] @ np.array([0, 0, depth]) + inverse(base)[:, 3]
        seen = []
        for phase in np.linspace(0, 1, LOOKS):
            pose = compose(exp_se3(scale * twist(phase)), base)
            x = pose[:, :3] @ middle + pose[:, 3]
            seen.append([K[0, 0] * x[0] / x[2], K[1, 1] * x[1] / x[2]])
        return float(np.linalg.norm(np.diff(seen, axis=0), axis=1).sum())

    small = 1e-3
    scale = small * length_px / max(length(small), 1e-12)  # the path is linear in small twists
    return lambda phase: compose(exp_se3(scale * twist(float(phase))), base)


def _depth_of_middle(model: Model, pose: Floats) -> float:
    """Depth of the scene's weighted middle in front of the camera, at least a tenth of the gauge's unit."""
    return max(float(pose[2, :3] @ model.middle() + pose[2, 3]), 0.1 / model.gauge.scale)


def _shake(
    model: Model, scene: SceneFile, out: Path, suffix: str, subframes: int, shake_px: tuple[float, float], seed: int
) -> list[str]:
    """Sub-exposures of every training view and the sharp picture of every held-out one, laid out for `sim frames`."""
    step = 1 / (subframes - 1)
    extra = int(np.ceil(MARGIN / step))
    phases = np.arange(-extra, subframes + extra) * step
    label = float(phases[label_of(phases)])
    views, files = [], []
    for k, name in enumerate(progress(scene.names, "rendering shaken views", "view")):
        base = scene.view(name, spikes=False).pose.cam_from_world
        if name in scene.test:
            files.append(f"{name}.{suffix}")
            _write(out / files[-1], model.picture(base))
            views.append({"name": name, "split": "test", "frames": [frame_row(files[-1], base)]})
            continue
        rng = np.random.default_rng(np.random.SeedSequence([seed, k]))
        path = shake(model, base, float(rng.uniform(*shake_px)), rng)
        (out / name).mkdir(exist_ok=True)
        shown = []
        for number, phase in enumerate(phases):
            file, pose = f"{name}/{number:03d}.{suffix}", path(phase)
            _write(out / file, model.picture(pose))
            shown.append({**frame_row(file, pose), "phase": float(phase)})
        depth = f"{name}/depth.exr"
        _write_exr(out / depth, model.depth(path(label)))
        files += [s["file"] for s in shown] + [depth]
        views.append({"name": name, "split": "train", "depth": depth, "frames": shown})
    return [*files, write_layout(out, model.camera, views)]


def _write(path: Path, codes: NDArray[np.float32]) -> None:
    from spikerig.dataset.images import linear_from_srgb, write_image

    if not np.all(np.isfinite(codes)):
        raise DataError("a render is not finite", value=path, next="train anew; the checkpoint holds broken numbers")
    codes = np.clip(codes, 0, 1)
    pixels = np.rint(codes * 255).astype(np.uint8) if path.suffix == ".png" else linear_from_srgb(codes)
    write_image(path, pixels if path.suffix == ".png" else np.asarray(pixels, np.float32), force=True)


def _write_exr(path: Path, light: NDArray[np.float32]) -> None:
    from spikerig.dataset.images import write_image

    write_image(path, light, force=True)
