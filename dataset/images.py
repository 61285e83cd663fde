"""Pictures on disk (PNG, JPEG, OpenEXR) and the sRGB curve. PNG and JPEG hold encoded pixels, EXR holds linear light.

What cv2 gets wrong is put right here (the BGR order, damaged files read in part), what OpenEXR does in `exr`.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikerig.dataset.bayer import ColourTexture
from spikerig.dataset.errors import DataError, NumericsError, UsageError
from spikerig.dataset.exr import check_size, damaged, exr_head, read_exr, write_exr
from spikerig.dataset.outfile import whole_file
from spikerig.dataset.texture import Texture

SUFFIXES = (".png", ".jpg", ".jpeg", ".exr")
_PNG_START = b"\x89PNG\r\n\x1a\n"
_EXR_START = b"\x76\x2f\x31\x01"


def srgb_from_linear(light: ArrayLike) -> NDArray[np.floating]:
    """Encode linear light by the exact piecewise sRGB curve.

    Args:
        light: any shape, 1.0 = display white.

    Returns:
        The encoded values; float32 stays float32, anything else becomes float64.

    Edges:
        Nothing is clipped: negative light follows the straight segment, light above 1 the power; NaN stays NaN.

    Source: IEC 61966-2-1.
    """
    x = _floats(light)
    power = np.power(np.maximum(x, 0.0031308), 1 / 2.4) * 1.055 - 0.055
    return np.where(x <= 0.0031308, x * 12.92, power).astype(x.dtype)


def linear_from_srgb(pixels: ArrayLike) -> NDArray[np.floating]:
    """Decode sRGB values in [0, 1] to linear light; the inverse of `srgb_from_linear`, same edges, same dtypes.

    Args:
        pixels: any shape, floats; uint8 and uint16 are divided by 255 and 65535 first and give float32.
    """
    x = _floats(pixels)
    power = np.power((np.maximum(x, 0.04045) + 0.055) / 1.055, 2.4)
    return np.where(x <= 0.04045, x / 12.92, power).astype(x.dtype)


def srgb8_from_linear(light: ArrayLike) -> NDArray[np.uint8]:
    """8-bit sRGB pixels of linear light: clipped to [0, 1], encoded, rounded to the nearest of 255 steps.

    Raises:
        NumericsError: the light holds NaN.
    """
    encoded = srgb_from_linear(light)
    if np.isnan(encoded).any():
        raise NumericsError("light to be encoded holds NaN", value=f"{int(np.isnan(encoded).sum())} values")
    return np.rint(np.clip(encoded, 0, 1) * 255).astype(np.uint8)


def _floats(values: ArrayLike) -> NDArray[np.floating]:
    x = np.asarray(values)
    if x.dtype == np.uint8:
        return x.astype(np.float32) / np.float32(255)
    if x.dtype == np.uint16:
        return x.astype(np.float32) / np.float32(65535)
    return x if x.dtype == np.float32 else x.astype(np.float64)


def read_image(path: str | Path, *, nonfinite: str = "error", layer: str = "") -> NDArray[Any]:
    """Read a picture: encoded pixels of PNG and JPEG, linear light of EXR.

    Args:
        path: .png (8 or 16 bit), .jpg or .exr.
        nonfinite: "error", or "keep" to let NaN and infinities of an EXR through.
        layer: of an EXR: the layer, view, part or channel to read.

    Returns:
        uint8 or uint16 [H,W,C] as stored, from PNG and JPEG; float32 [H,W,C], linear Rec.709, from EXR; C is 1, 3 or
        4, in the order R, G, B, A.

    Raises:
        DataError: not a picture, damaged, truncated, too large, or of a kind not handled.
        NumericsError: an EXR holds NaN or infinities.

    Edges:
        Which picture of an EXR, and on which window, is said at `exr.read_exr`. A JPEG's rotation tag is ignored.
    """
    source = Path(path)
    start = _start(source)
    if start.startswith(_EXR_START):
        light = read_exr(source, layer)
        bad = int((~np.isfinite(light)).sum())
        if bad and nonfinite != "keep":
            raise NumericsError("the EXR holds NaN or infinite values", value=f"{source}: {bad} of {light.size}")
        return light
    if layer:
        raise UsageError("only an EXR has layers", value=f"{source}: {layer}")
    if start.startswith(_PNG_START):
        data = source.read_bytes()
        _check_png(source, data)
    elif start.startswith(b"\xff\xd8\xff"):
        data = source.read_bytes()
        if data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda"):
            raise damaged(source, "the JPEG has no end marker")
    else:
        raise DataError("not a picture this tool reads", value=source, expected="PNG, JPEG or OpenEXR")
    import cv2

    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise damaged(source, str(error)) from error
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        raise damaged(source, "its pixels cannot be decoded")
    if pixels.ndim == 2:
        return pixels[:, :, None]
    order = [2, 1, 0, 3][: pixels.shape[2]]
    return np.ascontiguousarray(pixels[:, :, order])


class Head(NamedTuple):
    """What a picture says of itself before its pixels are read."""

    width: int
    height: int
    alpha: bool


def image_head(path: str | Path) -> Head:
    """Size of a picture and whether it has alpha; of a PNG or EXR only the head is read.

    Raises:
        DataError: not a picture, damaged, or too large.
    """
    source = Path(path)
    start = _start(source)
    if start.startswith(_PNG_START):
        with source.open("rb") as file:
            head = file.read(26)
        width, height = int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")
        check_size(source, width, height)
        return Head(width, height, head[25:] in (b"\4", b"\6"))
    if start.startswith(_EXR_START):
        return Head(*exr_head(source))
    pixels = read_image(source)
    return Head(pixels.shape[1], pixels.shape[0], pixels.shape[2] == 4)


def read_linear(
    path: str | Path, *, background: float | None = None, nonfinite: str = "error", layer: str = ""
) -> NDArray[np.float32]:
    """Read any picture as linear light, float32[H,W,3]; gray is repeated, alpha is laid over `background`.

    Args:
        path, nonfinite, layer: as for `read_image`.
        background: linear gray level behind transparent pixels; needed where the picture has alpha.

    Raises:
        UsageError: there is alpha and no background.
        DataError, NumericsError: as `read_image`.

    Edges:
        Straight alpha of an encoded picture is composited on encoded values, as NeRF's data sets are; an EXR's
        alpha is premultiplied, as its standard says.
    """
    pixels = read_image(path, nonfinite=nonfinite, layer=layer)
    linear = pixels.dtype == np.float32
    colour = _floats(pixels)
    if colour.shape[2] == 1:
        colour = np.repeat(colour, 3, axis=2)
    if colour.shape[2] == 4:
        if background is None:
            raise UsageError(
                "the picture has alpha: say what lies behind it",
                value=path,
                next="give a background (--background 1; of a folder: background in transforms.json)",
            )
        alpha, colour = colour[:, :, 3:], colour[:, :, :3]
        behind = background if linear else float(srgb_from_linear(background))
        colour = colour * (1 if linear else alpha) + behind * (1 - alpha)
    return np.asarray(colour if linear else linear_from_srgb(colour), np.float32)


def write_image(path: str | Path, pixels: ArrayLike, *, force: bool = False) -> None:
    """Write a picture: .png from uint8 or uint16 (encoded), .exr from floats (linear, stored as float32, ZIP).

    Args:
        path: ends in .png or .exr; appears whole or not at all.
        pixels: [H,W], [H,W,1], [H,W,3] or [H,W,4], in the order R, G, B, A; any memory layout.
        force: replace an existing file.

    Raises:
        UsageError: the file exists, or the ending and the dtype do not fit together.
        HostError: the disk is full, or writing is not permitted.
    """
    target = Path(path)
    array = np.asarray(pixels)
    array = array[:, :, None] if array.ndim == 2 else array
    if array.ndim != 3 or array.shape[2] not in (1, 3, 4) or array.size == 0:
        raise UsageError("a picture is [H,W], [H,W,1], [H,W,3] or [H,W,4]", value=array.shape)
    whole = array.dtype in (np.uint8, np.uint16)
    if target.suffix.lower() not in (".png", ".exr") or whole == (target.suffix.lower() == ".exr"):
        raise UsageError(
            "a picture's ending must fit its numbers",
            value=f"{target.name}, {array.dtype}",
            expected=".png for uint8 or uint16 (encoded), .exr for floats (linear)",
        )
    with whole_file(target, force=force) as part:
        (_write_png if whole else write_exr)(part, array)


def texture_png(
    path: str | Path, texture: Texture | ColourTexture, gain: float | None = None, *, force: bool = False
) -> float:
    """Write a texture as an 8-bit PNG, sRGB(gain * light); pixels not known (in all colours) are transparent.

    Args:
        path: of the PNG.
        texture: light float32[H,W] or [H,W,3], known bool of its shape.
        gain: None takes the one that lifts the 99th percentile of known light to white.
        force: replace an existing file.

    Returns:
        The gain used: print it.
    """
    if gain is None:
        lit = texture.light[texture.known]
        top = float(np.percentile(lit, 99)) if lit.size else 0.0
        gain = 1 / top if top > 0 else 1.0
    codes = srgb8_from_linear(np.where(texture.known, texture.light, 0) * np.float32(gain))
    if not texture.known.all():
        known = np.atleast_3d(texture.known).all(2)
        colours = codes if codes.ndim == 3 else np.dstack([codes] * 3)
        codes = np.dstack([colours, np.where(known, 255, 0).astype(np.uint8)])
    write_image(path, codes, force=force)
    return gain


def _write_png(path: Path, array: NDArray[Any]) -> None:
    import cv2

    order = {1: [0], 3: [2, 1, 0], 4: [2, 1, 0, 3]}[array.shape[2]]
    done, data = cv2.imencode(".png", np.ascontiguousarray(array[:, :, order]))
    if not done:
        raise DataError("the picture could not be encoded", value=path)
    path.write_bytes(data.tobytes())


def _start(path: Path) -> bytes:
    try:
        if not path.is_file():
            raise DataError("not a file", value=path, expected="a PNG, JPEG or OpenEXR picture")
        with path.open("rb") as file:
            return file.read(8)
    except OSError as error:
        raise DataError("the picture cannot be opened", value=f"{path}: {error.strerror}") from error


def _check_png(path: Path, data: bytes) -> None:
    """Walk a PNG's chunks: sizes, checksums, the end; libpng may return part of a picture without a word."""
    at, kind = len(_PNG_START), b""
    while at < len(data) and kind != b"IEND":
        size, kind = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        body = data[at + 8 : at + 8 + size]
        if len(body) != size or zlib.crc32(body, zlib.crc32(kind)) != int.from_bytes(
            data[at + 8 + size : at + 12 + size], "big"
        ):
            raise damaged(path, f"the PNG breaks off or is corrupt at byte {at}")
        if kind == b"IHDR" and size == 13:
            check_size(path, int.from_bytes(body[:4], "big"), int.from_bytes(body[4:8], "big"))
        at += 12 + size
    if kind != b"IEND":
        raise damaged(path, "the PNG has no end")
