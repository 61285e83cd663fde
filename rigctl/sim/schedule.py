"""When pictures are cast within a view, and how ticks, phases and nanoseconds relate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import UsageError
from spikerig.rigctl.sim.spec import Exposure


@dataclass(frozen=True, slots=True)
class Schedule:
    """When pictures are cast for one view; tick 0 is the start of the exposure, phase 1 its end.

    Args:
        knots: ticks, int64[K] (linear) or [K+1] (hold), over the exposure and its margins.
        phases: float64[K], phase of the exposure (0 to 1, beyond in the margins) at which each picture is cast.
        label: phase of the view's pose and sharp truth.
    """

    knots: NDArray[np.int64]
    phases: NDArray[np.float64]
    label: float


@dataclass(frozen=True, slots=True)
class Track:
    """The camera over the exposure: increasing phases float64[N], cam_from_world float64[N,3,4]; the label is one."""

    phases: NDArray[np.float64]
    poses: NDArray[np.float64]


def track_phases(plan: Schedule, readout: float = 0.0) -> NDArray[np.float64]:
    """Phases of a track's poses: the ends of the exposure, the pictures within it, and the label.

    Args:
        plan: of the view.
        readout: of a rolling shutter, in exposures: half of it is added on either side, for the rows read there.
    """
    ends = np.array([-readout / 2, 0.0, 1.0, 1 + readout / 2])
    within = plan.phases[(plan.phases >= ends[0]) & (plan.phases <= ends[-1])]
    return np.unique(np.concatenate([ends, within, [plan.label]]))


def schedule(exposure: Exposure) -> Schedule:
    """Knots evenly spread over the exposure (rounded to ticks), at the same spacing over the margins.

    Raises:
        UsageError: sub_poses is 0, as many as a view's motion asks for: `samples.sampled` says how many.

    Edges:
        One sub-pose: the picture at the label stands still over exposure and margins.
    """
    ticks, margin, n = exposure.ticks, exposure.margin_ticks, exposure.sub_poses
    if n < 1:
        raise UsageError("only a view knows how many light samples its motion asks for", value=f"sub_poses = {n}")
    parts = n if exposure.light == "hold" else max(n - 1, 1)
    inner = np.rint(np.linspace(0, ticks, parts + 1))
    outer = np.rint(np.linspace(0, margin, int(np.ceil(margin * parts / ticks)) + 1))[1:]
    knots = np.concatenate([-outer[::-1], inner, ticks + outer]).astype(np.int64)
    times = (knots[:-1] + knots[1:]) / 2 if exposure.light == "hold" else knots.astype(np.float64)
    phases = times / ticks
    label = 0.5 if exposure.label == "mid" else float(phases[phases >= 0][0])
    return Schedule(knots, np.full_like(phases, label) if n == 1 else phases, label)


def start_ns(exposure: Exposure, number: int) -> int:
    """Start of the exposure of a view on the rig's clock."""
    return round((number + 1) * exposure.period_ms * 1e6)


def phase_ns(exposure: Exposure, phase: NDArray[np.float64] | float) -> NDArray[np.int64]:
    """Nanoseconds from the start of the exposure to a phase of it."""
    return np.rint(np.asarray(phase) * (exposure.ticks * exposure.tick_ns)).astype(np.int64)
