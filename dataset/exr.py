"""OpenEXR files: the parts, layers and channels that make a picture or a depth, on the display window.

What the library gets wrong is put right here: it writes wrong pixels from any array that is not contiguous, and opens a
truncated file "successfully" with a part missing.
"""

from __future__ import annotations

from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.primaries import REC709, rec709_from, rgb_from_luma_chroma

MAX_PIXELS = 1 << 27
MAX_BYTES = 1 << 31
MAX_RATIO = 1 << 12  # of pixels in memory to bytes in the file: more is no picture but a claim
DEEP = ("deepscanline", "deeptile")
DEPTHS = ("Z", "Y", "V", "depth", "Depth")  # names under which renderers write depth
FAR = {np.dtype(np.float16): 65504.0, np.dtype(np.float32): 1e9}  # "nothing there", as Blender and others write it
Pixels = NDArray[np.float32]


class Part(NamedTuple):
    """One part of a file: its header and the samples of its channels, deep ones left out."""

    header: dict[str, Any]
    channels: dict[str, NDArray[Any]]


class Layer(NamedTuple):
    """Channels that belong together: `a.b.R`, `a.b.G`, `a.b.B` are the layer `a.b`."""

    name: str
    part: Part
    channels: dict[str, NDArray[Any]]

    @property
    def label(self) -> str:
        """Its own name, or that of its part."""
        return self.name or str(self.part.header.get("name") or "")

    @property
    def kind(self) -> str:
        """What picture the channels make: RGBA, RGB, YC, YCA, YA, Y, or nothing."""
        height, width = window_shape(self.part.header, "dataWindow")
        half = ((height + 1) // 2, (width + 1) // 2)
        full = {name for name, c in self.channels.items() if c.shape == (height, width)}
        alpha = "A" if "A" in full else ""
        if {"R", "G", "B"} <= full:
            return "RGB" + alpha
        if "RY" in self.channels or "BY" in self.channels:
            chroma = [c for c in ("RY", "BY") if c in self.channels and self.channels[c].shape == half]
            return "YC" + alpha if "Y" in full and len(chroma) == 2 else ""
        return "Y" + alpha if "Y" in full and "X" not in full else ""  # X, Y, Z is a vector


def read_exr(path: Path, layer: str = "") -> Pixels:
    """A picture of an EXR file, linear Rec.709, on its display window; values as stored, NaN and infinities too.

    Args:
        path: of the file.
        layer: of a layer, a view, a part, or a single channel; by default a Blender render's `Combined`, else the
            first layer without a name, else the only one there is.

    Returns:
        float32[H,W,C], C 1 (gray), 3 or 4 (alpha, premultiplied). half and float as they are, uint as numbers.

    Raises:
        DataError: damaged, truncated, too large; deep; data wholly outside the display window; no picture or several.

    Edges:
        Pixels that the data window leaves unsaid are 0. Of a mip-map the finest level is read. Luminance-chroma is
        reconstructed as OpenEXR does; other primaries than Rec.709 are converted, to their `adoptedNeutral` if given.
    """
    parts = _read_parts(path)
    found = _pick(path, [chosen for part in parts for chosen in _layers(part)], layer)
    channels, header = found.channels, found.part.header
    primaries = _numbers(path, header, "chromaticities", 8) or REC709
    neutral = _numbers(path, header, "adoptedNeutral", 2)
    alpha = [np.asarray(channels["A"], np.float32)] if found.kind.endswith("A") else []
    if found.kind.startswith("YC"):
        rgb = rgb_from_luma_chroma(channels["Y"], channels["RY"], channels["BY"], primaries)
    elif found.kind.startswith("RGB"):
        rgb = np.stack([np.asarray(channels[c], np.float32) for c in "RGB"], 2)
    else:
        gray = np.asarray(channels["Y"], np.float32)[:, :, None]
        rgb = gray if not alpha else np.repeat(gray, 3, 2)
    if rgb.shape[2] == 3 and (np.abs(np.subtract(primaries, REC709)).max() > 1e-4 or neutral):
        rgb = rgb @ rec709_from(primaries, neutral).T.astype(np.float32)
    return _on_display(path, header, np.dstack([rgb, *alpha]))


def read_exr_depth(path: Path) -> Pixels:
    """Depth of an EXR file, float32[H,W]; inf where the writer means "nothing there" (65504 in half, 1e9 or more).

    A channel Z, Y, V or depth (of any layer), the only channel there is, or a picture of three equal channels.

    Raises:
        DataError: as `read_exr`, or no such channel.
    """
    parts = _read_parts(path)
    layers = [layer for part in parts for layer in _layers(part)]
    every = [(name, layer.part, c) for layer in layers for name, c in layer.channels.items()]
    plain = [layer for layer in layers if "X" not in layer.channels]  # X, Y, Z is a vector
    named = [(k, layer.part, layer.channels[k]) for k in DEPTHS for layer in plain if k in layer.channels]
    planes = named or (every if len(every) == 1 else [])
    if not planes:
        colours = [c for c in parts[0].channels.values() if c.shape == window_shape(parts[0].header, "dataWindow")]
        if len(colours) > 2 and all(np.array_equal(colours[0], c, equal_nan=True) for c in colours[1:3]):
            planes = [("", parts[0], colours[0])]
    if not planes:
        raise DataError(
            "no depth in this EXR",
            value=f"{path}: channels {', '.join(e[0] for e in every)}",
            expected=f"a channel {', '.join(DEPTHS)}, or a lone one",
        )
    _, part, plane = planes[0]
    far = FAR.get(plane.dtype, np.inf)
    depth = np.where(plane >= far, np.inf, plane).astype(np.float32)
    return _on_display(path, part.header, depth[:, :, None])[:, :, 0]


def exr_head(path: Path) -> tuple[int, int, bool]:
    """Width, height of the display window of the first part, and whether it has alpha; no pixel is read."""
    head = _heads(path)[0]
    height, width = window_shape(head, "displayWindow")
    return width, height, any(channel.name == "A" for channel in head["channels"])


def write_exr(path: Path, pixels: NDArray[Any]) -> None:
    """Write [H,W,C], C 1, 3 or 4, as float32 with ZIP compression, from any memory layout."""
    import OpenEXR

    pixels = np.ascontiguousarray(pixels, np.float32)  # OpenEXR writes wrong pixels from any other layout
    name = {1: "Y", 3: "RGB", 4: "RGBA"}[pixels.shape[2]]
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {name: pixels[:, :, 0].copy() if name == "Y" else pixels}).write(str(path))


def window_shape(header: dict[str, Any], name: str) -> tuple[int, int]:
    """Height and width of a header's dataWindow or displayWindow."""
    (x0, y0), (x1, y1) = np.asarray(header[name], np.int64).tolist()
    return y1 - y0 + 1, x1 - x0 + 1


def damaged(path: Path, cause: str) -> DataError:
    """The error of a picture that breaks off or does not decode."""
    return DataError("the picture is damaged", value=path, cause=cause, next="copy or export it again")


def check_size(path: Path, width: int, height: int) -> None:
    """Raise a DataError for a size no picture has: empty, or beyond `MAX_PIXELS`."""
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise DataError("the picture's claimed size is refused", value=f"{path}: {width} x {height}")


def _heads(path: Path) -> list[dict[str, Any]]:
    """The headers of all parts, their claimed sizes checked before any pixel is asked for."""
    import OpenEXR

    try:
        with redirect_stdout(StringIO()), OpenEXR.File(str(path), header_only=True) as file:
            heads = [dict(part.header) for part in file.parts]  # emptied on leaving the `with`
        claimed = 0
        for head in heads:
            for window in ("dataWindow", "displayWindow"):
                height, width = window_shape(head, window)
                check_size(path, width, height)
            height, width = window_shape(head, "dataWindow")
            if tiles := head.get("tiles"):  # they are allocated whole, however small the picture is
                check_size(path, tiles.xSize, tiles.ySize)
                height, width = max(height, tiles.ySize), max(width, tiles.xSize)
            claimed += (128 if _type(head) in DEEP else 4) * height * width * len(head["channels"])
        most = min(MAX_BYTES, (1 << 24) + MAX_RATIO * path.stat().st_size)
    except DataError:
        raise
    except Exception as error:  # the binding raises RuntimeError, ValueError, TypeError, as it comes
        raise damaged(path, str(error)) from error
    if not heads:
        raise damaged(path, "it has no parts")
    if claimed > most:
        raise DataError("the picture's claimed size is refused", value=f"{path}: {claimed} bytes in {len(heads)} parts")
    return heads


def _read_parts(path: Path) -> list[Part]:
    import OpenEXR

    heads = _heads(path)
    if all(_type(head) in DEEP for head in heads):
        raise DataError(
            "deep pixels are no picture", value=path, cause="each pixel holds samples at many depths",
            next="flatten it first, e.g. with oiiotool --flatten",
        )  # fmt: skip
    said = StringIO()  # the binding prints on stdout what it could not read, and goes on
    try:
        with redirect_stdout(said), OpenEXR.File(str(path), separate_channels=True) as file:
            parts = [
                Part(dict(p.header), {name: np.array(c.pixels) for name, c in p.channels.items()}) for p in file.parts
            ]
    except Exception as error:
        raise damaged(path, str(error)) from error
    if len(parts) != len(heads):
        lost = f"{len(heads) - len(parts)} of {len(heads)} parts cannot be read: truncated?"
        raise damaged(path, f"{lost} ({' '.join(said.getvalue().split())[:200]})")
    return [part for part in parts if _type(part.header) not in DEEP]


def _numbers(path: Path, header: dict[str, Any], name: str, count: int) -> tuple[float, ...] | None:
    """An attribute of so many numbers; None where the file has none."""
    if name not in header:
        return None
    try:
        values = tuple(float(v) for v in np.ravel(header[name]))
    except (TypeError, ValueError):  # an attribute of another type
        values = ()
    if len(values) != count:
        raise damaged(path, f"its {name} is not {count} numbers")
    return values


def _type(header: dict[str, Any]) -> str:
    return str(getattr(header.get("type"), "name", ""))


def _layers(part: Part) -> list[Layer]:
    groups: dict[str, dict[str, NDArray[Any]]] = {}
    for name, samples in part.channels.items():
        if samples.dtype != object:
            prefix, _, last = name.rpartition(".")
            groups.setdefault(prefix, {})[last] = samples
    return [Layer(name, part, channels) for name, channels in groups.items()]


def _pick(path: Path, layers: list[Layer], wanted: str) -> Layer:
    pictures = [layer for layer in layers if layer.kind]
    if wanted:
        for layer in pictures:
            labels = {layer.name, layer.part.header.get("name"), layer.part.header.get("view")}
            multi = layer.part.header.get("multiView") or [None]
            if wanted in labels or (layer.name == "" and wanted == multi[0]):
                return layer
        for layer in layers:
            for name, samples in layer.channels.items():
                if wanted == f"{layer.name}.{name}".lstrip("."):
                    return Layer(wanted, layer.part, {"Y": samples})
        raise UsageError("no such layer in this EXR", value=f"{path}: {wanted}", expected=_told(layers))
    unnamed = [layer for layer in pictures if not layer.name]
    combined = [layer for layer in pictures if layer.label.rpartition(".")[2] == "Combined"]
    if combined or unnamed or len(pictures) == 1:
        return (combined or unnamed or pictures)[0]
    raise DataError(
        "this EXR holds several pictures" if pictures else "no RGB, RGBA, Y or luminance-chroma picture in this EXR",
        value=f"{path}: {_told(layers)}",
        next="name the layer, or a single channel to be taken as gray",
    )


def _told(layers: list[Layer]) -> str:
    said = []
    for layer in layers:
        name = layer.name or layer.part.header.get("view") or layer.part.header.get("name") or "without a name"
        said.append(f"{name} ({', '.join(layer.channels)})")
    return "; ".join(said)


def _on_display(path: Path, header: dict[str, Any], pixels: Pixels) -> Pixels:
    (ax, ay), (bx, by) = np.asarray(header["dataWindow"], np.int64).tolist()
    (cx, cy), (dx, dy) = np.asarray(header["displayWindow"], np.int64).tolist()
    if pixels.shape[:2] != window_shape(header, "dataWindow"):
        raise DataError("a channel sampled at fewer pixels than its picture has", value=path, cause="subsampled")
    if (ax, ay, bx, by) == (cx, cy, dx, dy):
        return np.ascontiguousarray(pixels)
    left, top, right, bottom = max(ax, cx), max(ay, cy), min(bx, dx) + 1, min(by, dy) + 1
    if left >= right or top >= bottom:
        raise DataError("the EXR's pixels lie wholly outside its display window", value=path)
    out = np.zeros((dy - cy + 1, dx - cx + 1, pixels.shape[2]), np.float32)
    out[top - cy : bottom - cy, left - cx : right - cx] = pixels[top - ay : bottom - ay, left - ax : right - ax]
    return out
