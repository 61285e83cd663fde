"""From a spike camera to raw segments: one thread reads, one writes, a ring of at least a second between them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DeviceError, RigError
from spikerig.dataset.segments import PAGE, ChunkHead, chunk_ticks, padded
from spikerig.rigctl.devices import Block, SpikeSource
from spikerig.rigctl.drain import Drain
from spikerig.rigctl.host import Host
from spikerig.rigctl.looks import Looks
from spikerig.rigctl.numbering import FRAMING, Numbering
from spikerig.rigctl.recorder_options import RecorderOptions, RecorderState
from spikerig.rigctl.ring import Ring, Slot, ring_slots
from spikerig.rigctl.segment_writer import SegmentWriter
from spikerig.rigctl.stream_notes import Glimpse, Progress

TIMEOUT_NS = 100_000_000  # of one read
SILENT_NS = 2_000_000_000  # without a byte for so long, the camera is said to be silent
WARN_AT = (0.5, 0.75)  # of the ring
SLOW = "the disk is too slow: recording stopped before anything was lost"
Event = Callable[[Mapping[str, Any]], None]


class Recorder:
    """Reads a source until closed, and keeps the bytes between `keep` and `pause`.

    Args:
        source: of the bytes; started and stopped here, not closed.
        folder: of the segments.
        host: the clock.
        take: number of the take, for the chunk headers.
        first, first_epoch: numbers of the first chunk and of the source's first epoch.
        options: how.
        acknowledged: called by the writing thread when a chunk is on disk: its head, file and offset. From then on a
            kill of this program cannot take it back; a power cut can until `RecorderState.synced` counts it.
        event: called with {"host_ns", "kind", ...} of losses, gaps, warnings; from either thread.

    Raises:
        HostError: no memory for the ring, or the folder cannot be written.

    Edges:
        Keeping begins and ends at whole ticks of an epoch; a loss or a new epoch ends a chunk at once.
    """

    def __init__(
        self,
        source: SpikeSource,
        folder: Path,
        host: Host,
        take: int,
        *,
        first: int = 0,
        first_epoch: int = 0,
        options: RecorderOptions | None = None,
        acknowledged: Callable[[ChunkHead, Path, int], None] = lambda head, path, offset: None,
        event: Event = lambda told: None,
    ) -> None:
        self.source, self.host, self.take = source, host, take
        self.options = options or RecorderOptions()
        profile = source.profile
        self.tick_bytes = profile.tick_bytes
        ticks = chunk_ticks(self.tick_bytes, profile.rate_hz)
        self.payload = ticks * self.tick_bytes
        slots = ring_slots(
            ticks / profile.rate_hz, self.options.ring_s, PAGE + padded(self.payload), self.options.memory
        )
        self.ring = Ring(self.payload, slots)
        self._event = event
        self._numbering = Numbering(first_epoch)
        self._looks = Looks(
            profile, self.ring, self.options.on_full == "wait", self._numbering, self._count_lost, self._tell
        )  # fmt: skip
        writer = SegmentWriter(
            folder, host, lambda kind, words: self._tell(kind, words=words), segment_bytes=self.options.segment_bytes,
            sync_s=self.options.sync_s, direct=self.options.direct,
        )  # fmt: skip
        self._drain = Drain(
            self.ring, writer, take, first, self.tick_bytes, acknowledged, self._give_up, self._fail,
            self._looks.look if self.options.watch else None,
        )  # fmt: skip
        self._progress = Progress(self.tick_bytes / 1e9 * profile.rate_hz)
        self._lock = threading.Lock()
        self._want = False  # what keep() and pause() ask for
        self._keeping = False
        self._trouble = ""
        self._stop = False
        self._slot: Slot | None = None
        self._pending = Slot(memoryview(b""), np.zeros(0, np.uint8))  # losses that the next chunk will tell
        self._epoch, self._next = -1, 0  # the byte expected next
        self._seen = self._kept = self._lost_transport = self._lost_recorder = 0
        self._warned = 0
        self._last_ns = host.now_ns()
        self._silent = False
        self._spans: list[list[int]] = []
        self._glimpse: Glimpse | None = None
        self._ready = threading.Event()
        self._read = threading.Thread(target=self._reading, name="spike-reader", daemon=True)

    def start(self) -> None:
        """Start the source and both threads; nothing is kept yet."""
        self.source.start()
        self._last_ns = self.host.now_ns()
        self._drain.start()
        self._read.start()
        self._ready.wait()  # emulated time must not run before the reader takes part

    def keep(self) -> None:
        """Keep bytes from the next whole tick on; forgives a disk that was too slow."""
        with self._lock:
            self._spans = []
            if self._trouble == SLOW:
                self._trouble = ""
            self._want = True

    def pause(self) -> list[tuple[int, int, int]]:
        """Keep no more; once all is on disk and synced, the spans (epoch, first byte, byte past the last) since `keep`.

        Raises:
            HostError: the disk does not sync.
        """
        with self._lock:
            self._want = False
        while self._keeping and self._read.is_alive():
            self.host.sleep_until(self.host.now_ns() + 1_000_000)
        self.ring.drained()  # emulated time stands still meanwhile: the writer needs none
        self._drain.writer.sync()
        return [(e, a, b) for e, a, b in self._spans if b > a]

    def peek(self, ticks: int, timeout_ns: int = 2_000_000_000) -> NDArray[np.uint8] | None:
        """The next whole ticks of the stream, uint8[ticks, tick_bytes], kept or not; None where none come in time."""
        wanted = Glimpse(ticks, self.tick_bytes)
        with self._lock:
            self._glimpse = wanted
        until = self.host.now_ns() + timeout_ns
        while not wanted.full and self.host.now_ns() < until and self._read.is_alive():
            self.host.sleep_until(self.host.now_ns() + 5_000_000)
        with self._lock:
            self._glimpse = None
        return wanted.ticks() if wanted.full else None

    def state(self) -> RecorderState:
        """Where it stands."""
        ring, drain = self.ring, self._drain
        return RecorderState(
            self._keeping, self._epoch, self._seen, self._kept, drain.number, drain.writer.synced, ring.fill,
            ring.slots, ring.high_water, self._lost_transport, self._lost_recorder, self._trouble,
        )  # fmt: skip

    def position(self) -> tuple[int, int]:
        """The epoch, and bytes that came of it."""
        return self._epoch, self._next

    @property
    def dead(self) -> bool:
        """No byte will be read or written any more: the reader ended, or the disk failed."""
        return bool(self._trouble) and self._trouble != SLOW

    @property
    def doubtful_bytes(self) -> int:
        """Bytes at the end of what came that may lie behind a loss; of a source that can tell, once closed."""
        return int(getattr(self.source, "doubtful_bytes", 0))

    def progress(self) -> list[tuple[int, int, int]]:
        """New since the last call: (epoch, bytes of it, host time after), the most punctual transfer of each 50 ms."""
        return self._progress.told()

    def device_ns(self, byte: int) -> int:
        """The spike camera's own time at a byte of an epoch: nominal, whatever the rate truly is."""
        return round(byte / self.tick_bytes / self.source.profile.rate_hz * 1e9)

    def close(self) -> None:
        """Stop the source, write what is there, close the files; may be called twice.

        Raises:
            HostError: the last bytes could not be written.
        """
        self._stop = True
        if self._read.is_alive():
            with self.host.aside():
                self._read.join()
        self.source.stop()
        self._drain.close()

    # the reading thread

    def _reading(self) -> None:
        with self.host.worker("spike-reader"):
            self._ready.set()
            while not self._stop:
                try:
                    block = self.source.read(TIMEOUT_NS)
                except RigError as error:
                    self._fail(error.what, error)
                    break
                except Exception as error:  # a fault of ours must not leave a silent thread behind
                    self._fail("the reading thread broke", error)
                    break
                if block is None:
                    self._nothing()
                else:
                    self._take(block)
                if not self._want:
                    self._end()
            self._end()
            self._looks.flush()

    def _nothing(self) -> None:
        if not self._silent and self.host.now_ns() - self._last_ns > SILENT_NS:
            self._silent = True
            self._tell("silent", words="no byte came from the spike camera for 2 s")

    def _take(self, block: Block) -> None:
        block = self._numbering.take(block)
        self._last_ns, self._silent = block.after_ns, False
        self._progress.note(block)
        data, at = block.data, block.byte_index
        self._seen += len(data)
        if block.epoch != self._epoch or at != self._next:
            self._new_epoch(block)
        self._next = at + len(data)
        with self._lock:
            if self._glimpse is not None:
                self._glimpse.show(block)
        if self._want and not self._keeping and not self._trouble:
            skip = min(-at % self.tick_bytes, len(data))
            self._pass_by(data[:skip], at)
            data, at = data[skip:], at + skip
            if len(data):
                self._looks.flush()
                self._keeping = True
                self._spans.append([self._epoch, at, at])
        if self._keeping:
            self._keep(data, at, block)
        else:
            self._pass_by(data, at)

    def _pass_by(self, data: NDArray[np.uint8], at: int) -> None:
        """Bytes that are not kept."""
        self._pending.skipped += len(data)
        if self.options.watch:
            self._looks.pass_by(data, self._epoch, at)

    def _new_epoch(self, block: Block) -> None:
        self._hand_over()
        self._looks.flush()
        first, lost = self._epoch < 0, block.lost_bytes
        if block.epoch == self._epoch and block.byte_index > self._next:
            lost = max(lost, block.byte_index - self._next)  # the driver skipped bytes and did not say so
        self._pending.why = block.lost_why or ("start" if first or not lost else "gap")
        self._pending.skipped = self._pending.lost_recorder = 0
        self._pending.lost_transport += lost
        self._pending.suspect = block.suspect_bytes
        if block.lost_why != FRAMING and (lost or block.lost_why):  # that one was told when it was found
            self._count_lost(lost)
            self._tell("transport", epoch=block.epoch, byte_index=block.byte_index, lost_bytes=lost,
                       suspect_bytes=block.suspect_bytes,
                       words=f"lost on the link: {block.lost_why or 'a gap'}")  # fmt: skip
        self._epoch = block.epoch
        if self._keeping:
            self._spans.append([block.epoch, block.byte_index, block.byte_index])

    def _keep(self, data: NDArray[np.uint8], at: int, block: Block) -> None:
        while len(data):
            slot = self._slot or self._fresh(at)
            if slot is None:
                self._drop(len(data), at)
                return
            n = min(len(data), self.payload - slot.used)
            slot.room[slot.used : slot.used + n] = data[:n]
            slot.used += n
            slot.stamps.append((slot.used, block.before_ns, block.after_ns))
            self._kept += n
            self._spans[-1][2] = at + n
            data, at = data[n:], at + n
            if slot.used == self.payload:
                self._hand_over()
                if not self._keeping:  # the ring was nearly full: what is left of this block is not wanted
                    self._pending.skipped += len(data)
                    return

    def _fresh(self, at: int) -> Slot | None:
        slot = self.ring.take(wait=self.options.on_full == "wait")
        if slot is None:
            return None
        slot.epoch, slot.byte_index, self._slot = self._epoch, at, slot
        slot.tell(self._pending)
        return slot

    def _hand_over(self) -> None:
        slot, self._slot = self._slot, None
        if slot is None:
            return
        fill = self.ring.give(slot)
        level = sum(fill >= share * self.ring.slots for share in WARN_AT)
        if level > self._warned:
            self._tell("ring", fill=fill, slots=self.ring.slots,
                       words=f"THE DISK FALLS BEHIND: {fill} of {self.ring.slots} buffers wait for it")  # fmt: skip
        self._warned = level
        if self.options.on_full == "stop" and fill >= self.ring.brim and self._keeping:
            self._set_trouble(SLOW)
            self._keeping = False

    def _drop(self, n: int, at: int) -> None:
        self._pending.lost_recorder += n
        self._lost_recorder += n
        self._pending.why = "ring full"
        if self._pending.lost_recorder == n:
            self._tell("recorder", epoch=self._epoch, byte_index=at, words="LOSING DATA: the ring is full")

    def _end(self) -> None:
        if self._keeping or self._slot is not None:
            self._hand_over()
            self._keeping = False

    def _count_lost(self, lost: int) -> None:
        with self._lock:
            self._lost_transport += lost

    def _give_up(self, slot: Slot) -> None:
        if not slot.wanted:
            return
        self._lost_recorder += slot.used
        self._tell("recorder", epoch=slot.epoch, byte_index=slot.byte_index, lost_bytes=slot.used,
                   words="LOST: these bytes could not be written")  # fmt: skip

    def _fail(self, words: str, error: Exception) -> None:
        self._set_trouble(words)
        kind = "device" if isinstance(error, DeviceError) else "fault"
        self._tell(kind, words=f"{words}: {getattr(error, 'value', None) or error}")

    def _set_trouble(self, words: str) -> None:
        if not self._trouble:
            self._trouble = words
            self._tell("stopped", words=words)

    def _tell(self, kind: str, **more: Any) -> None:
        self._event({"host_ns": self.host.now_ns(), "kind": kind, **more})
