"""What the operator shot: two folders, paired, and each file as a picture in which a board can be sought."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.build import SPIKE_SUFFIXES, natural
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.images import SUFFIXES, linear_from_srgb, read_image
from spikerig.dataset.spikes import SpikeFile, open_spikes
from spikerig.dataset.texture import tfp

STILL_PX = 0.2  # a short window whose picture has moved this far no longer counts towards the average


@dataclass(frozen=True, slots=True)
class Pair:
    """The two files of a view."""

    name: str
    spike: Path
    rgb: Path


@dataclass(frozen=True, slots=True)
class Reading:
    """How files become pictures.

    Args:
        height, width, row_bits, axes: layout of raw spike files, as for `open_spikes`.
        at: the instant in ticks; None: the middle of the file.
        window: ticks of a short texture.
        windows: how many of them are averaged at most, as long as the picture stays still.
    """

    height: int | None = None
    width: int | None = None
    row_bits: int | None = None
    axes: str | None = None
    at: float | None = None
    window: int = 128
    windows: int = 8


def pair_up(spike_dir: Path, rgb_dir: Path) -> tuple[list[Pair], str]:
    """Pairs of the files of two folders in natural order, and by what they were paired.

    By equal stem where any stem is shared; else by the last number of the stem where that is one to one (cam0_7 with
    cam1_7); else by order, where the folders hold equally many.

    Raises:
        UsageError: a folder is absent or empty, or nothing pairs the files.
    """
    both = [files_in(folder) for folder in (spike_dir, rgb_dir)]
    keys: tuple[tuple[str, Callable[[str], str | None]], ...] = (("stem", lambda s: s), ("number", _last_number))
    for how, key in keys:
        first, second = ({key(p.stem): p for p in files} for files in both)
        shared = [k for k in first if k is not None and k in second]
        whole = how == "stem" or (len(first), len(second)) == (len(both[0]), len(both[1]))
        if shared and whole:
            names = sorted((first[k].stem, k) for k in shared)
            pairs = [Pair(stem, first[k], second[k]) for stem, k in names]
            return sorted(pairs, key=lambda p: natural(p.name)), how
    if len(both[0]) != len(both[1]):
        raise UsageError(
            "the two folders' files do not pair up",
            value=f"{len(both[0])} in {spike_dir}, {len(both[1])} in {rgb_dir}, no stem in common",
            expected="equal stems, e.g. spike/07.dat and rgb/07.png", next="rename them, view by view",
        )  # fmt: skip
    return [Pair(a.stem, a, b) for a, b in zip(*both, strict=True)], "order"


def unpaired(pairs: Sequence[Pair], spike_dir: Path, rgb_dir: Path) -> list[str]:
    """Names of the files of two folders that are in no pair, as folder/name."""
    taken = {path for pair in pairs for path in (pair.spike, pair.rgb)}
    return [f"{p.parent.name}/{p.name}" for folder in (spike_dir, rgb_dir) for p in files_in(folder) if p not in taken]


def files_in(folder: Path) -> list[Path]:
    """Pictures and spike files of a folder in natural order; no stem may occur twice."""
    if not folder.is_dir():
        raise UsageError("there is no such folder", value=folder)
    kinds = (*SUFFIXES, *SPIKE_SUFFIXES)
    found = [p for p in folder.iterdir() if p.is_file() and p.suffix.lower() in kinds and not p.name.startswith(".")]
    if not found:
        raise UsageError("the folder holds no pictures and no spike files", value=folder, expected=" ".join(kinds))
    stems: dict[str, list[str]] = {}
    for p in found:
        stems.setdefault(p.stem, []).append(p.name)
    twice = [names for names in stems.values() if len(names) > 1]
    if twice:
        raise UsageError("files share a stem", value="; ".join(", ".join(sorted(t)) for t in twice[:5]),
                         next="keep one of each")  # fmt: skip
    return sorted(found, key=lambda p: natural(p.stem))


def _last_number(stem: str) -> str | None:
    numbers = re.findall(r"\d+", stem)
    return str(int(numbers[-1])) if numbers and len(numbers[-1]) < 20 else None


def read_light(path: Path, reading: Reading) -> NDArray[np.float32]:
    """A picture or a spike file's texture as linear gray light, float32[H,W]; pictures are taken to be sRGB.

    Raises:
        DataError: the file is damaged, or its spikes are too short or lost.
    """
    if path.suffix.lower() in SUFFIXES:
        pixels = read_image(path)[:, :, :3]
        linear = pixels if pixels.dtype == np.float32 else linear_from_srgb(pixels)
        return linear.mean(2, dtype=np.float32)
    with open_reading(path, reading) as file:
        return still_light(file, reading)


def open_reading(path: Path, reading: Reading) -> SpikeFile:
    """Open a spike file; the layout is given only to files that do not say theirs."""
    kind = path.suffix.lower()
    if kind in (".npz", ".h5"):
        return open_spikes(path, axes=reading.axes if kind == ".npz" else None)
    return open_spikes(path, height=reading.height, width=reading.width, row_bits=reading.row_bits)


def still_light(file: SpikeFile, reading: Reading) -> NDArray[np.float32]:
    """Light of short windows around an instant, averaged as long as the picture stays still; float32[H,W].

    Windows are added in pairs, one before and one after, so that a steady drift does not move the average.

    Raises:
        DataError: the file has fewer ticks than one window, or lost those around the instant.
    """
    middle = file.ticks / 2 if reading.at is None else reading.at
    n = min(reading.window, file.ticks)
    if not 0 <= middle <= file.ticks or n < 8:
        raise DataError("too few ticks to see a board", value=f"{file.path}: {file.ticks} ticks",
                        expected=f"at least 8 around tick {middle:g}")  # fmt: skip
    first = int(np.clip(middle - n / 2, 0, file.ticks - n))
    stream = file.read(first, first + n)
    texture = tfp(stream, n // 2, n)
    if not texture.known.any():
        raise DataError("the ticks around the instant were lost", value=f"{file.path}: tick {middle:g}",
                        next="give another instant with --at")  # fmt: skip
    total, count = texture.light.astype(np.float64), 1
    for k in range(1, (reading.windows - 1) // 2 + 1):
        starts = (first - k * n, first + k * n)
        if starts[0] < 0 or starts[1] + n > file.ticks:
            break
        pair = [tfp(file.read(t, t + n), n // 2, n) for t in starts]
        if not all(p.known.all() for p in pair):
            break
        if max(moved_px(texture.light, p.light) for p in pair) > STILL_PX:
            break
        total, count = total + pair[0].light + pair[1].light, count + 2
    return (total / count).astype(np.float32)


def moved_px(before: NDArray[np.float32], after: NDArray[np.float32]) -> float:
    """How far a picture has moved as a whole, px: least squares on the gradient, good to a pixel or two.

    Edges:
        Infinite where the pictures have little in common; 0 where there is nothing to see, and along stripes.
    """
    import cv2

    a, b = (cv2.GaussianBlur(p, (0, 0), 2.0).astype(np.float64) for p in (before, after))
    if a.std() == 0:
        return 0.0
    if b.std() == 0 or np.corrcoef(a.ravel(), b.ravel())[0, 1] < 0.5:
        return float("inf")
    gy, gx = np.gradient((a + b) / 2)
    A = np.array([[(gx * gx).sum(), (gx * gy).sum()], [(gx * gy).sum(), (gy * gy).sum()]])
    shift = np.linalg.lstsq(A, -np.array([(gx * (b - a)).sum(), (gy * (b - a)).sum()]), rcond=0.05)[0]
    return float(np.hypot(shift[0], shift[1]))


def content_hash(picture: NDArray[Any]) -> str:
    """What a picture holds, as SHA-256 (hex): equal for copies, whatever their file names or formats."""
    head = f"{picture.shape} {picture.dtype}".encode()
    return hashlib.sha256(head + np.ascontiguousarray(picture).tobytes()).hexdigest()
