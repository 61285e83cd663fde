"""The host's own clock, and sleeping on it: everything that waits takes a `Host`, so that time can be emulated."""

from __future__ import annotations

import time
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol


class Host(Protocol):
    """The computer that records: one monotonic clock, and threads that sleep on it.

    All times are int nanoseconds of this clock, named "host" in files. It never steps back; it may differ from true
    time by an oscillator's error. Drivers, services and the record loop know no other clock.
    """

    def now_ns(self) -> int:
        """The time now."""
        ...

    def sleep_until(self, at_ns: int) -> None:
        """Return at `at_ns`, or at once if that is past."""
        ...

    def suspended_ns(self) -> int:
        """How long the computer has been suspended in all: this clock stood still then, those of devices did not."""
        ...

    def worker(self, name: str) -> AbstractContextManager[None]:
        """While inside, the calling thread takes part in the passing of time; names are unique among live threads.

        A real clock does not care. An emulated one stands still until each worker sleeps.
        """
        ...

    def aside(self) -> AbstractContextManager[None]:
        """While inside, a worker waits for something other than time (a lock, another thread) and holds nothing up."""
        ...


class RealHost:
    """This computer's monotonic clock (it stops while the machine is suspended, as the services expect)."""

    def now_ns(self) -> int:
        """Nanoseconds of CLOCK_MONOTONIC."""
        return time.monotonic_ns()

    def sleep_until(self, at_ns: int) -> None:
        """Sleep until then; a few tens of microseconds late, as the scheduler has it."""
        left = at_ns - time.monotonic_ns()
        if left > 0:
            time.sleep(left / 1e9)

    def suspended_ns(self) -> int:
        """CLOCK_BOOTTIME minus CLOCK_MONOTONIC; 0 where the system has no such clock."""
        boot = getattr(time, "CLOCK_BOOTTIME", None)
        return 0 if boot is None else max(time.clock_gettime_ns(boot) - time.monotonic_ns(), 0)

    def delayed_ns(self) -> int:
        """How long this thread has waited for a processor in its life; 0 where the system does not tell (Linux does).

        What a driver subtracts to know when bytes came, and not when it was let to look.
        """
        try:
            with open("/proc/thread-self/schedstat", "rb") as file:
                return int(file.read().split()[1])
        except (OSError, IndexError, ValueError):
            return 0

    def worker(self, name: str) -> AbstractContextManager[None]:
        """Nothing: real time waits for nobody."""
        return nullcontext()

    def aside(self) -> AbstractContextManager[None]:
        """Nothing."""
        return nullcontext()
