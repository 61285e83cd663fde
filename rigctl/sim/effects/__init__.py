"""Effects: what a real sensor does to the light, one small frozen class each, imported only when a scene asks for it.

An effect states its stage, units, source, and the limit in which it vanishes; it draws from its own random stream,
bounds its own effect on the output (`magnitude`), and estimates its cost. `begin` makes it ready for one view and
returns hooks; the simulator calls the hooks in the order of the stages.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from importlib import import_module
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.draws import stream
from spikerig.rigctl.sim.limits import Faults, nearest, read_record

Floats = NDArray[np.floating]  # float32 unless said


class Stage(IntEnum):
    """Where in the chain from light to files an effect acts; a list of effects runs in this order."""

    LIGHT = 0
    OPTICS = 1
    PHOTONS = 2
    CHARGE = 3
    SPIKES = 4
    WIRE = 5
    CLOCK = 6
    RGB = 7


@dataclass(frozen=True, slots=True)
class Site:
    """Where an effect acts: picture size, view number, the scene's seed."""

    height: int
    width: int
    view: int
    seed: int

    def draw(self, effect: str) -> np.random.Generator:
        """The effect's own stream for this view."""
        return stream(self.seed, effect, self.view)

    def draw_fixed(self, effect: str) -> np.random.Generator:
        """The effect's own stream for what stays the same from view to view: the sensor's fixed patterns."""
        return stream(self.seed, effect)


@dataclass(frozen=True, slots=True)
class Hooks:
    """What an effect does to one view; each is None where it does nothing.

    Args:
        light: changes light [n,H,W] in place, in thresholds a tick. Unless the effect is `per_tick` it must be
            affine in the light and the same for all ticks, so that it may act on knots.
        charge: changes the initial charge float64[H,W] in place, in thresholds.
        encoded: changes the encoded picture float32[H,W,3] in place, 0 to 1, before it is rounded.
    """

    light: Callable[[Floats], None] | None = None
    charge: Callable[[NDArray[np.float64]], None] | None = None
    encoded: Callable[[Floats], None] | None = None


@dataclass(frozen=True, slots=True)
class Facts:
    """What `magnitude` needs to know of a scene.

    Args:
        light_max: brightest light in thresholds a tick.
        ticks: of an exposure.
        pixels: of one view.
    """

    light_max: float
    ticks: int
    pixels: int


class Effect(Protocol):
    """What every effect class offers, beside its parameters as dataclass fields."""

    name: str
    stage: Stage
    per_tick: bool
    unit: str
    source: str
    vanishes: str
    cost_ns: float

    def begin(self, site: Site) -> Hooks:
        """Ready for one view."""
        ...

    def magnitude(self, facts: Facts) -> float:
        """A bound (three standard deviations for noise) on the change of the output, in `unit`."""
        ...


# name -> module and class. A table, not a registry: importing this module imports no effect.
EFFECTS: Mapping[str, tuple[str, str]] = {
    "shot_noise": ("shot", "ShotNoise"),
    "dark_current": ("dark", "DarkCurrent"),
    "threshold_fpn": ("fpn", "ThresholdFpn"),
    "initial_phase": ("phase", "InitialPhase"),
    "read_noise": ("read", "ReadNoise"),
}


def effect_class(name: str) -> type:
    """The class of a named effect; imports its module."""
    module, cls = EFFECTS[name]
    return getattr(import_module(f"{__name__}.{module}"), cls)


def read_effects(rows: Any, phase: str, faults: Faults) -> tuple[Effect, ...]:
    """Effects of a scene file in stage order: a list of names or of tables with a `name` and parameters."""
    if rows == "auto":
        faults.add("effects", 'is "auto": not offered yet; list the effects wanted')
        return ()
    if not isinstance(rows, list | tuple):
        faults.add("effects", f"is {rows!r}, expected a list of names or tables")
        return ()
    found: dict[str, Effect] = {}
    for k, row in enumerate(rows):
        table = {"name": row} if isinstance(row, str) else row
        if not isinstance(table, Mapping) or not isinstance(table.get("name"), str):
            faults.add(f"effects[{k}]", f"is {row!r}, expected a name or a table with a name")
            continue
        name = table["name"]
        if name not in EFFECTS:
            faults.add(f"effects[{k}].name", f"is {name!r}; {nearest(name, EFFECTS)}")
        elif name in found:
            faults.add(f"effects[{k}].name", f"is '{name}' a second time; an effect is listed once")
        else:
            rest = {key: value for key, value in table.items() if key != "name"}
            found[name] = read_record(effect_class(name), rest, f"effects[{k}]", faults)
    if "initial_phase" in found and phase == "zero":
        faults.add("effects", "list initial_phase, but exposure.phase is zero: these contradict each other")
    if phase == "random" and "initial_phase" not in found:
        found["initial_phase"] = effect_class("initial_phase")()
    return in_order(found.values())


def in_order(effects: Any) -> tuple[Effect, ...]:
    """Effects in the order in which they act: by stage, then as the table above lists them."""
    names = list(EFFECTS)
    rank = {name: k for k, name in enumerate(names)}
    return tuple(sorted(effects, key=lambda e: (e.stage, rank.get(e.name, len(names)))))


def parameters(effect: Effect) -> dict[str, Any]:
    """An effect's parameters, JSON-ready."""
    return dataclasses.asdict(effect)  # type: ignore[call-overload]
