"""Where the camera was at an instant: SE(3) geodesics between the poses of a trajectory, exact at its knots."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.rigid import between, compose, exp_se3
from spikerig.dataset.scene import Floats, Trajectory, View

if TYPE_CHECKING:
    from spikerig.train.config import FitConfig

PATH_PHASES = (0.0, 0.25, 0.5, 0.75, 1.0)  # where paths are written down


def pose_at(trajectory: Trajectory, at_ns: float) -> Floats:
    """The pose [3,4] cam_from_world at an instant; exact at knots, a screw motion between them.

    Args:
        trajectory: at least one knot.
        at_ns: nanoseconds on the trajectory's clock, fractions allowed.

    Raises:
        DataError: the instant lies more than one knot spacing outside (up to there the end segment is extended: knots
            of an exposure in n samples often lie at sample middles, half a spacing inside).
    """
    times = trajectory.at_ns
    if len(times) == 1:
        if at_ns != times[0]:
            raise DataError("a trajectory of one pose has no other instants", value=at_ns, expected=str(times[0]))
        return trajectory.poses[0]
    k = int(np.clip(np.searchsorted(times, at_ns, side="right") - 1, 0, len(times) - 2))
    u = (at_ns - float(times[k])) / float(times[k + 1] - times[k])
    if not -1.0 <= u <= 2.0:
        raise DataError(
            "an instant lies outside the trajectory",
            value=f"{at_ns:.0f} ns",
            expected=f"{times[0]} to {times[-1]} ns",
            cause="the trajectory does not cover the exposure, or is on another clock",
        )
    return between(trajectory.poses[k], trajectory.poses[k + 1], u)


def phases(n: int, rule: str, label: str) -> tuple[float, ...]:
    """The n instants of an exposure as fractions of it.

    Args:
        n: how many; 1 is the labelled instant (mid = 1/2, first = 0).
        rule: midpoints = (j+1/2)/n; endpoints = j/(n-1).
        label: mid or first.
    """
    if n < 1 or rule not in ("midpoints", "endpoints") or label not in ("mid", "first"):
        raise UsageError("no such set of instants", value=(n, rule, label))
    if n == 1:
        return (0.5 if label == "mid" else 0.0,)
    return tuple((j + 0.5) / n if rule == "midpoints" else j / (n - 1) for j in range(n))


def sub_pose(view: View, phase: float) -> Floats:
    """The camera [3,4] at a fraction of a view's exposure.

    Raises:
        DataError: the view has no trajectory and the instant is not mid-exposure.
    """
    if view.trajectory is not None and len(view.trajectory.at_ns) > 1:
        return pose_at(view.trajectory, view.instant_ns(phase))
    if phase == 0.5:
        return view.pose.cam_from_world
    raise DataError(
        f"view '{view.name}' has no trajectory, so only its mid-exposure pose is known",
        value=f"an instant at {phase:g} of the exposure",
        expected="poses over the exposure (View.trajectory)",
        next="use --method plain or spikenerf with --pose-label mid, or estimate the trajectory first",
    )


def given_pose(view: View, number: int, phase: float, config: FitConfig, scale: float) -> Floats:
    """The camera [3,4] a fit is given for an instant, before it optimises anything.

    Args:
        view: a training view.
        number: of it among them.
        phase: fraction of its exposure.
        config: `trajectory` and `path_from` say whether the one mid-exposure pose stands for all instants;
            `pose_noise_*` spoil what is given, for studies.
        scale: of the gauge, so that a shift of 1 is half the scene's size.

    Raises:
        DataError: no pose is known at that instant, and the fit would not find one.
    """
    moves = view.trajectory is not None and len(view.trajectory.at_ns) > 1
    still = config.trajectory != "given" and (config.path_from == "mid" or not moves)
    pose = sub_pose(view, 0.5 if still else phase)
    if config.pose_noise_deg == 0 and config.pose_noise_share == 0:
        return pose
    size = np.repeat([np.radians(config.pose_noise_deg), config.pose_noise_share / scale], 3)
    off, drift = np.random.default_rng((config.seed, 8, number)).normal(size=(2, 6))
    return compose(exp_se3(size * (off if still else off + (phase - 0.5) * drift)), pose)


def as_float32(poses: NDArray[np.float64]) -> NDArray[np.float32]:
    """Poses for the rasteriser, float32, C order."""
    return np.ascontiguousarray(poses, np.float32)
