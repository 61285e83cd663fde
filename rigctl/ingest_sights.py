"""The LED panel read from a take: what both cameras saw of it at each viewpoint, as marks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.clock_maps import Clocks
from spikerig.calib.panel_frames import Look, read_frames
from spikerig.calib.panel_read import Spot, read_spikes
from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DataError, RefusedError, UsageError
from spikerig.dataset.gopro_file import GoProClip, open_gopro
from spikerig.dataset.gopro_pictures import read_pictures
from spikerig.dataset.images import linear_from_srgb
from spikerig.dataset.marks import Sight
from spikerig.dataset.rawtake import RawTake, TakenView, WireBytes
from spikerig.dataset.stream import SpikeStream
from spikerig.dataset.wire_ticks import ticks_from_wire
from spikerig.rigctl.ingest_times import LATE_TICKS, Framing, clip_number
from spikerig.rigctl.panel_framing import complements
from spikerig.rigctl.panel_view import PanelPlan, mask, spots

BLOCK_TICKS = 4096  # read at a time
GRAY = np.array([0.2126, 0.7152, 0.0722], np.float32)


def panel_plan(plan: Mapping[str, Any]) -> PanelPlan | None:
    """The panel of a take's plan; None without.

    Raises:
        DataError: it is no panel.
    """
    told = plan.get("panel")
    if told is None:
        return None
    try:
        names = {f.name for f in fields(PanelPlan)}
        values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in told.items() if k in names}
        panel = PanelPlan(**values)
        _ = panel.panel
    except (TypeError, ValueError, AttributeError, UsageError) as error:
        raise DataError("the take's plan has a panel that is none", value=str(error)) from error
    return panel


def panel_mask(take: RawTake) -> NDArray[np.bool_] | None:
    """Pixels of the spike camera that the panel's light reaches in either arm, bool[H,W]; None without a panel."""
    plan = panel_plan(take.plan)
    if plan is None:
        return None
    return mask(plan.panel, plan.spike, plan.spike_radius_px, take.profile.height, take.profile.width)


def panel_pairs(take: RawTake) -> list[tuple[Spot, Spot]]:
    """The panel's LEDs and their complements in the spike camera's picture; empty without a panel."""
    plan = panel_plan(take.plan)
    return [] if plan is None else complements(plan.panel, spots(plan.panel, plan.spike, plan.spike_radius_px))


def sights(
    take: RawTake, views: list[TakenView], clocks: Clocks, wire: WireBytes, framing: Framing,
    done: Callable[[], None] = lambda: None,
) -> tuple[list[Sight], dict[str, str]]:  # fmt: skip
    """Sightings of all viewpoints, and why there are none of some.

    Args:
        take: whose plan tells where the panel is; without one there are no sightings.
        views: those that were kept.
        clocks: fitted without sightings: which turn of the panel's code it is.
        wire, framing: of the take.
        done: called after each viewpoint.

    Cost:
        Every frame of each clip is decoded; the spikes of a viewpoint are read once.
    """
    plan = panel_plan(take.plan)
    found: list[Sight] = []
    missing: dict[str, str] = {}
    for view in views if plan is not None else []:
        for arm, read in (("spike", _spike_sights), ("rgb", _rgb_sights)):
            try:
                found += read(take, view, plan, clocks, wire, framing)  # type: ignore[arg-type]
            except (DataError, RefusedError, UsageError) as error:
                missing[f"{view.name} {arm}"] = f"{error.what}: {error.value}"
        done()
    return found, missing


def _spike_sights(
    take: RawTake, view: TakenView, plan: PanelPlan, clocks: Clocks, wire: WireBytes, framing: Framing
) -> Iterator[Sight]:
    profile = take.profile
    epoch, start, stop = max(view.spikes, key=lambda s: s[2] - s[1])
    offset = framing.offset(epoch)
    first, last = -(-(start - offset) // profile.tick_bytes), (stop - offset) // profile.tick_bytes
    where = spots(plan.panel, plan.spike, plan.spike_radius_px)
    for t0 in range(first, last, BLOCK_TICKS):
        t1 = min(t0 + BLOCK_TICKS, last)
        data, missing = wire.read(epoch, offset + t0 * profile.tick_bytes, offset + t1 * profile.tick_bytes)
        lost = [((a - offset) // profile.tick_bytes - t0, -(-(b - offset) // profile.tick_bytes) - t0)
                for a, b in missing]  # fmt: skip
        at = round((t0 + offset / profile.tick_bytes - LATE_TICKS) / profile.rate_hz * NS)
        stream = SpikeStream(ticks_from_wire(data, profile), profile.width, profile.rate_hz, at, "spike",
                             np.array(lost, np.int64).reshape(-1, 2))  # fmt: skip
        model = clocks.fit("spike", epoch, at).model
        ahead = int(model.rig_from_device(at)) + clocks.origin_ns - at
        yield from read_spikes(stream, plan.panel, where, epoch=epoch, ahead_ns=ahead)


def _rgb_sights(
    take: RawTake, view: TakenView, plan: PanelPlan, clocks: Clocks, wire: WireBytes, framing: Framing
) -> list[Sight]:
    if view.clip is None or not view.clips:
        raise DataError("its clip is not in the take", value=view.name)
    clip = open_gopro([take.folder / "rgb" / name for name in view.clips])
    if clip.row_ns is None:
        raise DataError("the clip does not tell its read-out time", value=view.clips[0])
    begun = sum(int(t) for t in view.clip["start_ns"]) // 2
    panel_ns = int(clocks.fit("host", None, begun).model.rig_from_device(begun)) + clocks.origin_ns
    return read_frames(
        _looks(clip), plan.panel, spots(plan.panel, plan.rgb, plan.rgb_radius_px), clip.row_ns,
        epoch=clip_number(Path(view.clips[0]).name), ahead_ns=panel_ns - int(clip.start_ns[0]),
    )  # fmt: skip


def _looks(clip: GoProClip) -> Iterator[Look]:
    for number, frame in read_pictures(clip, range(clip.frames)):
        light = np.asarray(linear_from_srgb(np.asarray(frame.pixels, np.float32) / frame.full), np.float32) @ GRAY
        yield Look(frame.start_ns, frame.exposure_ns, light, not clip.key[number])
