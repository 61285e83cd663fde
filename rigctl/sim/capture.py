"""A scene file played from viewpoint to viewpoint: views, truth and surface points."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, fields, replace
from math import fsum
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import ClockModel
from spikerig.dataset.errors import HostError
from spikerig.dataset.scene import Camera, Frame, Points, Pose, Trajectory, Truth, View
from spikerig.rigctl.sim.draws import stream
from spikerig.rigctl.sim.effects import parameters
from spikerig.rigctl.sim.light import Stage, stage_of
from spikerig.rigctl.sim.orbit import orbit_pose, target_depth
from spikerig.rigctl.sim.sensor import Light, encode
from spikerig.rigctl.sim.shake import ShakePath, shake_path
from spikerig.rigctl.sim.simulate import simulate
from spikerig.rigctl.sim.spec import Exposure, SceneSpec


@dataclass(frozen=True, slots=True)
class Schedule:
    """When pictures are cast for one view; tick 0 is the start of the exposure.

    Args:
        knots: ticks, int64[K] (linear) or [K+1] (hold), over the exposure and its margins.
        phases: float64[K], phase of the exposure (0 to 1, beyond in the margins) at which each picture is cast.
        label: phase of the view's pose and sharp truth.
    """

    knots: NDArray[np.int64]
    phases: NDArray[np.float64]
    label: float


@dataclass(frozen=True, slots=True)
class Taken:
    """One captured view, its truth, its surface points, and what to report of it."""

    view: View
    light: NDArray[np.float32]
    at_ns: int
    trajectory: Trajectory
    points: Points
    blur_db: float
    spikes_mean: float
    spikes_max: int


def schedule(exposure: Exposure) -> Schedule:
    """Knots evenly spread over the exposure (rounded to ticks), at the same spacing over the margins."""
    ticks, margin, n = exposure.ticks, exposure.margin_ticks, exposure.sub_poses
    parts = n if exposure.light == "hold" else max(n - 1, 1)
    inner = np.rint(np.linspace(0, ticks, parts + 1))
    outer = np.rint(np.linspace(0, margin, int(np.ceil(margin * parts / ticks)) + 1))[1:]
    knots = np.concatenate([-outer[::-1], inner, ticks + outer]).astype(np.int64)
    times = (knots[:-1] + knots[1:]) / 2 if exposure.light == "hold" else knots.astype(np.float64)
    phases = times / ticks
    first = float(phases[phases >= 0][0])
    label = 0.5 if exposure.label == "mid" else first
    return Schedule(knots, np.full_like(phases, label) if n == 1 else phases, label)


def camera_of(spec: SceneSpec) -> Camera:
    """The scene's pinhole camera."""
    return Camera.pinhole(spec.lens.width, spec.lens.height, spec.lens.fov_deg)


def view_path(spec: SceneSpec, number: int) -> ShakePath:
    """How the camera moves over the exposure of a view; held-out views are labelled at the same phase of theirs."""
    rng = stream(spec.seed, "shake", number)
    base = orbit_pose(spec.orbit, number)
    return shake_path(spec.shake, spec.exposure, camera_of(spec), base, target_depth(spec.orbit), rng)


def take_view(spec: SceneSpec, number: int, stage: Stage | None = None) -> Taken:
    """Capture one view; the same bits whoever asks, in any order.

    Args:
        spec: the scene.
        number: of the view, from 0.
        stage: the world made ready, to save doing it again.
    """
    stage = stage or stage_of(spec.world)
    camera, plan, exposure = camera_of(spec), schedule(spec.exposure), spec.exposure
    path = view_path(spec, number)
    label = path.poses(plan.label)[0]
    sharp = stage.picture(camera, label, spec.lens.samples)
    start_ns = round((number + 1) * exposure.period_ms * 1e6)
    length_ns = exposure.ticks * exposure.tick_ns
    at_ns = start_ns + round(plan.label * length_ns)
    phases = _inside(plan)
    trajectory = Trajectory(start_ns + np.rint(phases * length_ns).astype(np.int64), path.poses(phases))
    if number in spec.orbit.held_out():
        frame = Frame(encode(sharp), start_ns=at_ns)
        view = _view(f"{number:03d}", frame, None, label, None, "test")
        return Taken(view, sharp, at_ns, trajectory, _no_points(), np.nan, 0.0, 0)
    light = _light(stage, camera, path, plan, spec, start_ns, sharp)
    seen = simulate(light, spec.sensor, spec.effects, spec.seed, number)
    view = _view(f"{number:03d}", seen.frame, seen.spikes, label, trajectory, "train")
    points = _surface(stage, camera, label, seen.frame.pixels, spec, number)
    error = seen.frame.pixels.astype(np.float64) - encode(sharp)
    counts = _exposure_counts(seen.spikes.bits, exposure, spec.lens.width)
    blur_db = 20 * np.log10(255 / max(np.sqrt(np.mean(error**2)), 1e-9))
    return Taken(view, sharp, at_ns, trajectory, points, blur_db, float(counts.mean()), int(counts.max()))


def _inside(plan: Schedule) -> NDArray[np.float64]:
    """Phases of the trajectory's poses: the ends of the exposure, the pictures within it, and the label."""
    within = plan.phases[(plan.phases >= 0) & (plan.phases <= 1)]
    return np.unique(np.concatenate([[0.0], within, [plan.label, 1.0]]))


def _light(
    stage: Stage,
    camera: Camera,
    path: ShakePath,
    plan: Schedule,
    spec: SceneSpec,
    start_ns: int,
    sharp: NDArray[np.float32],
) -> Light:
    """Cast all pictures of one view; the label's is at hand."""
    poses = path.poses(plan.phases)
    rgb = np.empty((len(poses), camera.height, camera.width, 3), np.float32)
    for k, pose in enumerate(poses):
        rgb[k] = sharp if plan.phases[k] == plan.label else stage.picture(camera, pose, spec.lens.samples)
    first = int(plan.knots[0])
    t0_ns = start_ns + round(first * spec.exposure.tick_ns)
    return Light(rgb, plan.knots - first, (-first, spec.exposure.ticks - first), spec.exposure.rate_hz, t0_ns)


def _view(name, frame, spikes, pose, trajectory, split) -> View:
    height, width = frame.pixels.shape[:2]
    rows = np.repeat(np.arange(height, dtype=np.float32)[:, None], width, 1)
    return View(name, frame, spikes, rows, np.ones((height, width), bool), Pose(pose), trajectory, split)


def _no_points() -> Points:
    return Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "simulator")


def _surface(
    stage: Stage, camera: Camera, pose: NDArray[np.float64], pixels: NDArray[np.uint8], spec: SceneSpec, number: int
) -> Points:
    """This view's share of the surface points: random pixels, true depth with noise, colour of the blurry picture."""
    train = sorted(set(range(spec.orbit.views)) - spec.orbit.held_out())
    rank = train.index(number)
    share = spec.cloud.count * (rank + 1) // len(train) - spec.cloud.count * rank // len(train)
    rng = stream(spec.seed, "points", number)
    depth = stage.depth(camera, pose).astype(np.float64)
    seen = np.flatnonzero(np.isfinite(depth))
    picked = rng.permutation(seen)[:share]
    z = depth.reshape(-1)[picked] * (1 + spec.cloud.depth_noise * rng.standard_normal(len(picked)))
    y, x = np.divmod(picked, camera.width)
    rays = np.stack([(x + 0.5 - camera.K[0, 2]) / camera.K[0, 0], (y + 0.5 - camera.K[1, 2]) / camera.K[1, 1]], 1)
    local = np.concatenate([rays, np.ones((len(rays), 1))], 1) * z[:, None]
    return Points((local - pose[:, 3]) @ pose[:, :3], pixels.reshape(-1, 3)[picked], "simulator")


def _exposure_counts(bits: NDArray[np.uint8], exposure: Exposure, width: int) -> NDArray[np.uint32]:
    from spikerig.dataset.kernels import count

    return count(bits, width, exposure.margin_ticks, exposure.margin_ticks + exposure.ticks)


def take_all(spec: SceneSpec, workers: int = 1) -> Iterator[Taken]:
    """All views in order, cast by several processes; the same bits for any number of them.

    Args:
        spec: the scene.
        workers: processes; 1 works in this one.

    Raises:
        HostError: a worker process died.
    """
    views = spec.orbit.views
    if min(workers, views) <= 1:
        yield from (take_view(spec, number) for number in range(views))
        return
    pool = ProcessPoolExecutor(min(workers, views), mp_context=get_context("spawn"))
    try:
        waiting: deque[Future[Taken]] = deque()
        for number in range(views):
            waiting.append(pool.submit(take_view, spec, number))
            if len(waiting) > 2 * workers:  # bounded memory: no view is made long before it is written
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    except BrokenProcessPool as error:
        raise HostError(
            "a worker process died", cause="out of memory, or killed", next="give --workers 1, or a smaller picture"
        ) from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def capture(
    spec: SceneSpec,
    path: str | Path,
    *,
    workers: int = 1,
    force: bool = False,
    done: Callable[[Taken], None] = lambda taken: None,
) -> dict[str, Any]:
    """Play a scene and write it, a view at a time.

    Args:
        spec: the scene.
        path: of the scene file; it appears there complete or not at all.
        workers: processes that cast and simulate.
        force: replace an existing file.
        done: called after each view is written.

    Returns:
        What was made, JSON-ready: counts, spikes an exposure, blur.

    Raises:
        UsageError: the file exists. HostError: the disk is full or a worker died.
    """
    from spikerig.dataset.store import SceneWriter

    truth = Truth({}, {}, {}, ClockModel.identity(), _effects(spec), spec.seed, spec.exposure.label)
    gain = spec.sensor.gain * fsum(spec.sensor.response)
    told: list[Taken] = []
    points: list[Points] = []
    with SceneWriter(
        path, spec.name, camera_of(spec), light_gain=gain, info=provenance(spec), truth=truth, force=force
    ) as out:
        for taken in take_all(spec, workers):
            out.add(taken.view, light=taken.light, at_ns=taken.at_ns, trajectory=taken.trajectory)
            points.append(taken.points)
            told.append(replace(taken, view=replace(taken.view, spikes=None), points=_no_points()))
            done(taken)
        cloud = Points(np.concatenate([p.xyz for p in points]), np.concatenate([p.rgb for p in points]), "simulator")
        out.points = cloud if len(cloud.xyz) else None
    train = [t for t in told if t.view.split == "train"]
    return {
        "scene": spec.name,
        "seed": spec.seed,
        "train_views": len(train),
        "test_views": len(told) - len(train),
        "size": [spec.lens.width, spec.lens.height],
        "ticks": spec.exposure.ticks,
        "margin_ticks": spec.exposure.margin_ticks,
        "rate_hz": spec.exposure.rate_hz,
        "protocol": spec.exposure.protocol,
        "pose_label": spec.exposure.label,
        "light_gain": gain,
        "effects": _effects(spec),
        "points": len(cloud.xyz),
        "spikes_mean": float(np.mean([t.spikes_mean for t in train])),
        "spikes_max": max(t.spikes_max for t in train),
        "blurry_psnr_db": float(np.mean([t.blur_db for t in train])),
    }


def _effects(spec: SceneSpec) -> dict[str, Any]:
    return {effect.name: parameters(effect) for effect in spec.effects}


def provenance(spec: SceneSpec) -> dict[str, Any]:
    """How a scene was made, JSON-ready: the whole scene file as it was understood."""
    record = {f.name: getattr(spec, f.name) for f in fields(spec) if f.name not in ("effects", "name", "seed")}
    parts = {key: asdict(value) for key, value in record.items()}
    return {"made_by": "spikerig sim capture", "scene_file": {**parts, "effects": _effects(spec)}}
