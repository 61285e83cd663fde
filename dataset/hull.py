"""Points from silhouettes: what lies inside the alpha of every picture (the visual hull), for scenes without SfM."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError
from spikerig.dataset.scene import Camera, Points, Pose

BATCH = 200_000


def hull_points(
    camera: Camera, poses: Sequence[Pose], rgba: Sequence[NDArray[np.uint8]], *, count: int = 20_000, seed: int = 0
) -> Points:
    """Random points inside every silhouette, coloured by the mean of what the pictures show there.

    Args:
        camera: of all pictures.
        poses: of the pictures.
        rgba: uint8[H,W,4] pictures (any size of the camera's shape), encoded colours, straight alpha.
        count: how many points to keep, at most.
        seed: of the random points.

    Returns:
        Points(source="given"): at most `count`; colours carry no occlusion, a starting guess only.

    Raises:
        DataError: nothing lies inside all silhouettes (wrong poses, or empty alpha).

    Edges: a point outside a picture's field of view is not judged by that picture; at least half must judge it.
    Cost: `count` / (share of the volume that is inside) projections a picture; seconds for 100 pictures.
    """
    centre, half = _common_volume(camera, poses)
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0x48554C4C]))
    kept, colours, found, tried = [], [], 0, 0
    while found < count and tried < 60 * BATCH:
        xyz = centre + rng.uniform(-half, half, (BATCH, 3))
        xyz, colour = _inside(camera, poses, rgba, xyz)
        kept.append(xyz)
        colours.append(colour)
        found, tried = found + len(xyz), tried + BATCH
    if found == 0:
        raise DataError(
            "nothing lies inside all silhouettes",
            value=f"{len(rgba)} pictures, {tried} points tried",
            cause="poses of another convention, or pictures whose alpha is not a silhouette",
            next="give points by --colmap, or train with --set init=random",
        )
    xyz, colour = np.concatenate(kept)[:count], np.concatenate(colours)[:count]
    return Points(xyz, np.rint(colour).astype(np.uint8), "given")


def _common_volume(camera: Camera, poses: Sequence[Pose]) -> tuple[NDArray, float]:
    """The point nearest to all optical axes, and the half size of the cube around it that the cameras see."""
    rotations = np.stack([p.cam_from_world[:, :3] for p in poses])
    centres = np.stack([p.centre for p in poses])
    across = np.eye(3) - rotations[:, 2, :, None] * rotations[:, 2, None, :]
    middle = np.linalg.lstsq(across.sum(0), (across @ centres[..., None]).sum(0)[:, 0], rcond=None)[0]
    reach = np.median(np.linalg.norm(centres - middle, axis=1))
    return middle, float(reach * max(camera.width / camera.K[0, 0], camera.height / camera.K[1, 1]) / 2)


def _inside(
    camera: Camera, poses: Sequence[Pose], rgba: Sequence[NDArray[np.uint8]], xyz: NDArray
) -> tuple[NDArray, NDArray]:
    total, seen = np.zeros((len(xyz), 3)), np.zeros(len(xyz))
    for pose, picture in zip(poses, rgba, strict=True):
        h, w = picture.shape[:2]
        local = xyz @ pose.cam_from_world[:, :3].T + pose.cam_from_world[:, 3]
        z = local[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            x = (camera.K[0, 0] * local[:, 0] / z + camera.K[0, 2]) * (w / camera.width)
            y = (camera.K[1, 1] * local[:, 1] / z + camera.K[1, 2]) * (h / camera.height)
        within = (z > 0) & (x >= 0) & (x < w) & (y >= 0) & (y < h)
        pixel = picture[np.where(within, y, 0).astype(int), np.where(within, x, 0).astype(int)]
        keep = ~within | (pixel[:, 3] > 127)
        total += np.where(within[:, None], pixel[:, :3], 0)
        seen += within
        xyz, total, seen = xyz[keep], total[keep], seen[keep]
    judged = 2 * seen >= len(poses)  # what few pictures frame is not carved out by them
    return xyz[judged], total[judged] / seen[judged, None]
