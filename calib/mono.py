"""One camera alone: its lens from views of a board, with as many coefficients as the corners bear out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.bundle import LONGEST, SHORTEST, Fit, Guess, Sight, solve, turn
from spikerig.calib.lens import LENSES, directions, our_matrix
from spikerig.dataset.errors import NumericsError
from spikerig.dataset.scene import Camera

Floats = NDArray[np.float64]
FOLDS = 5
ENOUGH = 8  # views from which on lenses are compared
ODD = 5.0  # a view this many times as far off as most, ...
FINE = 3e-4  # ... and by more than this part of the diagonal (0.14 px of 400x250), was misread
USUAL = 5  # OpenCV's default number of coefficients
WORTH = 0.02  # a lens with fewer coefficients may foretell unseen views this much worse


@dataclass(frozen=True, slots=True)
class Mono:
    """A camera fitted alone.

    Args:
        fit: of the views where the board was seen; other views keep a made-up pose.
        sight: what was fitted, `sigma_px` now the residual of a coordinate.
        foretold_px: number of lens coefficients -> residual of views that the fit had not seen.
        odd: bool[V], views left out because their corners fit no lens that fits the others.
    """

    fit: Fit
    sight: Sight
    foretold_px: dict[int, float]
    odd: NDArray[np.bool_]

    @property
    def views(self) -> NDArray[np.bool_]:
        """bool[V]: where the board was seen."""
        return self.sight.views

    def mirrored(self) -> Mono:
        """The same camera behind a mirror that swaps left and right; the board's labels are swapped with it."""
        K, c = self.fit.lenses[0]
        K = K + np.array([[0, 0, self.sight.width - 2 * K[0, 2]], [0, 0, 0], [0, 0, 0]])
        c = np.where(np.arange(len(c)) == 3, -c, c)  # p2, the only term odd in x
        flip = np.diag([-1.0, 1, 1])
        poses = self.fit.poses.copy()
        poses[:, :, :3] = flip @ poses[:, :, :3] @ flip
        poses[:, :, 3] = poses[:, :, 3] @ flip
        return replace(self, fit=replace(self.fit, lenses=((K, c),), poses=poses), sight=self.sight.flipped())


def fit_lens(board: Floats, sight: Sight, lenses: Sequence[int] = LENSES) -> Mono:
    """Fit a camera to the views in which it saw the board.

    How many coefficients the lens gets is decided by what they foretell: the views are fitted without every fifth of
    them in turn, and the ones left out are then explained by their board pose alone. The fewest coefficients are taken
    that do that within `WORTH` of the best, of lenses that stay one to one within the picture. (Criteria that count
    corners as independent take eight coefficients from four views.)

    Args:
        board: float64[N,3], z = 0.
        sight: at least one view with four corners.
        lenses: numbers of coefficients to choose from.

    Raises:
        NumericsError: no view, or no start could be found.

    Edges:
        Too few or too flat views still give a fit; its covariance says how little it means. Fewer than `ENOUGH` views
        foretell nothing: OpenCV's usual five coefficients are taken, or as many of them as were asked for.

    Cost:
        About 1 s for 20 views of 54 corners, all lenses tried.
    """
    use = sight.seen.sum(1) >= 4
    if not use.any():
        raise NumericsError("no view shows the board", value=0)
    fits, odd = _without_odd(board, sight, use, lenses)
    use = use & ~odd
    sight = replace(sight, seen=sight.seen & use[:, None])
    covering = [n for n in fits if _covers(fits[n].camera(0, sight))] or [min(fits)]
    best = max((n for n in covering if n <= USUAL), default=min(covering))
    foretold: dict[int, float] = {}
    if use.sum() >= ENOUGH and len(covering) > 1:
        foretold = {n: _foretold(board, sight, fits[n], use) for n in covering}
        best = min(n for n in covering if foretold[n] <= (1 + WORTH) * min(foretold.values()))
    sigma = float(np.sqrt(fits[best].chi2 / fits[best].dof))
    return Mono(fits[best], replace(sight, sigma_px=max(sigma, 1e-4)), foretold, odd)


def _without_odd(
    board: Floats, sight: Sight, use: NDArray[np.bool_], lenses: Sequence[int]
) -> tuple[dict[int, Fit], NDArray[np.bool_]]:
    """The fits, and which views were left out of them because their corners fit no lens that fits the others."""
    odd = np.zeros_like(use)
    while True:
        fits = _fits(board, sight, use & ~odd, lenses)
        off = fits[max(fits)].view_rms_px(0)
        limit = max(ODD * float(np.nanmedian(off)), FINE * float(np.hypot(sight.width, sight.height)))
        wrong = use & ~odd & (np.nan_to_num(off) > limit)
        if not wrong.any():
            return fits, odd
        odd |= wrong


def _fits(board: Floats, sight: Sight, use: NDArray[np.bool_], lenses: Sequence[int]) -> dict[int, Fit]:
    """A fit for each number of coefficients, each started from the one before."""
    guess = _start(board, sight, use)
    fits: dict[int, Fit] = {}
    for n in sorted(lenses):
        K, c = guess.lenses[0]
        at = replace(guess, lenses=((K, np.concatenate([c, np.zeros(8)])[:n]),))
        fits[n] = solve(board, (sight,), at, use=use)
        guess = Guess(fits[n].lenses, fits[n].poses)
    return fits


def _foretold(board: Floats, sight: Sight, fit: Fit, use: NDArray[np.bool_]) -> float:
    """Residual in px of views left out of the fit, a fifth of them (at least one) at a time."""
    views = np.flatnonzero(use)
    total = 0.0
    for fold in range(min(FOLDS, len(views))):
        out = np.zeros(len(use), bool)
        out[views[fold :: min(FOLDS, len(views))]] = True
        lens = solve(board, (sight,), Guess(fit.lenses, fit.poses), use=use & ~out, most=8, rest=1e-6).lenses
        told = solve(board, (sight,), Guess(lens, fit.poses), use=out, free_lens=False, most=8, rest=1e-6)
        total += told.chi2 if np.isfinite(told.chi2) else 1e12
    return float(np.sqrt(total / sight.seen.sum()))


def _covers(camera: Camera) -> bool:
    """Whether the lens is one to one out to the middles of the picture's edges; the corners are often unsaid."""
    w, h = camera.width, camera.height
    return bool(np.isfinite(directions(camera, [[0, h / 2], [w, h / 2], [w / 2, 0], [w / 2, h]])).all())


def _start(board: Floats, sight: Sight, use: NDArray[np.bool_]) -> Guess:
    """OpenCV's fit without distortion: a start for ours."""
    import cv2

    views = np.flatnonzero(use)
    objects = [board[sight.seen[v]].astype(np.float32) for v in views]
    images = [(sight.px[v][sight.seen[v]] - 0.5).astype(np.float32)[:, None] for v in views]
    size = (sight.width, sight.height)
    straight = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    try:
        _, K, _, turns, shifts = cv2.calibrateCamera(objects, images, size, None, None, flags=straight)  # type: ignore[call-overload]
        if not _plausible(
            np.asarray(K), sight
        ):  # boards that barely tilt: take a usual lens, and poses that go with it
            usual = np.array([[1.2 * size[0], 0, size[0] / 2], [0, 1.2 * size[0], size[1] / 2], [0, 0, 1]])
            held = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_FOCAL_LENGTH | cv2.CALIB_FIX_PRINCIPAL_POINT
            _, K, _, turns, shifts = cv2.calibrateCamera(
                objects, images, size, usual, np.zeros(5), flags=straight | held
            )
    except cv2.error as error:
        raise NumericsError("no camera fits these corners", value=str(error).splitlines()[0]) from error
    poses = np.tile(np.concatenate([np.eye(3), [[0.0], [0.0], [1e3]]], 1), (len(use), 1, 1))
    for v, w, t in zip(views, turns, shifts, strict=True):
        poses[v] = np.concatenate([turn(np.asarray(w, np.float64).ravel()), np.asarray(t, np.float64).reshape(3, 1)], 1)
    return Guess(((our_matrix(np.asarray(K, np.float64)), np.zeros(0)),), poses)


def _plausible(K: NDArray[Any], sight: Sight) -> bool:
    f, middle = K[0, 0] / sight.width, K[:2, 2] / (sight.width, sight.height)
    return bool(np.isfinite(K).all() and 3 * SHORTEST < f < LONGEST / 10 and np.all((middle > 0) & (middle < 1)))
