"""Checks of what a scene says of its own making."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from spikerig.dataset.check import POSED, RELEASE, Check, Fault, check, fault
from spikerig.dataset.check_look import SceneLook

Nothing = Mapping[str, object]


def record(scene: SceneLook, key: str) -> dict[str, Any]:
    """A record of `info`, empty where there is none (or something else stands there)."""
    found = scene.info.get(key)
    return found if isinstance(found, dict) else {}


@check(
    "provenance",
    "warning",
    "alignment, poses or calibration had been refused and were kept by --force",
    "calibrate, align or estimate poses again",
)
def nothing_was_forced(scene: SceneLook, _: Nothing) -> Iterator[Fault]:
    """What was refused once is not better for having been kept."""
    for key in ("align", "poses"):
        made = record(scene, key)
        if made.get("forced") or made.get("accepted") is False:
            reasons = made.get("reasons")
            told = "; ".join(str(r)[:200] for r in reasons[:3]) if isinstance(reasons, list) else ""
            yield fault("", f"info.{key} was refused and kept" + (f": {told}" if told else ""))
    forced = (scene.calibration or {}).get("forced")
    if isinstance(forced, list) and forced:
        yield fault("", f"the calibration was forced: {', '.join(str(f)[:80] for f in forced[:5])}")


@check(
    "provenance",
    "error",
    "the scene was aligned by another calibration than the one it holds",
    "align the raw recording again",
)
def calibration_is_the_one_used(scene: SceneLook, _: Nothing) -> Iterator[Fault]:
    """The record in the file and the one that its pictures were warped by."""
    used, held = record(scene, "align").get("calibration"), (scene.calibration or {}).get("id")
    if used and held != used:
        yield fault("", f"aligned by {str(used)[:16]}, holds {str(held)[:16]}")


@check(
    "provenance",
    "note",
    "there are no sparse points: training starts from random ones, some 10 dB worse",
    "estimate poses (`calib poses`), or give points when the scene is built",
    profiles=POSED,
)
def points_are_there(scene: SceneLook, _: Nothing) -> Iterator[Fault]:
    """Splats start from points."""
    if scene.points is None or not len(scene.points.xyz):
        yield fault("", "no points")
    elif scene.points.source == "random":
        yield fault("", "the points are at random places")


@check(
    "provenance",
    "warning",
    "a reader cannot tell where pictures, alignment and poses come from, or no view is held out",
    "keep the records that `calib align` and `calib poses` write; hold views out",
    profiles=RELEASE,
)
def release_tells_its_origin(scene: SceneLook, _: Nothing) -> Iterator[Fault]:
    """A simulated scene tells how it was made; a real one how it was aligned, calibrated and posed."""
    if not scene.test:
        yield fault("", "no view is held out: methods cannot be compared")
    if scene.truth_label or "made_by" in scene.info:
        return
    for key, there in (("info.align", record(scene, "align")), ("info.poses", record(scene, "poses")),
                       ("a calibration", scene.calibration)):  # fmt: skip
        if not there:
            yield fault("", f"{key} is missing")
    if scene.light_gain is None:
        yield fault("", "light_gain is not known: brightness of spikes and pictures cannot be compared", "note")


PROVENANCE: tuple[Check, ...] = (
    nothing_was_forced, calibration_is_the_one_used, points_are_there, release_tells_its_origin,
)  # fmt: skip
