"""What both cameras saw at a viewpoint of a take, piece by piece, and roughly when: for whoever reads lights in it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.clock import Piece, fit_clock
from spikerig.calib.panel_frames import Look
from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DataError
from spikerig.dataset.gopro_file import GoProClip, open_gopro
from spikerig.dataset.gopro_pictures import read_pictures
from spikerig.dataset.images import linear_from_srgb
from spikerig.dataset.marks import Mark
from spikerig.dataset.rawtake import RawTake, TakenView, WireBytes
from spikerig.dataset.stream import SpikeStream
from spikerig.dataset.wire_ticks import ticks_from_wire
from spikerig.rigctl.ingest_times import LATE_TICKS, Framing

SLICE_S = 0.25  # of the stream, in memory at once
GRAY = np.array([0.2126, 0.7152, 0.0722])


def streams(wire: WireBytes, framing: Framing, span: tuple[int, int, int]) -> Iterator[SpikeStream]:
    """The spikes of a span of bytes in pieces of a quarter of a second, on the camera's own time.

    Args:
        wire, framing: of the take.
        span: (epoch, first byte, byte past the last).

    Yields:
        Ticks with those that are lost or suspect listed, their bits 0; the last piece may be half as long again.
    """
    profile = wire.take.profile
    epoch, start, stop = span
    offset, size = framing.offset(epoch), profile.tick_bytes
    step = max(round(SLICE_S * profile.rate_hz), 1)
    first, last = -(-(start - offset) // size), (stop - offset) // size
    for t in range(first, max(last - step // 2, first + 1), step):
        end = last if t + 3 * step // 2 >= last else t + step
        a, b = offset + t * size, offset + end * size
        data, missing = wire.read(epoch, a, b)
        missing += wire.suspect(epoch, a, b)
        lost = np.array(sorted(((m - a) // size, -(-(n - a) // size)) for m, n in missing), np.int64).reshape(-1, 2)
        bits = ticks_from_wire(data, profile)
        for m, n in lost:
            bits[m:n] = 0
        t0_ns = round((t + offset / size - LATE_TICKS) / profile.rate_hz * NS)
        yield SpikeStream(bits, profile.width, profile.rate_hz, t0_ns, "spike", lost)


def open_clip(take: RawTake, view: TakenView) -> GoProClip:
    """A viewpoint's clip, which tells exposures and read-out.

    Raises:
        DataError: it is not there, damaged, or does not tell.
    """
    if view.clip is None or not view.clips:
        raise DataError("its clip is not in the take", value=view.name, next="spikerig rig record ... --resume fetches")
    clip = open_gopro([take.folder / "rgb" / name for name in view.clips])
    if clip.exposure_ns is None or clip.row_ns is None:
        raise DataError("the clip does not tell exposures or read-out", value=view.clips[0])
    return clip


def looks(clip: GoProClip) -> Iterator[Look]:
    """Every frame of a clip; its light is worked out where it is looked at."""
    for number, frame in read_pictures(clip, range(clip.frames)):
        light: Any = _Linear(frame.pixels, frame.full)
        yield Look(frame.start_ns, frame.exposure_ns, light, not clip.key[number])


class _Linear:
    """A picture whose light is worked out only where it is looked at."""

    def __init__(self, pixels: NDArray[Any], full: float) -> None:
        self._pixels, self._full, self.shape = pixels, full, pixels.shape[:2]

    def __getitem__(self, where: Any) -> NDArray[np.float64]:
        part = np.asarray(self._pixels[where], np.float32) / self._full
        return np.asarray(linear_from_srgb(part), np.float64) @ GRAY


class Near:
    """Clocks roughly, from what the host stamped: good to milliseconds for bytes, to a second for clips."""

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
        """Box time at a time of the spike camera, as `of_host`.

        Raises:
            DataError: no stamps of that epoch.
        """
        return self.of_host(int(self._piece(epoch).track.model().rig_from_device(device_ns)))

    def spike_of_host(self, epoch: int, host_ns: int) -> tuple[int, int]:
        """The spike camera's time at a host time, and what that is good to, ns.

        Raises:
            DataError: no stamps of that epoch.
        """
        piece = self._piece(epoch)
        model = piece.track.model(0, piece.bias_ns)
        at = int(model.device_from_rig(host_ns))
        return at, round(2 * float(model.sigma_at(at)))

    def _piece(self, epoch: int) -> Piece:
        if epoch not in self._spike:
            raise DataError("no stamps tell when an epoch of the spike stream was", value=f"epoch {epoch}",
                            cause="marks.jsonl is cut short")  # fmt: skip
        return self._spike[epoch]


def without(marks: Iterable[Mark], kind: type) -> list[Mark]:
    """Marks but those of a kind."""
    return [m for m in marks if not isinstance(m, kind)]
