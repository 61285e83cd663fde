"""`spikerig data texture` and `data import`: make pictures of spikes, convert streams."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from spikerig.dataset.bayer import PATTERNS
from spikerig.dataset.errors import UsageError
from spikerig.dataset.info_cli import (
    Axes,
    DropTail,
    File,
    Force,
    Height,
    Json,
    Rate,
    RowBits,
    Width,
    describe_spikes,
    is_scene,
)  # fmt: skip
from spikerig.dataset.terminal import Progress, emit, note

if TYPE_CHECKING:
    from spikerig.dataset.bayer import ColourTexture
    from spikerig.dataset.spikes import SpikeFile
    from spikerig.dataset.texture import Texture

METHODS = ("tfp", "tfi", "tfi-causal", "tfp-adaptive")
REACH = 2048  # ticks to each side that TFI looks at, 51 MB of a Vidar


def texture(
    file: File,
    at: Annotated[float, typer.Option("--at", help="The instant, in ticks; a fraction means the tick it lies in.")],
    out: Annotated[Path, typer.Option("-o", "--out", help=".npy (light, NaN = unknown), .png or .exr.")],
    method: Annotated[str, typer.Option(help=" | ".join(METHODS))] = "tfp",
    window: Annotated[
        int | None,
        typer.Option(
            help="TFP: ticks, default 41: [at - N//2, at - N//2 + N); an even one is centred on the tick's start."
        ),
    ] = None,
    intervals: Annotated[int, typer.Option(help="TFI: inter-spike intervals to average.")] = 1,
    reach: Annotated[int, typer.Option(help="TFI: how many ticks to each side to look for spikes.")] = REACH,
    gain: Annotated[str, typer.Option(help="PNG = sRGB(gain * light): a number, or auto (99 % of light to white).")] = (
        "auto"
    ),
    view: Annotated[str | None, typer.Option(help="Of a scene: which view.")] = None,
    bayer: Annotated[
        str, typer.Option(help="Colours of the pixels: rggb, grbg, gbrg, bggr; off; auto: as the scene says.")
    ] = "auto",
    flat: Annotated[
        Path | None, typer.Option(help="The sensor's maps (.npz of `calib photometric`): evens the texture out.")
    ] = None,
    height: Height = None,
    width: Width = None,
    row_bits: RowBits = None,
    axes: Axes = None,
    drop_tail: DropTail = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Make a picture of the spikes around an instant."""
    from spikerig.dataset.flat import flattened, read_flat
    from spikerig.dataset.outfile import refuse_existing
    from spikerig.dataset.spikes import open_spikes

    kind = out.suffix.lower()
    if method not in METHODS:
        raise UsageError("no such method", value=method, expected=", ".join(METHODS))
    if kind not in (".npy", ".png", ".exr"):
        raise UsageError("a texture is written as .npy, .png or .exr", value=out)
    if window is not None and method != "tfp":
        raise UsageError(f"{method} has no window", value=window, next="leave out --window, or use --method tfp")
    if intervals != 1 and not method.startswith("tfi"):
        raise UsageError(f"{method} has no intervals", value=intervals, next="leave out --intervals")
    if bayer not in ("auto", "off", *PATTERNS):
        raise UsageError("no such Bayer pattern", value=bayer, expected=f"auto, off, {', '.join(PATTERNS)}")
    number = _gain(gain)
    refuse_existing(out, force)
    maps = None if flat is None else read_flat(flat)
    opened = (
        _view(file, view)
        if view is not None or is_scene(file)
        else open_spikes(file, height=height, width=width, row_bits=row_bits, axes=axes, drop_tail=drop_tail)
    )
    with opened:
        made, used = _make(opened, method, at, 41 if window is None else window, intervals, reach)
        made = made if maps is None else flattened(made, maps)
        made, pattern = _coloured(made, bayer, opened)
    used_gain = _write(out, made, number, force)
    told = {
        "file": str(file), "out": str(out), "method": made.method, "at": at, "width": made.light.shape[1],
        "height": made.light.shape[0], "window": [used[0], used[1]], "known": float(made.known.mean()),
        "mean_light": float(made.light[made.known].mean()) if made.known.any() else None, "gain": used_gain,
        "bayer": pattern, "flat": None if flat is None else str(flat),
    }  # fmt: skip
    if as_json:
        emit("spikerig.data.texture/1", told)
        return
    note(f"{out}: {made.method} at tick {at:g} from ticks [{used[0]}, {used[1]}), {100 * told['known']:.1f} % known")
    if used_gain is not None:
        note(f"gain {used_gain:.6g} (set it with --gain)")


def _gain(text: str) -> float | None:
    if text == "auto":
        return None
    try:
        value = float(text)
    except ValueError as error:
        raise UsageError("a gain is a number or auto", value=text) from error
    if not (np.isfinite(value) and value > 0):
        raise UsageError("a gain is positive and finite", value=text)
    return value


def _view(path: Path, name: str | None) -> SpikeFile:
    from spikerig.dataset.spikes import SpikeFile
    from spikerig.dataset.store import open_scene

    scene = open_scene(path)
    try:
        if name is None:
            raise UsageError("a scene has spikes for each view", value=path, expected="--view NAME",
                             next=f"give --view, one of {', '.join(scene.names[:8])}")  # fmt: skip
        whole = scene.spikes(name)
    except BaseException:
        scene.close()
        raise
    return SpikeFile(
        path, "scene", whole.ticks, whole.height, whole.width, lambda t0, t1: whole.bits[t0:t1], scene.close,
        whole.rate_hz, whole.t0_ns, whole.clock, whole.lost, {"sensor": scene.info.get("sensor")},
    )  # fmt: skip


def _make(
    file: SpikeFile, method: str, at: float, window: int, intervals: int, reach: int
) -> tuple[Texture, tuple[int, int]]:
    """The texture, and the ticks read for it: only what the method needs, TFI in growing stretches."""
    from spikerig.dataset import texture as t

    if not 0 <= at <= file.ticks:
        raise UsageError("the instant leaves the file", value=f"tick {at:g}", expected=f"0 .. {file.ticks}")
    if method.startswith("tfp"):
        windows = t.WINDOWS if method == "tfp-adaptive" else (window,)
        first, stop = (min(max(x, 0), file.ticks) for x in t.tfp_window(at, windows[-1]))
        part = file.read(first, stop)
        made = t.tfp(part, at - first, window) if method == "tfp" else t.tfp_adaptive(part, at - first)
        return made, (first, stop)
    if reach < 1:
        raise UsageError("TFI needs some reach", value=reach)
    side = min(128, reach)
    while True:
        first, stop = max(int(at) - side, 0), min(int(at) + side, file.ticks)
        made = t.tfi(file.read(first, stop), at - first, causal=method == "tfi-causal", intervals=intervals)
        if made.known.all() or side >= reach or (first, stop) == (0, file.ticks):
            return made, (first, stop)
        side = min(4 * side, reach)


def _coloured(made: Texture, bayer: str, file: SpikeFile) -> tuple[Texture | ColourTexture, str | None]:
    """The texture, in colour where its pixels see colours, and their pattern."""
    from spikerig.dataset.bayer import Bayer, bayer_of, demosaic

    colours = Bayer(bayer) if bayer in PATTERNS else bayer_of(file.facts) if bayer == "auto" else None
    return (made, None) if colours is None else (demosaic(made, colours), colours.pattern)


def _write(out: Path, made: Texture | ColourTexture, gain: float | None, force: bool) -> float | None:
    if out.suffix.lower() == ".png":
        from spikerig.dataset.images import texture_png

        return texture_png(out, made, gain, force=force)
    if out.suffix.lower() == ".exr":
        from spikerig.dataset.images import write_image

        write_image(out, made.with_nan(), force=force)
        return None
    from spikerig.dataset.outfile import whole_file

    with whole_file(out, force=force) as part:
        np.save(part, made.with_nan(), allow_pickle=False)
    return None


def convert(
    file: File,
    out: Annotated[Path, typer.Option("-o", "--out", help="The .h5 to write.")],
    rate_hz: Rate = None,
    height: Height = None,
    width: Width = None,
    row_bits: RowBits = None,
    axes: Axes = None,
    drop_tail: DropTail = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Convert a spike file of any format to our own HDF5, block by block in bounded memory."""
    from spikerig.dataset.outfile import refuse_existing, whole_file
    from spikerig.dataset.spikes import open_spikes
    from spikerig.dataset.spikes_h5 import H5Writer

    if out.suffix.lower() not in (".h5", ".hdf5"):
        raise UsageError("import writes HDF5", value=out, expected="a name that ends in .h5")
    refuse_existing(out, force)
    layout: dict[str, Any] = {"height": height, "width": width, "row_bits": row_bits, "axes": axes}
    with open_spikes(file, **layout, rate_hz=rate_hz, drop_tail=drop_tail) as source:
        if source.rate_hz is None:
            note("the tick rate is not known: give --rate-hz if you know it; without it there is no time")
        bar = Progress(f"importing {file.name}", source.ticks, "ticks")
        with whole_file(out, force=force) as part, H5Writer(part, source) as writer:
            for block in source.blocks():
                writer.append(block)
                bar.step(block.ticks)
        told = {"file": str(file), "out": str(out), **describe_spikes(source), "bytes": out.stat().st_size}
    if as_json:
        emit("spikerig.data.import/1", told)
    else:
        note(f"wrote {out}: {told['ticks']} ticks of {told['width']}x{told['height']}")
