"""The plan: which effects a scene calls for, and why, from bounds on what each can change.

With a tolerance, effects are left out smallest bound first while the sum of what is left out stays within it, in both
outputs; what is left out is neither imported, drawn nor timed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from spikerig.dataset.images import srgb_from_linear
from spikerig.rigctl.sim.effects import Effect, parameters
from spikerig.rigctl.sim.judge.chain import bounds_of
from spikerig.rigctl.sim.judge.facts import PART, Bound, Facts
from spikerig.rigctl.sim.judge.looks import Looked, Samples, look
from spikerig.rigctl.sim.spec import Exposure, SceneSpec, Tolerance

EVEN = 1 - PART / 100  # a change of this much of a whole step moves so many values over a step, where they lie evenly
CROWDED = 1.5 * EVEN  # more values than this so near to a step do not


@dataclass(frozen=True, slots=True)
class Judged:
    """One effect as the plan judged it.

    Args:
        effect: with its parameters.
        on: whether it is simulated.
        bound: on what it changes.
        reason: why it is on or off.
    """

    effect: Effect
    on: bool
    bound: Bound
    reason: str


@dataclass(frozen=True, slots=True)
class Plan:
    """What is simulated of a scene, and why.

    Args:
        rows: one an effect, in the order in which they act.
        tolerance: asked for; None where the effects were listed.
        room: what left-out bounds may sum to, (spikes an exposure, digital numbers); see `room_of`.
        left: what they sum to.
        samples: of light.
        looked: what it was judged from.
    """

    rows: tuple[Judged, ...]
    tolerance: Tolerance | None
    room: tuple[float, float]
    left: tuple[float, float]
    samples: Samples
    looked: Looked = dataclasses.field(repr=False)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Those that are on."""
        return tuple(row.effect for row in self.rows if row.on)

    def summary(self) -> str:
        """One line for people."""
        on, off = ([row.effect.name for row in self.rows if row.on is want] for want in (True, False))
        if self.tolerance is None:
            return f"effects as listed: {', '.join(on) or 'none'}"
        left = f" (together at most {self.left[0]:.3g} spikes, {self.left[1]:.3g} DN)" if off else ""
        return f"effects that matter: {', '.join(on) or 'none'}; left out: {', '.join(off) or 'none'}{left}"

    def as_json(self) -> dict[str, Any]:
        """JSON-ready, and the same for the same scene."""
        rows = [
            {
                "name": row.effect.name,
                "stage": row.effect.stage.name,
                "on": row.on,
                "spikes": row.bound.spikes,
                "dn": row.bound.dn,
                "formula": row.bound.formula,
                "reason": row.reason,
            }
            for row in self.rows
        ]
        pairs = {key: dict(zip(("spikes", "dn"), getattr(self, key), strict=True)) for key in ("room", "left")}
        tolerance = None if self.tolerance is None else dataclasses.asdict(self.tolerance)
        return {"effects": rows, "tolerance": tolerance, **pairs, "samples": dataclasses.asdict(self.samples)}


def plan(spec: SceneSpec) -> Plan:
    """Judge a scene's effects; the same every time.

    Args:
        spec: the scene; where its effects were listed, all are on, and their bounds are told.

    Cost:
        A few looks at the scene: see `looks.look`.
    """
    return judged(look(spec), spec.effects, spec.tolerance)


def judged(
    looked: Looked,
    effects: Sequence[Effect],
    tolerance: Tolerance | None,
    bounds: Mapping[str, Bound] | None = None,
) -> Plan:
    """Choose among effects, smallest bound first, while the sum of what is left out stays within the tolerance.

    Args:
        looked: the scene.
        effects: those to choose from, in the order in which they act.
        tolerance: None keeps all.
        bounds: of the effects by name, where they are known already.
    """
    bounds = bounds_of(looked, effects) if bounds is None else bounds
    if tolerance is None:
        rows = tuple(Judged(e, True, bounds[e.name], "listed") for e in effects)
        return Plan(rows, None, (0.0, 0.0), (0.0, 0.0), looked.samples, looked)
    room = room_of(tolerance, looked.facts, any(e.name == "initial_phase" for e in effects))
    left, off, why = np.zeros(2), set[str](), dict[str, str]()
    for name in sorted(bounds, key=lambda name: (_share(bounds[name], tolerance), name)):
        bound = np.array([bounds[name].spikes, bounds[name].dn])
        with_it = left + bound
        if np.all(with_it <= np.array(room) + 1e-12):
            left = with_it
            off.add(name)
            why[name] = f"left out; that sums to {_pair(left)} of {_pair(room)}" if bound.any() else "changes neither"
        else:
            why[name] = _too_much(bound, left, room)
    rows = tuple(Judged(e, e.name not in off, bounds[e.name], why[e.name]) for e in effects)
    return Plan(rows, tolerance, room, (float(left[0]), float(left[1])), looked.samples, looked)


def _share(bound: Bound, tolerance: Tolerance) -> float:
    """A bound in parts of the tolerance, in the output where it is the larger part."""
    parts = [
        value / allowed if allowed > 0 else (np.inf if value > 0 else 0.0)
        for value, allowed in ((bound.spikes, tolerance.spikes), (bound.dn, tolerance.dn))
    ]
    return max(parts)


def _pair(values: Sequence[float] | np.ndarray) -> str:
    return f"{values[0]:.3g} spikes, {values[1]:.3g} DN"


def _too_much(bound: np.ndarray, left: np.ndarray, room: Sequence[float]) -> str:
    k = int(np.argmax(left + bound - np.array(room)))
    unit = ("spikes", "DN")[k]
    before = f"{left[k]:.3g} + " if left[k] else ""
    return f"matters: {before}{bound[k]:.3g} > {room[k]:.3g} {unit}"


def room_of(tolerance: Tolerance, facts: Facts, random_phase: bool) -> tuple[float, float]:
    """What left-out bounds may sum to.

    Args:
        tolerance: asked for.
        facts: of the scene.
        random_phase: whether pixels start at a random charge.

    Returns:
        (spikes an exposure, digital numbers): the tolerance. Bounds count whole steps, for values that lie evenly
        between them (see `Bound`); where many lie just beside a step (a picture of few values, every pixel starting
        empty), a change however small may move them all by one, and only whole steps of the tolerance are left.
    """
    counts = np.zeros(0) if random_phase else facts.counts
    values = 255 * srgb_from_linear(np.clip(facts.rgb, 0, 1)) + 0.5
    rooms = [
        float(np.floor(allowed)) if _crowded(real) else allowed
        for allowed, real in ((tolerance.spikes, counts), (tolerance.dn, values))
    ]
    return rooms[0], rooms[1]


def _crowded(values: np.ndarray) -> bool:
    """Whether more of the values than of even ones lie just above, or just below, a whole number."""
    if not values.size:
        return False
    rest = values % 1.0
    return bool(max(np.mean(rest < EVEN), np.mean(rest > 1 - EVEN)) > CROWDED)


def resolve(spec: SceneSpec, made: Plan) -> SceneSpec:
    """The scene with its effects chosen, and no tolerance left; as if the file had listed them."""
    if spec.tolerance is None:
        return spec
    effects, exposure = chosen(made, spec.exposure)
    return replace(spec, effects=effects, exposure=exposure, tolerance=None)


def chosen(made: Plan, exposure: Exposure) -> tuple[tuple[Effect, ...], Exposure]:
    """The effects that are on, and the exposure that goes with them.

    Edges:
        Where the initial phase is left out every pixel starts empty, and `exposure.phase` says so.
    """
    empty = all(effect.name != "initial_phase" for effect in made.effects)
    return made.effects, replace(exposure, phase="zero") if empty else exposure


def resolved_table(table: Mapping[str, Any], made: Plan) -> dict[str, Any]:
    """A scene file's table (or that of a folder's settings) with the chosen effects listed, parameters and all.

    Args:
        table: as it was read.
        made: its plan.
    """
    rest = {key: value for key, value in table.items() if key not in ("effects", "consider", "tolerance", "exposure")}
    exposure = dict(table.get("exposure", {}))
    if made.samples.chosen:
        exposure["sub_poses"] = 0
    if all(effect.name != "initial_phase" for effect in made.effects):
        exposure["phase"] = "zero"
    effects = [{"name": e.name, **parameters(e)} for e in made.effects if e.name != "initial_phase"]
    plain = {key: value for key, value in rest.items() if not isinstance(value, Mapping | list)}
    return {**plain, "effects": effects, "exposure": exposure, **rest}
