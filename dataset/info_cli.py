"""`spikerig data info`: what a file is; and the options that every verb on spike files shares."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from spikerig.dataset.errors import UsageError
from spikerig.dataset.terminal import emit, note

if TYPE_CHECKING:
    from spikerig.dataset.spikes import SpikeFile

PICTURES = {".png", ".jpg", ".jpeg", ".exr"}

File = Annotated[Path, typer.Argument(help="The file.")]
Height = Annotated[int | None, typer.Option(help="Rows of a raw raster; with --width.")]
Width = Annotated[int | None, typer.Option(help="Pixels a row of a raw raster; with --height.")]
RowBits = Annotated[int | None, typer.Option(help="Bits a row of a raw raster on disk, trailer included.")]
Axes = Annotated[str | None, typer.Option(help="THW or HWT: order of the axes of a foreign .npz.")]
Rate = Annotated[float | None, typer.Option(help="Ticks a second, where the file does not say or is wrong.")]
DropTail = Annotated[bool, typer.Option("--drop-tail", help="Leave out an unfinished last tick of a raw raster.")]
Json = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]
Force = Annotated[bool, typer.Option("--force", help="Replace an existing file.")]


def info(
    file: File,
    height: Height = None,
    width: Width = None,
    row_bits: RowBits = None,
    axes: Axes = None,
    rate_hz: Rate = None,
    drop_tail: DropTail = False,
    as_json: Json = False,
) -> None:
    """Say what a file is: spikes (.dat .bin .npz .h5), a scene (.h5), a GoPro clip (.mp4), a texture or a picture."""
    layout = {"height": height, "width": width, "row_bits": row_bits, "axes": axes, "rate_hz": rate_hz}
    raw = any(v is not None for v in layout.values()) or drop_tail
    if not raw and file.suffix.lower() in PICTURES:
        found = _picture(file)
    elif not raw and file.suffix.lower() == ".npy":
        found = _array(file)
    elif not raw and file.suffix.lower() == ".mp4":
        from spikerig.dataset.gopro_info import describe_clip

        found = describe_clip(file)
    elif not raw and is_scene(file):
        found = _scene(file)
    else:
        from spikerig.dataset.spikes import open_spikes

        with open_spikes(file, **layout, drop_tail=drop_tail) as opened:  # type: ignore[arg-type]
            found = describe_spikes(opened)
    found = {"file": str(file), **found, "bytes": file.stat().st_size}
    if as_json:
        emit("spikerig.data.info/1", found)
        return
    for key, value in found.items():
        note(f"{key:<12} {'not known' if value is None else value}")


def describe_spikes(file: SpikeFile) -> dict[str, Any]:
    """What a spike file is, JSON-ready."""
    seconds = None if file.rate_hz is None else file.ticks / file.rate_hz
    return {
        "format": file.format,
        "width": file.width,
        "height": file.height,
        "ticks": file.ticks,
        "row_bits": file.facts.get("row_bits", (file.width + 7) // 8 * 8),
        "rate_hz": file.rate_hz,
        "duration_s": seconds,
        "t0_ns": file.t0_ns,
        "clock": file.clock,
        "spike_rate": _spike_rate(file),
        "lost": file.lost.tolist(),
        **{k: v for k, v in file.facts.items() if k != "row_bits"},
    }


def _spike_rate(file: SpikeFile, samples: int = 16, ticks: int = 64) -> float | None:
    """Mean spikes a pixel and tick over a few short stretches spread over the file; None for an empty one."""
    from spikerig.dataset.texture import window_sum

    starts = np.unique(np.linspace(0, max(file.ticks - ticks, 0), samples).astype(int)).tolist()
    seen = fired = 0
    for t0 in starts:
        part = file.read(t0, min(t0 + ticks, file.ticks))
        good = part.ticks - int(part.lost_before()[-1])
        fired += int(window_sum(part, 0, part.ticks).sum())
        seen += good * file.height * file.width
    return fired / seen if seen else None


def _picture(path: Path) -> dict[str, Any]:
    from spikerig.dataset.images import read_image

    pixels = read_image(path, nonfinite="keep")
    finite = pixels[np.isfinite(pixels)] if pixels.dtype.kind == "f" else pixels
    return {
        "format": path.suffix.lower().lstrip("."),
        "width": pixels.shape[1],
        "height": pixels.shape[0],
        "channels": pixels.shape[2],
        "dtype": str(pixels.dtype),
        "transfer": "linear" if pixels.dtype.kind == "f" else "srgb",
        "least": finite.min() if finite.size else None,
        "most": finite.max() if finite.size else None,
        "not_finite": int(pixels.size - finite.size),
    }


def _array(path: Path) -> dict[str, Any]:
    from spikerig.dataset.errors import DataError

    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)
        if values.ndim != 2 or values.dtype.kind != "f":
            raise ValueError(f"{values.dtype}{values.shape}, a texture is float32[H,W]")
    except FileNotFoundError as error:
        raise UsageError("there is no such file", value=path) from error
    except (ValueError, EOFError, OSError) as error:
        raise DataError("not a texture", value=path, cause=str(error)) from error
    known = np.isfinite(values)
    return {
        "format": "texture",
        "width": values.shape[1],
        "height": values.shape[0],
        "dtype": str(values.dtype),
        "known": float(known.mean()),
        "mean_light": float(values[known].mean()) if known.any() else None,
    }


def is_scene(path: Path) -> bool:
    """Whether a file is HDF5 and not a lone stream."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        if not file.read(8).startswith(b"\x89HDF"):
            return False
    from spikerig.dataset.spikes_h5 import is_lone_stream

    return not is_lone_stream(path)


def _scene(path: Path) -> dict[str, Any]:
    from spikerig.dataset.store import open_scene

    with open_scene(path, partial=True) as scene:
        ticks = rate = None
        for name in scene.names[:1]:
            view = scene.view(name)
            if view.spikes is not None:
                ticks, rate = view.spikes.ticks, view.spikes.rate_hz
        points = scene.points
        events: dict[str, int] = scene.describe()["events"]
        return {
            "format": "scene",
            "name": scene.name,
            "status": scene.status,
            "width": scene.camera.width,
            "height": scene.camera.height,
            "views": len(scene.names),
            "train": len(scene.train),
            "test": len(scene.test),
            "first_view": scene.names[0] if scene.names else None,
            "ticks": ticks,
            "rate_hz": rate,
            "events": sum(events.values()) if events else None,
            "event_views": len(events),
            "light_gain": scene.light_gain,
            "points": None if points is None else len(points.xyz),
            "point_source": None if points is None else points.source,
            "truth": scene.has_truth,
            "truth_label": scene.truth_label or None,
        }
