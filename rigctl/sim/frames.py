"""Pictures from elsewhere: a folder of linear (or sRGB) sub-frames with poses becomes a spike-RGB scene."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, RigError
from spikerig.dataset.images import read_image, read_linear
from spikerig.rigctl.sim.folder import Folder
from spikerig.rigctl.sim.limits import Faults
from spikerig.rigctl.sim.points import read_points
from spikerig.rigctl.sim.take import Taken, in_parallel, pack, share_of, surface, take_blurry, take_sharp


def take_sequence(folder: Folder, number: int) -> Taken | list[str]:
    """One view of the folder as both sensors take it, or all that is wrong with its pictures."""
    sequence, rig = folder.views[number], folder.rig
    trouble: list[str] = []
    pictures = [_picture(folder, file, trouble) for file in sequence.files]
    depth = None
    if sequence.depth is not None:
        try:
            depth = read_image(sequence.depth, nonfinite="keep")[:, :, 0]
            if depth.dtype != np.float32 or depth.shape != (rig.camera.height, rig.camera.width):
                trouble.append(f"{sequence.depth.name}: {depth.dtype} {depth.shape}, expected an EXR of the same size")
        except RigError as error:
            trouble.append(f"{sequence.depth.name}: {error.what} ({error.value})")
    if trouble:
        return [f"{sequence.name}/{text}" for text in trouble]
    plan = sequence.plan
    rgb = np.stack(pictures)  # type: ignore[arg-type]
    rgb = np.repeat(rgb, len(plan.phases), axis=0) if len(rgb) == 1 else rgb
    sharp = rgb[int(np.argmin(np.abs(plan.phases - plan.label)))].copy()
    if sequence.split == "test":
        return take_sharp(rig, number, sequence.name, plan, sharp, sequence.track)
    taken = take_blurry(rig, number, sequence.name, plan, sharp, sequence.track, rgb)
    if depth is None:
        return taken
    ranks = [k for k, view in enumerate(folder.views) if view.split == "train" and view.depth is not None]
    share = share_of(folder.settings.cloud.count, ranks.index(number), len(ranks))
    return replace(taken, points=surface(rig, number, folder.settings.cloud, share, taken.view, depth))


def _picture(folder: Folder, file: Path, trouble: list[str]) -> NDArray[np.float32] | None:
    try:
        light = read_linear(file, background=folder.background)
    except RigError as error:
        trouble.append(f"{file.name}: {error.what} ({error.value})")
        return None
    camera = folder.rig.camera
    if light.shape[:2] != (camera.height, camera.width):
        trouble.append(
            f"{file.name}: is {light.shape[1]}x{light.shape[0]}, the first picture {camera.width}x{camera.height}"
        )
        return None
    negative = int(np.count_nonzero(light < 0))
    if negative:
        trouble.append(f"{file.name}: {negative} of {light.size} values are negative, the least {light.min():.3g}")
        return None
    return light


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
        What was made, JSON-ready.

    Raises:
        DataError: pictures that cannot be used (damaged, of another size, NaN, infinite, negative): all at once.
    """
    faults = Faults("the pictures", DataError, "docs/sim_frames.md says what a picture may hold")
    takes = in_parallel(take_sequence, folder, len(folder.views), workers)

    def good() -> Iterator[Taken]:
        for taken in takes:
            if isinstance(taken, list):
                faults.found += taken
            elif not faults.found:  # with a fault known, the rest is only looked at
                yield taken
        faults.raise_any()

    info = {"made_by": "spikerig sim frames", "folder": folder.rig.name}
    points = read_points(folder.points) if folder.points else None
    return pack(path, folder.rig, good(), info=info, points=points, views=len(folder.views), force=force, done=done)
