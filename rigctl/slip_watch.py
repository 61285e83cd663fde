"""Where ticks begin, watched while recording: small losses that neither an error nor the time tells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset import m1k40
from spikerig.dataset.framing import Rates, byte_counts, find_phase, find_shift, rates_at
from spikerig.dataset.wire import WireProfile
from spikerig.rigctl.slips import LOOK_TICKS, SURE, narrow, settled

Bytes = NDArray[np.uint8]
MARGIN = LOOK_TICKS // 2  # ticks that `narrow` needs on either side of a look
TAGS_S = 0.05  # between two looks at tags
KEPT = 160  # ticks that are kept of what came: a look with its margins, and edges before it
STEP = 128  # ticks between looks where something seems to have moved
TESTS, EARNED = 4.0, 1 / 16  # full tests at hand at most, and earned by each look, of ticks of
COSTLY = 12_500  # bytes; smaller ones cost less


@dataclass(frozen=True, slots=True)
class Slip:
    """Ticks begin elsewhere than they did: bytes are missing.

    Args:
        epoch: of the stream.
        after, before: the loss lies between these byte numbers of the epoch.
        lost: bytes, less whole ticks: those cannot be told.
        shift: bytes by which ticks begin later than they did.
        confidence: of the shift, at least.
    """

    epoch: int
    after: int
    before: int
    lost: int
    shift: int
    confidence: float


@dataclass(frozen=True, slots=True)
class Refound:
    """The framing after a loss that was told: ticks of this epoch begin `shift` bytes after multiples of a tick,
    counted from where those of the epoch before began."""

    epoch: int
    before: int
    shift: int
    confidence: float


class _Window:
    """The last bytes of an epoch, as `slips.Stream`: what was kept of earlier ones, and those that just came."""

    def __init__(self, profile: WireProfile) -> None:
        self.profile = profile
        self.first = self.end = 0
        self._kept = self._new = np.zeros(0, np.uint8)

    def begin(self, byte_index: int, data: Bytes) -> None:
        """Forget all, and hold these."""
        self.first, self.end = byte_index, byte_index + len(data)
        self._kept, self._new = self._new[:0], data

    def add(self, data: Bytes) -> None:
        """Go on with these."""
        self._new, self.end = data, self.end + len(data)

    def keep(self, size: int) -> None:
        """Copy the last bytes, about so many, before their buffer is used again."""
        first = max(self.first, self.end - size)
        self._kept, self._new = self.read(0, first, self.end)[0].copy(), self._new[:0]
        self.first = first

    def read(self, epoch: int, start: int, stop: int) -> tuple[Bytes, list[tuple[int, int]]]:
        """Bytes [start, stop), and what of them is not in the window."""
        if start < self.first or stop > self.end:
            return np.zeros(stop - start, np.uint8), [(start, stop)]
        a, b, seam = start - self.first, stop - self.first, len(self._kept)
        if b <= seam:
            return self._kept[a:b], []
        if a >= seam:
            return self._new[a - seam : b - seam], []
        return np.concatenate([self._kept[a:], self._new[: b - seam]]), []


class SlipWatch:
    """Compares the end of each chunk with the end of the one before it.

    Args:
        profile: of the wire.

    Attributes:
        looks: made so far; suspicions: of them that made a full test necessary; untested: suspicions for which there
            was no test at hand.

    Edges:
        Each look compares pictures of 8-pixel columns (`framing.find_shift`). Where ticks seem to begin elsewhere, it
        looks again every 6.4 ms in between, and only where two such looks differ, too, comes the test that ingest
        makes (`slips.narrow`, `slips.settled`): the shift must come at once, within 3 ms, and one of whole rows only
        where the picture's edges moved as well. So a moving picture is no loss, and what is told here is what ingest
        would find. Those tests are rationed (one in 16 looks, 4 in a row, more of smaller pictures; shifts by whole
        rows, as a picture that moves makes them, and others apart), or a rig that is carried about would cost a whole
        core; what was not tested is counted, and ingest finds it. After a slip nothing is told until the next epoch.
        Whole ticks that are lost move nothing.

    Cost:
        At 400x250: 0.4 ms a look, 20 looks a second, and a copy of 2 MB; 3 ms where it looks again, 20 to 150 ms a
        test.
    """

    def __init__(self, profile: WireProfile) -> None:
        self.profile = profile
        self.looks = self.suspicions = self.untested = 0
        self._size = profile.tick_bytes
        self._epoch, self._next, self._told = -1, 0, False
        self._window = _Window(profile)
        self._seen: tuple[int, Rates] | None = None  # the last look: where, and what
        self._before: Bytes | None = None  # the last look of the epoch before
        scale = max(1.0, COSTLY / self._size)
        self._most, self._earned = TESTS * scale, EARNED * scale
        self._tests = [
            self._most,
            self._most,
        ]  # at hand: of shifts by whole rows, as of a moving picture, and of all others

    def add(self, epoch: int, byte_index: int, data: Bytes) -> Slip | Refound | None:
        """Bytes of an epoch, in order; where some are left out, what lies between is not judged."""
        if self.profile.framing == "m1k40":
            return self._tags(epoch, byte_index, data)
        found: Slip | Refound | None = None
        if epoch != self._epoch:
            self._before = None if self._seen is None else self._at(self._seen[0]).copy()
            self._epoch, self._seen, self._told = epoch, None, False
        if self._told:
            return None
        if self._seen is None or byte_index != self._next:
            found = self._begin(byte_index, data)
        else:
            self._window.add(data)
        self._next = byte_index + len(data)
        found = found or self._go_on()
        self._window.keep(KEPT * self._size)
        return found

    def _begin(self, byte_index: int, data: Bytes) -> Refound | None:
        """A first look, at the beginning of what came."""
        first = -(-byte_index // self._size) * self._size
        self._window.begin(byte_index, data)
        self._seen = None
        at = first + MARGIN * self._size
        if at + LOOK_TICKS * self._size > self._window.end:
            return None
        self._seen = (at, byte_counts(self._at(at), self._size))
        before, self._before = self._before, None
        if before is None:
            return None
        phase = find_phase(self._at(at), self.profile, like=rates_at(before, self.profile, 0))
        return Refound(self._epoch, at, phase.offset, phase.confidence)

    def _at(self, start: int) -> Bytes:
        return self._window.read(self._epoch, start, start + LOOK_TICKS * self._size)[0]

    def _go_on(self) -> Slip | None:
        """A look at the end of what came, against the one before."""
        at = (self._window.end // self._size - MARGIN - LOOK_TICKS) * self._size
        if self._seen is None or at < self._seen[0] + LOOK_TICKS * self._size:
            return None
        (before, then), now = self._seen, byte_counts(self._at(at), self._size)
        self._seen = (at, now)
        self.looks += 1
        self._tests = [min(self._most, left + self._earned) for left in self._tests]
        if not find_shift(now, then, SURE):
            return None
        self.suspicions += 1
        last, counts = before, then
        for near in [*range(before + STEP * self._size, at, STEP * self._size), at]:
            here = now if near == at else byte_counts(self._at(near), self._size)
            shift = find_shift(here, counts, SURE)
            if shift and (slip := self._test(last, near, shift)):
                return slip
            last, counts = near, here
        return None

    def _test(self, before: int, at: int, shift: int) -> Slip | None:
        """The test that ingest makes, where there is one at hand."""
        row = self.profile.row_bits // 8
        kind = int(1 < shift % row < row - 1)
        if self._tests[kind] < 1:
            self.untested += 1
            return None
        self._tests[kind] -= 1
        slip = narrow(self._window, self._epoch, before, at)
        span = (self._epoch, self._window.first, self._window.end)
        sure = None if slip is None else settled(self._window, slip[0], [span], slip[1])
        if slip is None or sure is None:
            return None
        self._told = True
        return Slip(self._epoch, sure.after, sure.before, sure.lost, self._size - sure.lost, SURE)

    def _tags(self, epoch: int, byte_index: int, data: Bytes) -> Slip | Refound | None:
        """The same of M1K40: its tags say where blocks begin, whatever the picture does."""
        again = epoch != self._epoch
        if again:
            self._epoch, self._told, self._next = epoch, False, byte_index
        if self._told or byte_index < self._next:
            return None
        start = m1k40.find_start(data[: 2 * m1k40.FRAME], sure=True)
        if start is None:
            return None
        self.looks += 1
        self._next = byte_index + round(TAGS_S * self.profile.bytes_s)
        phase = (byte_index + start) % m1k40.FRAME
        seen, self._seen = self._seen, (byte_index, np.array([float(phase)]))
        if seen is None:
            return None
        shift = (phase - int(seen[1][0])) % m1k40.FRAME
        if again:
            return Refound(epoch, byte_index + len(data), shift, 1.0)
        if not shift:
            return None
        self._told = True
        return Slip(epoch, seen[0], byte_index + 2 * m1k40.FRAME, m1k40.FRAME - shift, shift, 1.0)
