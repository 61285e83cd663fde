"""Emulated time: it moves when every worker sleeps, to the earliest moment one of them waits for."""

from __future__ import annotations

import heapq
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from spikerig.dataset.errors import UsageError


class VirtualHost:
    """A `Host` whose time costs nothing: 300 s pass as fast as the work in them is done.

    True time is what the emulated world runs on; this host's clock is true time (give a device its own oscillator to
    make the two differ). One worker runs at a time, in the order of (time, name), so a run repeats exactly.

    Args:
        start_ns: the time at first.

    Edges:
        A thread that is no worker may sleep; time then moves without waiting for it once it is awake again.
        A worker that blocks on anything but this host, without `aside`, stops time: a test's timeout will tell.
    """

    def __init__(self, start_ns: int = 0) -> None:
        self._now = int(start_ns)
        self._turn = threading.Condition()
        self._queue: list[tuple[int, str, int, threading.Event]] = []
        self._names: dict[int, str] = {}  # thread -> worker, those that take part
        self._awake = 0
        self._count = 0
        self._suspended = 0

    def suspended_ns(self) -> int:
        """What `suspend` was told in all."""
        return self._suspended

    def suspend(self, for_ns: int) -> None:
        """Suspend the computer: nothing moves here; devices that outlive it add `suspended_ns` to true time."""
        self._suspended += int(for_ns)

    def now_ns(self) -> int:
        """The time now."""
        return self._now

    def sleep_until(self, at_ns: int) -> None:
        """Sleep; alone, this only sets the time."""
        with self._turn:
            if at_ns <= self._now:
                return
            name = self._names.get(threading.get_ident())
            ready = threading.Event()
            self._count += 1
            heapq.heappush(self._queue, (int(at_ns), name or "", self._count, ready))
            if name is not None:
                self._awake -= 1
            self._move()
            while not ready.is_set():
                self._turn.wait()
            if name is None:  # a guest: it was counted awake when it was woken
                self._awake -= 1
                self._move()

    @contextmanager
    def worker(self, name: str) -> Iterator[None]:
        """Take part; see `Host.worker`."""
        me = threading.get_ident()
        with self._turn:
            if me in self._names or name in self._names.values():
                raise UsageError("a worker's name is taken, or this thread is one already", value=name)
            self._names[me] = name
            self._awake += 1
        try:
            yield
        finally:
            with self._turn:
                del self._names[me]
                self._awake -= 1
                self._move()

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Step aside; see `Host.aside`."""
        with self._turn:
            mine = threading.get_ident() in self._names
            if mine:
                self._awake -= 1
                self._move()
        try:
            yield
        finally:
            if mine:
                with self._turn:
                    self._awake += 1

    def _move(self) -> None:
        if self._awake == 0 and self._queue:
            at_ns, _, _, ready = heapq.heappop(self._queue)
            self._now = max(self._now, at_ns)
            self._awake += 1
            ready.set()
            self._turn.notify_all()
