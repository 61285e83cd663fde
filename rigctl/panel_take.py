"""The LED panel read in a whole take: sights of its spikes and clips, which tie both cameras to the panel's time."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.clock import Piece, fit_clock
from spikerig.calib.panel_frames import Look, read_frames
from spikerig.calib.panel_read import Spot, read_spikes
from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DataError, RigError, UsageError
from spikerig.dataset.gopro_file import open_gopro
from spikerig.dataset.gopro_pictures import read_pictures
from spikerig.dataset.images import linear_from_srgb
from spikerig.dataset.marks import Mark, MarkLog, Sight, read_marks
from spikerig.dataset.outfile import whole_file
from spikerig.dataset.panel import Led, Panel
from spikerig.dataset.rawtake import RawTake, TakenView, WireBytes, open_take
from spikerig.dataset.stream import SpikeStream
from spikerig.dataset.wire_ticks import ticks_from_wire
from spikerig.rigctl.ingest_times import LATE_TICKS, Framing, clip_number

SCHEMA = "spikerig.panel/1"
SLICE_S = 0.25  # of the stream, in memory at once


@dataclass(frozen=True, slots=True)
class InView:
    """The panel, and where its LEDs lie in each camera's picture (pixels of that camera)."""

    panel: Panel
    spike: tuple[Spot, ...]
    rgb: tuple[Spot, ...]


def read_spots(path: str | Path) -> InView:
    """A file of spots: {"schema": "spikerig.panel/1", "panel": {step_ns, bits, slow, leds}, "spike": [[led, x, y, r]],
    "rgb": [...]}; `leds` ([[bit, inverted, x_mm, y_mm]]) may be left out for the usual two rows.

    Raises:
        UsageError: there is no such file.
        DataError: it is something else.
    """
    try:
        told = json.loads(Path(path).read_text(encoding="utf-8"))
        if told["schema"] != SCHEMA:
            raise ValueError(f"schema {told['schema']!r}")
        own = dict(told["panel"])
        leds = tuple(Led(int(b), bool(i), float(x), float(y)) for b, i, x, y in own.pop("leds", ()))
        panel = Panel(**{k: int(v) for k, v in own.items()}, leds=leds)
        spots = {
            k: tuple(Spot(int(n), float(x), float(y), float(r)) for n, x, y, r in told[k]) for k in ("spike", "rgb")
        }
        numbers = [s.led for row in spots.values() for s in row]
        if not numbers or min(numbers) < 0 or max(numbers) >= len(panel.leds):
            raise ValueError("a spot names an LED that the panel does not have, or there are none")
        return InView(panel, spots["spike"], spots["rgb"])
    except OSError as error:
        raise UsageError("the file of spots cannot be read", value=f"{path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, UsageError) as error:
        raise DataError("not a file of the panel's spots", value=path, cause=str(error), expected=SCHEMA) from error


def read_panel(folder: str | Path, view: InView, *, force: bool = False) -> dict[str, Any]:
    """Read the panel in every kept viewpoint of a take and add the sights to its marks.

    Args:
        folder: of the take, not being recorded.
        view: the panel and its spots.
        force: sights that are there already are replaced.

    Returns:
        How many sights each camera gave, and what could not be read.

    Raises:
        UsageError: sights are there and `force` is not given.
        DataError: nothing in the take shows the panel.
    """
    take = open_take(folder)
    path = take.folder / "marks.jsonl"
    marks = list(read_marks(path)) if path.exists() else []
    old = [m for m in marks if isinstance(m, Sight)]
    if old and not force:
        raise UsageError("this take's panel was read already", value=f"{len(old)} sights", next="--force reads anew")
    marks = [m for m in marks if not isinstance(m, Sight)]
    near = _Near(marks)
    views = [v for v in take.views() if v.kept]
    sights: list[Sight] = []
    trouble: list[str] = []
    for found in (_of_spikes(take, views, view, near), _of_clips(take, views, view, near)):
        for got in found:
            if isinstance(got, str):
                trouble.append(got)
            else:
                sights += got
    if not sights:
        raise DataError("nothing in this take shows the panel", value=take.folder, cause="; ".join(trouble)[:500])
    with whole_file(path, force=True) as part:
        log = MarkLog(part)
        log.add([*marks, *sights])
        log.close()
    return {
        "spike": sum(s.clock == "spike" for s in sights), "rgb": sum(s.clock == "rgb" for s in sights),
        "trouble": trouble,
    }  # fmt: skip


class _Near:
    """The panel's time roughly, from what the host stamped: good to milliseconds for bytes, to a second for clips."""

    def __init__(self, marks: Sequence[Mark]) -> None:
        self._host: list[Piece] = fit_clock(marks, "host")
        self._spike = {p.epoch: p for p in fit_clock(marks, "spike") if p.to == "host"}

    def of_host(self, host_ns: int) -> int:
        """Box time at a host time; without a box the host's own stands in."""
        if not self._host:
            return host_ns
        piece = min(self._host, key=lambda p: max(p.track.valid_ns[0] - host_ns, host_ns - p.track.valid_ns[1], 0))
        return int(piece.track.model().rig_from_device(host_ns))

    def of_spike(self, epoch: int, device_ns: int) -> int:
        """Box time at a time of the spike camera; 0 is not known."""
        piece = self._spike.get(epoch)
        return 0 if piece is None else self.of_host(int(piece.track.model().rig_from_device(device_ns)))


def _of_spikes(take: RawTake, views: list[TakenView], view: InView, near: _Near) -> Iterator[list[Sight] | str]:
    if not view.spike:
        return
    wire, profile = WireBytes(take), take.profile
    framing = Framing(wire, [s for v in views for s in v.spikes])
    step = max(round(SLICE_S * profile.rate_hz), 1)
    for taken in views:
        for epoch, start, stop in taken.spikes:
            try:
                offset = framing.offset(epoch)
                first = -(-(start - offset) // profile.tick_bytes)
                last = (stop - offset) // profile.tick_bytes
                for t in range(first, max(last - step // 2, first + 1), step):
                    end = last if t + 3 * step // 2 >= last else t + step
                    stream = _stream(wire, epoch, offset, t, end)
                    ahead = near.of_spike(epoch, stream.t0_ns) - stream.t0_ns
                    yield read_spikes(stream, view.panel, view.spike, epoch=epoch, ahead_ns=ahead)
            except RigError as error:
                yield f"{taken.name}, spikes: {error.what}"


def _stream(wire: WireBytes, epoch: int, offset: int, first: int, last: int) -> SpikeStream:
    """Ticks of an epoch on the camera's own time: bytes over the nominal rate, as the ingest counts them."""
    profile = wire.take.profile
    size = profile.tick_bytes
    a, b = offset + first * size, offset + last * size
    data, missing = wire.read(epoch, a, b)
    missing += wire.suspect(epoch, a, b)
    lost = np.array([((m - a) // size, -(-(n - a) // size)) for m, n in missing], np.int64).reshape(-1, 2)
    bits = ticks_from_wire(data, profile)
    for m, n in lost:
        bits[m:n] = 0
    t0_ns = round((first + offset / size - LATE_TICKS) / profile.rate_hz * NS)
    return SpikeStream(bits, profile.width, profile.rate_hz, t0_ns, "spike", lost)


def _of_clips(take: RawTake, views: list[TakenView], view: InView, near: _Near) -> Iterator[list[Sight] | str]:
    if not view.rgb:
        return
    for taken in views:
        if not taken.clips or taken.clip is None:
            continue
        try:
            clip = open_gopro([take.folder / "rgb" / name for name in taken.clips])
            if clip.exposure_ns is None or clip.row_ns is None:
                yield f"{taken.name}, clip: it does not tell exposures or read-out"
                continue
            ahead = near.of_host(int(taken.clip["start_ns"][-1])) - int(clip.start_ns[0])
            looks = (
                Look(f.start_ns, f.exposure_ns, _Linear(f.pixels), not clip.key[k])  # type: ignore[arg-type]
                for k, f in read_pictures(clip, range(clip.frames))
            )
            number = clip_number(taken.clips[0])
            yield read_frames(looks, view.panel, view.rgb, clip.row_ns, epoch=number, ahead_ns=ahead)
        except RigError as error:
            yield f"{taken.name}, clip: {error.what}"


class _Linear:
    """A picture whose light is worked out only where it is looked at."""

    def __init__(self, pixels: NDArray[Any]) -> None:
        self._pixels, self.shape = pixels, pixels.shape[:2]

    def __getitem__(self, where: tuple[slice, slice]) -> NDArray[np.float64]:
        return np.asarray(linear_from_srgb(self._pixels[where]), np.float64).mean(-1)
