"""A colour spike sensor: each pixel sees one colour, in a pattern of two by two."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import frozen_array
from spikerig.dataset.errors import DataError, UsageError

if TYPE_CHECKING:
    from spikerig.dataset.texture import Texture

PATTERNS = ("rggb", "grbg", "gbrg", "bggr")


@dataclass(frozen=True, slots=True)
class Bayer:
    """The colours of a sensor.

    Args:
        pattern: colours of pixels (0,0), (0,1), (1,0), (1,1), row first: rggb, grbg, gbrg or bggr.
        gain: of red, green and blue pixels over the scene's light_gain: a texture is light_gain * gain[c] * light[c].

    Raises:
        DataError: another pattern, or gains that are not positive and finite.
    """

    pattern: str
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        if self.pattern not in PATTERNS:
            raise DataError("no such Bayer pattern", value=self.pattern, expected=", ".join(PATTERNS))
        if len(self.gain) != 3 or not all(0 < g < np.inf for g in self.gain):
            raise DataError("a colour sensor has three positive gains", value=self.gain)

    def channels(self, height: int, width: int) -> NDArray[np.int8]:
        """Which colour each pixel sees, int8[H,W]: 0 red, 1 green, 2 blue."""
        cell = np.array(["rgb".index(c) for c in self.pattern], np.int8).reshape(2, 2)
        return np.tile(cell, ((height + 1) // 2, (width + 1) // 2))[:height, :width]


@dataclass(frozen=True, slots=True)
class ColourTexture:
    """Light of three colours: light float32[H,W,3], known bool[H,W,3]; light is 0 where not known. Else as Texture."""

    light: NDArray[np.float32]
    known: NDArray[np.bool_]
    at: float
    method: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "light", frozen_array(self.light, np.float32))
        object.__setattr__(self, "known", frozen_array(self.known, np.bool_))

    def with_nan(self) -> NDArray[np.float32]:
        """The light, NaN where it is not known."""
        return np.where(self.known, self.light, np.float32(np.nan))


def bayer_of(info: Mapping[str, Any]) -> Bayer | None:
    """The colours of a scene's spike sensor, by what its `info` says; None for one that sees gray.

    Raises:
        DataError: `info` names a pattern that is none.
    """
    sensor = info.get("sensor")
    if not isinstance(sensor, Mapping) or "bayer" not in sensor:
        return None
    gain = sensor.get("channel_gain", (1.0, 1.0, 1.0))
    if not isinstance(gain, list | tuple) or not all(isinstance(g, int | float) for g in gain):
        raise DataError("a colour sensor has three positive gains", value=gain)
    return Bayer(str(sensor["bayer"]), tuple(float(g) for g in gain))  # type: ignore[arg-type]


def bayer_info(bayer: Bayer) -> dict[str, Any]:
    """What a scene's `info` says of its colours, JSON-ready; the inverse of `bayer_of`."""
    return {"sensor": {"bayer": bayer.pattern, "channel_gain": list(bayer.gain)}}


def mosaic(pictures: NDArray[np.floating], bayer: Bayer) -> NDArray[np.float32]:
    """What the pixels see of pictures [..,H,W,3]: float32[..,H,W], each its own colour, times its gain."""
    if pictures.ndim < 3 or pictures.shape[-1] != 3:
        raise UsageError("pictures are [..,H,W,3]", value=pictures.shape)
    out = np.empty(pictures.shape[:-1], np.float32)
    for k, colour in enumerate(bayer.pattern):
        c, part = "rgb".index(colour), (..., slice(k // 2, None, 2), slice(k % 2, None, 2))
        out[part] = pictures[(*part, c)] * np.float32(bayer.gain[c])
    return out


def split(texture: Texture, bayer: Bayer) -> ColourTexture:
    """The colours of a texture apart: each pixel knows its own, the gain taken off; the two others are not known."""
    height, width = texture.light.shape
    own = bayer.channels(height, width)[:, :, None] == np.arange(3)
    known = own & texture.known[:, :, None]
    light = texture.light[:, :, None] / np.asarray(bayer.gain, np.float32)
    return ColourTexture(np.where(known, light, 0), known, texture.at, texture.method)


def demosaic(texture: Texture, bayer: Bayer) -> ColourTexture:
    """All colours of all pixels, bilinear: a pixel's own colour as it is, the others from their known neighbours.

    Args:
        texture: of a colour sensor.
        bayer: its pattern and gains.

    Returns:
        The colours, the gains taken off: light_gain is that of a white of all three.

    Edges:
        A neighbour that is not known, or beyond the border, is left out and the others count more; a colour is not
        known where none of the eight neighbours (and not the pixel itself) knows it. Any size, 1 x 1 and odd too.

    Cost:
        About 35 ns a pixel and colour.
    """
    apart = split(texture, bayer)
    number = _around(apart.known.astype(np.float32))
    total = _around(apart.light)
    around = np.divide(total, number, out=np.zeros_like(total), where=number > 0)  # all of them are equally far
    light = np.where(apart.known, apart.light, around)
    return ColourTexture(light, number > 0, texture.at, f"{texture.method}, bilinear")


def _around(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sum over 3 x 3 pixels, [H,W,3]; nothing beyond the border."""
    for axis in (0, 1):
        wide = np.pad(planes, [(1, 1) if a == axis else (0, 0) for a in range(3)])
        n = planes.shape[axis]
        at = [[slice(k, k + n) if a == axis else slice(None) for a in range(3)] for k in range(3)]
        planes = wide[tuple(at[0])] + wide[tuple(at[1])] + wide[tuple(at[2])]
    return planes
