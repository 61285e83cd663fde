"""Is a scene what it should be? One function a check; a check that cannot decide says so, and why.

A check has two halves. `measure` looks at one view at a time and keeps little of it (memory is bounded by one view);
the check itself is a pure function of what was measured, so that it can be tried without a file:

    @check("ticks", "error", "spikes do not cover the exposure", "record longer", measure=covered)
    def spikes_cover_the_exposure(scene, seen):
        for name, (before, after) in seen.items():
            if min(before, after) < 0:
                yield fault(name, f"{-min(before, after):.1f} ticks are missing")
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from spikerig.dataset.check_look import SceneLook, Undecided, ViewLook
from spikerig.dataset.errors import RigError
from spikerig.dataset.scene import ERROR, WARNING, Finding

Importance = Literal["error", "warning", "note"]
BEYOND = "numbers that nothing can be made of"  # NaN rows, times beyond 2^63: findings of the structure's
NO_VIEW = "no view could be judged"
Status = Literal["passed", "failed", "undecided"]
PROFILES: dict[str, str] = {
    "capture": "as recorded: neither aligned nor posed; what concerns poses and alignment is left out",
    "scene": "aligned and posed, to train on (the default)",
    "release": "to give away: what a reader needs to trust and compare it must be there too",
}
ALL = tuple(PROFILES)
POSED = ("scene", "release")
RELEASE = ("release",)


@dataclass(frozen=True, slots=True)
class Fault:
    """What a check says: where (a view's name, a path in the file, or "" for the scene), what, and how grave (None: as
    the check is)."""

    view: str
    message: str
    importance: Importance | None = None


@dataclass(frozen=True, slots=True)
class Figure:
    """What a check measured, told whether it is well or not: a name with its unit, and the value."""

    name: str
    value: float


Judge = Callable[[SceneLook, Mapping[str, Any]], Iterator[Fault | Figure]]
Measure = Callable[[ViewLook], Any]


@dataclass(frozen=True, slots=True)
class Check:
    """A check: its name and group, how grave what it finds is, what trips it and the cure, where it applies.

    Args:
        name: as in Finding.check.
        group: structure, ticks, sync, alignment, poses or provenance.
        importance: of what it finds, unless a Fault says otherwise.
        trips: what trips it, in words.
        fix: what to do about it.
        judge: (scene, what was measured by view) -> faults; raises Undecided.
        measure: of a view, what the judge needs; raises Undecided. None: the judge needs the scene alone.
        profiles: those in which it is run.
    """

    name: str
    group: str
    importance: Importance
    trips: str
    fix: str
    judge: Judge
    measure: Measure | None
    profiles: Sequence[str] = ALL


@dataclass(slots=True)
class Result:
    """How a check went. A failed one has errors or warnings; notes alone pass."""

    check: Check
    findings: list[Finding] = field(default_factory=list)
    figures: dict[str, float] = field(default_factory=dict)
    undecided: dict[str, str] = field(default_factory=dict)  # view name, or "" for the scene -> why
    measured: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def status(self) -> Status:
        """Undecided where nothing was found and no view, or not the scene, could be judged."""
        if any(f.importance in (ERROR, WARNING) for f in self.findings):
            return "failed"
        return "undecided" if "" in self.undecided else "passed"

    def as_json(self) -> dict[str, Any]:
        """For the document of `data check`."""
        return {
            "check": self.check.name,
            "group": self.check.group,
            "importance": self.check.importance,
            "status": self.status,
            "findings": len(self.findings),
            "figures": self.figures,
            "undecided": self.undecided,
            "seconds": self.seconds,
        }


def check(
    group: str, importance: Importance, trips: str, fix: str, *, measure: Measure | None = None,
    profiles: Sequence[str] = ALL,
) -> Callable[[Judge], Check]:  # fmt: skip
    """Make a Check of a judging function; its name, with hyphens, is the check's."""

    def made(judge: Judge) -> Check:
        name = getattr(judge, "__name__", "").replace("_", "-")
        return Check(name, group, importance, trips, fix, judge, measure, profiles)

    return made


def fault(view: str, message: str, importance: Importance | None = None) -> Fault:
    """A Fault of a view, or of the scene where `view` is empty."""
    return Fault(view, message, importance)


def run_checks(
    checks: Sequence[Check], scene: SceneLook, profile: str = "scene", done: Callable[[str], object] = lambda name: None
) -> list[Result]:
    """Run checks on a scene, view by view.

    Args:
        checks: to run, in this order.
        scene: to look at.
        profile: checks of other profiles are left out.
        done: called with the name of each view that was looked at.

    Returns:
        One Result a check.

    Cost:
        Reads each view once; holds one view, and of its spikes some 8 MB at a time.
    """
    results = [Result(c) for c in checks if profile in c.profiles]
    for name in scene.names:
        look = ViewLook(scene, name)
        for result in results:
            if result.check.measure is not None:
                _measure(result, result.check.measure, look)
        done(name)
    for result in results:
        began = time.perf_counter()
        result.findings = _judge(result, scene)
        result.seconds += time.perf_counter() - began
        result.measured = {}
    return results


def _measure(result: Result, measure: Measure, look: ViewLook) -> None:
    began = time.perf_counter()
    try:
        result.measured[look.name] = measure(look)
    except Undecided as why:
        result.undecided[look.name] = str(why)
    except RigError as error:  # a view that cannot be read is a finding of the structure's
        result.undecided[look.name] = f"{error.what} {error.cause}".strip()
    except (ArithmeticError, ValueError) as error:
        result.undecided[look.name] = f"{BEYOND}: {error}"
    result.seconds += time.perf_counter() - began


def _judge(result: Result, scene: SceneLook) -> list[Finding]:
    rule = result.check
    if rule.measure is not None and not result.measured:
        result.undecided[""] = NO_VIEW
        return []
    try:
        said = list(rule.judge(scene, result.measured))
    except Undecided as why:
        result.undecided[""] = str(why)
        return []
    except RigError as error:
        result.undecided[""] = f"{error.what} {error.cause}".strip()
        return []
    except (ArithmeticError, ValueError) as error:
        result.undecided[""] = f"{BEYOND}: {error}"
        return []
    result.figures = {f.name: f.value for f in said if isinstance(f, Figure)}
    return [_finding(rule, f) for f in said if isinstance(f, Fault)]


def _finding(rule: Check, said: Fault) -> Finding:
    where = said.view if said.view.startswith("/") else f"/views/{said.view}" if said.view else "/"
    return Finding(rule.name, said.importance or rule.importance, where, said.message, rule.fix)


def table(checks: Sequence[Check]) -> str:
    """All checks as a Markdown table, by group: docs/checks.md is made of it."""
    rows = ["| check | importance | trips when | what to do | profiles |", "|---|---|---|---|---|"]
    for group in dict.fromkeys(c.group for c in checks):
        rows.append(f"| **{group}** | | | | |")
        for c in checks:
            if c.group == group:
                where = "all" if tuple(c.profiles) == ALL else ", ".join(c.profiles)
                rows.append(f"| `{c.name}` | {c.importance} | {c.trips} | {c.fix} | {where} |")
    return "\n".join(rows) + "\n"
