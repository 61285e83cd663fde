"""How two arms belong together before anyone judges them: the splitter's mirror, the labels of the board, odd pairs.

A mirrored arm looks exactly like bad synchronisation: each camera alone fits to 0.1 px, both together only to many
pixels. So both parities are tried, and in each view every way to label the board that its symmetry allows, and the
step between the arms on which most views agree is taken. Only then is the residual looked at.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.boards import Board
from spikerig.calib.bundle import Fit, Guess, Sight, solve
from spikerig.calib.lens import bent_only
from spikerig.calib.mono import Mono

Floats = NDArray[np.float64]
FINE = 3e-4  # of the RGB picture's diagonal: a pair no further off belongs (0.7 px of 1920x1080)
CAP = 5e-3  # of the diagonal: a pair further off does not, and counts as this far
ODD = 6.0  # in between it belongs if it is no more than this many times as far off as most


@dataclass(frozen=True, slots=True)
class Match:
    """Two arms brought together with their lenses held.

    Args:
        first, second: the arms, the second mirrored where that fits, its corners labelled like the first's.
        mirrored: whether one arm is a mirror picture of the other.
        pairs: bool[V], views that both arms saw.
        agree: bool[V], pairs that agree on the step.
        off_px: float64[V], residual of each pair (both arms), NaN where there is none.
        score: robust mean residual over all pairs, in diagonals; what parities are compared by.
        fit: of the agreeing pairs.
    """

    first: Mono
    second: Mono
    mirrored: bool
    pairs: NDArray[np.bool_]
    agree: NDArray[np.bool_]
    off_px: Floats
    score: float
    fit: Fit


def match_arms(board: Board, first: Mono, second: Mono, mirrored: bool | None = None) -> tuple[Match, ...]:
    """Both parities of two arms, the better one first.

    Args:
        board: its symmetry says which labels are possible.
        first, second: fitted alone, over the same views.
        mirrored: None tries both; ChArUco boards know, and give one.

    Returns:
        One Match for each parity tried. Both may be bad: that is for the caller to judge.

    Cost:
        About 1 ms for each view squared.
    """
    tried = []
    for flip in (False, True) if mirrored is None else (mirrored,):
        arm = second.mirrored() if flip else second
        if flip and not board.charuco:
            arm = _relabelled(board, arm, np.zeros(len(arm.views), int), mirrored=True)
        tried.append(_match(board, first, arm, flip))
    return tuple(sorted(tried, key=lambda m: m.score))


def _match(board: Board, first: Mono, second: Mono, flip: bool) -> Match:
    pairs = first.views & second.views
    points, diagonal = board.points(), float(np.hypot(second.sight.width, second.sight.height))
    step, labels = _consensus(board, first, second, pairs, CAP * diagonal)
    second = _relabelled(board, second, labels)
    sights = (first.sight, second.sight)
    lenses = (first.fit.lenses[0], second.fit.lenses[0])
    off = _transfer(second, times(step, first.fit.poses), points)
    agree = pairs & (off <= max(CAP * diagonal, 3 * float(np.min(off[pairs], initial=np.inf))))
    poses, fit = first.fit.poses, first.fit
    for _ in range(3):
        # a board's pose is started from the arm that explains the pair better
        other = times(inverse(step), second.fit.poses)
        better = _pair_cost(points, sights, lenses, other, step) < _pair_cost(points, sights, lenses, poses, step)
        guess = Guess(lenses, np.where(better[:, None, None], other, poses), step)
        fit = solve(points, sights, guess, use=agree, free_lens=False, most=30)
        step = fit.step
        held = {"free_lens": False, "free_turn": False, "free_shift": False}
        poses = solve(points, sights, Guess(lenses, fit.poses, step), use=pairs, most=20, **held).poses
        off = np.where(pairs, np.sqrt(_pair_cost(points, sights, lenses, poses, step)), np.nan)
        near = pairs & (off <= np.clip(ODD * np.median(off[agree]), FINE * diagonal, CAP * diagonal))
        if (near == agree).all() or not near.any():
            break
        agree = near
    capped = np.minimum(np.where(pairs, off, 0) / diagonal, CAP)
    score = float(np.sqrt((capped[pairs] ** 2).mean())) if pairs.any() else CAP
    return Match(first, second, flip, pairs, agree, off, score, fit)


def _consensus(
    board: Board, first: Mono, second: Mono, pairs: NDArray[np.bool_], cap_px: float
) -> tuple[Floats, NDArray[np.int64]]:
    """The step between the arms, of one pair and one labelling of it, that most other pairs agree with; the labels."""
    points = board.points()
    poses = [second.fit.poses @ _homogeneous(_label_turn(board, k)) for k in board.turns]
    best, chosen, labels = np.inf, second.fit.poses[0], np.zeros(len(pairs), int)
    for v in np.flatnonzero(pairs):
        for k in range(len(board.turns)):
            step = times(poses[k][v], inverse(first.fit.poses[v]))
            seen = times(step, first.fit.poses)
            off = np.stack([
                _transfer(_relabelled(board, second, np.full(len(pairs), t)), seen, points) for t in board.turns
            ])  # fmt: skip
            score = float(np.minimum(off.min(0)[pairs], cap_px).sum())
            if score < best:
                best, chosen, labels = score, step, np.array(board.turns)[off.argmin(0)]
    return chosen, labels


def _relabelled(board: Board, arm: Mono, turns: NDArray[np.int64], mirrored: bool = False) -> Mono:
    """An arm whose corners are labelled anew, view by view; poses of turned boards turn with them."""
    px = np.stack([board.relabelled(p, int(t), mirrored) for p, t in zip(arm.sight.px, turns, strict=True)])
    seen = np.stack([board.relabelled(s, int(t), mirrored) for s, t in zip(arm.sight.seen, turns, strict=True)])
    poses = np.stack([
        p @ _homogeneous(_label_turn(board, int(t))) for p, t in zip(arm.fit.poses, turns, strict=True)
    ])  # fmt: skip
    return replace(arm, sight=replace(arm.sight, px=px, seen=seen), fit=replace(arm.fit, poses=poses))


def _label_turn(board: Board, turns: int) -> Floats:
    """The rotation R [3,3] of the board with points[relabelled] = R points."""
    points = board.points()
    to = points[board.relabelled(np.arange(len(points)), turns)]
    c, s = float((points * to).sum()), float((points[:, 0] * to[:, 1] - points[:, 1] * to[:, 0]).sum())
    c, s = c / np.hypot(c, s), s / np.hypot(c, s)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _homogeneous(R: Floats) -> Floats:
    out = np.eye(4)
    out[:3, :3] = R
    return out


def times(a: Floats, b: Floats) -> Floats:
    """Rigid maps float64[...,3,4]: b, then a."""
    R = a[..., :3] @ b[..., :3]
    return np.concatenate([R, (a[..., :3] @ b[..., 3:]) + a[..., 3:]], -1)


def inverse(a: Floats) -> Floats:
    """Rigid maps float64[...,3,4] the other way."""
    R = np.swapaxes(a[..., :3], -1, -2)
    return np.concatenate([R, -R @ a[..., 3:]], -1)


def _predicted(lens: tuple[Floats, Floats], poses: Floats, points: Floats) -> Floats:
    p = points @ np.swapaxes(poses[:, :, :3], 1, 2) + poses[:, None, :, 3]
    z = p[..., 2:]
    with np.errstate(all="ignore"):
        px = bent_only(p[..., :2] / z, lens[1]) * np.diag(lens[0])[:2] + lens[0][:2, 2]
    return np.where((z > 0) & np.isfinite(px), px, 1e6)


def _transfer(arm: Mono, poses: Floats, points: Floats) -> Floats:
    """RMS distance in px, float64[V], of an arm's corners from where boards at given poses would show them."""
    seen = arm.sight.seen
    off = np.where(seen[..., None], arm.sight.px - _predicted(arm.fit.lenses[0], poses, points), 0)
    return np.sqrt((off**2).sum((1, 2)) / np.maximum(seen.sum(1), 1))


def _pair_cost(
    points: Floats, sights: tuple[Sight, Sight], lenses: tuple[tuple[Floats, Floats], ...], poses: Floats, step: Floats
) -> Floats:
    """Mean square distance over both arms' corners, float64[V]."""
    total, n = np.zeros(len(poses)), np.zeros(len(poses))
    for sight, lens, at in zip(sights, lenses, (poses, times(step, poses)), strict=True):
        off = np.where(sight.seen[..., None], sight.px - _predicted(lens, at, points), 0)
        total, n = total + (off**2).sum((1, 2)), n + sight.seen.sum(1)
    return total / np.maximum(n, 1)
