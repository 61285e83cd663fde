"""A researcher's spikes, pictures and poses become a scene: `spikerig data build`.

Spike files, pictures and poses are matched by stem. The poses say which views there are. Everything that does not fit
is listed at once, before anything is written.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DataError, RigError, UsageError
from spikerig.dataset.hull import hull_points
from spikerig.dataset.images import SUFFIXES, image_head, linear_from_srgb, read_image, srgb8_from_linear
from spikerig.dataset.posed import Posed, read_transforms
from spikerig.dataset.scene import Camera, Frame, Points, View
from spikerig.dataset.spikes import SpikeStream, open_spikes
from spikerig.dataset.store import NAME, SceneWriter
from spikerig.dataset.terminal import note, progress

SPIKE_SUFFIXES = (".dat", ".bin", ".npz", ".h5", ".raw")
_SHOWN = 20


@dataclass(frozen=True, slots=True)
class BuildConfig:
    """What to build from and how.

    Args:
        rgb, spikes: folders of pictures and of spike files; without spikes, a scene of pictures only.
        transforms, colmap: a transforms.json, or the folder of a COLMAP model: exactly one.
        rate_hz: ticks a second; None takes each file's own.
        exposure_us: of the pictures, centred in their spikes; None: as long as the spikes.
        height, width, row_bits, axes: layout of raw spike files, as for `open_spikes`.
        test_every: every how-manyth view is held out, from the first; 0: none, 1: all.
        background: gray behind transparent pixels, encoded, 0 black to 1 white; None: transparency is a fault.
        resize: bring pictures of another size to that of the spikes, by area average of linear light.
        size: (width, height) of the scene, where there are no spikes to say it; pictures are brought to it.
        skip_unmatched: leave out what has no partner instead of refusing.
        name: of the scene; None takes the file's stem.
    """

    rgb: Path
    spikes: Path | None = None
    transforms: Path | None = None
    colmap: Path | None = None
    rate_hz: float | None = None
    exposure_us: float | None = None
    height: int | None = None
    width: int | None = None
    row_bits: int | None = None
    axes: str | None = None
    test_every: int = 0
    background: float | None = None
    resize: bool = False
    size: tuple[int, int] | None = None
    skip_unmatched: bool = False
    name: str | None = None


@dataclass(slots=True)
class Plan:
    """What will be written: the posed camera, and per view its name, picture, spike file (None: held out without)."""

    posed: Posed
    camera: Camera
    views: list[tuple[str, Path, Path | None, str]]
    notes: list[str] = field(default_factory=list)


def build_scene(config: BuildConfig, out: str | Path, *, force: bool = False) -> dict[str, Any]:
    """Build a scene file.

    Returns:
        What was made, JSON-ready: counts, size, notes, checksum.

    Raises:
        DataError: files do not fit together; all faults are listed.
        UsageError: an option is missing or wrong, or the scene exists.
    """
    plan = plan_scene(config)
    for line in plan.notes:
        note(line)
    info = {
        "made_by": "spikerig data build",
        "poses": plan.posed.source,
        "exposure": "as long as the spikes" if config.exposure_us is None else f"{config.exposure_us} us, centred",
        "background": config.background,
        "resized": config.resize,
        "notes": plan.notes,
    }
    name = config.name or Path(out).stem
    points = plan.posed.points or _silhouette_points(plan)
    with SceneWriter(out, name, plan.camera, info=info, points=points, force=force, keep=False) as writer:
        for view_name, picture, spikes, split in progress(plan.views, "building the scene", "view"):
            writer.add(_view(config, plan, view_name, picture, spikes, split))
    from spikerig.dataset.store import open_scene

    with open_scene(out) as made:
        return {"scene": str(out), **made.describe(), "notes": plan.notes}


def _silhouette_points(plan: Plan) -> Points | None:
    """Points inside all silhouettes, where every training picture has an alpha; None elsewhere."""
    train = [(name, picture) for name, picture, _, split in plan.views if split == "train"]
    if not train or not all(image_head(picture).alpha for _, picture in train):
        return None
    rgba = [read_image(picture) for _, picture in progress(train, "reading silhouettes", "picture")]
    if any(picture.dtype != np.uint8 for picture in rgba):
        return None
    try:
        return hull_points(plan.camera, [plan.posed.poses[name] for name, _ in train], rgba)
    except DataError as error:  # points are a starting guess: a scene without them is a scene
        note(f"no points: {error.what}")
        plan.notes.append(f"no points: {error.what}")
        return None


def plan_scene(config: BuildConfig) -> Plan:
    """Match files and check everything that can be checked without reading spikes; see `build_scene`."""
    _check_options(config)
    pictures, faults = _listed(config.rgb, SUFFIXES)
    streams, more = _listed(config.spikes, SPIKE_SUFFIXES) if config.spikes is not None else ({}, [])
    faults += more
    if not pictures:
        raise UsageError("no pictures in this folder", value=config.rgb, expected=", ".join(SUFFIXES))
    head = image_head(next(iter(pictures.values())))
    posed = _posed(config, head.width, head.height)
    order = sorted(posed.poses, key=natural)
    held = {stem for i, stem in enumerate(order) if config.test_every and i % config.test_every == 0}
    notes: list[str] = []
    lonely = [f"{stem}: a pose, but no picture" for stem in order if stem not in pictures]
    bare = set(order) if config.spikes is None else held
    lonely += [f"{stem}: a pose, but no spikes" for stem in order if stem not in streams and stem not in bare]
    lonely += [
        f"{path.name}: no pose" for stem, path in (*pictures.items(), *streams.items()) if stem not in posed.poses
    ]
    if config.skip_unmatched:
        notes += [f"left out: {line}" for line in lonely]
    else:
        faults += lonely
    whole = [s for s in order if s in pictures and (s in streams or s in bare)]
    faults += [f"{stem!r}: not a view's name (letters, digits, - _ .)" for stem in whole if not NAME.fullmatch(stem)]
    if not whole:
        faults.append("nothing has a picture, spikes and a pose")
    camera, sized = _fit_camera(config, posed.camera, [(s, pictures[s]) for s in whole], streams)
    faults += sized
    if faults:
        shown = faults[:_SHOWN] + ([f"and {len(faults) - _SHOWN} more"] if len(faults) > _SHOWN else [])
        raise DataError(
            f"{len(faults)} things do not fit together",
            value="\n    " + "\n    ".join(shown),
            expected="pictures, spike files and poses of the same stems and sizes",
            next="mend them; --skip-unmatched leaves out what has no partner, --resize fits pictures to the spikes",
        )
    views = [(s, pictures[s], streams.get(s), "test" if s in held else "train") for s in whole]
    return Plan(posed, camera, views, notes)


def natural(stem: str) -> list[tuple[int, int | str]]:
    """Sort key that puts r_2 before r_10."""
    return [(0, int(w)) if w.isdigit() else (1, w) for w in re.split(r"(\d+)", stem) if w]


def _check_options(config: BuildConfig) -> None:
    if (config.transforms is None) == (config.colmap is None):
        raise UsageError("give the poses once", expected="--transforms FILE or --colmap FOLDER")
    if config.test_every < 0:
        raise UsageError("--test-every N holds out each Nth view", value=config.test_every, expected="0 or more")
    if config.exposure_us is not None and not 0 <= config.exposure_us < 1e9:
        raise UsageError("an exposure is at least 0", value=f"{config.exposure_us} us")
    if config.background is not None and not 0 <= config.background <= 1:
        raise UsageError("a background is a gray from 0 (black) to 1 (white)", value=config.background)
    if config.size is not None and (config.spikes is not None or min(config.size) < 1):
        raise UsageError("--size is for scenes of pictures only: spikes say the size", value=config.size)
    for folder in (config.rgb, config.spikes):
        if folder is not None and not folder.is_dir():
            raise UsageError("there is no such folder", value=folder)


def _listed(folder: Path, suffixes: Sequence[str]) -> tuple[dict[str, Path], list[str]]:
    found: dict[str, Path] = {}
    faults: list[str] = []
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in suffixes and not path.name.startswith("."):
            if path.stem in found:
                faults.append(f"{path.name}: the same stem as {found[path.stem].name}")
            found[path.stem] = path
    return found, faults


def _posed(config: BuildConfig, width: int, height: int) -> Posed:
    if config.transforms is not None:
        posed = read_transforms(config.transforms, width, height)
    else:
        from spikerig.dataset.colmap_model import read_colmap

        posed = read_colmap(config.colmap or Path())
    camera = posed.camera
    if (camera.width, camera.height) != (width, height):
        raise DataError(
            "the pictures are not of the size that the poses' camera says",
            value=f"{width} x {height}",
            expected=f"{camera.width} x {camera.height}",
            cause="pictures resized after the poses were found",
        )
    if camera.distortion.any():
        raise DataError(
            "the poses' camera has lens distortion, and spikes cannot be undistorted here",
            value=f"{camera.distortion.tolist()}: {_bend(camera):.2f} pixels at the corner",
            expected="a pinhole camera",
            next="undistort pictures before simulating spikes, or find poses with a PINHOLE camera; "
            "recordings of a real rig go through calibration instead",
        )
    return posed


def _bend(camera: Camera) -> float:
    """How far the distortion moves the first pixel's corner, in pixels (radial terms only)."""
    x, y = -camera.K[0, 2] / camera.K[0, 0], -camera.K[1, 2] / camera.K[1, 1]
    r2 = x * x + y * y
    k1, k2, *_ = [*camera.distortion, 0.0, 0.0]
    return float(np.hypot(x * camera.K[0, 0], y * camera.K[1, 1]) * abs(k1 * r2 + k2 * r2 * r2))


def _fit_camera(
    config: BuildConfig, camera: Camera, pictures: list[tuple[str, Path]], streams: dict[str, Path]
) -> tuple[Camera, list[str]]:
    """The scene's camera, of the spikes' size, and what is wrong with sizes, rates and lengths."""
    faults: list[str] = []
    target: tuple[int, int] | None = config.size
    for stem, picture in pictures:
        faults += _told(picture.name, lambda p=picture: _picture_faults(config, p, camera))
        if stem not in streams:
            continue
        path = streams[stem]
        try:
            with _open(config, path) as file:
                target = target or (file.width, file.height)
                if (file.width, file.height) != target:
                    faults.append(f"{path.name}: {file.width} x {file.height}, others are {target[0]} x {target[1]}")
                if file.rate_hz is None:
                    faults.append(f"{path.name}: does not say its rate: give --rate-hz")
                elif config.exposure_us is not None and file.ticks / file.rate_hz < config.exposure_us * 1e-6:
                    faults.append(f"{path.name}: {file.ticks} ticks are shorter than the exposure")
        except RigError as error:
            faults.append(f"{path.name}: {error.what} {error.value or ''} {error.next}".rstrip())
    if target is None or target == (camera.width, camera.height):
        return camera, faults
    sx, sy = target[0] / camera.width, target[1] / camera.height
    if not config.resize and config.size is None:
        size = f"{camera.width} x {camera.height}"
        faults.append(f"the pictures are {size}, the spikes {target[0]} x {target[1]}: --resize brings them together")
    elif abs(camera.width * sy - target[0]) > 1:
        faults.append(f"pictures {camera.width} x {camera.height} and {target[0]} x {target[1]} differ in shape")
    scaled = np.diag([sx, sy, 1.0]) @ camera.K  # pixel centres at +0.5: a resize is a plain scaling
    return Camera(scaled, np.zeros(0), *target), faults


def _told(name: str, check) -> list[str]:
    try:
        return check()
    except RigError as error:
        return [f"{name}: {error.what}"]


def _picture_faults(config: BuildConfig, path: Path, camera: Camera) -> list[str]:
    head = image_head(path)
    if (head.width, head.height) != (camera.width, camera.height):
        return [f"{path.name}: {head.width} x {head.height}, others are {camera.width} x {camera.height}"]
    if head.alpha and config.background is None:
        return [f"{path.name}: has alpha: say what lies behind it with --background black|white"]
    return []


def _open(config: BuildConfig, path: Path):
    raw = path.suffix.lower() in (".dat", ".raw")
    return open_spikes(
        path,
        height=config.height if raw else None,
        width=config.width if raw else None,
        row_bits=config.row_bits if raw else None,
        axes=config.axes if path.suffix.lower() == ".npz" else None,
        rate_hz=config.rate_hz,
    )


def _view(config: BuildConfig, plan: Plan, name: str, picture: Path, spikes: Path | None, split: str) -> View:
    camera = plan.camera
    stream: SpikeStream | None = None
    if spikes is not None:
        with _open(config, spikes) as file:
            stream = file.read()
    start_ns, exposure_ns = 0, round((config.exposure_us or 0) * 1000)
    if stream is not None and stream.rate_hz is not None:
        whole_ns = round(stream.ticks / stream.rate_hz * NS)
        exposure_ns = whole_ns if config.exposure_us is None else exposure_ns
        start_ns = stream.t0_ns + (whole_ns - exposure_ns) // 2
    pixels = _pixels(config, picture, camera.width, camera.height)
    frame = Frame(pixels, "srgb", start_ns, exposure_ns, 0, stream.clock if stream is not None else "rig")
    rows = np.repeat(np.arange(camera.height, dtype=np.float32)[:, None], camera.width, 1)
    valid = np.ones((camera.height, camera.width), bool)
    split_as = "test" if split == "test" else "train"
    return View(name, frame, stream, rows, valid, plan.posed.poses[name], None, split_as)


def _pixels(config: BuildConfig, path: Path, width: int, height: int) -> NDArray[np.uint8]:
    """A picture as sRGB codes uint8[H,W,3] of the scene's size; untouched where it is that already."""
    pixels = read_image(path)
    if pixels.shape[2] == 1:
        pixels = np.repeat(pixels, 3, 2)
    if pixels.dtype == np.uint8 and pixels.shape == (height, width, 3):
        return pixels
    if pixels.dtype == np.float32:
        codes = pixels[:, :, :3] if pixels.shape[2] == 3 else _over(config, path, pixels, premultiplied=True)
        linear = codes
    else:
        codes = pixels / np.iinfo(pixels.dtype).max
        codes = codes if pixels.shape[2] == 3 else _over(config, path, codes, premultiplied=False)
        if codes.shape[:2] == (height, width):
            return np.rint(codes * 255).astype(np.uint8)
        linear = linear_from_srgb(codes)
    return srgb8_from_linear(area_resize(np.asarray(linear, np.float32), width, height))


def _over(config: BuildConfig, path: Path, rgba: NDArray[Any], premultiplied: bool) -> NDArray[Any]:
    """Colours over the stated background: encoded for an encoded picture (as NeRF does), linear for an EXR."""
    alpha = rgba[:, :, 3:]
    if config.background is None:
        if np.all(alpha == 1):
            return rgba[:, :, :3]
        raise UsageError("the picture is transparent: say what lies behind it", value=path, next="give --background")
    behind = float(linear_from_srgb(config.background)) if premultiplied else config.background
    return rgba[:, :, :3] * (1 if premultiplied else alpha) + behind * (1 - alpha)


def area_resize(light: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Resize linear light [H,W,3] by area average (exact box filter downwards); same size: unchanged."""
    if light.shape[:2] == (height, width):
        return light
    import cv2

    smaller = width <= light.shape[1] and height <= light.shape[0]
    way = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(light, (width, height), interpolation=way), np.float32)
