"""A rig as opened for a take, and what came of the take."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from spikerig.dataset.errors import HostError
from spikerig.dataset.terminal import jsonable
from spikerig.rigctl.devices import DeviceFacts, FrameSource, SpikeSource, SyncBox
from spikerig.rigctl.host import Host


@dataclass(frozen=True)
class Rig:
    """The devices of a take.

    Args:
        host: the clock.
        spike, rgb, box: as opened; the latter two may be missing.
        place: brings the rig to a viewpoint by its number; of a real rig the operator does that.
        truth: what really happened, of an emulated rig.
    """

    host: Host
    spike: SpikeSource
    rgb: FrameSource | None = None
    box: SyncBox | None = None
    place: Callable[[int], None] = lambda number: None
    truth: Callable[[], Mapping[str, Any]] | None = None

    @property
    def facts(self) -> list[DeviceFacts]:
        """Of all that are there."""
        return [d.facts for d in (self.spike, self.rgb, self.box) if d is not None]

    def close(self) -> None:
        """Give all back."""
        for device in (self.spike, self.rgb, self.box):
            if device is not None:
                device.close()


@dataclass
class Tally:
    """What came of a take so far, JSON-ready by `asdict`."""

    viewpoints: int = 0
    kept: int = 0
    skipped: list[str] = field(default_factory=list)
    poor: dict[str, list[str]] = field(default_factory=dict)
    retaken: int = 0
    lost_ticks: int = 0
    status: str = "recording"
    seconds: float = 0.0
    bytes: int = 0
    chunks: int = 0
    high_water: int = 0
    slots: int = 0


def write_truth(folder: Path, truth: Mapping[str, Any]) -> None:
    """What really happened, beside a take; a resumed one keeps what was told before."""
    path = folder / "truth.json"
    try:
        before = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
        path.write_text(json.dumps([*before, jsonable(dict(truth))], allow_nan=False) + "\n", encoding="utf-8")
    except (OSError, ValueError) as error:
        raise HostError("the truth cannot be written", value=f"{path}: {error}") from error
