"""A take's numbers for a source's epochs and bytes: they go on over sessions, and a slip begins an epoch, too."""

from __future__ import annotations

import threading
from dataclasses import replace

from spikerig.rigctl.devices import Block
from spikerig.rigctl.slip_watch import Slip

FRAMING = "framing"  # why an epoch began: ticks began elsewhere


class Numbering:
    """Renumbers blocks in the reading thread; slips come from another.

    Args:
        first_epoch: number of the source's first epoch.

    Edges:
        One loss is counted once: what the framing told is taken off what bytes against time tell of the same bytes
        later; and a slip in an epoch that a told loss has ended meanwhile is not told again.
    """

    def __init__(self, first_epoch: int) -> None:
        self._first_epoch = first_epoch
        self._base: int | None = None  # added to the source's epochs
        self._source = self._origin = 0  # the source's epoch, and its byte that is our byte 0
        self._epoch = self._began = self._seen = 0  # ours, its first byte and all bytes, counted over all epochs
        self._slip: Slip | None = None
        self._told = (-1, 0)  # of the last slip: where, counted over all epochs, and bytes
        self._lock = threading.Lock()

    def slip(self, slip: Slip) -> bool:
        """The next block shall begin an epoch; False where this one has ended already."""
        with self._lock:
            if slip.epoch != self._epoch:
                return False
            self._slip, self._told = slip, (self._began + slip.after, slip.lost)
            return True

    def take(self, block: Block) -> Block:
        """The block, as the take numbers it."""
        with self._lock:
            if self._base is None:
                self._base, self._source = self._first_epoch - block.epoch, block.epoch
                self._epoch = self._first_epoch
            if block.epoch != self._source:
                self._source, self._origin = block.epoch, 0
                self._begin(block.epoch + self._base)
                block = self._once(block)
            elif self._slip is not None:
                suspect = self._seen - self._told[0]
                lost = self._slip.lost
                self._base, self._origin = self._base + 1, block.byte_index
                self._begin(block.epoch + self._base)
                block = replace(block, lost_bytes=lost, lost_why=FRAMING, suspect_bytes=suspect)
            self._seen += len(block.data)
            return replace(block, epoch=self._epoch, byte_index=block.byte_index - self._origin)

    def _begin(self, epoch: int) -> None:
        self._epoch, self._began, self._slip = epoch, self._seen, None

    def _once(self, block: Block) -> Block:
        """A loss that the time tells, without what the framing told of the same bytes."""
        where, lost = self._told
        if block.lost_why != "rate" or where < self._seen - block.suspect_bytes:
            return block
        self._told = (-1, 0)
        return replace(block, lost_bytes=max(0, block.lost_bytes - lost))
