"""The plan of a folder of frames: its views are looked at as they lie there, and cost what reading them costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError
from spikerig.dataset.exr import read_exr_depth
from spikerig.rigctl.sim.judge.calibrate import Work, least
from spikerig.rigctl.sim.judge.looks import LOOK_PARTS, LOOK_PX, VIEWS, Looked, full_map, samples_left, spread
from spikerig.rigctl.sim.judge.plan import Plan, chosen, judged
from spikerig.rigctl.sim.judge.samples import motion_px, parts_for
from spikerig.rigctl.sim.judge.survey import Look, survey
from spikerig.rigctl.sim.sensor import Light
from spikerig.rigctl.sim.sources.folder import Folder, Sequence
from spikerig.rigctl.sim.sources.pictures import read_light
from spikerig.rigctl.sim.sources.points import read_points

Floats = NDArray[np.floating]


def plan_folder(folder: Folder, views: int = VIEWS) -> Plan:
    """Judge the effects of a folder's settings; the same every time.

    Args:
        folder: as `read_folder` gives it.
        views: how many of its training views to look at.

    Raises:
        DataError: a picture that is looked at cannot be read, or is of another size.

    Cost:
        Reads 3 to 17 pictures of each view looked at.
    """
    return judged(look_folder(folder, views), folder.rig.effects, folder.settings.tolerance)


def resolve_folder(folder: Folder, made: Plan) -> Folder:
    """The folder with its effects chosen; as if its settings had listed them."""
    if folder.settings.tolerance is None:
        return folder
    effects, exposure = chosen(made, folder.rig.exposure)
    rig = replace(folder.rig, effects=effects, exposure=exposure)
    return replace(
        folder, rig=rig, settings=replace(folder.settings, effects=effects, exposure=exposure, tolerance=None)
    )


def look_folder(folder: Folder, views: int = VIEWS) -> Looked:
    """Look at a few training views of a folder.

    Edges:
        The motion of a picture is that of its surface: of the view's depth, or of points at the middle distance of the
        given ones; where neither is there, only the camera's turning counts.
    """
    rig, camera = folder.rig, folder.rig.camera
    train = [k for k, view in enumerate(folder.views) if view.split == "train"]
    xyz = read_points(folder.points).xyz if folder.points else np.zeros((0, 3))
    looks, exposures, motions, depths = [], [], [], []
    for number in spread(train, views):
        view = folder.views[number]
        depth = _depth(view, xyz, (camera.height, camera.width))
        label = view.track.poses[int(np.argmin(np.abs(view.track.phases - view.plan.label)))]
        motion = motion_px(camera, depth, label, view.track.poses)
        looks.append(Look(_light(folder, view, float(motion.max())), full_map(motion, depth.shape)))
        motions.append(float(motion.max()))
        exposures.append(replace(rig.exposure, sub_poses=len(_inside(view))))
        depths.append(depth[np.isfinite(depth) & (depth > 0)])
    far = np.concatenate(depths)
    near = (float(far.min()), float(np.median(far))) if far.size else (np.inf, np.inf)
    facts = survey(looks, rig.sensor, rig.exposure, focal_px=float(camera.K[0, 0]), views=len(train), depth=near)
    lights = [each.light for each in looks]
    samples = samples_left(lights, exposures, motions, rig.sensor, chosen=False)
    return Looked(facts, samples, tuple(looks), tuple(train), rig.seed, rig.sensor, rig.exposure, camera)


def _inside(view: Sequence) -> NDArray[np.intp]:
    """Numbers of the pictures that the exposure sees."""
    return np.flatnonzero((view.plan.phases >= 0) & (view.plan.phases <= 1))


def _light(folder: Folder, view: Sequence, motion: float) -> Light:
    """Light over the exposure from enough of the view's pictures."""
    ticks, phases = folder.rig.exposure.ticks, view.plan.phases
    inside = _inside(view)
    parts = min(parts_for(motion, LOOK_PX), LOOK_PARTS, len(inside) - 1)
    picked = inside if parts < 1 else inside[np.unique(np.rint(np.linspace(0, len(inside) - 1, parts + 1)).astype(int))]
    if len(view.files) == 1:
        picked = picked[:1]
    pictures = [_picture(folder, view, int(k)) for k in picked]
    if len(pictures) == 1:
        return Light(np.stack(pictures), np.array([0, ticks]), (0, ticks), folder.rig.exposure.rate_hz)
    knots = np.rint(phases[picked] * ticks)
    knots = np.rint((knots - knots[0]) * (ticks / (knots[-1] - knots[0]))).astype(np.int64)  # slots: to their ends
    return Light(np.stack(pictures), knots, (0, ticks), folder.rig.exposure.rate_hz)


def _picture(folder: Folder, view: Sequence, k: int) -> NDArray[np.float32]:
    file, camera = view.files[k], folder.rig.camera
    light, _ = read_light(file, background=folder.background, layer=folder.layer, how=folder.bad_values)
    if light.shape[:2] != (camera.height, camera.width):
        raise DataError(
            "a picture of another size", value=f"{file}: {light.shape[1]}x{light.shape[0]}",
            expected=f"{camera.width}x{camera.height}, as the first",
        )  # fmt: skip
    return light


def _depth(view: Sequence, xyz: Floats, shape: tuple[int, int]) -> Floats:
    """The view's depth [H,W], as well as it is known."""
    if view.depth is not None:
        return read_exr_depth(view.depth)
    pose = view.track.poses[len(view.track.poses) // 2]
    z = xyz @ pose[2, :3] + pose[2, 3]
    z = z[z > 0]
    return np.full(shape, float(np.median(z)) if z.size else np.inf)


def work_folder(folder: Folder, made: Plan) -> Work:
    """What the capture of a folder does."""
    train = [view for view in folder.views if view.split == "train"]
    test = [view for view in folder.views if view.split != "train"]
    first = train[0]
    read = least(lambda: _picture(folder, first, 0), 2)
    depth = least(lambda: _depth(first, np.zeros((0, 3)), (1, 1)), 2) if first.depth else 0.0
    files = float(np.mean([len(view.files) for view in train]))
    points = folder.settings.cloud.count if any(view.depth for view in train) else 0
    each = float(np.mean([len(view.files) for view in test])) if test else 0.0
    return Work(folder.rig, len(train), len(test), first.plan, 0.0, files * read + depth, each * read, points)
