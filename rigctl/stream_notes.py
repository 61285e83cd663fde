"""What a recorder notes of a stream in passing: when its bytes came, and a few of its ticks to look at."""

from __future__ import annotations

import threading

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.devices import Block

MARK_NS = 50_000_000  # the stream's progress is noted once in so long


class Progress:
    """Of each stretch of 50 ms the most punctual transfer.

    Args:
        bytes_ns: the stream's pace, bytes a nanosecond.
    """

    def __init__(self, bytes_ns: float) -> None:
        self._pace = bytes_ns
        self._noted: list[tuple[int, int, int]] = []
        self._lock = threading.Lock()

    def note(self, block: Block) -> None:
        """A block came."""
        end = block.byte_index + len(block.data)
        with self._lock:
            if self._noted:
                epoch, byte, at = self._noted[-1]
                if epoch == block.epoch and at // MARK_NS == block.after_ns // MARK_NS:
                    if (end - byte) / self._pace <= block.after_ns - at:
                        return
                    self._noted.pop()
            self._noted.append((block.epoch, end, block.after_ns))

    def told(self) -> list[tuple[int, int, int]]:
        """New since the last call: (epoch, bytes of it, host time after)."""
        with self._lock:
            told, self._noted = self._noted[:-1], self._noted[-1:]
        return told


class Glimpse:
    """The next whole ticks, filled block by block.

    Args:
        ticks: wanted.
        tick_bytes: of each.
    """

    def __init__(self, ticks: int, tick_bytes: int) -> None:
        self._data, self._tick_bytes = np.zeros(ticks * tick_bytes, np.uint8), tick_bytes
        self._filled, self._epoch, self._next = 0, -1, 0

    @property
    def full(self) -> bool:
        """All are there."""
        return self._filled == len(self._data)

    def ticks(self) -> NDArray[np.uint8]:
        """uint8[ticks, tick_bytes]."""
        return self._data.reshape(-1, self._tick_bytes)

    def show(self, block: Block) -> None:
        """A block came: it begins anew at a whole tick where the block does not follow."""
        data, at = block.data, block.byte_index
        if (self._epoch, self._next) != (block.epoch, at):
            skip = min(-at % self._tick_bytes, len(data))
            self._filled, data = 0, data[skip:]
        n = min(len(data), len(self._data) - self._filled)
        self._data[self._filled : self._filled + n] = data[:n]
        self._filled += n
        self._epoch, self._next = block.epoch, block.byte_index + len(block.data)
