"""Camera poses of a scene from its spikes: sharp textures are mapped by COLMAP, several ways, and must agree."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.gauge import centres, extent, pose_errors, similarity
from spikerig.calib.mapping import Map, Options, build_map
from spikerig.calib.pictures import KINDS, Looks, looks, picture_of, texture_of
from spikerig.calib.smooth import compose, mean_pose, smooth_path
from spikerig.dataset.errors import UsageError
from spikerig.dataset.scene import Camera, View

Floats = NDArray[np.float64]
LOOKED_AT = 6  # views on which the kinds of texture are judged
AGREE_DEG, AGREE_SHARE = 1.5, 0.03  # median rotation, and median distance over the extent, within which maps agree
HARDER = Options(peak_threshold=0.0015, max_ratio=0.85)


@dataclass(frozen=True, slots=True)
class Wanted:
    """What to estimate, and what is good enough.

    Args:
        arms: pictures of the `spike` arm, of `rgb`, or of `both` as a COLMAP rig of fixed relative pose.
        kinds: of texture; empty chooses by measured sharpness and noise.
        maps: how many kinds of texture are mapped independently; two or more can disagree, and then nothing is kept.
        instants: poses over each exposure, ends included; 1 gives the middle alone.
        min_share: of the views that must be placed.
        max_error_px: mean residual above which a map is refused.
    """

    arms: str = "spike"
    kinds: tuple[str, ...] = ()
    maps: int = 3
    instants: int = 5
    min_share: float = 0.8
    max_error_px: float = 1.5

    def __post_init__(self) -> None:
        if self.arms not in ("spike", "rgb", "both"):
            raise UsageError("unknown arms", value=self.arms, expected="spike, rgb or both")
        if not (1 <= self.maps <= 8 and 1 <= self.instants <= 101 and 0 < self.min_share <= 1):
            raise UsageError("maps, instants or min_share out of range", value=(self.maps, self.instants, self.min_share))


@dataclass(frozen=True, slots=True)
class Path:
    """A view's poses over its exposure: phases float64[M], cam_from_world [M,3,4], covariances [M,6,6], chi-square."""

    phases: Floats
    poses: Floats
    cov: Floats
    chi2: float


@dataclass(frozen=True, slots=True)
class Estimate:
    """Poses in a world of their own, and why to trust them or not.

    Args:
        images: names of all views asked for.
        poses: cam_from_world [3,4] at mid-exposure, by view, of those placed.
        paths: over the exposure, by view, of those where enough instants were.
        best: the map they come from.
        kinds: of texture mapped; the first is `best`'s.
        looked: sharpness and noise of the kinds.
        agreement_deg, agreement_share: largest median difference between the maps that agree.
        agreeing: how many of the maps agree with the best, itself included, and how many there were.
        reasons: why it is refused; empty when it is not.
    """

    images: tuple[str, ...]
    poses: Mapping[str, Floats]
    paths: Mapping[str, Path]
    best: Map
    kinds: tuple[str, ...]
    looked: tuple[Looks, ...] = ()
    agreement_deg: float | None = None
    agreement_share: float | None = None
    agreeing: tuple[int, int] = (1, 1)
    reasons: tuple[str, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)


def estimate_poses(
    views: Sequence[View],
    camera: Camera,
    wanted: Wanted,
    options: Options,
    *,
    rgb_camera: Camera | None = None,
    spike_from_rgb: Floats | None = None,
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
        keep: folder for COLMAP's files of the best map.
        done: called with the name of each step.

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
        pictures = {v.name: v.frame.pixels for v in usable}
        found = build_map(pictures, rgb_camera or camera, options, keep=keep, done=done)
        return _judged(Estimate(names, _poses(found), {}, found, ("rgb",)), wanted)
    ranked = _ranked(usable, wanted)
    kinds = wanted.kinds or tuple(look.kind for look in ranked)
    rigged = _Rigged(usable, camera, wanted, options, rgb_camera or camera, spike_from_rgb, keep, done)
    maps: dict[str, Map] = {}
    for kind in kinds[: wanted.maps]:
        maps[kind] = rigged.map(kind, first=not maps)
    enough = wanted.min_share * len(usable)
    spare = [k for k in kinds[wanted.maps :] if k not in maps]
    while max(len(m.poses) for m in maps.values()) < enough and spare:
        maps[spare[0]] = rigged.map(spare.pop(0))
    if max(len(m.poses) for m in maps.values()) < enough:
        harder = replace(HARDER, seed=options.seed, threads=options.threads, max_error_px=options.max_error_px)
        rigged.options = harder
        maps[f"{kinds[0]}, low contrast"] = rigged.map(kinds[0])
    return _judged(_settled(rigged, maps, names, ranked), wanted)


class _Rigged:
    """Maps of one scene by kind of texture, with what they share."""

    def __init__(
        self,
        views: Sequence[View],
        camera: Camera,
        wanted: Wanted,
        options: Options,
        rgb_camera: Camera,
        spike_from_rgb: Floats | None,
        keep: Any,
        done: Callable[[str], None],
    ) -> None:
        self.views, self.camera, self.wanted, self.options = views, camera, wanted, options
        self.rgb_camera, self.spike_from_rgb, self.keep, self.done = rgb_camera, spike_from_rgb, keep, done
        self.phases = np.linspace(0, 1, wanted.instants) if wanted.instants > 1 else np.array([0.5])

    def map(self, kind: str, first: bool = False) -> Map:
        """Map the middle instants by one kind of texture; the first map also takes the further instants."""
        folder = "spike/" if self.wanted.arms == "both" else ""
        pictures = {f"{folder}{v.name}": picture_of(texture_of(v.spikes, tick_at(v, 0.5), kind)) for v in self.views}
        further = {}
        if first and self.wanted.instants > 1:
            for v in self.views:
                for k, phase in enumerate(self.phases):
                    if abs(phase - 0.5) > 1e-9:
                        picture = picture_of(texture_of(v.spikes, tick_at(v, phase), kind))
                        further[f"{folder}{v.name}.at{k:03d}"] = (f"{folder}{v.name}", picture)
        rig = None
        if self.wanted.arms == "both":
            pictures |= {f"rgb/{v.name}": v.frame.pixels for v in self.views}
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


def rig_config(spike: Camera, rgb: Camera, spike_from_rgb: Floats | None) -> list[dict[str, Any]]:
    """COLMAP's configuration of two arms: the spike arm is the reference, the RGB arm's pose is fixed."""
    from spikerig.calib.mapping import colmap_camera

    pose = np.eye(3, 4) if spike_from_rgb is None else spike_from_rgb
    rows = []
    for name, camera in (("spike/", spike), ("rgb/", rgb)):
        model = colmap_camera(camera)
        row = {"image_prefix": name, "camera_model_name": model["model"], "camera_params": list(map(float, model["params"]))}
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


def tick_at(view: View, phase: float) -> float:
    """The tick of the view's spikes at a phase of the middle row's exposure (0 its start, 1 its end)."""
    frame, spikes = view.frame, view.spikes
    if spikes is None or spikes.rate_hz is None:
        raise UsageError("this view has no spikes with a known rate", value=view.name)
    start = frame.mid_ns - frame.exposure_ns / 2
    return float((start + phase * frame.exposure_ns - spikes.t0_ns) * spikes.rate_hz * 1e-9)


def _ranked(views: Sequence[View], wanted: Wanted) -> tuple[Looks, ...]:
    """Kinds of texture, best first, as measured on a few views; kinds whose window leaves the spikes are left out."""
    some = [views[k] for k in np.unique(np.linspace(0, len(views) - 1, LOOKED_AT).round().astype(int))]
    found = []
    for kind in wanted.kinds or KINDS:
        try:
            found.append(looks([picture_of(texture_of(v.spikes, tick_at(v, 0.5), kind)) for v in some], kind))
        except UsageError:
            if wanted.kinds:
                raise
    if not found:
        raise UsageError("the spikes are too short for any texture", value=f"{some[0].spikes.ticks} ticks")
    return tuple(sorted(found, key=lambda look: -look.score))


def _poses(found: Map) -> dict[str, Floats]:
    return {name: placed.pose for name, placed in found.poses.items()}


def _arm(found: Map, folder: str) -> Map:
    """The pictures of one arm, their folder taken off their names."""
    mine = [{n.removeprefix(folder): p for n, p in rows.items() if n.startswith(folder)} for rows in (found.poses, found.placed)]
    return replace(found, poses=mine[0], placed=mine[1])


def _settled(rigged: _Rigged, maps: Mapping[str, Map], names: tuple[str, ...], ranked: tuple[Looks, ...]) -> Estimate:
    """The largest group of maps that agree: its best map, poses averaged over the group, paths through its instants."""
    apart = {(a, b): _apart(maps[a], maps[b]) for a in maps for b in maps if a != b}
    friends = {a: [a] + [b for b in maps if b != a and _agree(apart[a, b])] for a in maps}
    order = list(maps)
    best = max(order, key=lambda k: (len(friends[k]), len(maps[k].poses), -order.index(k)))
    group = friends[best]
    poses = _averaged([maps[k] for k in group])
    pairs = [apart[best, k] for k in group[1:]]
    first = maps[order[0]]
    paths = _paths(first, maps[best], poses, rigged.phases) if rigged.wanted.instants > 1 and order[0] in group else {}
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
    )


def _apart(a: Map, b: Map) -> tuple[float, float]:
    """Median rotation (degrees) and distance (share of the extent) between two maps' poses of the same views."""
    shared = sorted(a.poses.keys() & b.poses.keys())
    if len(shared) < 3:
        return np.inf, np.inf
    stacks = [np.stack([m.poses[n].pose for n in shared]) for m in (a, b)]
    if extent(stacks[0]) <= 0 or extent(stacks[1]) <= 0:
        return np.inf, np.inf
    turned, moved = pose_errors(*stacks)
    return float(np.median(turned)), float(np.median(moved))


def _agree(apart: tuple[float, float]) -> bool:
    return apart[0] <= AGREE_DEG and apart[1] <= AGREE_SHARE


def _averaged(maps: Sequence[Map]) -> dict[str, Floats]:
    """Poses in the first map's world, averaged over all maps that have them: their errors differ."""
    stacks = [_poses(maps[0])]
    for other in maps[1:]:
        shared = sorted(maps[0].poses.keys() & other.poses.keys())
        to = similarity(*(np.stack([m.poses[n].pose for n in shared]) for m in (other, maps[0])))
        moved = to.poses(np.stack([p.pose for p in other.poses.values()]))
        stacks.append(dict(zip(other.poses, moved, strict=True)))
    return {name: mean_pose([s[name] for s in stacks if name in s]) for name in stacks[0]}


def _paths(first: Map, best: Map, poses: Mapping[str, Floats], phases: Floats) -> dict[str, Path]:
    """Paths over the exposures, moved so that each goes through its view's averaged pose at the middle."""
    to = None
    if first is not best:
        shared = sorted(first.poses.keys() & best.poses.keys())
        to = similarity(*(np.stack([m.poses[n].pose for n in shared]) for m in (first, best)))
    paths = {}
    for name in poses.keys() & first.poses.keys():
        rows = [(0.5, first.poses[name].pose, None)]
        rows += [
            (phases[k], first.placed[key].pose, first.placed[key].cov)
            for k in range(len(phases))
            if (key := f"{name}.at{k:03d}") in first.placed
        ]
        if len(rows) < 3:
            continue
        at, measured = np.array([r[0] for r in rows]), np.stack([r[1] for r in rows])
        known = np.array([np.sqrt(np.maximum(np.diag(c), 0)) for _, _, c in rows[1:]])
        sigmas = np.concatenate([np.median(known, 0)[None], known])
        scale = 1.0
        if to is not None:
            measured, scale = to.poses(measured), to.scale
        sigmas[:, 3:] *= scale
        smooth, cov, chi2 = smooth_path(at, measured, sigmas, np.append(phases, 0.5))
        inverse = np.concatenate([smooth[-1][:, :3].T, -(smooth[-1][:, :3].T @ smooth[-1][:, 3])[:, None]], 1)
        shift = compose(inverse, poses[name])  # world of the path -> world of the average, in the middle
        moved = np.stack([compose(p, shift) for p in smooth[:-1]])
        paths[name] = Path(phases, moved, cov[:-1], chi2)
    return paths


def _judged(found: Estimate, wanted: Wanted) -> Estimate:
    """The estimate with the reasons against it."""
    reasons = []
    placed, asked = len(found.poses), len(found.images)
    if placed < max(3, wanted.min_share * asked):
        lost = ", ".join(sorted(set(found.images) - found.poses.keys())[:12])
        reasons.append(f"only {placed} of {asked} views were placed ({wanted.min_share:.0%} asked for); not: {lost}")
    if placed and not found.best.error_px <= wanted.max_error_px:
        reasons.append(f"the mean residual is {found.best.error_px:.2f} px, more than {wanted.max_error_px:g}")
    if found.agreeing[1] > 1 and found.agreeing[0] < 2:
        reasons.append(f"{found.agreeing[1]} kinds of texture give {found.agreeing[1]} different maps: none is to be trusted")
    if placed >= 3:
        stack = np.stack(list(found.poses.values()))
        depth = _depth(found.best, stack)
        if depth > 0 and extent(stack) < 1e-3 * depth:
            reasons.append("the camera did not move: all views stand at one place")
    return replace(found, reasons=tuple(reasons))


def _depth(found: Map, stack: Floats) -> float:
    if not len(found.xyz):
        return 0.0
    return float(np.median(np.linalg.norm(found.xyz[None, :2000] - centres(stack)[:, None], axis=2)))
