"""Rigs whose two arms differ, by name: for scenes that are to be calibrated before they are of use."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from spikerig.dataset.errors import UsageError
from spikerig.rigctl.sim.effects import Effect, in_order, read_effects
from spikerig.rigctl.sim.limits import Faults

RIGS: Mapping[str, tuple[Mapping[str, Any], ...]] = {
    # A rig screwed together by hand: the splitter mirrors the RGB arm, which points a degree off, and the spike arm has
    # a barrel lens (1.1 % at the corner of the demo's picture).
    "splitter": (
        {"name": "misalignment", "rotation_deg": [0.6, -0.9, 1.2]},
        {"name": "mirror_flip", "arm": "rgb", "axis": "x"},
        {"name": "distortion", "arm": "spike", "k1": -0.06, "k2": 0.01},
    ),
}


def rig_effects(name: str, others: tuple[Effect, ...]) -> tuple[Effect, ...]:
    """A scene's effects behind a rig, in the order in which they act; the rig's take the place of the scene's own.

    Raises:
        UsageError: no such rig.
    """
    if name not in RIGS:
        raise UsageError("no such rig", value=name, expected=", ".join(RIGS))
    faults = Faults(f"rig '{name}'")
    found = read_effects([dict(row) for row in RIGS[name]], faults, "rig")
    faults.raise_any()
    return in_order([*(e for e in others if e.name not in found), *found.values()])
