"""A ring of page-aligned buffers between the thread that reads a camera and the one that writes to disk."""

from __future__ import annotations

import mmap
import threading
from collections import deque
from dataclasses import dataclass, field
from math import ceil

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import HostError
from spikerig.dataset.segments import PAGE, padded

STOP_AT = 0.95  # of the ring: recording ends in good order here, before anything is lost


@dataclass(slots=True)
class Slot:
    """One buffer: a page for the header, then room for a payload; `used` bytes of it are filled.

    What is not `wanted` is only looked at, and not written.
    """

    page: memoryview
    room: NDArray[np.uint8]
    used: int = 0
    stamps: list[tuple[int, int, int]] = field(default_factory=list)
    epoch: int = 0
    byte_index: int = 0
    lost_transport: int = 0
    lost_recorder: int = 0
    skipped: int = 0
    suspect: int = 0
    why: str = ""
    wanted: bool = True

    def tell(self, pending: Slot) -> None:
        """Take over what was lost before this buffer; nothing is pending any more."""
        self.lost_transport, self.lost_recorder = pending.lost_transport, pending.lost_recorder
        self.skipped, self.suspect, self.why = pending.skipped, pending.suspect, pending.why
        pending.lost_transport = pending.lost_recorder = pending.skipped = pending.suspect = 0
        pending.why = ""


class Ring:
    """Buffers that go round: free, filling, full, and free again.

    Args:
        payload: bytes of a buffer.
        slots: how many, at least 3.

    Raises:
        HostError: the memory is not to be had.

    Edges:
        `fill` counts full buffers, those waiting for the disk and the one on its way there. `brim` is where recording
        has to stop: 95 % of the ring, and always one free buffer before the last, so that what is in hand fits.

    Cost:
        `slots * (payload + 4096)` bytes, touched at once: no page fault comes later.
    """

    def __init__(self, payload: int, slots: int) -> None:
        self.slots = max(3, slots)
        self.payload = payload
        step = PAGE + padded(payload)
        try:
            self._memory = mmap.mmap(-1, step * self.slots, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | mmap.MAP_POPULATE)
        except (OSError, ValueError, OverflowError) as error:
            raise HostError(
                "no memory for the ring", value=f"{step * self.slots / 1e6:.0f} MB: {error}",
                next="close other programs, or set [recorder] ring_s lower in the plan",
            ) from error  # fmt: skip
        view = memoryview(self._memory)
        self._free = deque(
            Slot(view[k * step : (k + 1) * step], np.frombuffer(view[k * step + PAGE : (k + 1) * step], np.uint8))
            for k in range(self.slots)
        )
        self._full: deque[Slot] = deque()
        self._turn = threading.Condition()
        self._closed = False
        self.fill = 0
        self.high_water = 0
        self.brim = min(ceil(STOP_AT * self.slots), self.slots - 2)

    def take(self, wait: bool = False) -> Slot | None:
        """A free buffer, emptied; None where there is none (with `wait`, once there is one)."""
        with self._turn:
            while wait and not self._free and not self._closed:
                self._turn.wait()
            if not self._free:
                return None
            slot = self._free.popleft()
        slot.used = slot.lost_transport = slot.lost_recorder = slot.skipped = slot.suspect = 0
        slot.why, slot.wanted = "", True
        slot.stamps.clear()
        return slot

    def give(self, slot: Slot) -> int:
        """Hand a filled buffer to the writer; how many are full now."""
        with self._turn:
            self._full.append(slot)
            self.fill += 1
            self.high_water = max(self.high_water, self.fill)
            self._turn.notify_all()
            return self.fill

    def next(self) -> Slot | None:
        """The oldest full buffer, waited for; None once the ring is closed and empty."""
        with self._turn:
            while not self._full and not self._closed:
                self._turn.wait()
            return self._full.popleft() if self._full else None

    def done(self, slot: Slot) -> None:
        """A buffer is on disk (or given up): it is free again."""
        with self._turn:
            self._free.append(slot)
            self.fill -= 1
            self._turn.notify_all()

    def drained(self, timeout_s: float | None = None) -> bool:
        """Wait until no buffer is full; False where that took too long."""
        with self._turn:
            return self._turn.wait_for(lambda: self.fill == 0, timeout_s)

    def close(self) -> None:
        """No more buffers come; `next` gives what is left."""
        with self._turn:
            self._closed = True
            self._turn.notify_all()


def ring_slots(chunk_s: float, ring_s: float, slot_bytes: int, memory: int) -> int:
    """How many buffers hold `ring_s` seconds beside the one that fills.

    Raises:
        HostError: they need more memory than is allowed.
    """
    slots = max(3, ceil(ring_s / chunk_s) + 2)
    if slots * slot_bytes > memory:
        raise HostError(
            "the ring between camera and disk does not fit the memory it may have",
            value=f"{slots} buffers of {slot_bytes / 1e6:.1f} MB for {ring_s:g} s",
            expected=f"at most {memory / 1e6:.0f} MB",
            next="set [recorder] memory_mb higher, or ring_s lower, in the plan",
        )
    return slots
