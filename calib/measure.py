"""The whole of `spikerig calib board`: files to corners to a rig to a verdict, and the report of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.boards import SMALLEST, Board, Found, find, seen_size
from spikerig.calib.bundle import Sight
from spikerig.calib.crop import crop_homography, working_depth_mm
from spikerig.calib.lens import LENSES
from spikerig.calib.optics import MirrorHint, RigFit, fit_arms, sight_of
from spikerig.calib.parity import inverse
from spikerig.calib.shots import Pair, Reading, content_hash, read_light
from spikerig.calib.verdict import Seen, Verdict, coverage, judge_fit, judge_views, pair_rms_px, tilt_deg
from spikerig.dataset.errors import DataError, NumericsError, RigError

PROBES = 4  # pictures of an arm in which any checkerboard is sought: two, and others in which the one given is not seen
ModelHint = Literal["auto", "common", "stereo"]


@dataclass(frozen=True, slots=True)
class Measured:
    """What came of it: the verdict, the fit (None where none was possible), what each view showed.

    `mirror` says how it is known whether the arms' parities differ, and which arm is the mirrored one: "measured" (both
    were tried), "markers", "given", or "convention" (nothing in the pictures could tell).
    """

    board: Board
    seen: Seen
    used: NDArray[np.bool_]
    verdict: Verdict
    fit: RigFit | None
    mirrored_board: tuple[bool | None, bool | None]
    mirror: dict[str, str]


def look(
    pairs: Sequence[Pair], board: Board, spike: Reading, rgb: Reading, done: Callable[[], object] = lambda: None
) -> tuple[Seen, tuple[bool | None, bool | None]]:
    """Find the board in every file.

    Returns:
        What was seen, and for each arm whether a ChArUco board was seen in a mirror (None: it cannot tell).

    Raises:
        DataError: files that cannot be read (all at once), or pictures of one arm that differ in size.
    """
    found: tuple[list[Found | None], list[Found | None]] = ([], [])
    hashes: list[tuple[str, str]] = []
    shapes: tuple[set[tuple[int, int]], set[tuple[int, int]]] = (set(), set())
    sizes: list[tuple[int, int]] = []
    probes, broken = [0, 0], list[str]()
    for pair in pairs:
        names = []
        for arm, (path, reading) in enumerate(((pair.spike, spike), (pair.rgb, rgb))):
            try:
                light = read_light(path, reading)
            except RigError as error:
                broken.append(f"{path}: {error.what}" + ("" if error.value is None else f" ({error.value})"))
                continue
            if min(light.shape) < SMALLEST:
                height, width = light.shape
                broken.append(f"{path}: {width}x{height} pixels are too few to show a board")
                continue
            hopeless = len(sizes) >= PROBES and not any(f is not None for arm_found in found for f in arm_found)
            here = None if hopeless else find(light, board)  # another board: every further search would be in vain
            if not board.charuco and probes[arm] < PROBES and (here is None or len(found[arm]) < PROBES // 2):
                probes[arm] += 1
                size = seen_size(light)
                sizes += [size] if size else []
            found[arm].append(here)
            shapes[arm].add(light.shape)
            names.append(content_hash(light))
        hashes.append((names[0], names[1]) if len(names) == 2 else ("", ""))
        done()
    if broken:
        raise DataError("files of the calibration cannot be read", value="; ".join(broken[:10]),
                        next="shoot these views again, or leave them out")  # fmt: skip
    for name, some in zip(("spike", "RGB"), shapes, strict=True):
        if len(some) > 1:
            raise DataError(
                f"the {name} pictures differ in size", value=sorted(some), cause="two cameras or modes mixed"
            )
    sights = [sight_of(f, board, w, h) for f, ((h, w),) in zip(found, shapes, strict=True)]
    seen = Seen([p.name for p in pairs], sights[0], sights[1], hashes, sizes)
    return seen, (_mirrored(found[0]), _mirrored(found[1]))


def _mirrored(found: Sequence[Found | None]) -> bool | None:
    said = [f.mirrored for f in found if f is not None and f.mirrored is not None]
    return 2 * sum(said) > len(said) if said else None


def measure(
    board: Board,
    seen: Seen,
    mirrored_board: tuple[bool | None, bool | None] = (None, None),
    *,
    mirror: MirrorHint = "auto",
    model: ModelHint = "auto",
    lenses: Sequence[int] = LENSES,
) -> Measured:
    """Fit and judge what was seen; `mirrored_board` as `look` returns it, the rest as in `fit_arms`."""
    verdict = Verdict()
    used = judge_views(board, seen, verdict)
    known = {"parity": "measured", "arm": "convention"} if mirror == "auto" else {"parity": "given", "arm": "given"}
    if mirror == "auto" and None not in mirrored_board:
        known = {"parity": "markers", "arm": "markers"}
        if all(mirrored_board):
            verdict.warnings.append(
                "both arms see the board in a mirror: taken as neither, so that the world is mirrored instead"
            )
            seen = replace(seen, spike=_in_a_mirror(board, seen.spike), rgb=_in_a_mirror(board, seen.rgb))
        mirror = _hint(mirrored_board)
    fit = None
    try:
        fit = fit_arms(board, _of(seen.spike, used), _of(seen.rgb, used), mirror=mirror, model=model, lenses=lenses)
        if fit.calibration.mirrored and known["arm"] == "convention":
            verdict.warnings.append(
                "one arm is mirrored, which of them a checkerboard cannot tell: the RGB arm is taken by convention, so "
                "that spikes need no flip. --mirror spike says otherwise; a ChArUco board knows"
            )
        judge_fit(fit, [n for n, u in zip(seen.names, used, strict=True) if u], verdict)
    except (NumericsError, np.linalg.LinAlgError) as error:
        if verdict.accepted:
            verdict.refuse("no-fit", f"no calibration fits these views: {error}")
    return Measured(board, seen, used, verdict, fit, mirrored_board, known)


def _hint(mirrored: tuple[bool | None, bool | None]) -> MirrorHint:
    if mirrored[0] == mirrored[1]:
        return "none"
    return "spike" if mirrored[0] else "rgb"


def _in_a_mirror(board: Board, sight: Sight) -> Sight:
    """The board's mirror picture for the board: pixels stay, labels are swapped left to right."""
    px = np.stack([board.relabelled(p, 0, mirrored=True) for p in sight.px])
    return replace(sight, px=px, seen=np.stack([board.relabelled(s, 0, mirrored=True) for s in sight.seen]))


def _of(sight: Sight, views: NDArray[np.bool_]) -> Sight:
    return replace(sight, px=sight.px[views], seen=sight.seen[views])


def report(measured: Measured, forced: bool = False) -> dict[str, Any]:
    """The report as JSON-ready values; numbers that no fit gave are None."""
    fit, verdict, seen = measured.fit, measured.verdict, measured.seen
    pairs = seen.spike.views & seen.rgb.views
    told: dict[str, Any] = {
        "accepted": verdict.accepted,
        "forced": forced and not verdict.accepted,
        "reasons": [text for _, text in verdict.reasons],
        "reason_codes": [code for code, _ in verdict.reasons],
        "warnings": verdict.warnings,
        "board": {"pattern": f"{measured.board.cols}x{measured.board.rows}", "square_mm": measured.board.square_mm,
                  "charuco": measured.board.charuco or None},
        "views_given": len(seen.names),
        "views_used": 0 if fit is None else int(fit.match.agree.sum()),
        "pairs_seen": int(pairs.sum()),
        "rms_px": {"spike": None, "rgb": None, "stereo": None},
        "fx_px": None, "baseline_mm": None, "model": None, "mirrored": None, "mirror": None,
        "coverage": {"spike": coverage(seen.spike), "rgb": coverage(seen.rgb)},
        "views": [],
    }  # fmt: skip
    if fit is not None:
        told |= _fit_json(fit) | {"mirror": measured.mirror}
        told["views"] = _views_json(measured, fit)
    return told


def _fit_json(fit: RigFit) -> dict[str, Any]:
    c, diagonal = fit.calibration, float(np.hypot(fit.rgb.sight.width, fit.rgb.sight.height))
    turned = float(np.degrees(np.arccos(np.clip((np.trace(c.spike_from_rgb.cam_from_world[:, :3]) - 1) / 2, -1, 1))))
    parities = [m for m in (fit.match, fit.other) if m is not None]
    depth = working_depth_mm(c)
    return {
        "rms_px": {"spike": fit.spike.fit.rms_px(), "rgb": fit.rgb.fit.rms_px(), "stereo": pair_rms_px(fit)},
        "fx_px": c.spike.K[0, 0],
        "focal_px": {"spike": [c.spike.K[0, 0], c.spike.K[1, 1]], "rgb": [c.rgb.K[0, 0], c.rgb.K[1, 1]]},
        "baseline_mm": c.baseline_mm,
        "turn_deg": turned,
        "rgb_from_spike": inverse(c.spike_from_rgb.cam_from_world),
        "model": c.model,
        "mirrored": c.mirrored,
        "parity_px": {"mirrored" if m.mirrored else "plain": m.score * diagonal for m in parities},
        "common_centre": {"chance": fit.chance, "parallax_px": fit.parallax_px, "parallax_bound_px": fit.bound_px},
        "depth_mm": list(c.depth_mm),
        "crop": {"spike_px_from_rgb_px": crop_homography(c), "depth_mm": depth if np.isfinite(depth) else None,
                 "sd_px": fit.sure.crop_sd_px, "sd_worst_px": fit.sure.worst_crop_px},
        "sd": dict(fit.sure.sd),
        "sd_leaving_views_out": dict(fit.sure.jackknife),
        "lens": {"spike": len(fit.spike.fit.lenses[0][1]), "rgb": len(fit.rgb.fit.lenses[0][1]), "held": fit.held,
                 "foretold_px": {"spike": fit.spike.foretold_px, "rgb": fit.rgb.foretold_px}},
    }  # fmt: skip


def _views_json(measured: Measured, fit: RigFit) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    rms = [m.fit.view_rms_px(0) for m in (fit.spike, fit.rgb)]
    joint = [fit.fit.view_rms_px(k) for k in (0, 1)]
    tilts, at = tilt_deg(fit.fit.poses), -1
    for v, name in enumerate(measured.seen.names):
        row: dict[str, Any] = {"name": name, "spike": bool(measured.seen.spike.seen[v].any()),
                               "rgb": bool(measured.seen.rgb.seen[v].any()), "used": False}  # fmt: skip
        if measured.used[v]:
            at += 1
            row |= {
                "used": bool(fit.match.agree[at]),
                "rms_px": {"spike": rms[0][at], "rgb": rms[1][at]},
                "joint_rms_px": {"spike": joint[0][at], "rgb": joint[1][at]},
                "pair_px": fit.match.off_px[at],
                "tilt_deg": tilts[at],
                "depth_mm": fit.fit.poses[at, 2, 3],
                "without_it": {"crop_moves_px": fit.sure.crop_left_out_px[at],
                               "fx_px": fit.sure.left_out[at, fit.sure.names.index("spike.fx_px")]},
            }  # fmt: skip
        rows.append(row)
    return rows
