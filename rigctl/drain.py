"""The thread that takes full buffers from the ring to the disk."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import xxhash

from spikerig.dataset.errors import HostError
from spikerig.dataset.segments import PAGE, STAMP, ChunkHead, encode_head, padded, thinned
from spikerig.rigctl.ring import Ring, Slot
from spikerig.rigctl.segment_writer import SegmentWriter


class Drain:
    """Writes buffers as chunks until the ring is closed; after a failure it empties the ring and counts.

    Args:
        ring: to empty.
        writer: of the segments.
        take, first: numbers of the take and of the first chunk.
        tick_bytes: for the headers.
        acknowledged: called when a chunk is on disk.
        lost: called with a buffer that could not be written.
        failed: called once, with the words and the exception.
        look: called with each buffer, written or not wanted; None: nobody looks.

    Attributes:
        number: of the next chunk.
    """

    def __init__(
        self,
        ring: Ring,
        writer: SegmentWriter,
        take: int,
        first: int,
        tick_bytes: int,
        acknowledged: Callable[[ChunkHead, Path, int], None],
        lost: Callable[[Slot], None],
        failed: Callable[[str, Exception], None],
        look: Callable[[Slot], None] | None = None,
    ) -> None:
        self.ring, self.writer, self.take, self.number, self.tick_bytes = ring, writer, take, first, tick_bytes
        self._acknowledged, self._lost, self._failed = acknowledged, lost, failed
        self._look = look
        self._broken = False
        self._thread = threading.Thread(target=self._run, name="spike-writer", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def close(self) -> None:
        """Write what the ring still holds and close the files; may be called twice.

        Raises:
            HostError: the files do not close.
        """
        self.ring.close()
        if self._thread.is_alive():
            self._thread.join()
        self.writer.close()

    def _run(self) -> None:
        while (slot := self.ring.next()) is not None:
            try:
                if self._broken:
                    self._lost(slot)
                else:
                    if slot.wanted:
                        self._put(slot)
                    if self._look is not None:
                        self._look(slot)
            except Exception as error:  # also a fault of ours: it must not leave a silent thread behind
                self._broken = True
                self._lost(slot)
                self._failed(error.what if isinstance(error, HostError) else "the segment writer broke", error)
            finally:
                self.ring.done(slot)

    def _put(self, slot: Slot) -> None:
        stored = padded(slot.used)
        slot.room[slot.used : stored] = 0
        stamps = thinned(np.array(slot.stamps, STAMP))
        head = ChunkHead(
            self.take, self.number, slot.epoch, slot.byte_index, self.tick_bytes, slot.stamps[0][1],
            slot.stamps[-1][2], slot.lost_transport, slot.lost_recorder, slot.skipped, slot.why, slot.suspect,
            slot.used, xxhash.xxh3_64_intdigest(slot.room[: slot.used].data),
        )  # fmt: skip
        slot.page[:PAGE] = encode_head(head, stamps)
        path, offset = self.writer.write(slot.page[: PAGE + stored])
        self.number += 1
        self._acknowledged(head, path, offset)
