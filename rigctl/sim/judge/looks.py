"""A few looks at a scene, from which its effects are judged: pictures, motion and depth of some of its views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.caster.light import Stage, stage_of
from spikerig.rigctl.sim.judge.facts import Facts
from spikerig.rigctl.sim.judge.samples import GRID, error_left, parts_for, sampled
from spikerig.rigctl.sim.judge.survey import Look, survey
from spikerig.rigctl.sim.sensor import Light
from spikerig.rigctl.sim.spec import Exposure, SceneSpec, Sensor
from spikerig.rigctl.sim.viewpoint import camera_of, view_motion, view_path

VIEWS = 3  # looked at
LOOK_PX = 2.0  # motion between the pictures of a look
LOOK_PARTS = 16  # of an exposure, at most


@dataclass(frozen=True, slots=True)
class Samples:
    """The light samples of a scene's exposures, and what their distance leaves.

    Args:
        least, most, mean: samples an exposure, over the views looked at.
        chosen: whether they follow the motion; else the scene file or the folder gives them.
        motion_px: longest motion of a pixel over an exposure.
        step_px: longest motion between samples.
        spikes, dn: error of a count and of an RGB value that they leave in 95 % of pixels.
        formula: where it comes from, with this scene's numbers.
    """

    least: int
    most: int
    mean: float
    chosen: bool
    motion_px: float
    step_px: float
    spikes: float
    dn: float
    formula: str


@dataclass(frozen=True, slots=True)
class Looked:
    """What the looks gave.

    Args:
        facts: of the light as it is, for the effects' bounds.
        samples: of light.
        looks: the views looked at, over their exposures.
        train: numbers of all views that are simulated.
        seed, sensor, exposure, camera: of the scene.
    """

    facts: Facts
    samples: Samples
    looks: tuple[Look, ...]
    train: tuple[int, ...]
    seed: int
    sensor: Sensor
    exposure: Exposure
    camera: Camera

    @property
    def lights(self) -> tuple[Light, ...]:
        """The light of the views looked at."""
        return tuple(each.light for each in self.looks)

    def surveyed(self, looks: Sequence[Look]) -> Facts:
        """Facts of other looks at the same scene."""
        return survey(
            looks, self.sensor, self.exposure,
            focal_px=self.facts.focal_px, views=self.facts.views, depth=self.facts.depth,
        )  # fmt: skip


def spread(numbers: Sequence[int], count: int) -> list[int]:
    """At most `count` of the numbers, evenly spread: the middles of equal parts of the list."""
    n = min(count, len(numbers))
    return [numbers[int((k + 0.5) * len(numbers) / n)] for k in range(n)]


def look(spec: SceneSpec, views: int = VIEWS) -> Looked:
    """Look at a few training views of a scene file; the same every time.

    Args:
        spec: the scene.
        views: how many to look at.

    Cost:
        A picture a pixel of motion (3 to 17 a view): a few hundredths of what the capture casts.
    """
    stage, camera = stage_of(spec.world), camera_of(spec)
    held_out = spec.orbit.held_out()
    train = [k for k in range(spec.orbit.views) if k not in held_out]
    looks, exposures, motions, depths = [], [], [], []
    for number in spread(train, views):
        light, motion, depth = _view(spec, number, stage, camera)
        looks.append(Look(light, full_map(motion, depth.shape)))
        motions.append(float(motion.max()))
        exposures.append(sampled(spec.exposure, motions[-1]))
        depths.append(depth[np.isfinite(depth)])
    far = np.concatenate(depths)
    depth_range = (float(far.min()), float(np.median(far))) if far.size else (np.inf, np.inf)
    facts = survey(
        looks, spec.sensor, spec.exposure, focal_px=float(camera.K[0, 0]), views=len(train), depth=depth_range
    )
    lights = [each.light for each in looks]
    samples = samples_left(lights, exposures, motions, spec.sensor, chosen=not spec.exposure.sub_poses)
    return Looked(facts, samples, tuple(looks), tuple(train), spec.seed, spec.sensor, spec.exposure, camera)


def _view(spec: SceneSpec, number: int, stage: Stage, camera: Camera) -> tuple[Light, NDArray, NDArray]:
    """A view's light over its exposure, its motion [H/grid,W/grid] and its depth [H,W]."""
    path, (motion, depth) = view_path(spec, number), view_motion(spec, number, stage)
    ticks = spec.exposure.ticks
    parts = min(parts_for(float(motion.max()), LOOK_PX), LOOK_PARTS, ticks)
    knots = np.rint(np.linspace(0, ticks, parts + 1)).astype(np.int64)
    pictures = np.stack([stage.picture(camera, pose, spec.lens.samples) for pose in path.poses(knots / ticks)])
    return Light(pictures, knots, (0, ticks), spec.exposure.rate_hz), motion, depth


def full_map(coarse: NDArray, shape: tuple[int, ...]) -> NDArray:
    """A coarse map at every pixel."""
    return np.repeat(np.repeat(coarse, GRID, 0), GRID, 1)[: shape[0], : shape[1]]


def samples_left(
    lights: Sequence[Light], exposures: Sequence[Exposure], motions: Sequence[float], sensor: Sensor, *, chosen: bool
) -> Samples:
    """What the light samples of a few views are, and the error they leave.

    Args:
        lights: over the exposures looked at.
        exposures: of the same views, with the light samples they will have.
        motions: of the same views, the longest in pixels.
        sensor: of the scene.
        chosen: whether the samples follow the motion.
    """
    counts = [exposure.sub_poses for exposure in exposures]
    parts = [n if exposures[0].light == "hold" else max(n - 1, 1) for n in counts]
    step = max(motion / n for motion, n in zip(motions, parts, strict=True))
    ticks, n = exposures[0].ticks, min(parts)
    spikes, dn, root = error_left(lights, parts, sensor, ticks)
    formula = f"2 x {ticks} x {root:.3g} / sqrt(12) / {n}"
    mean = float(np.mean(counts))
    return Samples(min(counts), max(counts), mean, chosen, max(motions), step, spikes, dn, formula)
