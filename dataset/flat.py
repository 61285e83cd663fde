"""A sensor's flat field: its maps, their file, and textures as an even sensor would have seen them."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import frozen_array
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.outfile import whole_file
from spikerig.dataset.texture import Texture

MAX_PIXELS = 1 << 26


@dataclass(frozen=True, slots=True)
class FlatField:
    """Maps of one sensor, float32[H,W].

    Args:
        gain: relative, mean 1 over good pixels; vignetting and an uneven source included.
        dark: spikes a tick without light.
        good: bool[H,W]; False for dead, stuck and hot pixels.
        smooth: the smooth part of `gain`: vignetting. gain / smooth is the pixels' own pattern.
    """

    gain: NDArray[np.float32]
    dark: NDArray[np.float32]
    good: NDArray[np.bool_]
    smooth: NDArray[np.float32]

    def __post_init__(self) -> None:
        for name, dtype in (("gain", np.float32), ("dark", np.float32), ("good", np.bool_), ("smooth", np.float32)):
            object.__setattr__(self, name, frozen_array(getattr(self, name), dtype))
        if self.gain.ndim != 2 or not self.gain.shape == self.dark.shape == self.good.shape == self.smooth.shape:
            raise DataError("maps of a sensor are [H,W], all of one size", value=self.gain.shape)


def flattened(texture: Texture, flat: FlatField) -> Texture:
    """A texture as an even sensor would have seen it: (light - dark) / gain, not below 0; bad pixels not known."""
    if texture.light.shape != flat.gain.shape:
        raise UsageError(
            "the flat field is of another sensor", value=flat.gain.shape, expected=str(texture.light.shape)
        )
    known = texture.known & flat.good
    light = np.maximum(texture.light - flat.dark, 0) / np.where(flat.good, flat.gain, 1)
    return Texture(np.where(known, light, 0).astype(np.float32), known, texture.at, texture.method + "-flat")


def write_flat(path: str | Path, flat: FlatField, *, noise: float | None = None, force: bool = False) -> None:
    """Write the maps as a NumPy archive: gain, dark, good, smooth, and perhaps noise; the simulator reads it too.

    Args:
        path: ends in .npz.
        flat: the maps.
        noise: sd of the threshold, the same for all pixels.
        force: replace an existing file.
    """
    if Path(path).suffix.lower() != ".npz":
        raise UsageError("maps are written as .npz", value=path)
    more = {} if noise is None else {"noise": np.full(flat.gain.shape, noise, np.float32)}
    with whole_file(path, force=force) as part, part.open("wb") as file:
        np.savez(file, allow_pickle=False, gain=flat.gain, dark=flat.dark, good=flat.good.astype(np.uint8),
                 smooth=flat.smooth, **more)  # fmt: skip


def read_flat(path: str | Path) -> FlatField:
    """Read maps; `good` and `smooth` may be absent (then all pixels are good, and nothing is smooth).

    Raises:
        DataError: not such an archive, or maps that cannot be: all faults at once.
    """
    faults: list[str] = []
    found: dict[str, NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            sizes = {i.filename: i.file_size for i in archive.infolist()}
        if max(sizes.values(), default=0) > 4 * MAX_PIXELS:
            raise DataError("the maps' claimed size is refused", value=f"{path}: {max(sizes.values())} bytes")
        with np.load(path, allow_pickle=False) as data:
            for name, kind in (("gain", np.float32), ("dark", np.float32), ("good", np.uint8), ("smooth", np.float32)):
                if name in data:
                    found[name] = data[name]
                    if found[name].dtype != kind or found[name].ndim != 2 or not np.isfinite(found[name]).all():
                        faults.append(f"'{name}' is {found[name].dtype} {found[name].shape}, or not finite")
                elif name in ("gain", "dark"):
                    faults.append(f"'{name}' is missing")
    except (zipfile.BadZipFile, OSError, ValueError, EOFError, NotImplementedError, RuntimeError) as error:
        faults.append(f"not a NumPy archive ({error})"[:200])
    if len({m.shape for m in found.values()}) > 1:
        faults.append("sizes differ: " + ", ".join(f"{k} {v.shape}" for k, v in found.items()))
    if faults:
        raise DataError("the flat field cannot be used", value=f"{path}: " + "; ".join(faults),
                        expected="a .npz of gain and dark, float32 [H,W]")  # fmt: skip
    ones = np.ones_like(found["gain"])
    return FlatField(found["gain"], found["dark"], found.get("good", ones) > 0, found.get("smooth", ones))
