"""A take without a clock box: one blinking LED in both cameras' view ties them, viewpoint by viewpoint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.led_find import find_in_frames, find_in_spikes, periods_to_try
from spikerig.calib.led_frames import frame_sights, spike_sights, timeline
from spikerig.calib.led_read import Beat, Blinks, beat_of, spike_blinks
from spikerig.calib.panel_read import Spot
from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DataError, RefusedError, UsageError
from spikerig.dataset.gopro_file import GoProClip
from spikerig.dataset.marks import Mark, Sight
from spikerig.dataset.rawtake import RawTake, TakenView, WireBytes
from spikerig.rigctl.ingest_times import Framing, clip_number
from spikerig.rigctl.led_view import LedPlan, led_mask
from spikerig.rigctl.view_parts import Near, looks, open_clip, streams, without

SLACK_NS = 50_000_000  # a camera may say that it encodes so long before its first frame, or leave out the last ones


@dataclass(frozen=True, slots=True)
class LedSights:
    """What a blinking LED told of a take.

    Args:
        sights: marks of both cameras; the LED's time is the spike camera's, put on the host's.
        missing: why there are none, by viewpoint and arm.
        period_ns: of the LED by the spike camera's clock; 0: it is not steady.
        rms_ns: of its edges in the spikes, from an even beat.
        spike, rgb: where it was at each viewpoint.
    """

    sights: list[Sight]
    missing: dict[str, str]
    period_ns: float
    rms_ns: float
    spike: dict[str, list[Spot]]
    rgb: dict[str, list[Spot]]

    def hidden(self, view: str, height: int, width: int) -> NDArray[np.bool_] | None:
        """Pixels of the spike camera's picture that the LED lights at a viewpoint; None where it was not seen."""
        return led_mask(self.spike[view], height, width) if view in self.spike else None

    def as_json(self) -> dict[str, Any]:
        """JSON-ready, without the marks."""
        places = {
            arm: {name: [[round(s.x_px, 2), round(s.y_px, 2), round(s.radius_px, 2)] for s in row]
                  for name, row in told.items()}
            for arm, told in (("spike", self.spike), ("rgb", self.rgb))
        }  # fmt: skip
        return {"period_ms": self.period_ns / 1e6, "rms_us": self.rms_ns / 1e3, "places_px": places}


def led_sights(
    take: RawTake, views: Sequence[TakenView], led: LedPlan, marks: Sequence[Mark], wire: WireBytes, framing: Framing,
    done: Callable[[], None] = lambda: None,
) -> LedSights:  # fmt: skip
    """Sightings of the LED at all viewpoints.

    Args:
        take, views, led: what was recorded, and what the plan says of the LED.
        marks: of the take, for when the spike stream and the clips were, roughly.
        wire, framing: of the take.
        done: called after each viewpoint.

    Edges:
        Viewpoints whose spikes or clips do not tell are left out and told. Of an epoch of the spike stream without
        stamps nothing can be told.

    Cost:
        Every frame of each clip is decoded, twice where the LED's pixels are not given; spikes are read once or twice.
    """
    near = Near(without(marks, Sight))
    missing: dict[str, str] = {}
    places: dict[str, dict[str, list[Spot]]] = {"spike": {}, "rgb": {}}
    blinks: dict[str, Blinks] = {}
    for view in views:
        span = max(view.spikes, key=lambda s: s[2] - s[1])
        try:
            spots = led.spots("spike") or _found(led, wire, framing, span)
            blinks[view.name] = spike_blinks(streams(wire, framing, span), spots)
            places["spike"][view.name] = spots
        except (DataError, RefusedError, UsageError) as error:
            missing[f"{view.name} spike"] = f"{error.what}: {error.value}"
    beat = Beat(0.0, 0.0, (), 0.0)
    try:
        beat = beat_of(list(blinks.values()), led.period_ms * 1e6)
    except DataError as error:
        missing |= {f"{name} spike": f"{error.what}: {error.value}" for name in blinks}
        blinks = {}
    starts = dict(zip(blinks, beat.starts_ns, strict=True))
    told: list[Sight] = []
    for view in views:
        if view.name in blinks:
            try:
                spots, found = _of_view(take, view, led, blinks[view.name], beat, starts[view.name], near)
                places["rgb"][view.name] = spots
                told += found
            except (DataError, RefusedError, UsageError) as error:
                missing[f"{view.name} rgb"] = f"{error.what}: {error.value}"
        done()
    return LedSights(told, missing, beat.period_ns, beat.rms_ns, places["spike"], places["rgb"])


def _found(led: LedPlan, wire: WireBytes, framing: Framing, span: tuple[int, int, int]) -> list[Spot]:
    profile = wire.take.profile
    length = (span[2] - span[1]) / profile.bytes_s * NS
    return find_in_spikes(streams(wire, framing, span), periods_to_try(led.period_ms * 1e6, length))


def _of_view(
    take: RawTake, view: TakenView, led: LedPlan, blinks: Blinks, beat: Beat, start_ns: int, near: Near
) -> tuple[list[Spot], list[Sight]]:
    """Sightings of one viewpoint by both cameras, and where the LED is in the clip."""
    clip, number = open_clip(take, view), clip_number(Path(view.clips[0]).name)
    epoch = max(view.spikes, key=lambda s: s[2] - s[1])[0]
    first = blinks.span_ns[0]
    line = timeline(blinks, beat, start_ns, add := near.of_spike(epoch, first) - first)
    spots = led.spots("rgb")
    if not spots:
        if not beat.period_ns:
            raise DataError("an LED that is not steady is not found in a clip", value=view.name, next="led.rgb")
        spots = find_in_frames(((k.start_ns, k.light[:, :]) for k in looks(clip)), beat.period_ns)
    between = _between(view, clip, near, epoch, add)
    found = frame_sights(looks(clip), spots, float(clip.row_ns or 0), line, between, number)
    return spots, spike_sights(blinks, line, epoch, add) + found


def _between(view: TakenView, clip: GoProClip, near: Near, epoch: int, add_ns: int) -> tuple[int, int]:
    """What the LED's time minus the clip's media time may be, from the host's stamps around its start and its stop.

    Raises:
        DataError: the stamps contradict each other.
    """
    told = view.clip or {}
    frame = int(np.median(np.diff(clip.start_ns))) if clip.frames > 1 else 0
    ends = []
    for stamps, media, early, late in (
        (told["start_ns"], int(clip.start_ns[0]), 0, SLACK_NS),
        (told["stop_ns"], int(clip.start_ns[clip.frames - 1]), SLACK_NS + 2 * frame, 0),
    ):
        (a, good_a), (b, good_b) = (near.spike_of_host(epoch, int(t)) for t in stamps)
        ends.append((a + add_ns - media - early - good_a, b + add_ns - media + late + good_b))
    low, high = max(a for a, _ in ends), min(b for _, b in ends)
    if low >= high:
        raise DataError("when a clip was started and stopped does not agree with its length", value=view.name,
                        cause=f"{(low - high) / 1e6:.0f} ms apart")  # fmt: skip
    return low, high
