"""How large a map is: a board of known squares, seen in some of its views, gives millimetres."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.boards import Board, Found
from spikerig.dataset.scene import Camera

Floats = NDArray[np.float64]
FEWEST, MOST_SPREAD = 3, 0.05  # views, and relative scatter of their scales, beyond which a scale is not believed
THIN = 0.02  # of the rays' directions: less, and they do not meet anywhere in particular


@dataclass(frozen=True, slots=True)
class Scale:
    """Millimetres a unit of a map, their standard deviation, and the views they come from."""

    mm_per_unit: float
    sd: float
    views: tuple[str, ...]


def scale_of(poses: Mapping[str, Floats], seen: Mapping[str, Found], camera: Camera, board: Board) -> Scale | str:
    """The size of a map from a board that does not move.

    Each view alone gives the distance of the board's middle in millimetres, and its direction. The directions meet in a
    point of the map; each view's two distances to it give a scale. The middle is the same however a checkerboard's
    corners are labelled (it may be turned by half).

    Args:
        poses: cam_from_world [3,4] by view, of the map.
        seen: boards by view; views without a pose are left out.
        camera: of the pictures.
        board: which.

    Returns:
        The scale, or why there is none: fewer than three views, rays that do not meet, scales that scatter over 5 %.
    """
    rays, lengths, names = [], [], []
    for name in sorted(poses.keys() & seen.keys()):
        middle = middle_of(seen[name], camera, board)
        if middle is not None:
            lengths.append(float(np.linalg.norm(middle)))
            R, t = poses[name][:, :3], poses[name][:, 3]
            rays.append((-R.T @ t, R.T @ middle / lengths[-1]))
            names.append(name)
    if len(rays) < FEWEST:
        return f"the board was seen in {len(rays)} of {len(poses)} placed views; {FEWEST} are needed"
    across = [np.eye(3) - np.outer(d, d) for _, d in rays]
    total = np.sum(across, 0)
    if np.linalg.eigvalsh(total)[0] < THIN**2 * len(rays):
        return "the board was seen from one direction only"
    point = np.linalg.solve(total, np.sum([a @ c for a, (c, _) in zip(across, rays, strict=True)], 0))
    away = np.array([np.linalg.norm(point - c) for c, _ in rays])
    scales = np.array(lengths) / np.maximum(away, 1e-12)
    middle = float(np.median(scales))
    scatter = 1.4826 * float(np.median(np.abs(scales - middle)))
    missed = [np.linalg.norm(a @ (point - c)) for a, (c, _) in zip(across, rays, strict=True)]
    if float(np.median(missed / np.maximum(away, 1e-12))) > MOST_SPREAD:
        return "the directions to the board do not meet: it moved, or the map is bent"
    if scatter > MOST_SPREAD * middle:
        return f"the views give scales that scatter by {scatter / middle:.0%}: the board moved, or the map is bent"
    return Scale(middle, 1.2533 * scatter / len(scales) ** 0.5, tuple(names))


def middle_of(found: Found, camera: Camera, board: Board) -> Floats | None:
    """The board's middle in the camera's frame, mm; None where the corners fit no board."""
    import cv2

    if found.seen.sum() < 6:
        return None
    K = np.array(camera.K, np.float64)
    K[:2, 2] -= 0.5  # OpenCV's pixel centres are at 0
    distortion = np.asarray(camera.distortion, np.float64)
    here, px = board.points()[found.seen], found.px[found.seen] - 0.5
    ok, _, t = cv2.solvePnP(here, px, K, distortion, flags=cv2.SOLVEPNP_IPPE)
    return np.asarray(t, np.float64).ravel() if ok else None
