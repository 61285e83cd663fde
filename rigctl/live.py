"""Live checks: what a look at the stream says of exposure and focus, and what a viewpoint's checks say of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.kernels import count
from spikerig.dataset.wire import WireProfile
from spikerig.dataset.wire_ticks import ticks_from_wire
from spikerig.rigctl.take_plan import Checks

LOOK_TICKS = 128  # of a look


@dataclass(frozen=True, slots=True)
class Look:
    """A look at the stream.

    Args:
        exposure: mean spikes a tick and pixel, 0 to 1.
        saturated: share of pixels that fire at 95 % of ticks or more.
        focus: mean square of neighbours' differences over the square of the mean; only compared with itself.
    """

    exposure: float
    saturated: float
    focus: float


def look(data: NDArray[np.uint8], profile: WireProfile) -> Look:
    """Exposure, saturation and focus of some ticks of wire bytes, uint8[n, tick_bytes].

    Edges:
        Which byte begins a tick may not be known yet: exposure and saturation do not mind, focus hardly.
        All dark: focus 0.
    """
    bits = ticks_from_wire(data.reshape(-1), profile)
    counts = count(bits, profile.width, 0, len(bits)).astype(np.float64)
    mean = counts.mean()
    steps = (np.diff(counts, axis=0)[:, :-1] ** 2 + np.diff(counts, axis=1)[:-1] ** 2).mean() if mean else 0.0
    return Look(
        float(mean / len(bits)), float((counts >= 0.95 * len(bits)).mean()), float(steps / mean**2) if mean else 0.0
    )


def judge(checks: Checks, told: Mapping[str, Any], best_focus: float) -> list[str]:
    """What is amiss with a viewpoint, in words for the operator, each with what to do.

    Args:
        checks: the plan's.
        told: exposure, saturated, focus, lost_ticks, sync_us (None: not known), free_bytes; clip_ended_early and
            rgb_trouble (words) where there is an RGB camera.
        best_focus: of the viewpoints before.
    """
    amiss = []
    low, high = checks.exposure
    if told["exposure"] is not None:
        if told["exposure"] < low:
            amiss.append(f"too dark: {told['exposure']:.3f} spikes a tick, at least {low:g}: more light, open the lens")
        if told["exposure"] > high:
            amiss.append(f"too bright: {told['exposure']:.3f} spikes a tick, at most {high:g}: less light, close it")
        if told["saturated"] > checks.saturated:
            amiss.append(f"{told['saturated']:.1%} of pixels fire all the time: less light, or away from the lamp")
        if best_focus > 0 and told["focus"] < checks.focus * best_focus:
            amiss.append(f"out of focus: {told['focus'] / best_focus:.0%} of the best so far: look at the lens")
    else:
        amiss.append("no look at the stream: does the spike camera send?")
    if told["lost_ticks"] > checks.lost_ticks:
        amiss.append(f"{told['lost_ticks']} ticks lost: look at cable and disk (log.jsonl)")
    if told["sync_us"] is not None and told["sync_us"] > checks.sync_us:
        amiss.append(f"clock residual {told['sync_us']:.0f} us, at most {checks.sync_us:g}: look at the clock box")
    trouble = told.get("rgb_trouble") or ""
    if told.get("clip_ended_early"):
        amiss.append(f"the RGB camera stopped by itself ({trouble or 'it does not say why'}): take it again")
    elif trouble:
        amiss.append(f"the RGB camera: {trouble}: mend it before going on")
    if told["free_bytes"] < checks.spare_gb * 1e9:
        amiss.append(f"only {told['free_bytes'] / 1e9:.1f} GB of disk left: make room before going on")
    return amiss
