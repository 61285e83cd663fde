"""The figures of docs/calibration.md, of boards with known truth: `PYTHONPATH=tests python tests/calib/figures.py`."""

import time

import board_pictures as bp
import numpy as np
from calib_rigs import BOARD, crop_error_px, rig, seen_of, step_of

from spikerig.calib.align import pair, warp_of
from spikerig.calib.boards import Board, _find_plain, find, gray8
from spikerig.calib.measure import measure, report
from spikerig.calib.optics import sight_of
from spikerig.calib.parity import times
from spikerig.calib.rig import RigCalibration
from spikerig.dataset.images import linear_from_srgb, srgb8_from_linear
from spikerig.dataset.scene import Frame, Pose, View
from spikerig.dataset.texture import Texture, tfp

VIEWS, WIDTH = 12, 960


def off_px(px: np.ndarray, true: np.ndarray) -> float:
    """RMS distance, either way round."""
    return min(float(np.sqrt(((px - t) ** 2).sum(1).mean())) for t in (true, true[::-1]))


def main() -> None:
    """Print the tables."""
    true = rig(rgb_width=WIDTH)
    spike, rgb = bp.lens("spike", 5), bp.lens("rgb", 3, rgb_width=WIDTH)
    poses = bp.poses(VIEWS, 11)
    light = [spike.picture(p) for p in poses]
    gray = [linear_from_srgb(srgb8_from_linear(rgb.picture(times(step_of(true), p)))) for p in poses]
    began = time.process_time()
    seen_rgb = sight_of([find(g, BOARD) for g in gray], BOARD, WIDTH, WIDTH * 9 // 16)
    rgb_s = (time.process_time() - began) / VIEWS
    cases = {
        "clean light": lambda k: light[k],
        "spikes, 0.36 a tick at white, random phase only": lambda k: texture(0.45 * light[k], k, 256, noisy=False),
        "and 4 % threshold pattern, 560 e- shot noise": lambda k: texture(0.45 * light[k], k, 256),
        "and a quarter of the light": lambda k: texture(0.11 * light[k], k, 256),
        "and a quarter of the ticks": lambda k: texture(0.11 * light[k], k, 64),
    }
    heads = ("spike arm", "corners off, px", "SB alone, px", "residual spike", "rgb", "together", "crop off, px",
             "told sd", "fx off, px", "told sd")  # fmt: skip
    print(f"| {' | '.join(heads)} |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name, make in cases.items():
        pictures = [make(k) for k in range(VIEWS)]
        began = time.process_time()
        found = [find(p, BOARD) for p in pictures]
        find_s = (time.process_time() - began) / VIEWS
        plain = [_find_plain(gray8(p), BOARD) for p in pictures]
        off = [[off_px(f.px, spike.corners(p)) for f, p in zip(fs, poses, strict=True) if f] for fs in (found, plain)]
        corner, bare = (np.sqrt(np.mean(np.square(o))) for o in off)
        began = time.process_time()
        told = measure(BOARD, seen_of((sight_of(found, BOARD, 400, 250), seen_rgb)))
        fit_s = time.process_time() - began
        r = report(told)
        assert told.fit is not None
        assert r["accepted"]
        rms, c = r["rms_px"], told.fit.calibration
        print(f"| {name} | {corner:.4f} | {bare:.4f} | {rms['spike']:.4f} | {rms['rgb']:.4f} | {rms['stereo']:.4f} | "
              f"{crop_error_px(c, true):.3f} | {c.sd['crop_px']:.3f} | {abs(r['fx_px'] - 620):.3f} | "
              f"{told.fit.sure.sd['spike.fx_px']:.3f} |")  # fmt: skip
    charuco(true, poses)
    print(f"\nCPU seconds: board in a texture {find_s:.2f}, in a {WIDTH} px wide picture {rgb_s:.2f}, fit and verdict "
          f"of {VIEWS} views {fit_s:.1f}")  # fmt: skip
    align(true, light[1], gray[1])


def charuco(true: RigCalibration, poses: np.ndarray) -> None:
    """A ChArUco board of 6x4 corners, 23 mm, through the same noise: whole views and parts of it."""
    board, art, size = Board(6, 4, 23.0, "DICT_4X4_50", 17.25), bp.charuco(6, 4), {"cols": 6, "rows": 4, "square": 23.0}
    spike, rgb = bp.lens("spike", 5), bp.lens("rgb", 3, rgb_width=WIDTH)
    light = [0.45 * spike.picture(p, art=art, **size) for p in poses]
    gray = [linear_from_srgb(srgb8_from_linear(rgb.picture(times(step_of(true), p), art=art, **size))) for p in poses]
    seen_rgb = sight_of([find(g, board) for g in gray], board, WIDTH, WIDTH * 9 // 16)
    for name, pictures in (
        ("clean light", light),
        ("spikes, noisy", [texture(p, k, 256) for k, p in enumerate(light)]),
    ):
        found = [find(p, board) for p in pictures]
        off = [off_px(f.px[f.seen], spike.corners(p, **size)[f.seen]) for f, p in zip(found, poses, strict=True) if f]
        r = measure(board, seen_of((sight_of(found, board, 400, 250), seen_rgb)), (False, False))
        told = report(r)
        assert r.fit is not None
        print(f"ChArUco, {name}: {sum(int(f.seen.sum()) for f in found if f)} of {24 * VIEWS} corners, off "
              f"{np.sqrt(np.mean(np.square(off))):.4f} px, residual {told['rms_px']['spike']:.4f}, rgb "
              f"{told['rms_px']['rgb']:.4f}, together {told['rms_px']['stereo']:.4f}; crop off "
              f"{crop_error_px(r.fit.calibration, true):.3f}, told sd {told['crop']['sd_worst_px']:.3f}")  # fmt: skip


def texture(light: np.ndarray, seed: int, ticks: int, noisy: bool = True) -> np.ndarray:
    """TFP over all ticks of simulated spikes."""
    return tfp(bp.spikes(light, ticks, seed, noisy=noisy), ticks // 2, ticks).light


def align(true: RigCalibration, light: np.ndarray, gray: np.ndarray) -> None:
    """How long a warp and a view take."""
    pixels = srgb8_from_linear(np.repeat(gray[..., None], 3, 2))
    shape = pixels.shape[:2]
    view = View("v", Frame(pixels), None, np.zeros(shape, np.float32), np.ones(shape, bool), Pose(np.eye(4)[:3]), None)
    known = Texture(light, np.ones(light.shape, bool), 0.0, "true")
    began = time.process_time()
    warp = warp_of(true)  # type: ignore[arg-type]
    warp_s, began = time.process_time() - began, time.process_time()
    for _ in range(5):
        pair(view, true, warp=warp, texture=known)  # type: ignore[arg-type]
    print(f"alignment: {warp_s:.2f} to plan, {(time.process_time() - began) / 5:.3f} a view")


if __name__ == "__main__":
    main()
