"""`spikerig doctor`: everything about this machine and installation that matters, at once."""

from __future__ import annotations


def doctor() -> None:
    """Check this machine and installation; every problem at once, each with its fix."""
