"""From corners to a rig: both lenses, the mirror, the step between the arms, and how sure each of them is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.boards import Board, Found
from spikerig.calib.bundle import Fit, Guess, Sight, solve
from spikerig.calib.certainty import Certainty, certainty, parameters, rounded
from spikerig.calib.crop import parallax_px
from spikerig.calib.evidence import f_above, hotelling, jackknife_cov
from spikerig.calib.lens import LENSES, stored
from spikerig.calib.mono import Mono, fit_lens
from spikerig.calib.parity import Match, inverse, match_arms, times
from spikerig.calib.rig import Arm, Model, RigCalibration
from spikerig.dataset.errors import NumericsError
from spikerig.dataset.scene import Camera, Pose

Floats = NDArray[np.float64]
MirrorHint = Literal["auto", "none", "spike", "rgb"]
MANY = 4  # views; with more than this the scatter over views is the judge
CHANCE = 0.01  # a common centre is given up when the boards would show such parallax by chance less often than this
UNSEEN_PX = 0.1  # parallax below this, uncertainty included, is none
SPLITTER_PX = 1.0  # more parallax than this is none of a beam splitter's, however few the views that show it
STRAINED = 1.5  # lenses are held as each arm alone finds them where a joint fit would raise residuals by more


@dataclass(frozen=True, slots=True)
class RigFit:
    """All that a calibration is judged by.

    Args:
        calibration: the record.
        spike, rgb: each arm alone (the RGB arm no longer mirrored, labelled like the spike arm).
        match: the parity taken; `other` the one not taken, None where the board or the user knew.
        fit: the joint fit of `calibration`; views are those of the sights.
        held: whether the lenses were held as each arm alone found them.
        chance: of parallax as large as found, if the arms had one centre.
        parallax_px, bound_px: misalignment of one crop over the depths seen, as fitted and with two sd added.
        sure: the uncertainties.
    """

    calibration: RigCalibration
    spike: Mono
    rgb: Mono
    match: Match
    other: Match | None
    fit: Fit
    held: bool
    chance: float
    parallax_px: float
    bound_px: float
    sure: Certainty


def sight_of(found: Sequence[Found | None], board: Board, width: int, height: int) -> Sight:
    """What an arm saw over all views; None where the board was not found."""
    n = board.cols * board.rows
    px = np.full((len(found), n, 2), np.nan)
    seen = np.zeros((len(found), n), bool)
    for v, f in enumerate(found):
        if f is not None:
            px[v], seen[v] = f.px, f.seen
    return Sight(np.where(seen[..., None], px, 0.0), seen, width, height)


def fit_arms(
    board: Board,
    spike: Sight,
    rgb: Sight,
    *,
    mirror: MirrorHint = "auto",
    model: Literal["auto", "common", "stereo"] = "auto",
    lenses: Sequence[int] = LENSES,
) -> RigFit:
    """Fit a rig to what its arms saw of a board. Judging the result is `verdict.judge`'s.

    Args:
        board: which.
        spike, rgb: raw corners of both arms over the same views.
        mirror: the arm whose pictures are mirror pictures, "none", or "auto": both parities are tried. A checkerboard
            cannot tell which of two arms is the mirrored one: "auto" takes the RGB arm, so that spikes need no flip.
        model: one centre, two centres, or by evidence.
        lenses: numbers of lens coefficients to choose from.

    Raises:
        NumericsError: an arm saw no board, or no two arms saw it together.

    Cost:
        3 s for 20 views of 54 corners.
    """
    points = board.points()
    arms = {"spike": spike, "rgb": rgb}
    if mirror in arms:
        arms[mirror] = unflipped(board, arms[mirror])
    first, second = (fit_lens(points, arms[arm], lenses) for arm in ("spike", "rgb"))
    if not (first.views & second.views).any():
        raise NumericsError("no view shows the board to both arms", value=0)
    match, *others = match_arms(board, first, second, None if mirror == "auto" else False)
    mirrored: Arm | None = "rgb" if match.mirrored else None
    mirrored = mirror if mirror in ("spike", "rgb") else mirrored  # type: ignore[assignment]
    joint = _Joint.of(points, match)
    stereo, held = joint.solve_stereo()
    common = joint.solve_common(stereo, held)
    left_out = joint.leave_out(stereo, held)
    use = np.isfinite(left_out).all(1)
    chance = _chance(stereo, common, left_out[use], int(use.sum()))
    trial = _record(stereo, joint, "stereo", mirrored)
    parallax = parallax_px(trial)
    bound = parallax + _parallax_sd_px(trial, stereo, left_out[use])
    one_centre = (chance >= CHANCE and parallax < SPLITTER_PX) or bound < UNSEEN_PX
    chosen: Model = ("common" if one_centre else "stereo") if model == "auto" else model
    fit = common if chosen == "common" else stereo
    if chosen == "common":
        left_out = joint.leave_out(common, held)
    record = _record(fit, joint, chosen, mirrored)
    sure = certainty(record, fit, (match.first.fit, match.second.fit), held, left_out)
    sd = {**{k: v for k, v in sure.sd.items() if np.isfinite(v)}, "crop_px": min(sure.worst_crop_px, 1e6)}
    return RigFit(
        rounded(replace(record, sd=sd)), match.first, match.second, match, others[0] if others else None, fit, held,
        chance, parallax, bound, sure,
    )  # fmt: skip


def unflipped(board: Board, sight: Sight) -> Sight:
    """An arm's corners with the mirror undone: pixels swapped left to right, labels too where they were guessed."""
    flipped = sight.flipped()
    if board.charuco:
        return flipped
    px = np.stack([board.relabelled(p, 0, mirrored=True) for p in flipped.px])
    return replace(flipped, px=px, seen=np.stack([board.relabelled(s, 0, mirrored=True) for s in flipped.seen]))


@dataclass(frozen=True, slots=True)
class _Joint:
    """Both arms of the agreeing pairs, and of views that only one arm saw, ready for joint fits."""

    points: Floats
    match: Match
    sights: tuple[Sight, Sight]
    use: NDArray[np.bool_]

    @staticmethod
    def of(points: Floats, match: Match) -> _Joint:
        use = match.agree | (match.first.views ^ match.second.views)
        return _Joint(points, match, (match.first.sight, match.second.sight), use)

    def guess(self, step: Floats) -> Guess:
        first, second, pairs = self.match.first, self.match.second, self.match.pairs
        poses = np.where(first.views[:, None, None], first.fit.poses, times(inverse(step), second.fit.poses))
        poses = np.where(pairs[:, None, None], self.match.fit.poses, poses)
        return Guess((first.fit.lenses[0], second.fit.lenses[0]), poses, step)

    def solve_stereo(self) -> tuple[Fit, bool]:
        """The fit with two centres, and whether the lenses had to be held."""
        step = self.match.fit.step
        guess = self.guess(step)
        free = solve(self.points, self.sights, guess, use=self.use)
        if free.chi2 / free.dof <= STRAINED**2:
            return free, False
        return solve(self.points, self.sights, guess, use=self.use, free_lens=False), True

    def solve_common(self, stereo: Fit, held: bool) -> Fit:
        step = np.concatenate([stereo.step[:, :3], np.zeros((3, 1))], 1)
        guess = Guess(stereo.lenses, stereo.poses, step)
        return solve(self.points, self.sights, guess, use=self.use, free_lens=not held, free_shift=False)

    def leave_out(self, fit: Fit, held: bool) -> Floats:
        """`parameters` of the fit without each view, float64[V,P]; NaN for views not used."""
        names, _ = parameters(fit, fit)
        rows = np.full((len(self.use), len(names)), np.nan)
        for v in np.flatnonzero(self.use):
            use = self.use.copy()
            use[v] = False
            if not (use & self.match.agree).any():
                continue
            shift = bool(fit.step[:, 3].any())
            again = solve(self.points, self.sights, Guess(fit.lenses, fit.poses, fit.step), use=use, most=6, rest=1e-6,
                          free_lens=not held, free_shift=shift)  # fmt: skip
            rows[v] = parameters(again, fit)[1]
        return rows


def _chance(stereo: Fit, common: Fit, left_out: Floats, views: int) -> float:
    """The chance of the shift found if there were none: by the scatter over views, or of corners where views are few.

    Views are the independent samples (corners of one view share its errors): Hotelling's test on the jackknife.
    """
    if views > MANY:
        return hotelling(stereo.step[:, 3], jackknife_cov(left_out[:, -3:]), views)
    gain = max(common.chi2 - stereo.chi2, 0.0) / 3
    return f_above(gain / max(stereo.chi2 / stereo.dof, 1e-30), 3, stereo.dof)


def _parallax_sd_px(record: RigCalibration, stereo: Fit, left_out: Floats) -> float:
    """Two standard deviations of the shift across the axis, as misalignment over the depths seen, in spike px."""
    near, far = record.depth_mm
    at = [stereo.names.index(n) for n in ("shift_x", "shift_y")]
    variance = float(np.trace(stereo.cov[np.ix_(at, at)]))
    if len(left_out) >= 3:
        variance = max(variance, float(np.trace(jackknife_cov(left_out[:, -3:-1]))))
    return float(2 * np.sqrt(variance) * record.spike.K[0, 0] * (1 / near - 1 / far) / 2)


def _record(fit: Fit, joint: _Joint, model: Model, mirrored: Arm | None) -> RigCalibration:
    """The record of a joint fit, without its uncertainties."""
    cameras = [
        Camera(K, stored(c), s.width, s.height) for (K, c), s in zip(fit.lenses, joint.sights, strict=True)
    ]  # fmt: skip
    used = fit.used[0].any(1) | fit.used[1].any(1)
    z = (joint.points @ fit.poses[used][:, 2, :3].T) + fit.poses[used][:, 2, 3]
    depth = (max(float(z.min()), 1e-6), max(float(z.max()), 2e-6))
    return RigCalibration(
        cameras[0], cameras[1], Pose(inverse(fit.step)), model, mirrored, depth, residual_px=fit.rms_px()
    )
