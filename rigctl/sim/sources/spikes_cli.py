"""`spikerig sim spikes`: a video, a folder of pictures or one picture becomes a file of spikes."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spikerig.dataset.errors import HostError, UsageError
from spikerig.dataset.terminal import Progress, emit, note

if TYPE_CHECKING:
    from spikerig.rigctl.sim.sources.moving import Moving
    from spikerig.rigctl.sim.sources.retake import Exposures, Retake

LIST = "frames.json"


def spikes(
    source: Annotated[Path, typer.Argument(help="A video, a folder of PNG, JPEG or EXR pictures, or one picture.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The file of spikes to write: .dat, .npz or .h5.")],
    fps: Annotated[float | None, typer.Option(help="Pictures a second of the source, in place of its own.")] = None,
    rate_hz: Annotated[float, typer.Option("--rate-hz", help="Ticks a second of the spike camera.")] = 40_000.0,
    gain: Annotated[float, typer.Option(help="Spikes a tick at white.")] = 0.4,
    size: Annotated[
        str, typer.Option(help="WIDTHxHEIGHT: cropped in the middle, then averaged over areas; or 'source'.")
    ] = "400x250",
    hold: Annotated[
        bool, typer.Option("--hold/--linear", help="Each picture holds, or light goes linearly to the next.")
    ] = False,
    limit: Annotated[float | None, typer.Option(help="Seconds of the source at most; one picture stands 0.1.")] = None,
    phase: Annotated[str, typer.Option(help="Charge before the first tick: random or zero.")] = "random",
    seed: Annotated[int, typer.Option(help="Of the phase.")] = 0,
    transfer: Annotated[
        str, typer.Option(help="Of a video: auto (as the file says), bt709, srgb, linear, gamma22, gamma28, hlg, pq.")
    ] = "auto",
    background: Annotated[float | None, typer.Option(help="Linear gray behind transparent pixels, 0 to 1.")] = None,
    layer: Annotated[str, typer.Option(help="Of EXR pictures: the layer, view, part or channel.")] = "",
    bad_values: Annotated[
        str, typer.Option(help="NaN, infinite and negative light: refuse; zero; clip (infinite to the picture's most).")
    ] = "refuse",
    frames_out: Annotated[Path | None, typer.Option(help="Also a folder of blurry RGB frames (PNG, sRGB).")] = None,
    rgb_fps: Annotated[float, typer.Option(help="Frames a second of that RGB camera.")] = 30.0,
    exposure_ms: Annotated[float, typer.Option(help="Exposure of its frames.")] = 16.0,
    force: Annotated[bool, typer.Option("--force", help="Replace what is there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Turn moving pictures into spikes of an ideal camera, in bounded memory.

    Light is linear: a video is decoded by its own transfer, PNG and JPEG by sRGB, EXR is taken as it is. No poses are
    needed, and none are made: for training use `sim frames`.
    """
    from spikerig.dataset.outfile import refuse_existing
    from spikerig.rigctl.sim.sources.moving import Look, open_moving
    from spikerig.rigctl.sim.sources.retake import Retake, spikes_of
    from spikerig.rigctl.sim.sources.sink import check_ending, spike_sink

    began = time.monotonic()
    if background is not None and not 0 <= background <= 1:
        raise UsageError("a background is a linear gray level", value=background, expected="0 to 1")
    look = Look(fps, _size(size), transfer, background, layer, bad_values)
    retake = Retake(rate_hz, gain, hold, phase, seed, limit)
    check_ending(out)
    refuse_existing(out, force)
    with ExitStack() as stack:
        moving = open_moving(source, look)
        stack.callback(moving.close)
        append = stack.enter_context(spike_sink(out, moving.height, moving.width, rate_hz, force=force))
        folder = None if frames_out is None else stack.enter_context(_frames_folder(frames_out, force))
        camera, shots = (None, []) if folder is None else _camera(folder, retake, rgb_fps, exposure_ms)
        _room(out, moving, retake)
        bar = Progress(f"integrating {source.name}", retake.ticks(moving), "ticks")

        def sink(bits: Any) -> None:
            append(bits)
            bar.step(len(bits))

        made = spikes_of(moving, retake, sink, camera)
        if folder is not None:
            _list(folder, moving, retake, shots)
    _tell(source, out, moving, retake, made, frames_out, len(shots), began, as_json)


def _size(text: str) -> tuple[int, int] | None:
    if text == "source":
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise UsageError("a size is WIDTHxHEIGHT, or 'source'", value=text, expected="e.g. 400x250")
    return int(width), int(height)


def _room(out: Path, moving: Moving, retake: Retake) -> None:
    """Refuse at once what the disk cannot hold."""
    needed = retake.ticks(moving) * moving.height * ((moving.width + 7) // 8)
    free = shutil.disk_usage(out.parent).free
    if needed > free:
        raise HostError(
            "the spikes do not fit on the disk", value=f"{out}: {needed / 1e9:.1f} GB, {free / 1e9:.1f} GB are free",
            next="give --limit SECONDS, a smaller --size, or another disk",
        )  # fmt: skip


@contextmanager
def _frames_folder(folder: Path, force: bool) -> Iterator[Path]:
    """A folder beside `folder` that takes its place when all went well, and is gone when not."""
    ours = force and (folder / LIST).is_file()
    if folder.exists() and not ours and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(
            "the folder for the frames holds something", value=folder,
            next="--force replaces a folder that this command made; else give another",
        )  # fmt: skip
    if not folder.parent.is_dir():
        raise UsageError("there is no such folder", value=folder.parent, next=f"mkdir -p {folder.parent}")
    part = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        part.mkdir()
        yield part
        if folder.exists():
            shutil.rmtree(folder)
        part.rename(folder)
    except OSError as error:
        raise HostError("the frames cannot be written", value=f"{folder}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _camera(folder: Path, retake: Retake, fps: float, exposure_ms: float) -> tuple[Exposures, list[dict[str, Any]]]:
    from spikerig.dataset.images import write_image
    from spikerig.rigctl.sim.rgb import encode
    from spikerig.rigctl.sim.sources.retake import Exposures

    shots: list[dict[str, Any]] = []

    def keep(number: int, first: int, end: int, light: Any) -> None:
        file = f"{number:06d}.png"
        write_image(folder / file, encode(light))
        tick_ns = 1e9 / retake.rate_hz
        start, stop = round(first * tick_ns), round(end * tick_ns)
        shots.append({"file": file, "start_ns": start, "exposure_ns": stop - start, "ticks": [first, end]})

    return Exposures(retake.rate_hz, fps, exposure_ms, retake.hold, keep), shots


def _list(folder: Path, moving: Moving, retake: Retake, shots: list[dict[str, Any]]) -> None:
    import json

    document = {
        "schema": "spikerig.sim.rgb/1", "width": moving.width, "height": moving.height, "transfer": "srgb",
        "rate_hz": retake.rate_hz, "frames": shots,
    }  # fmt: skip
    (folder / LIST).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _tell(
    source: Path, out: Path, moving: Moving, retake: Retake, made: dict[str, Any], frames: Path | None, shots: int,
    began: float, as_json: bool,
) -> None:  # fmt: skip
    told = {
        "source": str(source), "kind": moving.kind, "out": str(out), "width": moving.width, "height": moving.height,
        **made, "seconds_of_light": made["ticks"] / retake.rate_hz, "rate_hz": retake.rate_hz, "gain": retake.gain,
        "light": "hold" if retake.hold else "linear", "phase": retake.phase, "seed": retake.seed, **moving.facts,
        "frames_out": None if frames is None else str(frames), "rgb_frames": shots, "bytes": out.stat().st_size,
        "seconds": time.monotonic() - began,
    }  # fmt: skip
    if as_json:
        emit("spikerig.sim.spikes/1", told)
    colour = f", {told['transfer']} ({told['transfer_from']})" if "transfer" in told else ""
    note(
        f"{out}: {told['ticks']} ticks ({told['seconds_of_light']:.3f} s) of {moving.width}x{moving.height} at "
        f"{retake.rate_hz:g} Hz{colour}, {told['spikes_per_tick']:.4f} spikes a tick, "
        f"{100 * told['clipped_share']:.2g} % of the charge clipped, {told['seconds']:.1f} s"
    )
    if frames is not None:
        note(f"{frames}: {shots} blurry frames")
    if told.get("skipped"):
        note(f"{told['skipped']} frames were not later than the one before and were left out")
    if told.get("missing_numbers"):
        note(f"{told['missing_numbers']} numbers are missing between the pictures: time goes on without them")
    if told.get("interlaced"):
        note("the video is interlaced: its lines are of two instants; deinterlace it first")
    bad = told.get("bad_values", {})
    if bad.get("pictures"):
        note(
            f"mended ({bad['how']}) in {bad['pictures']} pictures: {bad['nan']} NaN, {bad['infinite']} infinite, "
            f"{bad['negative']} negative values"
        )
