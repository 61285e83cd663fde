"""The watch over the framing inside a recorder: what it is shown, and what is told of what it finds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.wire import WireProfile
from spikerig.rigctl.numbering import Numbering
from spikerig.rigctl.ring import Ring, Slot
from spikerig.rigctl.slip_watch import SURE, Refound, Slip, SlipWatch

Tell = Callable[..., None]  # kind, and what else


class Looks:
    """Shows a `SlipWatch` every buffer, kept or not.

    Args:
        profile: of the wire.
        ring: gives buffers for bytes that are not kept, while the disk has little to do.
        wait: for such a buffer, where the source can wait.
        numbering: is asked for a new epoch at each slip.
        count: takes the bytes that a slip is short of.
        tell: takes what to log.

    Edges:
        A fault of the watch ends the watch, not the recording.
    """

    def __init__(
        self, profile: WireProfile, ring: Ring, wait: bool, numbering: Numbering, count: Callable[[int], None],
        tell: Tell,
    ) -> None:  # fmt: skip
        self._watch: SlipWatch | None = SlipWatch(profile)
        self._ring, self._wait, self._numbering, self._count, self._tell = ring, wait, numbering, count, tell
        self._idle: Slot | None = None

    def pass_by(self, data: NDArray[np.uint8], epoch: int, at: int) -> None:
        """In the reading thread: bytes that are not kept; they follow those before, or `flush` was called."""
        while self._watch is not None and len(data):
            if self._idle is None:
                slot = self._ring.take(self._wait) if self._wait or self._ring.fill <= 1 else None
                if slot is None:
                    return
                slot.wanted, slot.epoch, slot.byte_index, self._idle = False, epoch, at, slot
            slot = self._idle
            n = min(len(data), self._ring.payload - slot.used)
            slot.room[slot.used : slot.used + n] = data[:n]
            slot.used += n
            data, at = data[n:], at + n
            if slot.used == self._ring.payload:
                self.flush()

    def flush(self) -> None:
        """In the reading thread: what passed by goes to the watch now."""
        slot, self._idle = self._idle, None
        if slot is not None:
            self._ring.give(slot)

    def look(self, slot: Slot) -> None:
        """In the writing thread: each buffer in turn."""
        if self._watch is None:
            return
        try:
            found = self._watch.add(slot.epoch, slot.byte_index, slot.room[: slot.used])
        except Exception as error:  # a fault of ours must not cost a recording
            self._watch = None
            self._tell("fault", words=f"nobody watches the framing any more: {error!r}")
            return
        if isinstance(found, Refound):
            sure = found.confidence > SURE
            words = f"ticks begin {found.shift} bytes later" if sure else "where ticks begin could not be told"
            self._tell("framing", epoch=found.epoch, shift=found.shift, confidence=found.confidence,
                       words=f"after the loss, {words} (confidence {found.confidence:.3f})")  # fmt: skip
        elif isinstance(found, Slip) and self._numbering.slip(found):
            self._count(found.lost)
            self._tell("transport", epoch=found.epoch, byte_index=found.after, lost_bytes=found.lost,
                       suspect_bytes=found.before - found.after, shift=found.shift, confidence=found.confidence,
                       words=f"lost on the link: framing: ticks begin {found.shift} bytes later")  # fmt: skip
