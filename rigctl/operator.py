"""Who stands at the rig: asked before each viewpoint, told what is amiss; a person, or nobody."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import FrameType
from typing import Protocol

from spikerig.dataset.errors import UsageError
from spikerig.dataset.terminal import note


class Operator(Protocol):
    """Answers questions and hears words."""

    def say(self, text: str) -> None:
        """A line for people."""
        ...

    def ask(self, question: str, keys: Mapping[str, str]) -> str:
        """One of the keys ("" is Enter), explained by their words."""
        ...


class Person:
    """At a terminal: questions on stderr, answers from stdin."""

    def say(self, text: str) -> None:
        """A line on stderr."""
        note(text)

    def ask(self, question: str, keys: Mapping[str, str]) -> str:
        """Asks until one of the keys is typed.

        Raises:
            UsageError: stdin has ended: nobody is there.
        """
        shown = ", ".join(f"{key or 'Enter'} {words}" for key, words in keys.items())
        while True:
            sys.stderr.write(f"{question}  [{shown}] ")
            sys.stderr.flush()
            line = sys.stdin.readline()
            if not line:
                raise UsageError("a question, and nobody to answer", value=question,
                                 next='set advance = "auto" in the plan, or run it in a terminal')  # fmt: skip
            answer = line.strip().lower()
            if answer in keys:
                return answer


class Nobody:
    """Takes the first key of every question (the one that goes on)."""

    def say(self, text: str) -> None:
        """A line on stderr."""
        note(text)

    def ask(self, question: str, keys: Mapping[str, str]) -> str:
        """The first key."""
        return next(iter(keys))


class Interrupt:
    """Ctrl-C as a wish: the first one asks for an end in good order, the second one insists.

    Attributes:
        wanted: it was pressed.
        asking: a question is open: then the first one ends it at once.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self.wanted = self.asking = False
        self._say = say

    @contextmanager
    def watching(self) -> Iterator[None]:
        """While inside, SIGINT comes here; only in the main thread, elsewhere nothing changes."""
        try:
            before = signal.signal(signal.SIGINT, self._pressed)
        except ValueError:  # not the main thread
            yield
            return
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)

    def _pressed(self, number: int, frame: FrameType | None) -> None:
        if self.wanted or self.asking:
            self.wanted = True
            raise KeyboardInterrupt
        self.wanted = True
        self._say("ending in good order; Ctrl-C again ends at once")
