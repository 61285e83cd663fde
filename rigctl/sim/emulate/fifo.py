"""The memory between a spike camera and its bus, in byte numbers only: what is held, what was lost, what went out."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any


@dataclass
class Run:
    """Bytes [start, stop) of what the camera made."""

    start: int
    stop: int


class Fifo:
    """A queue of byte numbers with a size; what comes while it is full is lost, and written down.

    Args:
        capacity: bytes: the chip's 16 KiB and the memory before it.
        word: bytes that come and go together; 4 on the FT601's bus.

    Attributes:
        lost: list of {start, stop, why}, in order, touching ones of one cause merged.
        sent: list of `Run`: what went out, in order, merged.
    """

    def __init__(self, capacity: int, word: int = 4) -> None:
        self.capacity, self.word = capacity, word
        self.lost: list[dict[str, Any]] = []
        self.sent: list[Run] = []
        self.seen = 0
        self.level = 0
        self._held: deque[Run] = deque()
        self._doomed: list[tuple[int, int, str]] = []

    def doom(self, start: int, count: int, why: str) -> None:
        """Bytes that will vanish before the memory, whatever room there is; whole words."""
        start -= start % self.word
        self._doomed.append((start, start + -(-count // self.word) * self.word, why))
        self._doomed.sort()

    def doomed(self) -> list[tuple[int, int, str]]:
        """What `doom` was told, in order."""
        return list(self._doomed)

    def advance(self, made: int, room: int = 0, why: str = "overflow") -> None:
        """The camera has made bytes up to `made`; `room` bytes are being taken meanwhile and do not count."""
        made -= made % self.word
        while self.seen < made:
            stop = made
            doomed = next(((a, b, w) for a, b, w in self._doomed if b > self.seen), None)
            if doomed and doomed[0] <= self.seen:
                stop = min(made, doomed[1])
                self._lose(self.seen, stop, doomed[2])
                self.seen = stop
                continue
            if doomed:
                stop = min(made, doomed[0])
            fits = max(0, min(stop - self.seen, (self.capacity + room - self.level) // self.word * self.word))
            if fits:
                _append(self._held, self.seen, self.seen + fits)
                self.level += fits
            if self.seen + fits < stop:
                self._lose(self.seen + fits, stop, why)
            self.seen = stop

    def skip(self, made: int, why: str) -> None:
        """Everything made until then is lost, as nobody takes it."""
        made -= made % self.word
        if made > self.seen:
            self._lose(self.seen, made, why)
            self.seen = made

    def empty(self, why: str) -> None:
        """Throw away what is held."""
        for run in self._held:
            self._lose(run.start, run.stop, why)
        self._held.clear()
        self.level = 0

    def take(self, count: int, why: str = "") -> list[Run]:
        """The oldest `count` bytes (or all); they went out, or with a `why` are lost on the way."""
        out: list[Run] = []
        while count > 0 and self._held:
            run = self._held[0]
            n = min(count, run.stop - run.start)
            out.append(Run(run.start, run.start + n))
            run.start += n
            count -= n
            self.level -= n
            if run.start == run.stop:
                self._held.popleft()
        for run in out:
            if why:
                self._lose(run.start, run.stop, why)
            else:
                _append(self.sent, run.start, run.stop)
        return out

    def _lose(self, start: int, stop: int, why: str) -> None:
        if self.lost and self.lost[-1]["stop"] == start and self.lost[-1]["why"] == why:
            self.lost[-1]["stop"] = stop
        else:
            self.lost.append({"start": start, "stop": stop, "why": why})


def _append(runs: deque[Run] | list[Run], start: int, stop: int) -> None:
    if runs and runs[-1].stop == start:
        runs[-1].stop = stop
    else:
        runs.append(Run(start, stop))
