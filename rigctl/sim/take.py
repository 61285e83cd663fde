"""One view as both sensors took it, and the scene file that gathers them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from math import fsum
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.bayer import bayer_info
from spikerig.dataset.clocktime import ClockModel
from spikerig.dataset.errors import HostError, UsageError
from spikerig.dataset.kernels import count
from spikerig.dataset.scene import Camera, Frame, Points, Pose, Trajectory, Truth, View
from spikerig.rigctl.sim.arms import PLACING
from spikerig.rigctl.sim.draws import stream
from spikerig.rigctl.sim.effects import Effect, Site, in_order, parameters
from spikerig.rigctl.sim.effects import Stage as EffectStage
from spikerig.rigctl.sim.rgb import encode, optics
from spikerig.rigctl.sim.schedule import Schedule, Track, phase_ns, start_ns
from spikerig.rigctl.sim.sensor import Light
from spikerig.rigctl.sim.simulate import simulate
from spikerig.rigctl.sim.spec import Cloud, Exposure, Sensor

if TYPE_CHECKING:
    from spikerig.dataset.events import EventStream
    from spikerig.rigctl.sim.events import EventCamera

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Rig:
    """What stays the same from view to view: the two sensors, their timing and their faults.

    Args:
        name, seed: of the scene.
        camera: the one pinhole of both sensors.
        exposure, sensor, effects, events: as in the scene file.
    """

    name: str
    seed: int
    camera: Camera
    exposure: Exposure
    sensor: Sensor
    effects: tuple[Effect, ...]
    events: EventCamera | None = None

    @property
    def light_gain(self) -> float:
        """Spikes a tick at RGB white; of a colour sensor where its channel gain is 1."""
        return self.sensor.gain * (1.0 if self.sensor.bayer else fsum(self.sensor.response))

    @property
    def facts(self) -> dict[str, Any]:
        """What a reader of the scene must know of the cameras beside what its format says, for its info."""
        bayer, events = self.sensor.bayer, self.events
        return (bayer_info(bayer) if bayer else {}) | ({"events": asdict(events)} if events else {})


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
    events: EventStream | None = None


NO_POINTS = Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "simulator")


def take_sharp(
    rig: Rig,
    number: int,
    name: str,
    plan: Schedule,
    sharp: NDArray[np.float32],
    track: Track,
    arm: NDArray[np.float32] | None = None,
) -> Taken:
    """A view for testing: the sharp picture at the label as the RGB arm is placed to see it, no spikes.

    Args:
        rig: the sensors.
        number, name: of the view.
        plan: its schedule.
        sharp: linear light float32[H,W,3] at the label, of the spike arm's camera: the truth.
        track: where the camera was.
        arm: the same as the RGB arm sees it, where that differs.

    Edges:
        Of the effects only those that place the picture count (`PLACING`): a held-out picture has no other faults.
    """
    view, at_ns, path = _labelled(rig, number, name, plan, track, "test")
    height, width = sharp.shape[:2]
    site = Site(height, width, number, rig.seed, rig.exposure.rate_hz, camera=rig.camera, own_arm=arm is not None)
    placing = [effect.begin(site).rgb_optics for effect in in_order(rig.effects) if effect.name in PLACING]
    seen = optics((sharp if arm is None else arm)[None], placing)[0]
    return Taken(
        replace(view, frame=Frame(encode(seen), start_ns=at_ns)), sharp, at_ns, path, NO_POINTS, np.nan, 0.0, 0
    )


def take_blurry(
    rig: Rig,
    number: int,
    name: str,
    plan: Schedule,
    sharp: NDArray[np.float32],
    track: Track,
    rgb: NDArray[np.float32],
    arm: NDArray[np.float32] | None = None,
) -> Taken:
    """A view for training: spikes over exposure and margins, and the blurry picture.

    Args:
        rig, number, name, plan, sharp, track: as for `take_sharp`.
        rgb: linear light float32[K,H,W,3] at `plan.phases`.
        arm: the same as the RGB arm sees it, where that differs.
    """
    view, at_ns, path = _labelled(rig, number, name, plan, track, "train")
    light = light_of(rig, number, plan, rgb, arm)
    seen = simulate(light, rig.sensor, rig.effects, rig.seed, number, rig.camera, rig.events)
    error = seen.frame.pixels * (255 / seen.frame.full) - encode(sharp)
    counts = count(seen.spikes.bits, rig.camera.width, *light.exposure)
    blur_db = 20 * np.log10(255 / max(float(np.sqrt(np.mean(error**2))), 1e-9))
    view = replace(view, frame=seen.frame, spikes=seen.spikes, trajectory=path)
    return Taken(view, sharp, at_ns, path, NO_POINTS, blur_db, float(counts.mean()), int(counts.max()), seen.events)


def light_of(
    rig: Rig, number: int, plan: Schedule, rgb: NDArray[np.float32], arm: NDArray[np.float32] | None = None
) -> Light:
    """The light of a view over its spikes, from pictures at `plan.phases`; see `take_blurry`."""
    exposure, first = rig.exposure, int(plan.knots[0])
    t0_ns = start_ns(exposure, number) + round(first * exposure.tick_ns)
    return Light(rgb, plan.knots - first, (-first, exposure.ticks - first), exposure.rate_hz, t0_ns, arm)


def _labelled(
    rig: Rig, number: int, name: str, plan: Schedule, track: Track, split: Any
) -> tuple[View, int, Trajectory]:
    """A view without its picture yet, the instant of its label, its path."""
    height, width = rig.camera.height, rig.camera.width
    begin = start_ns(rig.exposure, number)
    path = Trajectory(begin + phase_ns(rig.exposure, track.phases), track.poses)
    pose = Pose(track.poses[int(np.searchsorted(track.phases, plan.label))])
    rows = np.repeat(np.arange(height, dtype=np.float32)[:, None], width, 1)
    frame = Frame(np.zeros((height, width, 3), np.uint8))
    view = View(name, frame, None, rows, np.ones((height, width), bool), pose, None, split)
    return view, begin + int(phase_ns(rig.exposure, plan.label)), path


def surface(rig: Rig, number: int, cloud: Cloud, share: int, view: View, depth: NDArray[np.floating]) -> Points:
    """A view's share of the surface points: random pixels, depth with noise, colours of the blurry picture.

    Args:
        rig: for camera and seed.
        number: of the view.
        cloud: relative depth noise.
        share: how many points at most.
        view: its picture and pose.
        depth: along z at the label through the pixel centres, [H,W]; not finite or <= 0 where nothing is.
    """
    rng, camera, pose = stream(rig.seed, "points", number), rig.camera, view.pose.cam_from_world
    flat = np.asarray(depth, np.float64).reshape(-1)
    picked = rng.permutation(np.flatnonzero(np.isfinite(flat) & (flat > 0)))[:share]
    z = flat[picked] * (1 + cloud.depth_noise * rng.standard_normal(len(picked)))
    y, x = np.divmod(picked, camera.width)
    K = camera.K
    rays = np.stack([(x + 0.5 - K[0, 2]) / K[0, 0], (y + 0.5 - K[1, 2]) / K[1, 1], np.ones(len(picked))], 1)
    return Points(
        (rays * z[:, None] - pose[:, 3]) @ pose[:, :3], view.frame.pixels8.reshape(-1, 3)[picked], "simulator"
    )


def share_of(total: int, rank: int, views: int) -> int:
    """How many of `total` points the view of that rank gives; the shares sum to the total."""
    return total * (rank + 1) // views - total * rank // views


def in_parallel(work: Callable[[Any, int], T], job: Any, count_: int, workers: int) -> Iterator[T]:
    """work(job, 0), work(job, 1), ... in order, by several processes; few are made ahead of what is taken.

    Args:
        work: a function of a module, for it runs in fresh processes.
        job: passed to each.
        count_: how many.
        workers: processes; 1 works in this one.

    Raises:
        HostError: a worker process died.
    """
    if min(workers, count_) <= 1:
        yield from (work(job, number) for number in range(count_))
        return
    pool = ProcessPoolExecutor(min(workers, count_), mp_context=get_context("spawn"))
    try:
        waiting: deque[Future[T]] = deque()
        for number in range(count_):
            waiting.append(pool.submit(work, job, number))
            if len(waiting) > 2 * workers:  # bounded memory
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    except BrokenProcessPool as error:
        raise HostError(
            "a worker process died", cause="out of memory, or killed", next="give --workers 1, or a smaller picture"
        ) from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def pack(
    path: str | Path,
    rig: Rig,
    takes: Iterable[Taken],
    *,
    info: Mapping[str, Any],
    points: Points | None = None,
    views: int = 0,
    force: bool = False,
    done: Callable[[Taken], None] = lambda taken: None,
) -> dict[str, Any]:
    """Write views into a scene file as they come.

    Args:
        path: of the file; it appears there complete or not at all, and nothing is left beside it unless killed.
        rig: what took them.
        takes: in order.
        info: provenance.
        points: instead of those of the views.
        views: how many will come; only effects on the clock need to know.
        force: replace an existing file.
        done: called after each view is written.

    Returns:
        What was made, JSON-ready.

    Raises:
        UsageError: the file exists; the spike camera's clock steps back. HostError: the disk is full.
    """
    from spikerig.dataset.store import SceneWriter

    effects = {effect.name: parameters(effect) for effect in rig.effects}
    truth = Truth({}, {}, {}, true_clock(rig, views), effects, rig.seed, rig.exposure.label)
    told: list[Taken] = []
    more = {"light_gain": rig.light_gain, "info": {**info, **rig.facts}, "truth": truth}
    events = 0
    # keep=False: what a simulation left half done can be made again
    with SceneWriter(path, rig.name, rig.camera, **more, force=force, keep=False) as out:
        for taken in takes:
            truths = {"light": taken.light, "at_ns": taken.at_ns, "trajectory": taken.trajectory}
            out.add(taken.view, **truths, events=taken.events)
            events += len(taken.events or ())
            told.append(replace(taken, view=replace(taken.view, spikes=None), events=None))
            done(taken)
        if points is None:
            xyz, rgb = (np.concatenate([getattr(t.points, key) for t in told]) for key in ("xyz", "rgb"))
            points = Points(xyz, rgb, "simulator")
        out.points = points if len(points.xyz) else None
    told_events = {"events": events} if rig.events else {}
    return _report(rig, told, len(points.xyz)) | {"effects": effects} | told_events


def true_clock(rig: Rig, views: int) -> ClockModel:
    """The exact map from the spike camera's time to the rig's: knots over each view's spikes.

    They lie at start, middle and end of each exposure and at the ends of its margins, straight in between.

    Raises:
        UsageError: the clock steps back from one view to the next.
    """
    clocks = [effect for effect in rig.effects if effect.stage == EffectStage.CLOCK]
    if not clocks:
        return ClockModel.identity()
    if views < 1:
        raise UsageError("effects on the clock need the number of views", value=views)
    exposure, margin = rig.exposure, rig.exposure.margin_ticks
    ticks = np.unique([-margin, 0, exposure.ticks / 2, exposure.ticks, exposure.ticks + margin])
    at_ns = np.array([start_ns(exposure, k) + np.rint(ticks * exposure.tick_ns) for k in range(views)]).astype(np.int64)
    ahead = np.zeros(at_ns.shape)
    for number, times in enumerate(at_ns):
        t0_s = float(times[0]) * 1e-9
        site = Site(rig.camera.height, rig.camera.width, number, rig.seed, exposure.rate_hz, t0_s)
        for effect in clocks:
            clock = effect.begin(site).clock_ns
            if clock is not None:
                ahead[number] += clock(times)
    rig_ns = at_ns.reshape(-1)
    return ClockModel(rig_ns + np.rint(ahead.reshape(-1)).astype(np.int64), rig_ns, np.zeros(len(rig_ns)), 0.0)


def _report(rig: Rig, told: list[Taken], points: int) -> dict[str, Any]:
    train = [t for t in told if t.view.split == "train"]
    exposure = rig.exposure
    return {
        "scene": rig.name,
        "seed": rig.seed,
        "train_views": len(train),
        "test_views": len(told) - len(train),
        "size": [rig.camera.width, rig.camera.height],
        "ticks": exposure.ticks,
        "rate_hz": exposure.rate_hz,
        "protocol": exposure.protocol,
        "pose_label": exposure.label,
        "light_gain": rig.light_gain,
        "points": points,
        "spikes_mean": float(np.mean([t.spikes_mean for t in train])) if train else 0.0,
        "spikes_max": max((t.spikes_max for t in train), default=0),
        "blurry_psnr_db": float(np.mean([t.blur_db for t in train])) if train else None,
    }
