"""What a capture plan comes to on this machine, and every reason against it, before anything is touched."""

from __future__ import annotations

import re
import shutil
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import Any

from spikerig.dataset.errors import RigError, UsageError
from spikerig.dataset.segments import PAGE, chunk_ticks, padded
from spikerig.rigctl.profiles import check_link
from spikerig.rigctl.ring import ring_slots
from spikerig.rigctl.take_plan import TakePlan

PERIODS = 1.6  # of a plain LED that a viewpoint must hold


@dataclass(frozen=True, slots=True)
class Forecast:
    """What a plan comes to.

    Args:
        view_bytes, spike_bytes: of a viewpoint's spikes, and of all.
        clip_bytes: of all clips.
        seconds: at least, of the whole take.
        bytes_s, link_bytes_s: what the spike camera makes, and what its link carries.
        ring_bytes: of memory.
        free_bytes: of the disk; None where there is no folder yet to ask of.
        cannot: every reason against it.
        limits: what ends it, in words.
    """

    view_bytes: int
    spike_bytes: int
    clip_bytes: int
    seconds: float
    bytes_s: float
    link_bytes_s: float
    ring_bytes: int
    free_bytes: int | None
    cannot: tuple[dict[str, Any], ...]
    limits: tuple[str, ...]


def forecast(plan: TakePlan, out: Path, *, done: int = 0, memory: int | None = None) -> Forecast:
    """What a plan will need on this machine; no device is touched.

    Args:
        plan: the plan.
        out: folder of the take, there or not.
        done: viewpoints that are kept already.
        memory: bytes of free memory; None: asked of the system.
    """
    wire, left = plan.profile, len(plan.viewpoints) - done
    ticks = chunk_ticks(wire.tick_bytes, wire.rate_hz)
    slot = PAGE + padded(ticks * wire.tick_bytes)
    per_view = ceil(plan.seconds * wire.bytes_s / (ticks * wire.tick_bytes)) * slot
    clip = (plan.seconds + 2 * plan.rgb.lead_s) * plan.rgb.mbit_s / 8 * 1e6 if plan.rgb.use else 0.0
    cannot: list[RigError] = []
    if (told := check_link(wire)) is not None:
        cannot.append(told)
    ring = 0
    try:
        ring = slot * ring_slots(ticks / wire.rate_hz, plan.recorder.ring_s, slot, round(plan.recorder.memory_mb * 1e6))
    except RigError as error:
        cannot.append(error)
    free_memory = _free_memory() if memory is None else memory
    if free_memory is not None and ring > 0.8 * free_memory:
        cannot.append(_lacks("memory", ring, free_memory, "close programs, or set recorder.ring_s lower"))
    free = _free_disk(out)
    needed = left * per_view + round(left * clip) + round(plan.checks.spare_gb * 1e9)
    if free is not None and free < needed:
        cannot.append(_lacks(f"disk at {out}", needed, free, "another --out, fewer viewpoints or seconds"))
    card = round(plan.rgb.card_gb * 1e9)
    if plan.rgb.use and card and card < left * clip:
        cannot.append(_lacks("the RGB camera's card", round(left * clip), card, "an empty card, fewer viewpoints"))
    cannot += _optical(plan)
    wait = plan.settle_s if plan.advance == "auto" else 0.0
    seconds = left * (plan.seconds + (2 * plan.rgb.lead_s if plan.rgb.use else 0.0) + wait)
    room = [] if free is None else [f"the disk: full after {max(0, free) / max(wire.bytes_s, 1):.0f} s of spikes"]
    return Forecast(
        per_view, left * per_view, round(left * clip), seconds, wire.bytes_s, wire.link_bytes_s, ring, free,
        tuple(e.as_json() for e in cannot),
        (f"the link: {wire.link_bytes_s / 1e6:.0f} MB/s, the camera makes {wire.bytes_s / 1e6:.0f}", *room,
         f"the ring: {plan.recorder.ring_s:g} s without the disk", *_beats(plan)),
    )  # fmt: skip


def _optical(plan: TakePlan) -> list[RigError]:
    """Why the LED of a plan without a clock box cannot do."""
    if plan.sync.mode != "optical":
        return []
    if not plan.rgb.use:
        return [UsageError("optical sync ties the spikes to an RGB camera, and the plan uses none", value="rgb.use",
                           next='rgb.use = true, or sync.mode = "none"')]  # fmt: skip
    period = (plan.led.period_ms if plan.led else 0.0) / 1e3
    if plan.seconds < PERIODS * period:
        return [UsageError("viewpoints are too short for the LED", value=f"{plan.seconds:g} s",
                           expected=f"at least {PERIODS} periods, {PERIODS * period:.2f} s")]  # fmt: skip
    return []


def _beats(plan: TakePlan) -> list[str]:
    """What the LED's period must be."""
    if plan.sync.mode != "optical":
        return []
    return ["the LED: its period must exceed what a clip's start and stop leave open, some 0.2 to 0.35 s by Bluetooth"]


def _lacks(what: str, needed: int, free: int, next: str) -> UsageError:
    return UsageError(f"not enough room: {what}", value=f"{free / 1e9:.2f} GB free",
                      expected=f"{needed / 1e9:.2f} GB", next=next)  # fmt: skip


def _free_disk(out: Path) -> int | None:
    for folder in (out, *out.absolute().parents):
        if folder.is_dir():
            return shutil.disk_usage(folder).free
    return None


def _free_memory() -> int | None:
    try:
        text = Path("/proc/meminfo").read_text(encoding="ascii")
    except OSError:
        return None
    found = re.search(r"MemAvailable:\s+(\d+) kB", text)
    return int(found[1]) * 1024 if found else None
