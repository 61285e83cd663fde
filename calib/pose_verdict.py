"""Is an estimate of poses to be trusted? Each reason against it, in words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.estimate import Estimate, Wanted
from spikerig.calib.gauge import centres, extent
from spikerig.calib.mapping import Map

Floats = NDArray[np.float64]
# A free focal length that is off by the first, and takes the second of the residual with it, says that K is wrong.
WRONG_FOCAL = ((0.05, 0.02), (0.2, 0.003))
# Points that the weakest link of a map needs, and below which all maps must agree: bent maps have up to 51, right ones
# 39 and more (demo and leaves over 174 degrees, 7 to 28 views; see docs/poses.md).
WEAK_LINK, THIN_LINK = 35, 60


def judged(found: Estimate, wanted: Wanted) -> Estimate:
    """The estimate with the reasons against it."""
    reasons = []
    placed, asked = len(found.poses), len(found.images)
    if placed < max(3, wanted.min_share * asked):
        lost = ", ".join(sorted(set(found.images) - found.poses.keys())[:12])
        reasons.append(f"only {placed} of {asked} views were placed ({wanted.min_share:.0%} asked for); not: {lost}")
    if placed and not found.best.error_px <= wanted.max_error_px:
        reasons.append(f"the mean residual is {found.best.error_px:.2f} px, more than {wanted.max_error_px:g}")
    focal = found.best.focal
    if any(abs(focal["ratio"] - 1) > off and focal["saved"] > saved for off, saved in WRONG_FOCAL if focal):
        reasons.append(
            f"the map asks for {focal['ratio']:.2f} times the focal length given ({focal['saved']:.0%} less residual): "
            "wrong intrinsics, or a bent map"
        )
    if found.agreeing[1] > 1 and found.agreeing[0] < 2:
        reasons.append(f"{found.agreeing[1]} kinds of texture give maps that differ: none is to be trusted")
    reasons += _weak(found)
    if placed >= 3:
        stack = np.stack(list(found.poses.values()))
        depth = _depth(found.best, stack)
        if depth > 0 and extent(stack) < 1e-3 * depth:
            reasons.append("the camera did not move: all views stand at one place")
    return replace(found, reasons=tuple(reasons))


def _weak(found: Estimate) -> list[str]:
    """Why the map's weakest link is too weak: it may have bent there, and another kind of texture bends there too."""
    link = found.best.link
    if link is None or link >= THIN_LINK or not found.poses:
        return []
    names = [n.removeprefix("spike/").removeprefix("rgb/") for n in found.best.hanging]
    told = ", ".join(names[:8]) + (", .." if len(names) > 8 else "")
    held = f"the map hangs together by {link} points only (views {told} and the others), and may be bent there"
    if link < WEAK_LINK:
        return [f"{held}: {WEAK_LINK} are needed"]
    if found.agreeing[0] < found.agreeing[1]:
        return [f"{held}: below {THIN_LINK}, all maps must agree, and {found.agreeing[0]} of {found.agreeing[1]} do"]
    return []


def _depth(found: Map, stack: Floats) -> float:
    if not len(found.xyz):
        return 0.0
    return float(np.median(np.linalg.norm(found.xyz[None, :2000] - centres(stack)[:, None], axis=2)))
