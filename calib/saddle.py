"""Corners of a checkerboard to a hundredth of a pixel: a model of two blurred edges that cross, fitted to each.

    light(d) = b + g . d + a edge(n1 . d) edge(n2 . d),   d = pixel - corner, n1 and n2 the edges' normals

An edge is tanh(u / s) averaged over the width of a pixel: a step as sharp as the pixels allow for s = 0, more blurred
for more. (Sampled instead of averaged, sharp edges along the pixel grid would pull corners off by 0.2 px.) Whatever
the true profile, the picture of a corner looks the same turned by 180 degrees, and so does the model: a wrong profile
costs accuracy of `s`, not of the corner.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
ROUNDS = 15
SHARPEST = -3.0  # log of the least blur, px
REACH = 0.6  # of the way to the next edge
FARTHEST = 1.5  # px a corner may move from where the detector put it


def refine(
    light: NDArray[Any], px: Floats, seen: NDArray[np.bool_], cols: int, rows: int, reach: float = REACH
) -> Floats:
    """Corners refined.

    Args:
        light: [H,W] LINEAR light, any dtype; encoded pixels cost accuracy where the picture is sharp.
        px: float64[cols*rows,2] corners to a pixel or so (centres at +0.5), row by row.
        seen: bool[cols*rows], at least four of them.
        cols, rows: of the board.
        reach: how much of the way to the next edge shows the two edges and nothing else: less where markers are.

    Returns:
        float64[cols*rows,2]; a corner that is not seen, whose fit fails, or runs off, stays where it was.

    Edges:
        The window of a corner is a disc that reaches that part of the way to the next edges, at most 15 px; corners
        nearer than two pixels to the next edge or to the picture's rim stay where they are.

    Cost:
        50 ms for 54 corners.
    """
    along, down = _directions(px, seen, cols, rows)
    area = np.abs(along[:, 0] * down[:, 1] - along[:, 1] * down[:, 0])
    room = area / np.maximum(np.linalg.norm(along, axis=-1), np.linalg.norm(down, axis=-1))  # to the nearest edge
    radius = np.where(seen & np.isfinite(room), np.clip(reach * room, 0, 15), 0)
    half = int(np.ceil(radius.max())) + 1
    at = np.floor(np.where(seen[:, None], px, -1)).astype(int)
    inside = (at >= half).all(1) & (at < np.array(light.shape[1::-1]) - half).all(1) & (radius >= 2)
    if not inside.any():
        return px
    step = np.arange(-half, half + 1)
    x, y = at[inside, 0, None] + step, at[inside, 1, None] + step
    values = np.asarray(light, np.float64)[y[:, :, None], x[:, None, :]].reshape(len(x), -1)
    where = np.stack(np.broadcast_arrays(x[:, None, :] + 0.5, y[:, :, None] + 0.5), -1).reshape(len(x), -1, 2)
    angles = [np.arctan2(e[inside, 0], -e[inside, 1]) for e in (along, down)]  # of the normals
    out = px.copy()
    out[inside] = _fit(values, where, px[inside], radius[inside], angles)
    return out


def _directions(px: Floats, seen: NDArray[np.bool_], cols: int, rows: int) -> tuple[Floats, Floats]:
    """Steps to the next corner along rows and along columns, float64[N,2] each, by a homography of the corners seen."""
    import cv2

    at = np.stack(np.meshgrid(np.arange(cols), np.arange(rows)), -1).reshape(-1, 2).astype(np.float64)
    H, _ = cv2.findHomography(at[seen], px[seen])
    if H is None:
        return np.zeros_like(at), np.zeros_like(at)

    def shown(points: Floats) -> Floats:
        p = points @ H[:, :2].T + H[:, 2]
        return p[:, :2] / p[:, 2:]

    half = 0.5 * np.eye(2)
    return shown(at + half[0]) - shown(at - half[0]), shown(at + half[1]) - shown(at - half[1])


def _fit(light: Floats, where: Floats, start: Floats, radius: Floats, angles: list[Floats]) -> Floats:
    """Levenberg-Marquardt for all corners at once: light [N,M] at pixels where [N,M,2]; returns corners [N,2]."""
    n = len(start)
    low, high = np.percentile(light, 10, axis=1), np.percentile(light, 90, axis=1)
    p = np.zeros((n, 9))
    p[:, :2], p[:, 2], p[:, 3], p[:, 4] = start, angles[0], angles[1], np.log(0.5)
    p[:, 6] = (low + high) / 2
    weight = np.clip(radius[:, None] + 0.5 - np.linalg.norm(where - start[:, None], axis=2), 0, 1)
    value, slope = _model(p, where)
    p[:, 5] = np.where((weight * value * (light - p[:, 6:7])).sum(1) < 0, -1, 1) * (high - low) / 2
    damping = np.full(n, 1e-3)
    value, slope = _model(p, where)
    cost = (weight * (light - value) ** 2).sum(1)
    for _ in range(ROUNDS):
        J = slope * np.sqrt(weight)[..., None]
        r = (light - value) * np.sqrt(weight)
        A = J.transpose(0, 2, 1) @ J
        A += (damping[:, None] * np.einsum("nii->ni", A) + 1e-12 * (high - low + 1)[:, None] ** 2)[:, :, None] * np.eye(
            9
        )
        move = np.linalg.solve(A, (J.transpose(0, 2, 1) @ r[..., None]))[..., 0]
        move[:, :2] = np.clip(move[:, :2], -0.5, 0.5)
        move[:, 2:5] = np.clip(move[:, 2:5], -0.3, 0.3)
        move[:, 4] = np.maximum(move[:, 4], SHARPEST - p[:, 4])
        trial = p + move
        trial_value, trial_slope = _model(trial, where)
        trial_cost = (weight * (light - trial_value) ** 2).sum(1)
        better = trial_cost < cost
        p[better], cost[better] = trial[better], trial_cost[better]
        value[better], slope[better] = trial_value[better], trial_slope[better]
        damping = np.where(better, damping / 5, damping * 5)
    spread = (weight * light**2).sum(1) - (weight * light).sum(1) ** 2 / weight.sum(1)
    good = (np.linalg.norm(p[:, :2] - start, axis=1) < FARTHEST) & (cost < 0.5 * spread)
    return np.where(good[:, None], p[:, :2], start)


def _model(p: Floats, where: Floats) -> tuple[Floats, Floats]:
    """Light [N,M] and its derivatives [N,M,9]; with an amplitude of 0 the bare product of edges (a start)."""
    d = where - p[:, None, :2]
    blur = np.exp(p[:, 4])[:, None]
    edges, falls, leans, blurs = [], [], [], []
    for k in (2, 3):
        c, s = np.cos(p[:, k])[:, None], np.sin(p[:, k])[:, None]
        edge, fall, by_blur = _edge(c * d[..., 0] + s * d[..., 1], blur)
        edges.append(edge)
        falls.append((fall * c, fall * s))
        leans.append((-s * d[..., 0] + c * d[..., 1]) * fall)
        blurs.append(by_blur)
    a = p[:, 5:6]
    bare = edges[0] * edges[1]
    value = np.where(a == 0, bare, p[:, 6:7] + p[:, 7:8] * d[..., 0] + p[:, 8:9] * d[..., 1] + a * bare)
    by = [-a * (falls[0][i] * edges[1] + falls[1][i] * edges[0]) - p[:, 7 + i : 8 + i] for i in (0, 1)]
    by_blur = a * blur * (blurs[0] * edges[1] + blurs[1] * edges[0])
    turned = a * leans[0] * edges[1], a * leans[1] * edges[0]
    return value, np.stack([*by, *turned, by_blur, bare, np.ones_like(bare), d[..., 0], d[..., 1]], -1)


def _edge(u: Floats, blur: Floats) -> tuple[Floats, Floats, Floats]:
    """tanh(u / blur) averaged over u -+ half a pixel, with its derivatives by u and by the blur."""
    up, down = (u + 0.5) / blur, (u - 0.5) / blur
    rise, t_up, t_down = _log_cosh(up) - _log_cosh(down), np.tanh(up), np.tanh(down)
    return blur * rise, t_up - t_down, rise - up * t_up + down * t_down


def _log_cosh(x: Floats) -> Floats:
    far = np.abs(x)
    return far + np.log1p(np.exp(-2 * far)) - np.log(2)
