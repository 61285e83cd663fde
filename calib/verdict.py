"""Whether a calibration may be kept: every fault at once, each with what to do about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.boards import Board
from spikerig.calib.bundle import Sight
from spikerig.calib.mono import ENOUGH
from spikerig.calib.optics import RigFit

Floats = NDArray[np.float64]
MIN_VIEWS = 4
GOOD_VIEWS = 10
FOCAL_SD = 0.02  # of the focal length: more than this and the boards have not fixed it
MONO = 1e-3  # of the diagonal: corners this far from any lens are not corners of this board
POOR = MONO / 2  # ... and from here on it is said (0.24 px of 400x250)
APART = 1e-3  # of the diagonal: arms that together fit no better than this are not one rig...
FAR_ABOVE = 3.0  # ... where each alone fits so many times better
REPEAT = 0.6e-3  # of the diagonal: a board that moved less between two views is the same view twice
CROP_PX = 0.25
LOOSE = 1e-2  # of the diagonal: a crop that is known no better than this somewhere in the picture is none


@dataclass(slots=True)
class Verdict:
    """Why a calibration is refused (code and words for each fault), and what else to know of it."""

    reasons: list[tuple[str, str]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def refuse(self, code: str, text: str) -> None:
        """Note a fault."""
        self.reasons.append((code, text))

    @property
    def accepted(self) -> bool:
        """Whether nothing speaks against it."""
        return not self.reasons


@dataclass(frozen=True, slots=True)
class Seen:
    """What is known of the views before anything is fitted.

    Args:
        names: of the views.
        spike, rgb: corners found.
        hashes: per view (spike, rgb) content of the pictures.
        sizes: sizes (cols, rows) of whatever boards were seen in some of the pictures.
    """

    names: Sequence[str]
    spike: Sight
    rgb: Sight
    hashes: Sequence[tuple[str, str]]
    sizes: Sequence[tuple[int, int]]


def repeats(seen: Seen) -> NDArray[np.int64]:
    """int64[V]: the earlier view in which both arms saw the board at the same place, -1 where there is none."""
    earlier = np.full(len(seen.names), -1)
    for v in range(len(seen.names)):
        for u in range(v):
            same = [_same_place(s, u, v) for s in (seen.spike, seen.rgb)]
            if earlier[u] < 0 and any(same) and None not in same and all(same):
                earlier[v] = u
                break
    return earlier


def _same_place(sight: Sight, u: int, v: int) -> bool | None:
    both = sight.seen[u] & sight.seen[v]
    if not both.any():
        return None
    a, b = sight.px[u][both], sight.px[v][both]
    off = min(float(np.sqrt(((a - q) ** 2).sum(1).mean())) for q in (b, b[::-1]))  # labels may be turned
    return off < REPEAT * float(np.hypot(sight.width, sight.height))


def judge_views(board: Board, seen: Seen, verdict: Verdict) -> NDArray[np.bool_]:
    """Faults of the views themselves; returns which views to fit, bool[V]."""
    copies = [(arm, found) for arm, found in (("spike", _copies(seen, 0)), ("RGB", _copies(seen, 1))) if found]
    if copies:
        which = "; ".join(f"the same {arm} picture serves as {_list(found)}" for arm, found in copies)
        verdict.refuse(
            "duplicates",
            f"duplicates: {which}. A picture counted twice makes a result look surer than it is, and one paired twice "
            "is wrong: remove the copies",
        )
    same = repeats(seen)
    still = [name for name, s in zip(seen.names, same, strict=True) if s >= 0]
    if still:
        verdict.warnings.append(f"the board had not moved in {_list(still)}: these views are left out")
    saw = seen.spike.views, seen.rgb.views
    for arm, found in (("spike", saw[0]), ("RGB", saw[1])):
        missing = [name for name, s in zip(seen.names, found, strict=True) if not s]
        if missing:
            verdict.warnings.append(
                f"no whole board in {len(missing)} of {len(seen.names)} {arm} pictures: {_list(missing)}"
            )
    pairs = int((saw[0] & saw[1] & (same < 0)).sum())
    other = {(max(s), min(s)) for s in seen.sizes if set(s) != {board.cols, board.rows}}
    none_right = len(seen.sizes) > 1 and all(set(s) != {board.cols, board.rows} for s in seen.sizes)
    if other and (none_right or 2 * pairs < len(seen.names)):  # a part of a larger board may well be found
        sizes = " or ".join(f"{c}x{r}" for c, r in sorted(other))
        verdict.refuse(
            "wrong-pattern",
            f"wrong pattern: the pictures show a board of {sizes} inner corners, not {board.cols}x{board.rows}. Count "
            f"INNER corners (squares less one) and give --pattern {sizes}",
        )
    if pairs < MIN_VIEWS:
        verdict.refuse(
            "too-few-views",
            f"too few views: {pairs} different pairs show the whole board to both arms, at least {MIN_VIEWS} are "
            f"needed and {GOOD_VIEWS} or more are good. Shoot more, the board wholly in view of both arms, sharp, lit "
            "evenly, tilted each time another way",
        )
    elif pairs < GOOD_VIEWS:
        verdict.warnings.append(f"only {pairs} views; {GOOD_VIEWS} or more are good")
    return same < 0


def _copies(seen: Seen, arm: int) -> list[str]:
    """Names of views that share a picture of one arm, e.g. "a = b"."""
    groups: dict[str, list[str]] = {}
    for name, hashes in zip(seen.names, seen.hashes, strict=True):
        groups.setdefault(hashes[arm], []).append(name)
    return [" = ".join(names) for names in groups.values() if len(names) > 1]


def judge_fit(fit: RigFit, names: Sequence[str], verdict: Verdict) -> None:
    """Faults of a fitted rig; `names` are those of the views that were fitted."""
    several = int(fit.match.pairs.sum())
    if several < 2:
        return
    if several >= MIN_VIEWS and not _judge_lenses(fit, names, verdict):
        verdict.warnings.append("whether the two arms agree cannot be told before both lenses are known")
        return
    if not _judge_pairs(fit, names, verdict):
        return  # what else is known of the step between the arms means nothing
    worst = fit.sure.worst_crop_px
    if worst > LOOSE * _diagonal(fit.spike.sight):
        verdict.refuse(
            "loose-crop",
            f"the crop is only known to {worst:.1f} px at the rim of the spike picture, at most "
            f"{LOOSE * _diagonal(fit.spike.sight):.1f} are kept: views do not agree with each other. Is the board flat "
            "and rigid, was it shown at the rim, too? Shoot more views",
        )
    elif worst > CROP_PX:
        verdict.warnings.append(
            f"the crop is only known to {worst:.2f} px at the rim of the spike picture: show the board there too"
        )
    left = fit.sure.crop_left_out_px
    if np.isfinite(left).any() and np.nanmax(left) > 2 * CROP_PX:
        v = int(np.nanargmax(left))
        verdict.warnings.append(
            f"leaving out {names[v]} alone moves the crop by {left[v]:.2f} px: too much hangs on it"
        )
    c = fit.calibration
    if c.model == "stereo":
        verdict.warnings.append(
            f"the arms do not share a centre: baseline {c.baseline_mm:.2f} mm (chance {fit.chance:.1g} of seeing that "
            f"were there none). One crop fits one depth; over {c.depth_mm[0]:.0f} to {c.depth_mm[1]:.0f} mm it is off "
            f"by up to {fit.parallax_px:.2f} spike px"
        )
    elif fit.bound_px > CROP_PX:
        verdict.warnings.append(
            "one centre is assumed, but the boards cannot tell it from a baseline that would put the crop off by "
            f"{fit.bound_px:.2f} px: show the board nearer and farther"
        )


def _judge_lenses(fit: RigFit, names: Sequence[str], verdict: Verdict) -> bool:
    """Whether both lenses are known."""
    known = True
    for arm, label, mono in (("spike", "spike", fit.spike), ("rgb", "RGB", fit.rgb)):
        rms = mono.fit.rms_px()
        if mono.odd.any():
            misread = [name for name, odd in zip(names, mono.odd, strict=True) if odd]
            verdict.warnings.append(f"{label} corners of {_list(misread)} fit no lens that fits the others: left out")
        if rms > MONO * _diagonal(mono.sight):
            verdict.refuse(
                "bad-corners",
                f"the {label} arm alone fits its corners only to {rms:.2f} px. Is the board flat and rigid, were "
                "pictures sharp, is --pattern right?",
            )
        elif rms > POOR * _diagonal(mono.sight):
            verdict.warnings.append(
                f"the {label} arm alone fits its corners to {rms:.2f} px, where good boards fit to a tenth: is the "
                "board flat and rigid, were pictures sharp?"
            )
        f, unsure = float(mono.fit.lenses[0][0][0, 0]), focal_sd(fit, arm)
        if not unsure <= FOCAL_SD:
            known = False
            tilts = np.linalg.norm(tilt_deg(mono.fit.poses[mono.views]), axis=1)
            verdict.refuse(
                "flat-boards",
                f"boards that barely tilt: the {label} focal length is {f:.0f} +- {unsure * f:.3g} px "
                f"({100 * unsure:.3g} %, at most {100 * FOCAL_SD:.0f} % is kept), however small the residual "
                f"({rms:.2f} px). As fitted, tilts were {tilts.min():.0f} to {tilts.max():.0f} deg, half of them "
                "should exceed 20: tilt the board left, right, up and down",
            )
    return known


def focal_sd(fit: RigFit, arm: str) -> float:
    """Relative standard deviation of an arm's focal length: the better of alone and joint, or by leaving views out."""
    mono = fit.spike if arm == "spike" else fit.rgb
    alone = max(mono.fit.sd("fx0"), mono.fit.sd("fy0"))
    joint = max(fit.sure.sd[f"{arm}.fx_px"], fit.sure.sd[f"{arm}.fy_px"])
    several = np.isfinite(fit.sure.left_out).all(axis=1).sum() >= ENOUGH
    scatter = max(fit.sure.jackknife[f"{arm}.fx_px"], fit.sure.jackknife[f"{arm}.fy_px"]) if several else 0.0
    return float(max(min(alone, joint) if joint > 0 else alone, scatter) / mono.fit.lenses[0][0][0, 0])


def _judge_pairs(fit: RigFit, names: Sequence[str], verdict: Verdict) -> bool:
    """Whether the arms have one step between them."""
    match, diagonal = fit.match, _diagonal(fit.rgb.sight)
    pairs, agree = int(match.pairs.sum()), int(match.agree.sum())
    mono = float(np.hypot(fit.spike.fit.rms_px(), fit.rgb.fit.rms_px()) / np.sqrt(2))
    stereo = pair_rms_px(fit)
    apart = 2 * agree <= pairs or fit.fit.rms_px() > max(FAR_ABOVE * mono, APART * diagonal)
    if apart:
        tried = "as they are and mirrored" if fit.other is not None else "only as markers or --mirror say"
        verdict.refuse(
            "not-one-rig",
            f"stereo residual far above mono: the arms were tried {tried}, and together fit only to {stereo:.2f} px "
            f"where each alone fits to {mono:.2f}. The pairs were not shot at the same instant, are paired wrongly, or "
            "the arms moved against each other: hold the board still for each view, check which files belong together, "
            "and clamp the rig",
        )
    elif agree < pairs:
        odd = [f"{name} ({off:.1f} px)" for name, off, fits in zip(names, match.off_px, match.agree, strict=True)
               if np.isfinite(off) and not fits]  # fmt: skip
        verdict.refuse(
            "odd-pairs",
            f"not synchronous: {len(odd)} of {pairs} pairs do not fit the others: {_list(odd)}. The board moved "
            "between the two pictures, or they are paired wrongly: remove these pairs, or shoot them again, the board "
            "held still",
        )
    elif stereo > 2 * mono and stereo > 0.2 * APART * diagonal:
        lenses = "held as each arm alone found them" if fit.held else "refitted together"
        verdict.warnings.append(
            f"the arms together fit to {stereo:.2f} px, each alone to {mono:.2f}: was the board held still? "
            f"Lenses were {lenses}"
        )
    return not apart


def pair_rms_px(fit: RigFit) -> float:
    """Residual over all pairs, those that do not agree included: as fitted, or as far off as the others' step says."""
    match = fit.match
    if match.agree[match.pairs].all():
        return fit.fit.rms_px()
    return float(np.sqrt(np.mean(match.off_px[match.pairs] ** 2)))


def tilt_deg(poses: Floats) -> Floats:
    """How a board's normal leans from the camera's axis, right and down, in degrees: float64[V,2]."""
    normal = poses[:, :, 2]
    normal = normal * np.where(normal[:, 2:] < 0, -1, 1)
    return np.degrees(np.arctan2(normal[:, :2], normal[:, 2:]))


def coverage(sight: Sight, across: int = 5, down: int = 4) -> NDArray[np.int64]:
    """Corners in each part of the picture, int64[down,across]."""
    px = sight.px[sight.seen]
    x = np.clip((px[:, 0] / sight.width * across).astype(int), 0, across - 1)
    y = np.clip((px[:, 1] / sight.height * down).astype(int), 0, down - 1)
    return np.bincount(y * across + x, minlength=across * down).reshape(down, across)


def _diagonal(sight: Sight) -> float:
    return float(np.hypot(sight.width, sight.height))


def _list(names: Sequence[str], most: int = 8) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
