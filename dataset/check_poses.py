"""Checks of poses: rotations, places, what the cameras look at, and paths over the exposures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.check import POSED, Check, Fault, check, fault
from spikerig.dataset.check_look import SceneLook, Undecided, ViewLook
from spikerig.dataset.scene import Points, Pose, Trajectory

Floats = NDArray[np.float64]
DRIFT = 1e-6  # of R R^T from 1
SAME = 1e-6  # of the cameras' extent: two centres at one place
SAME_DEG = 0.01
FAR = 8.0  # times the median distance to the second nearest camera
TURNED_DEG = 75.0  # from where each of the three nearest cameras looks
FEW_SEEN, MANY_SEEN = 0.02, 0.15  # share of the points inside a picture
SHORT = 0.01  # extent of the cameras over the points' distance
WORLDS = 1e4  # extent of the points over that of the cameras
OFF_PX, FAR_OFF_PX = 1.0, 5.0  # path against pose at mid-exposure
SWEEP = 0.25  # of the picture's width that a camera may move over one exposure
ENDS = 0.02  # of an exposure that a path may leave out at either end


def _pose(look: ViewLook) -> Pose:
    return look.view.pose


def centres_of(poses: Mapping[str, Pose]) -> Floats:
    """Camera centres float64[N,3]."""
    return np.stack([p.centre for p in poses.values()])


def _extent(centres: Floats) -> float:
    return float(np.linalg.norm(np.ptp(centres, axis=0)))


@check(
    "poses",
    "error",
    "K is no lens: a focal length below 0.3 or above 30 picture widths, or a principal point outside the picture; "
    "focal lengths that differ by over 5 % are a warning",
    "calibrate: `spikerig calib board`",
    profiles=POSED,
)
def camera_is_plausible(scene: SceneLook, _: Mapping[str, object]) -> Iterator[Fault]:
    """A camera matrix in the wrong unit, or of another picture size."""
    c = scene.camera
    fx, fy, cx, cy = c.K[0, 0], c.K[1, 1], c.K[0, 2], c.K[1, 2]
    if not 0.3 * c.width < fx < 30 * c.width:
        yield fault("", f"a focal length of {fx:g} px in pictures of {c.width}x{c.height}")
    if not (0 < cx < c.width and 0 < cy < c.height):
        yield fault("", f"the principal point ({cx:g}, {cy:g}) lies outside pictures of {c.width}x{c.height}")
    if abs(fx / fy - 1) > 0.05:
        yield fault("", f"focal lengths of {fx:g} and {fy:g} px: pixels that are not square", "warning")


@check(
    "poses",
    "warning",
    "a pose's rotation is off a rotation by over 1e-6 (over 1e-4 the file is not read at all)",
    "write poses in float64, orthonormal",
    measure=_pose,
    profiles=POSED,
)
def rotations_are_exact(scene: SceneLook, seen: Mapping[str, Pose]) -> Iterator[Fault]:
    """Rotations rounded on their way here."""
    for name, pose in seen.items():
        R = pose.cam_from_world[:, :3]
        drift = float(np.abs(R @ R.T - np.eye(3)).max())
        if drift > DRIFT:
            yield fault(name, f"R R^T differs from 1 by {drift:.2g}")


@check(
    "poses",
    "error",
    "all cameras stand at one place, or two views have the same pose (standing at one place but turned is a note)",
    "estimate poses: `spikerig calib poses`",
    measure=_pose,
    profiles=POSED,
)
def cameras_moved(scene: SceneLook, seen: Mapping[str, Pose]) -> Iterator[Fault]:
    """A scene is learnt from views of different places."""
    if len(seen) < 2:
        raise Undecided("a single view")
    names, centres = list(seen), centres_of(seen)
    size = _extent(centres)
    if size <= 1e-9 * max(1.0, float(np.abs(centres).max())):
        yield fault("", f"all {len(names)} views stand at one place")
        return
    for i, j in _pairs_within(centres, SAME * size):
        turned = _degrees(seen[names[i]].cam_from_world, seen[names[j]].cam_from_world)
        grave = "error" if turned < SAME_DEG else "note"
        yield fault(names[j], f"at the place of {names[i]}, turned by {turned:.3g} degrees", grave)


def _pairs_within(centres: Floats, reach: float) -> Iterator[tuple[int, int]]:
    for i in range(len(centres) - 1):
        away = np.linalg.norm(centres[i + 1 :] - centres[i], axis=1)
        for k in np.flatnonzero(away <= reach):
            yield i, i + 1 + int(k)


def _degrees(a: Floats, b: Floats) -> float:
    """Angle between two rotations, exact for small ones."""
    gap = float(np.linalg.norm(a[:, :3] - b[:, :3]))
    return float(np.degrees(2 * np.arcsin(min(1.0, gap / np.sqrt(8)))))


@check(
    "poses",
    "warning",
    "a camera is 8 times as far from its second nearest as is usual, or looks over 75 degrees away from where any "
    "of its three nearest does",
    "estimate poses again, or leave the view out",
    measure=_pose,
    profiles=POSED,
)
def no_camera_stands_apart(scene: SceneLook, seen: Mapping[str, Pose]) -> Iterator[Fault]:
    """Outliers of a map: a camera thrown far off, or turned about."""
    if len(seen) < 5:
        raise Undecided("under five views: none can be told to stand apart")
    names, centres = list(seen), centres_of(seen)
    ahead = np.stack([p.cam_from_world[2, :3] for p in seen.values()])
    away = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    near = np.argsort(away, axis=1)[:, 1:4]
    second = np.take_along_axis(away, near, 1)[:, 1]
    usual = float(np.median(second))
    for k, name in enumerate(names):
        if usual > 0 and second[k] > FAR * usual:
            yield fault(name, f"{second[k] / usual:.0f} times as far from its second nearest as is usual")
        turned = np.degrees(np.arccos(np.clip(ahead[near[k]] @ ahead[k], -1, 1)))
        if turned.min() > TURNED_DEG:
            yield fault(name, f"looks {turned.min():.0f} degrees away from where its neighbours look")


def _points(scene: SceneLook) -> Points:
    if scene.points is None or not len(scene.points.xyz):
        raise Undecided("no points")
    return scene.points


@check(
    "poses",
    "error",
    "under 2 % of the points lie in front of a view and inside its picture (under 15 %: a warning)",
    "the pose, the world or the sign of its axes is wrong: estimate poses again",
    measure=_pose,
    profiles=POSED,
)
def views_see_the_points(scene: SceneLook, seen: Mapping[str, Pose]) -> Iterator[Fault]:
    """A view that faces away from the scene, or poses of another world."""
    points = _points(scene)
    if points.source == "random":
        raise Undecided("points at random places")
    for name, pose in seen.items():
        share, ahead = points_seen(scene, points.xyz, pose)
        if share < MANY_SEEN:
            grave = "error" if share < FEW_SEEN else "warning"
            yield fault(name, f"{100 * share:.1f} % of the points inside the picture, {100 * ahead:.0f} % ahead", grave)


def points_seen(scene: SceneLook, xyz: Floats, pose: Pose) -> tuple[float, float]:
    """Shares of the points that lie inside a view's picture, and in front of it (lens distortion left out)."""
    at = xyz @ pose.cam_from_world[:, :3].T + pose.cam_from_world[:, 3]
    ahead = at[:, 2] > 0
    px = (at[ahead] / at[ahead, 2:]) @ scene.camera.K.T
    inside = (px[:, :2] >= 0).all(1) & (px[:, 0] < scene.camera.width) & (px[:, 1] < scene.camera.height)
    return float(inside.sum() / len(xyz)), float(ahead.mean())


@check(
    "poses",
    "warning",
    "the cameras' extent is below 1 % of the points' distance, or the points' extent over 10,000 times that of "
    "the cameras",
    "move the rig further between viewpoints; look for points at infinity",
    measure=_pose,
    profiles=POSED,
)
def extent_fits_the_depth(scene: SceneLook, seen: Mapping[str, Pose]) -> Iterator[Fault]:
    """Too short a baseline fixes no depth."""
    if len(seen) < 2:
        raise Undecided("a single view")
    points, centres = _points(scene), centres_of(seen)
    size = _extent(centres)
    depth = float(np.median(np.linalg.norm(points.xyz - centres.mean(0), axis=1)))
    spread = float(np.linalg.norm(np.ptp(points.xyz, axis=0)))
    if size < SHORT * depth:
        yield fault("", f"cameras within {size:.3g}, points {depth:.3g} away")
    elif spread > WORLDS * size:
        yield fault("", f"points spread over {spread:.3g}, cameras over {size:.3g}")


@dataclass(frozen=True, slots=True)
class Path:
    """A view's pose and path, and when the middle row was exposed."""

    pose: Pose
    path: Trajectory
    start_ns: int
    exposure_ns: int


def _path(look: ViewLook) -> Path:
    path = look.view.trajectory
    if path is None:
        raise Undecided("no path")
    return Path(look.view.pose, path, look.view.instant_ns(0.0), look.frame.exposure_ns)


@check(
    "poses",
    "warning",
    "a view's path leaves out over 2 % of the middle row's exposure at either end",
    "estimate the path over the whole exposure (`calib poses --instants 5`)",
    measure=_path,
    profiles=POSED,
)
def paths_cover_the_exposure(scene: SceneLook, seen: Mapping[str, Path]) -> Iterator[Fault]:
    """Sub-poses are needed from the first to the last instant of an exposure."""
    for name, p in seen.items():
        spare = ENDS * p.exposure_ns + 1
        late, early = p.path.at_ns[0] - p.start_ns, p.start_ns + p.exposure_ns - p.path.at_ns[-1]
        for missing, end in ((late, "begins {:.3f} ms late"), (early, "ends {:.3f} ms early")):
            if missing > spare:
                yield fault(name, "the path " + end.format(missing / 1e6))


@check(
    "poses",
    "error",
    "a view's path at mid-exposure is over 5 px off its pose (over 1 px: a warning); distances are judged at the "
    "points' median depth",
    "write pose and path of one estimate, in one world",
    measure=_path,
    profiles=POSED,
)
def paths_pass_through_the_poses(scene: SceneLook, seen: Mapping[str, Path]) -> Iterator[Fault]:
    """The pose of a view is the path's own at mid-exposure of the middle row."""
    if scene.truth_label not in ("", "mid") and "poses" not in scene.info:
        raise Undecided(f"poses are labelled {scene.truth_label!r}, not mid-exposure")
    for name, p in seen.items():
        at = p.start_ns + p.exposure_ns // 2
        if not p.path.at_ns[0] <= at <= p.path.at_ns[-1]:
            yield fault(name, "the path does not reach mid-exposure")
            continue
        off = pixels_apart(scene, pose_at(p.path, at), p.pose.cam_from_world)
        if off > OFF_PX:
            yield fault(name, f"pose and path are {off:.1f} px apart", "error" if off > FAR_OFF_PX else "warning")


@check(
    "poses",
    "warning",
    "a view's path moves the picture by over a quarter of its width within one exposure",
    "estimate the path again; or shorten the exposure",
    measure=_path,
    profiles=POSED,
)
def paths_are_short(scene: SceneLook, seen: Mapping[str, Path]) -> Iterator[Fault]:
    """A path that leaps is an outlier among its sub-poses."""
    for name, p in seen.items():
        inside = (p.path.at_ns >= p.start_ns) & (p.path.at_ns <= p.start_ns + p.exposure_ns)
        off = max((pixels_apart(scene, m, p.pose.cam_from_world) for m in p.path.poses[inside]), default=0.0)
        if off > SWEEP * scene.camera.width:
            yield fault(name, f"the path takes the picture {off:.0f} px away from its pose")


def pose_at(path: Trajectory, at_ns: int) -> Floats:
    """cam_from_world on a path between its two nearest knots: translation straight, rotation by the nearest rotation to
    the mean of both (right to third order in their angle)."""
    k = int(np.clip(np.searchsorted(path.at_ns, at_ns, side="right") - 1, 0, max(len(path.at_ns) - 2, 0)))
    if len(path.at_ns) == 1:
        return path.poses[0]
    w = float(at_ns - path.at_ns[k]) / float(path.at_ns[k + 1] - path.at_ns[k])
    u, _, v = np.linalg.svd((1 - w) * path.poses[k, :, :3] + w * path.poses[k + 1, :, :3])
    centre = [-m[:, :3].T @ m[:, 3] for m in path.poses[k : k + 2]]
    R = u @ v
    return np.column_stack([R, -R @ ((1 - w) * centre[0] + w * centre[1])])


def pixels_apart(scene: SceneLook, a: Floats, b: Floats) -> float:
    """How far apart two poses put a point ahead of the second, px: at the points' median depth, else by rotation."""
    depth = np.inf
    if scene.points is not None and len(scene.points.xyz):
        z = (scene.points.xyz @ b[2, :3]) + b[2, 3]
        depth = float(np.median(z[z > 0])) if (z > 0).any() else np.inf
    f = float(scene.camera.K[0, 0])
    moved = float(np.linalg.norm(a[:, :3].T @ a[:, 3] - b[:, :3].T @ b[:, 3])) / depth
    return f * float(np.hypot(np.radians(_degrees(a, b)), moved))


POSES: tuple[Check, ...] = (
    camera_is_plausible, rotations_are_exact, cameras_moved, no_camera_stands_apart, views_see_the_points,
    extent_fits_the_depth, paths_cover_the_exposure, paths_pass_through_the_poses, paths_are_short,
)  # fmt: skip
