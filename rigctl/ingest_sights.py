"""The LED panel read from a take: what both cameras saw of it at each viewpoint, as marks.

`data ingest` and `rig panel` both read it here; they differ in who says where the LEDs are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.panel_find import find_panel_in_frames, find_panel_in_spikes
from spikerig.calib.panel_frames import read_frames
from spikerig.calib.panel_read import Spot, read_spikes
from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DataError, RefusedError, UsageError
from spikerig.dataset.marks import Mark, Sight
from spikerig.dataset.panel import Panel
from spikerig.dataset.rawtake import RawTake, TakenView, WireBytes
from spikerig.rigctl.ingest_times import Framing, clip_number
from spikerig.rigctl.panel_framing import complements
from spikerig.rigctl.panel_view import PanelPlan, mask, spots
from spikerig.rigctl.view_parts import Near, looks, open_clip, streams, without


@dataclass(frozen=True, slots=True)
class InView:
    """The panel, and where its LEDs lie in each camera's picture (pixels of that camera); empty: not in its view."""

    panel: Panel
    spike: tuple[Spot, ...]
    rgb: tuple[Spot, ...]
    find: tuple[str, ...] = ()  # arms whose spots are to be found

    @property
    def pairs(self) -> list[tuple[Spot, Spot]]:
        """LEDs and their complements in the spike camera's picture."""
        return complements(self.panel, self.spike)


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


def panel_in_view(plan: Mapping[str, Any]) -> InView | None:
    """The panel of a take's plan and its LEDs' spots; None without; faults as `panel_plan`."""
    told = panel_plan(plan)
    if told is None:
        return None
    return InView(
        told.panel, tuple(spots(told.panel, told.spike, told.spike_radius_px)),
        tuple(spots(told.panel, told.rgb, told.rgb_radius_px)),
    )  # fmt: skip


def found_in(take: RawTake, views: Sequence[TakenView], panel: InView, wire: WireBytes, framing: Framing) -> InView:
    """The panel with spots in every arm that asks for them, found by their blinking at the first viewpoint that tells.

    Raises:
        DataError: none tells, with what the last one said.
    """
    for arm in panel.find:
        why: DataError | RefusedError | None = None
        for view in views:
            try:
                spots_ = _found(take, view, arm, panel.panel, wire, framing)
            except (DataError, RefusedError) as error:
                why = error
                continue
            panel = replace(panel, spike=spots_) if arm == "spike" else replace(panel, rgb=spots_)
            break
        else:
            raise why or DataError("the take has no viewpoint to find the panel in", value=take.folder)
    return replace(panel, find=())


def _found(
    take: RawTake, view: TakenView, arm: str, panel: Panel, wire: WireBytes, framing: Framing
) -> tuple[Spot, ...]:
    if arm == "spike":
        span = max(view.spikes, key=lambda s: s[2] - s[1])
        length = (span[2] - span[1]) / take.profile.bytes_s * NS
        return tuple(find_panel_in_spikes(streams(wire, framing, span), panel, length, NS / take.profile.rate_hz))
    clip = open_clip(take, view)
    length, frame = float(clip.start_ns[clip.frames - 1] - clip.start_ns[0]), float(np.median(np.diff(clip.start_ns)))
    return tuple(find_panel_in_frames(((k.start_ns, k.light[:, :]) for k in looks(clip)), panel, length, frame))


def panel_mask(take: RawTake) -> NDArray[np.bool_] | None:
    """Pixels of the spike camera that the panel's light reaches in either arm, bool[H,W]; None without a panel."""
    plan = panel_plan(take.plan)
    if plan is None:
        return None
    return mask(plan.panel, plan.spike, plan.spike_radius_px, take.profile.height, take.profile.width)


def panel_pairs(take: RawTake) -> list[tuple[Spot, Spot]]:
    """The panel's LEDs and their complements in the spike camera's picture; empty without a panel."""
    plan = panel_in_view(take.plan)
    return [] if plan is None else plan.pairs


def sights(
    take: RawTake, views: Sequence[TakenView], panel: InView, marks: Sequence[Mark], wire: WireBytes, framing: Framing,
    done: Callable[[], None] = lambda: None,
) -> tuple[list[Sight], dict[str, str]]:  # fmt: skip
    """Sightings of all viewpoints, and why there are none of some.

    Args:
        take: whose clips are read.
        views: those that were kept.
        panel: where it is.
        marks: of the take: which turn of the panel's code it is follows from probes and stamps. Sightings are not used.
        wire, framing: of the take.
        done: called after each viewpoint.

    Cost:
        Every frame of each clip is decoded; the spikes of a viewpoint are read once.
    """
    near = Near(without(marks, Sight))
    found: list[Sight] = []
    missing: dict[str, str] = {}
    for view in views:
        for arm, told in (("spike", _spikes(view, panel, near, wire, framing)), ("rgb", _rgb(take, view, panel, near))):
            try:
                for part in told:
                    found += part
            except (DataError, RefusedError, UsageError) as error:
                missing[f"{view.name} {arm}"] = f"{error.what}: {error.value}"
        done()
    return found, missing


def _spikes(view: TakenView, panel: InView, near: Near, wire: WireBytes, framing: Framing) -> Iterator[list[Sight]]:
    if not panel.spike:
        return
    for span in view.spikes:
        for stream in streams(wire, framing, span):
            ahead = near.of_spike(span[0], stream.t0_ns) - stream.t0_ns
            yield read_spikes(stream, panel.panel, panel.spike, epoch=span[0], ahead_ns=ahead)


def _rgb(take: RawTake, view: TakenView, panel: InView, near: Near) -> Iterator[list[Sight]]:
    if not panel.rgb:
        return
    clip = open_clip(take, view)
    begun = sum(int(t) for t in (view.clip or {})["start_ns"]) // 2
    yield read_frames(
        looks(clip), panel.panel, panel.rgb, float(clip.row_ns or 0), epoch=clip_number(Path(view.clips[0]).name),
        ahead_ns=near.of_host(begun) - int(clip.start_ns[0]),
    )  # fmt: skip
