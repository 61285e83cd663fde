"""A disk that stands still until a test lets it go."""

import threading
from pathlib import Path

import pytest

from spikerig.rigctl.segment_writer import SegmentWriter


class SlowDisk:
    """A gate in the way of the writer's `write`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.gate, real = threading.Event(), SegmentWriter.write

        def write(writer: SegmentWriter, data: memoryview) -> tuple[Path, int]:
            self.gate.wait(30)
            return real(writer, data)

        monkeypatch.setattr(SegmentWriter, "write", write)
