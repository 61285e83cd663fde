"""Pictures from elsewhere: a folder of linear (or sRGB) sub-frames with poses becomes a spike-RGB scene."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, RigError
from spikerig.dataset.exr import read_exr_depth
from spikerig.rigctl.sim.judge.folder_plan import plan_folder, resolve_folder
from spikerig.rigctl.sim.limits import Faults
from spikerig.rigctl.sim.sources.folder import Folder
from spikerig.rigctl.sim.sources.pictures import Bad, as_report, read_light
from spikerig.rigctl.sim.sources.points import read_points
from spikerig.rigctl.sim.take import Taken, in_parallel, pack, share_of, surface, take_blurry, take_sharp


class Shot(NamedTuple):
    """One view as taken, and what had to be mended of each of its pictures."""

    taken: Taken
    bad: list[Bad]


def take_sequence(folder: Folder, number: int) -> Shot | list[str]:
    """One view of the folder as both sensors take it, or all that is wrong with its pictures."""
    sequence, rig = folder.views[number], folder.rig
    trouble: list[str] = []
    bad: list[Bad] = []
    pictures = [_picture(folder, file, trouble, bad) for file in sequence.files]
    depth = _depth(folder, sequence.depth, trouble) if sequence.depth else None
    if trouble:
        return [f"{sequence.name}/{text}" for text in trouble]
    plan = sequence.plan
    rgb = np.stack(pictures)  # type: ignore[arg-type]
    rgb = np.repeat(rgb, len(plan.phases), axis=0) if len(rgb) == 1 else rgb
    sharp = rgb[int(np.argmin(np.abs(plan.phases - plan.label)))].copy()
    if sequence.split == "test":
        return Shot(take_sharp(rig, number, sequence.name, plan, sharp, sequence.track), bad)
    taken = take_blurry(rig, number, sequence.name, plan, sharp, sequence.track, rgb)
    if depth is not None:
        ranks = [k for k, view in enumerate(folder.views) if view.split == "train" and view.depth is not None]
        share = share_of(folder.settings.cloud.count, ranks.index(number), len(ranks))
        taken = replace(taken, points=surface(rig, number, folder.settings.cloud, share, taken.view, depth))
    return Shot(taken, bad)


def _picture(folder: Folder, file: Path, trouble: list[str], bad: list[Bad]) -> NDArray[np.float32] | None:
    try:
        light, counts = read_light(file, background=folder.background, layer=folder.layer, how=folder.bad_values)
    except RigError as error:
        trouble.append(f"{file.name}: {error.what} ({error.value})")
        return None
    bad.append(counts)
    camera = folder.rig.camera
    if light.shape[:2] != (camera.height, camera.width):
        trouble.append(
            f"{file.name}: is {light.shape[1]}x{light.shape[0]}, the first picture {camera.width}x{camera.height}"
        )
        return None
    return light


def _depth(folder: Folder, file: Path, trouble: list[str]) -> NDArray[np.float32] | None:
    camera = folder.rig.camera
    try:
        depth = read_exr_depth(file)
        if depth.shape == (camera.height, camera.width):
            return depth
        trouble.append(f"{file.name}: is {depth.shape[1]}x{depth.shape[0]}, expected an EXR of the pictures' size")
    except RigError as error:
        trouble.append(f"{file.name}: {error.what} ({error.value})")
    return None


def capture_folder(
    folder: Folder,
    path: str | Path,
    *,
    workers: int = 1,
    force: bool = False,
    done: Callable[[Taken], None] = lambda taken: None,
) -> dict[str, Any]:
    """Simulate a folder's views and write the scene.

    Args:
        folder: as `read_folder` gives it.
        path, workers, force, done: as for `capture`.

    Returns:
        What was made, JSON-ready; `bad_values` counts what was mended.

    Raises:
        DataError: pictures that cannot be used (damaged, of another size; NaN, infinite or negative, unless they are
            to be mended): all at once.
    """
    faults = Faults("the pictures", DataError, "docs/sim_frames.md says what a picture may hold (--bad-values mends)")
    bad: list[Bad] = []
    info: dict[str, Any] = {
        "made_by": "spikerig sim frames",
        "folder": folder.rig.name,
        "bad_values": folder.bad_values,
    }
    told: dict[str, Any] = {}
    if folder.settings.tolerance is not None:
        plan = plan_folder(folder)
        folder, told = resolve_folder(folder, plan), {"plan": plan.as_json(), "plan_line": plan.summary()}
        info["plan"] = told["plan"]
    takes = in_parallel(take_sequence, folder, len(folder.views), workers)

    def good() -> Iterator[Taken]:
        for taken in takes:
            if isinstance(taken, list):
                faults.found += taken
            elif not faults.found:  # with a fault known, the rest is only looked at
                bad.extend(taken.bad)
                yield taken.taken
        faults.raise_any()

    points = read_points(folder.points) if folder.points else None
    made = pack(path, folder.rig, good(), info=info, points=points, views=len(folder.views), force=force, done=done)
    return made | told | {"bad_values": as_report(folder.bad_values, bad)}
