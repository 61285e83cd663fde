"""How a recorder is to record, and what it says of itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

OnFull = Literal["stop", "drop", "wait"]


@dataclass(frozen=True, slots=True)
class RecorderOptions:
    """How to record.

    Args:
        ring_s: seconds of data between camera and disk.
        memory: bytes the ring may have.
        on_full: what to do when the ring is nearly full: "stop" keeping in good order before anything is lost; "drop"
            what does not fit, counted; "wait" for the disk, for sources that can wait (replays, emulated time).
        segment_bytes, sync_s, direct: as in SegmentWriter.
        watch: look whether ticks still begin where they did (`slip_watch`).
    """

    ring_s: float = 1.0
    memory: int = 1 << 30
    on_full: OnFull = "stop"
    segment_bytes: int = 1 << 30
    sync_s: float = 1.0
    direct: bool = True
    watch: bool = True


@dataclass(frozen=True, slots=True)
class RecorderState:
    """Where a recorder stands; `trouble` ended the keeping, empty while all is well."""

    keeping: bool
    epoch: int
    seen_bytes: int
    kept_bytes: int
    chunks: int
    synced: int
    fill: int
    slots: int
    high_water: int
    lost_transport: int
    lost_recorder: int
    trouble: str
