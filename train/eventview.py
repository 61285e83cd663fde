"""What the events of a training view say of its exposure: their thresholds, its instants on their clock, their sums."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.straight import Straight, straight_of
from spikerig.dataset.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from spikerig.dataset.events import EventStream
    from spikerig.dataset.scene import View
    from spikerig.dataset.store import SceneFile
    from spikerig.train.config import FitConfig

NEXT = "an [events] table in the scene's TOML, then `spikerig sim capture` again (docs/baselines.md)"
RECORDED = ("threshold_pos", "threshold_neg", "eps")


@dataclass(frozen=True, slots=True)
class Thresholds:
    """Change of log(light + eps) that makes an event up, or down; `how`: recorded, given or searched."""

    up: float
    down: float
    eps: float
    how: str

    def as_json(self) -> dict[str, Any]:
        """For run.json."""
        return asdict(self)


def require_events(scene: SceneFile) -> None:
    """Refuse a scene whose events cannot be trained on.

    Raises:
        DataError: a training view has none; or the scene's spikes, and so its events, are not on its own camera.
    """
    if without := [name for name in scene.train if not scene.has_events(name)]:
        raise DataError(
            "this method trains on events, and training views have none",
            value=f"{len(without)} of {len(scene.train)}: {', '.join(without[:5])}",
            expected="events in every training view",
            cause="no event camera was simulated beside the spikes",
            next=NEXT,
        )
    if straight_of(scene) != Straight():
        raise DataError(
            "the events of this scene are not on its camera: its spike arm is mirrored, or its lens bends",
            value=scene.name,
            expected="events seen by the scene's own pinhole camera, as simulated ones are",
        )


def thresholds_of(scene: SceneFile, config: FitConfig) -> Thresholds | None:
    """Those that the config gives, else those that the scene's simulator recorded; None where nobody says.

    Raises:
        DataError: what is recorded makes no sense.
    """
    found = scene.info.get("events")
    stored: dict[str, Any] = {n: found.get(n) for n in RECORDED} if isinstance(found, dict) else {}
    if not all(_sane(value) for value in stored.values()):
        raise DataError(
            "the scene records thresholds of its events that make no sense",
            value=stored,
            expected="positive numbers up to 1000",
            next="--set event_pos=0.2 --set event_neg=0.2 gives others",
        )
    eps = stored.get("eps", 0.0)
    if config.event_pos > 0:
        return Thresholds(config.event_pos, config.event_neg, eps, "given")
    return Thresholds(stored["threshold_pos"], stored["threshold_neg"], eps, "recorded") if stored else None


def _sane(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and 0 < value <= 1e3


def instants(scene: SceneFile, view: View, phases: Sequence[float], stream: EventStream) -> list[int]:
    """Fractions of a view's exposure as nanoseconds of its events' clock.

    Raises:
        DataError: two clocks and no map between them; or the events do not cover the exposure.
    """
    at = np.array([view.instant_ns(phase) for phase in (0.0, 1.0, *phases)], np.int64)
    if stream.clock != view.frame.clock:
        if scene.clock is None:
            raise DataError(
                f"the frame and events of view '{view.name}' are on different clocks",
                value=f"{view.frame.clock} and {stream.clock}",
                expected="one clock, or the scene's map between them",
            )
        at = scene.clock.device_from_rig(at)
    begin, end, *rest = (int(t) for t in at)
    if not stream.t0_ns <= begin < end <= stream.t1_ns:
        raise DataError(
            f"the events of view '{view.name}' do not cover its exposure",
            value=f"exposure {begin} to {end} ns, watched {stream.t0_ns} to {stream.t1_ns} ns",
            expected="events watched from its start to its end",
            next="spikerig data verify FILE",
        )
    return rest


def event_sums(scene: SceneFile, view: View, bins: int) -> NDArray[np.int32]:
    """Events up less events down in equal parts of a view's exposure: int32[bins,H,W]; DataError as `instants`."""
    stream = scene.events(view.name)
    edges = instants(scene, view, [k / bins for k in range(bins + 1)], stream)
    return stream.bins(np.array(edges, np.int64))
