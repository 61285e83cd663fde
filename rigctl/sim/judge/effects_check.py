"""The plan, checked: what leaving effects out really changes, with paired random streams, against what was promised."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import HostError
from spikerig.dataset.images import srgb_from_linear
from spikerig.dataset.kernels import count, fire
from spikerig.rigctl.sim.capture import capture, rgb_arm, rig_of
from spikerig.rigctl.sim.caster.light import stage_of
from spikerig.rigctl.sim.effects import Effect
from spikerig.rigctl.sim.judge.calibrate import Costs, least, predict
from spikerig.rigctl.sim.judge.casting import work_of
from spikerig.rigctl.sim.judge.check_scenes import Case, scene_of, table_of
from spikerig.rigctl.sim.judge.facts import PART, told
from spikerig.rigctl.sim.judge.looks import spread
from spikerig.rigctl.sim.judge.plan import Plan, judged, plan, resolve, resolved_table
from spikerig.rigctl.sim.judge.tomltext import toml_text
from spikerig.rigctl.sim.rgb import encode, expose
from spikerig.rigctl.sim.schedule import schedule
from spikerig.rigctl.sim.sensor import Light, spike_light
from spikerig.rigctl.sim.simulate import simulate
from spikerig.rigctl.sim.spec import SceneSpec, Tolerance
from spikerig.rigctl.sim.take import light_of
from spikerig.rigctl.sim.viewpoint import timed, view_path

TOLERANCES = ((0.0, 0.0), (0.5, 0.5), (1.0, 1.0), (2.0, 2.0), (5.0, 5.0), (20.0, 20.0))
TIMED = (2.0, 2.0)  # the tolerance at which seconds are predicted and measured
SEEN = 3  # views of a scene that are simulated
FINER = 4  # light samples that stand for the truth


@dataclass(frozen=True, slots=True)
class Outputs:
    """What the two cameras gave: counts of one exposure int64[V,H,W], RGB values float64[V,H,W,3] of 255 (whole, but
    for a camera of more than 8 bits)."""

    counts: NDArray[np.int64]
    values: NDArray[np.float64]


def lights_of(spec: SceneSpec, views: int = SEEN) -> list[tuple[int, Light]]:
    """The light of a few training views, as the capture makes it, by number of the view."""
    stage, rig = stage_of(spec.world), rig_of(spec)
    held_out = spec.orbit.held_out()
    found = []
    for number in spread([k for k in range(spec.orbit.views) if k not in held_out], views):
        times, path = schedule(timed(spec, number, stage)), view_path(spec, number)
        poses = path.poses(times.phases)
        rgb = np.stack([stage.picture(rig.camera, pose, spec.lens.samples) for pose in poses])
        found.append((number, light_of(rig, number, times, rgb, rgb_arm(spec, stage, poses))))
    return found


def outputs(spec: SceneSpec, lights: Sequence[tuple[int, Light]], effects: Sequence[Effect]) -> Outputs:
    """Simulate the views with some of the effects."""
    rig, apart = rig_of(spec), any(effect.name == "misalignment" for effect in effects)
    counts, values = [], []
    for number, both in lights:
        light = both if apart else replace(both, arm=None)
        seen = simulate(light, spec.sensor, effects, spec.seed, number, rig.camera)
        counts.append(count(seen.spikes.bits, rig.camera.width, *light.exposure))
        values.append(seen.frame.pixels * (255 / seen.frame.full))
    return Outputs(np.stack(counts).astype(np.int64), np.stack(values))


def check(case: Case, tolerances: Sequence[tuple[float, float]] = TOLERANCES, views: int = SEEN) -> dict[str, Any]:
    """One scene: at each tolerance what auto changes; of each effect its bound and what leaving it out changes.

    Args:
        case: the scene.
        tolerances: (spikes, digital numbers).
        views: that are simulated.

    Returns:
        JSON-ready: `auto`, a row a tolerance; `effects`, a row an effect.
    """
    spec = scene_of(case)
    made, lights = plan(spec), lights_of(spec, views)
    whole = outputs(spec, lights, spec.effects)
    auto, seen = [], {tuple(e.name for e in spec.effects): whole}
    bounds = {row.effect.name: row.bound for row in made.rows}
    for spikes, dn in tolerances:
        chosen = judged(made.looked, spec.effects, Tolerance(spikes, dn), bounds)
        names = tuple(e.name for e in chosen.effects)
        if names not in seen:
            seen[names] = outputs(spec, lights, chosen.effects)
        auto.append(_auto(chosen, whole, seen[names]))
    rows = []
    for row in made.rows:
        rest = [e for e in spec.effects if e is not row.effect]
        less = outputs(spec, lights, rest)
        actual = told(less.counts - whole.counts), told(less.values - whole.values)
        for output, bound, real in zip(("spikes", "dn"), (row.bound.spikes, row.bound.dn), actual, strict=True):
            if bound or real:
                rows.append({"effect": row.effect.name, "output": output, "bound": bound, "actual": real})
    about = {"scene": case.name, "words": case.words, "faint": case.faint, "samples": samples(spec, made)}
    return about | {"auto": auto, "effects": rows}


def _auto(made: Plan, whole: Outputs, seen: Outputs) -> dict[str, Any]:
    moved = [np.abs(a - b) for a, b in ((whole.counts, seen.counts), (whole.values, seen.values))]
    allowed = (made.tolerance.spikes, made.tolerance.dn) if made.tolerance else (0.0, 0.0)
    within = [float(np.mean(m <= t + 1e-9)) for m, t in zip(moved, allowed, strict=True)]
    return {
        "tolerance": allowed[0],
        "on": len(made.effects),
        "off": [row.effect.name for row in made.rows if not row.on],
        "left": made.left,
        "within_spikes": within[0],
        "within_dn": within[1],
        "most": [float(m.max(initial=0)) for m in moved],
    }


def samples(spec: SceneSpec, made: Plan) -> dict[str, Any]:
    """What the light samples of one view leave, against samples `FINER` times as dense, and the plan's bound on it.

    Returns:
        JSON-ready: the samples and motion of the plan; bounds and actual errors in 95 % of the pixels, of the light of
        one exposure in thresholds (at most one a tick), and of RGB values before they are rounded.
    """
    stage, camera, number = stage_of(spec.world), rig_of(spec).camera, made.looked.train[0]
    exposure, path = timed(spec, number, stage), view_path(spec, number)
    hold, n = exposure.light == "hold", exposure.sub_poses
    parts = n if hold else max(n - 1, 1)
    about = asdict(made.samples) | {"view": n}
    if n == 1:
        return about | {"spikes_off": 0.0, "dn_off": 0.0}

    def mean(cuts: int) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        phases = (np.arange(cuts) + 0.5) / cuts if hold else np.linspace(0, 1, cuts + 1)
        weights = np.ones(len(phases))
        if not hold:
            weights[[0, -1]] = 0.5
        gray, rgb = np.zeros((camera.height, camera.width)), np.zeros((camera.height, camera.width, 3))
        for weight, pose in zip(weights / weights.sum(), path.poses(phases), strict=True):
            picture = stage.picture(camera, pose, spec.lens.samples)
            gray += weight * np.minimum(spike_light(picture[None], spec.sensor)[0], 1)
            rgb += weight * picture
        return gray * exposure.ticks, 255 * srgb_from_linear(np.clip(rgb, 0, 1))

    pairs = zip(mean(parts), mean(FINER * parts), strict=True)
    off = [float(np.percentile(np.abs(here - truth), PART)) for here, truth in pairs]
    return about | {"spikes_off": off[0], "dn_off": off[1]}


def seconds(case: Case, tolerance: tuple[float, float] = TIMED) -> dict[str, Any]:
    """CPU seconds of one scene's capture as predicted, and as measured right after, in this process."""
    spec = scene_of(case, tolerance)
    began = time.process_time()
    made = plan(spec)
    judging = time.process_time() - began
    costs: Costs = predict(work_of(spec, made), made)
    whole = resolve(spec, made)
    with tempfile.TemporaryDirectory() as folder:
        measured = least(lambda: capture(whole, Path(folder) / "scene.h5", force=True), 2, stage_of.cache_clear)
    return {
        "scene": case.name, "on": len(made.effects), "predicted": costs.total, "measured": measured, "judging": judging,
        "predicting": costs.spent,
    }  # fmt: skip


def nothing(case: Case, repeats: int = 9) -> dict[str, Any]:
    """A scene that needs no effect: its cost against the bare closed form, and the effect modules that it imports.

    Args:
        case: the scene; its tolerance is set so high that nothing stays.
        repeats: of which the least counts, both kinds in turn.

    Returns:
        JSON-ready: `planned` and `bare` CPU seconds a view, `judging` (the plan, which does import the effects it
        judges), `modules` imported by a fresh process that takes a view of the resolved scene file.
    """
    spec = scene_of(case, (1e9, 1e9))
    spec = replace(spec, lens=replace(spec.lens, width=400, height=250))  # the sensor's own size
    began = time.process_time()
    made = plan(spec)
    judging = time.process_time() - began
    whole = resolve(spec, made)
    number, light = lights_of(whole, 1)[0]
    camera = rig_of(whole).camera

    def bare() -> None:
        start = np.zeros(light.rgb.shape[1:3], np.uint32)
        fire(np.ascontiguousarray(spike_light(light.rgb, whole.sensor)), light.knots, start, hold=light.hold)
        encode(expose(light))

    best = {"planned": np.inf, "bare": np.inf}
    runs = {"planned": lambda: simulate(light, whole.sensor, whole.effects, whole.seed, number, camera), "bare": bare}
    for _ in range(repeats):
        for key, run in runs.items():
            began = time.process_time()
            run()
            best[key] = min(best[key], time.process_time() - began)
    about = {"scene": case.name, "effects": len(whole.effects), "judging": judging}
    return about | best | {"modules": modules(case, made)}


PROGRAM = """
import sys
from spikerig.rigctl.sim.capture import take_view
from spikerig.rigctl.sim.spec import load_scene_toml
take_view(load_scene_toml(sys.argv[1]), 0)
root = "spikerig.rigctl.sim.effects."
print(*sorted(m.removeprefix(root) for m in sys.modules if m.startswith(root)))
"""


def modules(case: Case, made: Plan) -> list[str]:
    """Modules of effects that a fresh process imports to take a view of the resolved scene file."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "resolved.toml"
        file.write_text(toml_text(resolved_table(table_of(case), made)), encoding="utf-8")
        done = subprocess.run([sys.executable, "-c", PROGRAM, str(file)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise HostError("a fresh process could not take a view", value=done.stderr.strip()[-500:])
    return done.stdout.split()
