"""What a capture will cost, predicted from small measurements in this very process: CPU seconds, not wall.

Each part of the work is timed on as little as shows it (few pixels, few ticks, the least of some repeats) and scaled by
what its cost grows with. Machines differ and are shared; a table of costs would not hold.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.effects import Effect, Stage
from spikerig.rigctl.sim.judge.plan import Plan
from spikerig.rigctl.sim.schedule import Schedule, Track, track_phases
from spikerig.rigctl.sim.sensor import Light
from spikerig.rigctl.sim.shelf import dumps, loads
from spikerig.rigctl.sim.spec import Cloud
from spikerig.rigctl.sim.take import Rig, Taken, pack, surface, take_blurry

REPEATS = 3  # of which the least counts: a busy machine only ever adds
WIDE = 16_384  # pixels on which the work of every capture, and of a picture, is timed
SMALL = 4_096  # pixels on which what grows with light samples or ticks is timed
LOAD = 8_000_000  # pixel-ticks, and half as many pixel-samples, that a block may hold
TICKS = 32  # of an exposure on which what grows with ticks is timed


@dataclass(frozen=True, slots=True)
class Work:
    """What a capture does, as numbers to scale by.

    Args:
        rig: with any effects.
        train, test: how many views.
        times: the schedule of a middling view.
        once_s: CPU seconds of what is done once.
        train_s, test_s: of a view's pictures, cast or read.
        points: drawn from the views; 0 for none.
        arm_s: of a view's pictures for an RGB camera that stands apart; 0 where none can be cast.
    """

    rig: Rig
    train: int
    test: int
    times: Schedule
    once_s: float
    train_s: float
    test_s: float
    points: int
    arm_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Costs:
    """Predicted CPU seconds of a whole capture.

    Args:
        parts: of what every capture does, and what effects cost beyond each alone (it may be less): name -> seconds.
        effects: of each effect, on or off: name -> seconds it takes, or would.
        total: of the parts and the effects that are on.
        spent: what the prediction took.
    """

    parts: dict[str, float]
    effects: dict[str, float]
    total: float
    spent: float


def least(work: Callable[[], Any], repeats: int = REPEATS, before: Callable[[], Any] = lambda: None) -> float:
    """CPU seconds of one run of `work`, threads and all: the least of some repeats; `before` each is not timed."""
    best = np.inf
    for _ in range(repeats):
        before()
        began = time.process_time()
        work()
        best = min(best, time.process_time() - began)
    return float(best)


def predict(work: Work, made: Plan) -> Costs:
    """CPU seconds of a capture in one process, without the start of Python and without the plan itself.

    Args:
        work: what it does.
        made: its plan.

    Cost:
        A few tenths of a second.
    """
    began = time.process_time()
    lights = made.looked.lights
    light = lights[len(lights) // 2]
    parts = {"start": work.once_s, "light": work.train * work.train_s + work.test * work.test_s}
    parts |= _every_view(work, light)
    effects, more = _effects(work, light, [row.effect for row in made.rows], {e.name for e in made.effects})
    parts["effects together"] = more
    total = sum(parts.values()) + sum(effects[e.name] for e in made.effects)
    return Costs(parts, effects, total, time.process_time() - began)


@dataclass(frozen=True, slots=True)
class _Block:
    """A view of fewer pixels, ready to be taken; `share` is how much of the picture it is."""

    rig: Rig
    times: Schedule
    track: Track
    rgb: NDArray[np.float32]
    share: float

    def take(self, *effects: Effect, apart: bool = False) -> Taken:
        rig = replace(self.rig, effects=effects)
        arm = self.rgb if apart else None
        return take_blurry(rig, 0, "000", self.times, self.rgb[0], self.track, self.rgb, arm)


def _block(rig: Rig, times: Schedule, light: Light, pixels: int) -> _Block:
    """Every so many pixels of a view looked at, on a schedule."""
    camera, span = rig.camera, int(times.knots[-1] - times.knots[0])
    pixels = max(64, min(pixels, LOAD // span, LOAD // 2 // len(times.phases)))
    s = max(1, int(np.ceil(np.sqrt(camera.width * camera.height / pixels))))
    k = np.rint(np.clip(times.phases, 0, 1) * (len(light.rgb) - 1)).astype(int)
    rgb = np.ascontiguousarray(light.rgb[k][:, ::s, ::s])
    height, width = rgb.shape[1:3]
    K = np.diag([1 / s, 1 / s, 1]) @ camera.K
    phases = track_phases(times)
    track = Track(phases, np.repeat(np.eye(3, 4)[None], len(phases), 0))
    small = replace(rig, camera=Camera(K, np.zeros(0), width, height))
    return _Block(small, times, track, rgb, height * width / (camera.width * camera.height))


def _line(small: float, large: float, a: _Block, b: _Block) -> float:
    """Seconds of the whole picture, from those of two blocks: overhead and a share that grows with pixels."""
    if b.share <= a.share:
        return large
    slope = max(large - small, 0.0) / (b.share - a.share)
    return large + slope * (1 - b.share)


def _every_view(work: Work, light: Light) -> dict[str, float]:
    """What every capture does with the light of its views, and the file."""
    a, b = (_block(work.rig, work.times, light, n) for n in (WIDE // 8, WIDE))
    taken = [block.take() for block in (a, b)]
    view = _line(least(a.take), least(b.take), a, b)
    parts = {"exposure": work.train * view}
    if work.points:
        cloud = Cloud(work.points)
        depth = np.ones(b.rgb.shape[1:3])
        drawn = least(lambda: surface(b.rig, 0, cloud, work.points // work.train, taken[1].view, depth))
        parts["exposure"] += work.train * drawn / b.share
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "block.h5"

        def write(block: _Block, one: Taken, views: int) -> float:
            named = [replace(one, view=replace(one.view, name=f"{k:03d}")) for k in range(views)]
            return least(lambda: pack(file, block.rig, (shelved(k) for k in named), info={}, force=True), 2)

        few, more, large = write(a, taken[0], 1), write(a, taken[0], 4), write(b, taken[1], 4)
    each = _line(max(more - few, 0.0) / 3, max(large - few, 0.0) / 3, a, b)
    parts["file"] = few + (work.train - 1) * each + work.test * max(more - few, 0.0) / 3
    return parts


def shelved(taken: Taken) -> Taken:
    """A view as it comes back from where finished views wait."""
    return loads(dumps(taken), taken.view.name)


def _effects(work: Work, light: Light, effects: Sequence[Effect], on: set[str]) -> tuple[dict[str, float], float]:
    """Seconds that each effect adds by itself; and what those that are on add by acting on one another's work."""
    rig, times = work.rig, work.times
    coarse, few = _coarse(rig, times)
    span = int(times.knots[-1] - times.knots[0]) / int(few.knots[-1] - few.knots[0])
    fine = _block(rig, times, light, SMALL)
    blocks = {
        "knot": (fine, 1.0),
        "frame": (_block(coarse, few, light, WIDE), 1.0),
        "tick": (_block(coarse, few, light, SMALL), span),
    }
    bare = {per: least(block.take) for per, (block, _) in blocks.items()}
    found: dict[str, float] = {}
    for effect in effects:
        block, scale = blocks[effect.per]
        apart = effect.name == "misalignment" and work.arm_s > 0
        seconds = least(lambda b=block, e=effect, apart=apart: b.take(e, apart=apart)) - bare[effect.per]
        found[effect.name] = work.train * (max(seconds, 0.0) * scale / block.share + apart * work.arm_s)
    # A picture's coding is told well enough by itself; optics may act on every sample where rows roll.
    both = [e for e in effects if e.name in on and (e.per != "frame" or e.stage == Stage.OPTICS)]
    apart = any(e.name == "misalignment" for e in both) and work.arm_s > 0
    joint = work.train * (least(lambda: fine.take(*both, apart=apart), 2) - bare["knot"]) / fine.share
    alone = sum(found[e.name] for e in both) - apart * work.train * work.arm_s
    return found, joint - alone


def _coarse(rig: Rig, times: Schedule) -> tuple[Rig, Schedule]:
    """The same exposure and margins at fewer ticks and light samples."""
    exposure = rig.exposure
    ticks = min(TICKS, exposure.ticks)
    slower = ticks / exposure.ticks
    margin = int(np.ceil(exposure.margin_ticks * slower))
    rig = replace(rig, exposure=replace(exposure, rate_hz=exposure.rate_hz * slower, margin_ticks=margin))
    if exposure.light == "hold":
        knots = np.unique([-margin, 0, ticks, ticks + margin])
        phases = (knots[:-1] + knots[1:]) / 2 / ticks
    else:
        knots = np.unique([-margin, 0, (ticks + 1) // 2, ticks, ticks + margin])
        phases = knots / ticks
    return rig, Schedule(knots, phases, times.label if times.label in phases else float(phases[len(phases) // 2]))
