"""Rigs with known truth, and the corners they would see: for tests that need no pictures."""

from dataclasses import replace

import board_pictures as bp
import numpy as np

from spikerig.calib.boards import Board
from spikerig.calib.bundle import Guess, Sight, turn
from spikerig.calib.crop import grid, rgb_px_from_spike_px, spike_px_from_rgb_px
from spikerig.calib.lens import project
from spikerig.calib.parity import inverse, times
from spikerig.calib.rig import RigCalibration
from spikerig.calib.verdict import Seen
from spikerig.dataset.scene import Camera, Pose

BOARD = Board(bp.COLS, bp.ROWS, bp.SQUARE)
STEP_DEG = (0.5, -1.0, 2.0)


def rig(shift: tuple[float, float, float] = (0, 0, 0), mirrored: str | None = None, rgb_width: int = 960,
        lens: tuple[float, ...] = (-0.15, 0.08, 5e-4, -1e-3)) -> RigCalibration:  # fmt: skip
    """A true rig: 400x250 spikes, a 16:9 RGB arm turned by a few degrees and shifted by `shift` mm."""
    f, height = 0.78 * rgb_width, rgb_width * 9 // 16
    spike = Camera(np.array([[620.0, 0, 203], [0, 621, 122], [0, 0, 1]]), np.array(lens), 400, 250)
    K = np.array([[f, 0, rgb_width * 0.497], [0, f * 1.001, height * 0.51], [0, 0, 1]])
    rgb = Camera(K, np.array([-0.1, 0.05, 5e-4, -1e-3]), rgb_width, height)
    step = np.concatenate([turn(np.radians(STEP_DEG)), np.reshape(shift, (3, 1))], 1)
    model = "stereo" if any(shift) else "common"
    return RigCalibration(spike, rgb, Pose(inverse(step)), model, mirrored, (330.0, 620.0))  # type: ignore[arg-type]


def step_of(true: RigCalibration) -> np.ndarray:
    return inverse(true.spike_from_rgb.cam_from_world)


def corners_seen(true: RigCalibration, views: int, *, seed: int = 0, noise_seed: int | None = None,
                 noise_px: tuple[float, float] = (0.015, 0.03), tilt_deg: float = 40, jitter_mm: float = 0,
                 shuffle: bool = False) -> tuple[Sight, Sight]:  # fmt: skip
    """Raw corners of both arms; `jitter_mm` moves the board between the two pictures, `shuffle` turns labels."""
    poses = bp.poses(views, seed, tilt_deg=tilt_deg)
    rng = np.random.default_rng([seed if noise_seed is None else noise_seed, 5])
    board = bp.corners()
    px = []
    for arm, to in ((true.spike, None), (true.rgb, step_of(true))):
        at = poses.copy()
        at[:, :, 3] += rng.normal(size=(views, 3)) * (jitter_mm if to is not None else 0)
        at = at if to is None else times(to, at)
        px.append(project(arm, board @ at[:, :, :3].transpose(0, 2, 1) + at[:, None, :, 3]))
    px = [p + rng.normal(size=p.shape) * s for p, s in zip(px, noise_px, strict=True)]
    if true.mirrored:
        k = ("spike", "rgb").index(true.mirrored)
        px[k] = np.stack([true.camera(true.mirrored).width - px[k][..., 0], px[k][..., 1]], -1)
        px[k] = np.stack([BOARD.relabelled(p, 0, mirrored=True) for p in px[k]])
    if shuffle:
        for p in px:
            turned = rng.random(views) < 0.5
            p[turned] = p[turned][:, ::-1]
    seen = np.ones((views, len(board)), bool)
    return Sight(px[0], seen, 400, 250), Sight(px[1], seen, true.rgb.width, true.rgb.height)


def bundle_of(true: RigCalibration, sights: tuple[Sight, Sight], seed: int = 0, off: bool = False) -> tuple:
    """(points, sights, guess) for `solve`; the guess is the truth, or well off it."""
    views = len(sights[0].px)
    poses, step = bp.poses(views, seed), step_of(true)
    lenses = [(c.K, c.distortion) for c in (true.spike, true.rgb)]
    if off:
        lenses = [(K * [[1.1, 1, 1.05], [1, 1.1, 1], [1, 1, 1]], c * 0) for K, c in lenses]
        poses = poses + np.array([0, 0, 0, 10.0])
        step = np.concatenate([np.eye(3), np.zeros((3, 1))], 1)
    return bp.corners(), sights, Guess(tuple(lenses), poses, step)


def seen_of(sights: tuple[Sight, Sight], **changes: object) -> Seen:
    """What `judge_views` is told: every picture its own."""
    names = [f"v{k:02d}" for k in range(len(sights[0].px))]
    seen = Seen(names, sights[0], sights[1], [(f"s{k}", f"r{k}") for k in range(len(names))], [])
    return replace(seen, **changes)  # type: ignore[arg-type]


def crop_error_px(found: RigCalibration, true: RigCalibration, depth_mm: float = 450.0) -> float:
    """How far off, at most over the spike picture, the found crop is: spike px."""
    here = grid(400, 250, 9, 7)
    rgb = rgb_px_from_spike_px(true, here, depth_mm)
    back = spike_px_from_rgb_px(found, rgb, depth_mm)
    return float(np.nanmax(np.linalg.norm(back - here, axis=-1)))
