"""Camera poses of a scene from its spikes: sharp textures are mapped by COLMAP, several ways, and must agree."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.consensus import Path, agree, apart_by, averaged, paths_through, still_paths
from spikerig.calib.estimate import Estimate, Wanted
from spikerig.calib.mapping import Map, Options, build_map
from spikerig.calib.pattern import fixed_pattern
from spikerig.calib.pictures import KINDS, Looks, frame_picture, looks, picture_of, texture_of
from spikerig.calib.pose_verdict import judged
from spikerig.calib.straight import Straight
from spikerig.dataset.errors import UsageError
from spikerig.dataset.scene import Camera, View
from spikerig.dataset.texture import Texture

Floats = NDArray[np.float64]
LOOKED_AT = 6  # views on which the kinds of texture are judged
APART = (0.2, 0.8)  # phases of the two instants that features are compared between: windows share no spike
HARDER = {"peak_threshold": 0.0015, "max_ratio": 0.85}


def estimate_poses(
    views: Sequence[View],
    camera: Camera,
    wanted: Wanted,
    options: Options,
    *,
    rgb_camera: Camera | None = None,
    spike_from_rgb: Floats | None = None,
    straight: Straight = Straight(),
    keep: Any = None,
    done: Callable[[str], None] = lambda step: None,
) -> Estimate:
    """Map one picture of every view, and place further instants of each exposure in the map.

    Args:
        views: with spikes (except for `rgb`), as stored.
        camera: of the spike arm, known.
        wanted, options: what, and how COLMAP does it.
        rgb_camera: of the frames; None: the same as `camera`.
        spike_from_rgb: [3,4] for `both`; None: one centre, one direction.
        straight: what puts textures of raw spikes onto `camera`.
        keep: folder for COLMAP's files of the best map.
        done: called with the name of each step, by several threads.

    Returns:
        The estimate; look at `reasons` before using it.

    Raises:
        UsageError: fewer than three views, or no spikes.
        HostError: COLMAP is missing or died.

    Cost:
        `maps` maps, and `instants` - 1 further pictures a view. See docs/poses.md.
    """
    usable = [v for v in views if v.spikes is not None or wanted.arms == "rgb"]
    if len(usable) < 3:
        raise UsageError("poses need three views with spikes at least", value=f"{len(usable)} of {len(views)} views")
    names = tuple(v.name for v in usable)
    if wanted.arms == "rgb":
        pictures = {v.name: frame_picture(v.frame) for v in usable}
        found = build_map(pictures, rgb_camera or camera, options, keep=keep, done=done)
        return judged(Estimate(names, {n: p.pose for n, p in found.poses.items()}, {}, found, ("rgb",)), wanted)
    gain = gain_of(usable) if wanted.pattern else None
    ranked = _ranked(usable, wanted, gain, straight)
    done("textures ranked")
    kinds = wanted.kinds or tuple(look.kind for look in ranked)
    rigged = _Rigged(usable, camera, wanted, options, rgb_camera or camera, spike_from_rgb, keep, done, gain, straight)
    maps = _side_by_side(rigged, kinds[: wanted.maps])
    enough = wanted.min_share * len(usable)
    spare = [k for k in kinds[wanted.maps :] if k not in maps]
    while max(len(m.poses) for m in maps.values()) < enough and spare:
        kind = spare.pop(0)
        maps[kind] = rigged.map(kind)
    if max(len(m.poses) for m in maps.values()) < enough:
        harder = replace(options, **HARDER)
        maps[f"{kinds[0]}, low contrast"] = replace(rigged, options=harder).map(kinds[0])
    return judged(_settled(rigged, maps, names, ranked), wanted)


@dataclass(frozen=True, slots=True)
class _Rigged:
    """Maps of one scene by kind of texture, with what they share."""

    views: Sequence[View]
    camera: Camera
    wanted: Wanted
    options: Options
    rgb_camera: Camera
    spike_from_rgb: Floats | None
    keep: Any
    done: Callable[[str], None]
    gain: Floats | None
    straight: Straight

    @property
    def phases(self) -> Floats:
        """Of the exposure, at which poses are asked for."""
        return np.linspace(0, 1, self.wanted.instants) if self.wanted.instants > 1 else np.array([0.5])

    def map(self, kind: str, first: bool = False) -> Map:
        """Map the middle instants by one kind of texture; the first map also takes the further instants."""
        folder = "spike/" if self.wanted.arms == "both" else ""
        pictures = {f"{folder}{v.name}": look_at(v, 0.5, kind, self.gain, self.straight) for v in self.views}
        further = {}
        if first and self.wanted.instants > 1:
            for v in self.views:
                for k, phase in enumerate(self.phases):
                    if abs(phase - 0.5) > 1e-9:
                        picture = look_at(v, phase, kind, self.gain, self.straight)
                        further[f"{folder}{v.name}.at{k:03d}"] = (f"{folder}{v.name}", picture)
        rig = None
        if self.wanted.arms == "both":
            pictures |= {f"rgb/{v.name}": frame_picture(v.frame) for v in self.views}
            rig = rig_config(self.camera, self.rgb_camera, self.spike_from_rgb)
        keep = self.keep if first else None
        step = f"{kind}: "
        found = build_map(
            pictures,
            None if rig else self.camera,
            self.options,
            further=further,
            rig=rig,
            keep=keep,
            done=lambda name: self.done(step + name),
        )
        return found if not folder else _arm(found, folder)


def _side_by_side(rigged: _Rigged, kinds: Sequence[str]) -> dict[str, Map]:
    """A map by each kind, each in a COLMAP of its own: much of COLMAP runs on one thread, so two run on two cores."""
    threads = rigged.options.threads or len(os.sched_getaffinity(0))
    at_once = max(1, min(threads, len(kinds)))
    each = replace(rigged, options=replace(rigged.options, threads=max(1, threads // at_once)))
    with ThreadPoolExecutor(at_once) as pool:
        running = [pool.submit(each.map, kind, kind == kinds[0]) for kind in kinds]
        return {kind: future.result() for kind, future in zip(kinds, running, strict=True)}


def rig_config(spike: Camera, rgb: Camera, spike_from_rgb: Floats | None) -> list[dict[str, Any]]:
    """COLMAP's configuration of two arms: the spike arm is the reference, the RGB arm's pose is fixed."""
    from spikerig.calib.mapping import colmap_camera

    pose = np.eye(3, 4) if spike_from_rgb is None else spike_from_rgb
    rows: list[dict[str, Any]] = []
    for name, camera in (("spike/", spike), ("rgb/", rgb)):
        model = colmap_camera(camera)
        row = {
            "image_prefix": name,
            "camera_model_name": model["model"],
            "camera_params": list(map(float, model["params"])),
        }
        if name == "spike/":
            row["ref_sensor"] = True
        else:
            turned = pose[:, :3].T  # rgb_from_spike
            row["cam_from_rig_rotation"] = quaternion(turned).tolist()
            row["cam_from_rig_translation"] = (-turned @ pose[:, 3]).tolist()
        rows.append(row)
    return [{"cameras": rows}]


def quaternion(R: Floats) -> Floats:
    """w x y z of a rotation [3,3], w >= 0."""
    m = np.array(
        [
            [R[0, 0] + R[1, 1] + R[2, 2], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
            [0, R[0, 0] - R[1, 1] - R[2, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]],
            [0, 0, R[1, 1] - R[0, 0] - R[2, 2], R[1, 2] + R[2, 1]],
            [0, 0, 0, R[2, 2] - R[0, 0] - R[1, 1]],
        ]
    )
    _, vectors = np.linalg.eigh(m + np.triu(m, 1).T)
    q = vectors[:, -1]
    return q if q[0] >= 0 else -q


def gain_of(views: Sequence[View]) -> Floats | None:
    """The fixed pattern of the views' sensor, where there are views enough to tell it."""
    return fixed_pattern([v.spikes for v in views if v.spikes is not None])


def look_at(
    view: View, phase: float, kind: str, gain: Floats | None = None, straight: Straight = Straight()
) -> NDArray[np.uint8]:
    """The picture of a view by a kind of texture, at a phase of the exposure; the others as in `texture_at`."""
    if view.spikes is None:
        raise UsageError("this view has no spikes", value=view.name)
    if kind[:3] == "tfp" and kind[3:].isdigit() and int(kind[3:]) > view.spikes.ticks:
        told = f"{view.name}, {kind}: {view.spikes.ticks} ticks"
        raise UsageError("a texture does not fit the spikes", value=told, next="ask for a shorter window")
    return picture_of(texture_at(view, phase, kind, gain, straight))


def texture_at(
    view: View, phase: float, kind: str, gain: Floats | None = None, straight: Straight = Straight()
) -> Texture:
    """The texture of a view by a kind, at a phase of the exposure; divided by the gain, then put straight."""
    if view.spikes is None:
        raise UsageError("this view has no spikes", value=view.name)
    raw = texture_of(view.spikes, tick_at(view, phase), kind)
    if gain is not None:
        raw = replace(raw, light=(raw.light / gain).astype(np.float32))
    return straight.texture(raw)


def tick_at(view: View, phase: float) -> float:
    """The tick of the view's spikes at a phase of the middle row's exposure (0 its start, 1 its end)."""
    frame, spikes = view.frame, view.spikes
    if spikes is None or spikes.rate_hz is None:
        raise UsageError("this view has no spikes with a known rate", value=view.name)
    start = view.mid_ns - frame.exposure_ns / 2
    return float((start + phase * frame.exposure_ns - spikes.t0_ns) * spikes.rate_hz * 1e-9)


def _ranked(views: Sequence[View], wanted: Wanted, gain: Floats | None, straight: Straight) -> tuple[Looks, ...]:
    """Kinds of texture, best first, as measured on a few views; kinds whose window leaves the spikes are left out."""
    if len(wanted.kinds) == 1:
        return ()
    some = [views[k] for k in np.unique(np.linspace(0, len(views) - 1, LOOKED_AT).round().astype(int))]
    found = []
    for kind in wanted.kinds or KINDS:
        try:
            pairs = [tuple(look_at(v, phase, kind, gain, straight) for phase in APART) for v in some]
            found.append(looks([p for pair in pairs for p in pair], kind, [(a, b) for a, b in pairs]))
        except UsageError:
            if wanted.kinds:
                raise
    if not found:
        raise UsageError("the spikes are too short for any texture", expected="windows of 48 ticks and more")
    return tuple(sorted(found, key=lambda look: -look.score))


def best_kind(views: Sequence[View], gain: Floats | None = None) -> str:
    """The kind of texture whose features are found again best on these views."""
    return _ranked(views, Wanted(), gain, Straight())[0].kind


def _arm(found: Map, folder: str) -> Map:
    """The pictures of one arm, their folder taken off their names."""

    def mine(rows: Mapping[str, Any]) -> dict[str, Any]:
        return {n.removeprefix(folder): p for n, p in rows.items() if n.startswith(folder)}

    return replace(found, poses=mine(found.poses), placed=mine(found.placed))


def _settled(rigged: _Rigged, maps: Mapping[str, Map], names: tuple[str, ...], ranked: tuple[Looks, ...]) -> Estimate:
    """The largest group of maps that agree: its best map, poses averaged over the group, paths through its instants."""
    apart = {(a, b): apart_by(maps[a], maps[b]) for a in maps for b in maps if a != b}
    friends = {a: [a] + [b for b in maps if b != a and agree(apart[a, b])] for a in maps}
    order = list(maps)
    best = max(order, key=lambda k: (len(friends[k]), len(maps[k].poses), -order.index(k)))
    group = friends[best]
    poses = averaged([maps[k] for k in group])
    pairs = [apart[best, k] for k in group[1:]]
    paths: dict[str, Path] = {}
    if rigged.wanted.instants > 1:
        first = maps[order[0]] if order[0] in group else _with_instants(rigged, best)
        paths = paths_through(first, maps[best], poses, rigged.phases)
        paths |= still_paths(paths, poses, rigged.phases)
    kinds = (best, *(k for k in order if k != best))
    seconds: dict[str, float] = {}
    for found in maps.values():
        for step, spent in found.seconds.items():
            seconds[step] = seconds.get(step, 0.0) + spent
    return Estimate(
        names,
        poses,
        paths,
        maps[best],
        kinds,
        ranked,
        max((p[0] for p in pairs), default=None),
        max((p[1] for p in pairs), default=None),
        (len(group), len(maps)),
        (),
        seconds,
        None if rigged.gain is None else float(np.std(np.log(rigged.gain))),
    )


def _with_instants(rigged: _Rigged, name: str) -> Map:
    """The map of that name once more, with the further instants: the map that had them is not to be trusted."""
    kind, _, low = name.partition(", ")
    again = replace(rigged, options=replace(rigged.options, **HARDER)) if low else rigged
    return again.map(kind, first=True)
