"""Moving pictures without poses, as linear light over time: a video, a folder of pictures, or one that stands."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, NumericsError, UsageError
from spikerig.dataset.images import SUFFIXES
from spikerig.rigctl.sim.sources.pictures import Bad, as_report, check_mending, read_light

Picture = tuple[Fraction, NDArray[np.float32]]


@dataclass(slots=True)
class Moving:
    """A source of light.

    Args:
        kind: "video", "folder" or "picture".
        width, height: of what `pictures` gives.
        seconds: how long it is, None where that is not known before its end.
        last: how long the last picture lasts, seconds; set anew while a video is read.
        pictures: (seconds from the start, linear light float32[height,width,3]) in the order of time.
        close: releases the files.
        facts: what was found, assumed and mended, JSON-ready; complete after the last picture.
    """

    kind: str
    width: int
    height: int
    seconds: Fraction | None
    last: Fraction
    pictures: Iterator[Picture]
    close: Callable[[], object]
    facts: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Look:
    """How a source is looked at.

    Args:
        fps: pictures a second, in place of the source's own; needed for a folder.
        size: width and height to crop (in the middle) and resize to by an area filter; None keeps the source's.
        transfer: of a video's codes, or "auto".
        background: linear gray behind transparent pixels.
        layer: of EXR pictures.
        bad_values: as for `pictures.mend`.
    """

    fps: float | None = None
    size: tuple[int, int] | None = (400, 250)
    transfer: str = "auto"
    background: float | None = None
    layer: str = ""
    bad_values: str = "refuse"

    def __post_init__(self) -> None:
        check_mending(self.bad_values)
        if self.fps is not None and not 1e-3 <= self.fps <= 1e6:
            raise UsageError("no such frame rate", value=f"--fps {self.fps:g}", expected="0.001 to 1000000 a second")
        if self.size is not None and not all(1 <= n <= 8192 for n in self.size):
            raise UsageError("no such size", value=self.size, expected="1 to 8192 pixels a side")


def open_moving(path: str | Path, look: Look | None = None) -> Moving:
    """Open a video file, a folder of pictures in the order of their names, or a single picture.

    Raises:
        UsageError: nothing there; a folder without `fps`.
        DataError: no pictures, damaged ones, ones of different sizes; no video: now, or while they are read.
        HostError: a video, and PyAV is not installed.
    """
    path, look = Path(path), look or Look()
    if path.is_dir():
        return _folder(path, look)
    if not path.is_file():
        raise UsageError("there is no such source", value=path, expected="a video, a folder of pictures, or a picture")
    return _still(path, look) if path.suffix.lower() in SUFFIXES else _video(path, look)


def fitted(light: NDArray[np.float32], size: tuple[int, int] | None, aspect: float = 1.0) -> NDArray[np.float32]:
    """Light on `size` (width, height): cropped in the middle to its shape, then averaged over areas, in linear light.

    Args:
        light: float32[H,W,3].
        size: of the result, in square pixels; None leaves the picture as it is.
        aspect: width of a source pixel over its height.

    Edges:
        Where the picture has to grow it is interpolated.
    """
    height, width = light.shape[:2]
    if size is None or (size == (width, height) and aspect == 1):
        return light
    import cv2

    scale = max(size[0] / (width * aspect), size[1] / height)
    w, h = min(width, max(1, round(size[0] / scale / aspect))), min(height, max(1, round(size[1] / scale)))
    x, y = (width - w) // 2, (height - h) // 2
    part = np.ascontiguousarray(light[y : y + h, x : x + w])
    how = cv2.INTER_LINEAR if scale > 1 else cv2.INTER_AREA
    return np.maximum(cv2.resize(part, size, interpolation=how), 0)


def _read(file: Path, look: Look, bad: list[Bad]) -> NDArray[np.float32]:
    try:
        light, counts = read_light(file, background=look.background, layer=look.layer, how=look.bad_values)
    except NumericsError as error:
        raise NumericsError(
            error.what, value=f"{file.name}: {error.value}", next="--bad-values zero or clip mends them"
        ) from None
    bad.append(counts)
    return light


def _still(path: Path, look: Look) -> Moving:
    bad: list[Bad] = []
    light = fitted(_read(path, look, bad), look.size)
    facts = {"bad_values": as_report(look.bad_values, bad)}
    once = iter([(Fraction(0), light)])
    return Moving("picture", light.shape[1], light.shape[0], None, Fraction(0), once, lambda: None, facts)


def by_number(path: Path) -> list[Any]:
    """Sort key that puts `frame9` before `frame10`."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path.name)]


def _folder(root: Path, look: Look) -> Moving:
    files = sorted((p for p in root.iterdir() if p.suffix.lower() in SUFFIXES and p.name[0] != "."), key=by_number)
    if not files:
        raise DataError("the folder holds no pictures", value=root, expected=", ".join(SUFFIXES))
    if look.fps is None:
        raise UsageError("pictures do not say when they were taken", value=root, next="give --fps")
    period = 1 / Fraction(look.fps).limit_denominator(1_000_000)
    bad: list[Bad] = []
    first = _read(files[0], look, bad)
    bad.clear()  # it is read, and counted, again in its turn
    numbers = [int(found[-1]) for found in (re.findall(r"\d+", p.stem) for p in files) if found]
    missing = numbers[-1] - numbers[0] + 1 - len(numbers) if len(set(numbers)) == len(files) else 0
    facts: dict[str, Any] = {"pictures": len(files), "fps": look.fps, "missing_numbers": max(missing, 0)}

    def pictures() -> Iterator[Picture]:
        for k, file in enumerate(files):
            light = _read(file, look, bad)
            if light.shape != first.shape:
                (h, w), (h0, w0) = light.shape[:2], first.shape[:2]
                raise DataError("pictures of different sizes", value=f"{file}: {w}x{h}", expected=f"{w0}x{h0}")
            yield k * period, fitted(light, look.size)
        facts["bad_values"] = as_report(look.bad_values, bad)

    w, h = look.size or (first.shape[1], first.shape[0])
    return Moving("folder", w, h, len(files) * period, period, pictures(), lambda: None, facts)


def _video(path: Path, look: Look) -> Moving:
    from spikerig.rigctl.sim.sources.video import open_video

    if look.layer:
        raise UsageError("only EXR pictures have layers", value=f"{path}: {look.layer}")
    video = open_video(path, look.transfer)
    try:
        frames = video.frames()
        first = next(frames)
        rate = Fraction(look.fps).limit_denominator(1_000_000) if look.fps is not None else video.fps
        if rate is None and first[0] is None:
            raise DataError("the video says neither times nor a frame rate", value=path, next="give --fps")
    except BaseException:
        video.close()
        raise
    period = 1 / rate if rate else Fraction(1, 25)
    counted = look.fps is not None or first[0] is None
    facts = video.facts | {"fps": float(rate) if rate else None, "times": "frame rate" if counted else "file"}
    length = video.stream.frames * period if counted else video.seconds
    h0, w0 = first[1].shape[:2]
    w, h = look.size or (w0, h0)
    moving = Moving("video", w, h, Fraction(length) if length else None, period, iter(()), video.close, facts)

    def pictures() -> Iterator[Picture]:
        last, count, skipped = Fraction(-1), 0, 0
        for k, (said, light) in enumerate(chain([first], frames)):
            when = k * period if counted or said is None else said
            if light.shape[:2] != (h0, w0):
                size = f"{light.shape[1]}x{light.shape[0]}"
                raise DataError("the video changes its size", value=f"{path}: {size} at {float(when):.3f} s")
            if when <= last:
                skipped += 1  # not later than the frame before it
                continue
            moving.last = when - last if count and not counted else period
            last, count = when, count + 1
            yield when, fitted(light, look.size, video.pixel_aspect)
            facts.update(video.facts, pictures=count, skipped=skipped)

    moving.pictures = pictures()
    return moving
