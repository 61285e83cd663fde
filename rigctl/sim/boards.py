"""A checkerboard held before a scene's rig: what both arms record of it, and the calibration that is true of the rig.

One world unit of a scene is a metre here, so that the step between the arms has millimetres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.boards import Board
from spikerig.calib.lens import directions
from spikerig.calib.rig import RigCalibration, write_calibration
from spikerig.dataset.errors import UsageError
from spikerig.dataset.scene import Camera, Frame, Pose
from spikerig.dataset.spikes import SpikeStream
from spikerig.rigctl.sim.capture import rig_of
from spikerig.rigctl.sim.draws import stream
from spikerig.rigctl.sim.schedule import start_ns
from spikerig.rigctl.sim.sensor import Light
from spikerig.rigctl.sim.simulate import simulate
from spikerig.rigctl.sim.spec import SceneSpec
from spikerig.rigctl.sim.viewpoint import camera_of

Floats = NDArray[np.float64]
MM = 1000.0  # a world unit
WHITE, BLACK, BEHIND = 0.8, 0.05, 0.3  # linear light of paper, ink, and the room
SAMPLES = 6  # rays a pixel along each axis
RIM = 0.5  # squares of white around the board
INSIDE = 0.985  # share of the picture that the board stays within, for the lenses bend it outward
TILT_DEG = (20.0, 40.0)
SPREAD = (0.5, 1.0)  # share of the picture's width that the board takes up
FIRST = 1 << 20  # boards are numbered from here, so that no board shares a view's draws
PARTS = ((-1, -1), (1, 1), (1, -1), (-1, 1), (0, 0), (-1, 0.2), (1, -0.2))  # of the picture, one after the other


def true_calibration(spec: SceneSpec) -> RigCalibration:
    """What `calib board` should find of a scene's rig.

    Raises:
        UsageError: the rig is none that a calibration describes: both arms mirrored, or one top to bottom.
    """
    camera = camera_of(spec)
    apart, flip, bent = (_effect(spec, name) for name in ("misalignment", "mirror_flip", "distortion"))
    if flip is not None and (flip.arm == "both" or flip.axis != "x"):
        told = f"mirror_flip: arm {flip.arm}, axis {flip.axis}"
        raise UsageError("of a calibration one arm sees left and right swapped", value=told, expected="axis x, one arm")
    mirrored = None if flip is None else flip.arm
    step = np.eye(3, 4) if apart is None else apart.rgb_from_spike
    turn, shift = step[:, :3].T, -step[:, :3].T @ step[:, 3] * MM

    def arm(name: str) -> Camera:
        if bent is None or bent.arm not in (name, "both") or not any(bent.coefficients):
            return camera
        k1, k2, p1, p2 = bent.coefficients  # the lens comes behind the mirror, the record before it
        return replace(camera, distortion=np.array([k1, k2, p1, -p2 if mirrored == name else p2]))

    model = "stereo" if shift.any() else "common"
    pose = Pose(np.concatenate([turn, shift[:, None]], 1))
    return RigCalibration(arm("spike"), arm("rgb"), pose, model, mirrored)


def _effect(spec: SceneSpec, name: str) -> Any:
    found = next((e for e in spec.effects if e.name == name), None)
    return None if getattr(found, "absent", False) else found


def board_poses(spec: SceneSpec, board: Board, views: int) -> Floats:
    """spike_from_board float64[V,3,4] in mm: at many depths, tilted in turn, in every part of the picture.

    Every board with its rim is wholly within both arms' pictures.
    """
    camera, step = camera_of(spec), _step_mm(spec)
    found: list[Floats] = []
    for k in range(views):
        rng = stream(spec.seed, "boards", k)
        about = 2 * np.pi * (0.38 * k + 0.05 * rng.standard_normal())
        tilt = np.radians(rng.uniform(*TILT_DEG))
        R = _turn(np.array([0, 0, rng.uniform(-0.2, 0.2)])) @ _turn(tilt * np.array([np.cos(about), np.sin(about), 0]))
        share = SPREAD[0] + (SPREAD[1] - SPREAD[0]) * ((0.62 * k + rng.uniform(0, 0.2)) % 1)
        found.append(_placed(board, R, _least_depth(board, R, camera) / share, PARTS[k % len(PARTS)], camera, step))
    return np.stack(found)


def _placed(board: Board, R: Floats, z: float, part: tuple[float, float], camera: Camera, step: Floats) -> Floats:
    """A turned board at a depth, as far out in a part of the picture as both arms allow; farther where none does."""
    half = np.array([camera.width / camera.K[0, 0], camera.height / camera.K[1, 1]]) / 2
    for farther in np.geomspace(1, 4, 24):
        for out in np.linspace(1, 0, 41):
            t = np.array([*(np.array(part) * out * half * z * farther), z * farther])
            pose = np.concatenate([R, t[:, None]], 1)
            if _within(board, pose, camera) and _within(board, _compose(step, pose), camera):
                return pose
    raise UsageError("the arms look so far apart that no board is seen by both", value=str(board),
                     next="a smaller misalignment")  # fmt: skip


def _least_depth(board: Board, R: Floats, camera: Camera) -> float:
    """How near a turned board may come before it is wider or higher than the picture."""
    p = _rim(board) @ R.T
    reach = np.abs(p[:, :2]) * np.diag(camera.K)[:2] / (INSIDE / 2 * np.array([camera.width, camera.height]))
    return float((reach.max(1) - p[:, 2]).max())


def _within(board: Board, pose: Floats, camera: Camera) -> bool:
    p = _rim(board) @ pose[:, :3].T + pose[:, 3]
    px = p[:, :2] / p[:, 2:] * np.diag(camera.K)[:2]
    return bool((p[:, 2] > 0).all() and (np.abs(px) <= INSIDE / 2 * np.array([camera.width, camera.height])).all())


def _rim(board: Board) -> Floats:
    """The four corners of the white rim, mm."""
    x, y = ((n + 1) / 2 + RIM for n in (board.cols, board.rows))
    return np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]) * board.square_mm


def _step_mm(spec: SceneSpec) -> Floats:
    apart = _effect(spec, "misalignment")
    step = np.eye(3, 4) if apart is None else apart.rgb_from_spike.copy()
    step[:, 3] *= MM
    return step


def _compose(a: Floats, b: Floats) -> Floats:
    return np.concatenate([a[:, :3] @ b[:, :3], (a[:, :3] @ b[:, 3] + a[:, 3])[:, None]], 1)


def _turn(w: Floats) -> Floats:
    """The rotation about a vector by its length, radians (Rodrigues)."""
    angle = float(np.linalg.norm(w))
    if angle == 0:
        return np.eye(3)
    x, y, z = w / angle
    W = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * W + (1 - np.cos(angle)) * W @ W


def rays_of(camera: Camera, samples: int = SAMPLES) -> NDArray[np.float32]:
    """Directions (x, y) at z = 1 of samples x samples rays a pixel: float32[samples^2,H,W,2].

    They are staggered within a pixel, all at other heights and in other columns, so that an edge along the pixels is as
    exact as any other. Within a pixel a lens is straight to 1e-4 px, so that it is inverted five times a pixel only.
    """
    s = samples
    i, j = np.meshgrid(np.arange(s), np.arange(s))
    within = np.stack([(i + (j + 0.5) / s) / s, (j + (i + 0.5) / s) / s], -1).reshape(-1, 2) - 0.5
    here = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1) + 0.5
    middle = directions(camera, here)[..., :2]
    by = [(directions(camera, here + h) - directions(camera, here - h))[..., :2] for h in ([0.5, 0], [0, 0.5])]
    return np.stack([middle + by[0] * a + by[1] * b for a, b in within]).astype(np.float32)


def board_picture(rays: NDArray[np.float32], pose: Floats, board: Board) -> NDArray[np.float32]:
    """Linear light float32[H,W,3] of a board at cam_from_board [3,4], mm, along `rays_of` a camera."""
    H = np.linalg.inv(np.stack([pose[:, 0], pose[:, 1], pose[:, 3]], 1)).astype(np.float32)
    total = np.zeros(rays.shape[1:3])
    for x, y in np.moveaxis(rays, -1, 1):
        u, v, w = (H[k, 0] * x + H[k, 1] * y + H[k, 2] for k in range(3))
        across, down = u / w / board.square_mm + (board.cols + 1) / 2, v / w / board.square_mm + (board.rows + 1) / 2
        light = np.where((np.floor(across) + np.floor(down)) % 2 == 1, BLACK, WHITE)
        for rim, beyond in ((0.0, WHITE), (RIM, BEHIND)):
            out = (across < -rim) | (across > board.cols + 1 + rim) | (down < -rim) | (down > board.rows + 1 + rim)
            light[out] = beyond
        light[w <= 0] = BEHIND
        total += light
    return np.repeat((total / len(rays)).astype(np.float32)[..., None], 3, 2)


class Shots:
    """The two arms of a scene's rig before a still board.

    Lenses are cast through, not redrawn as pictures of the scene are: a redrawn edge lies 0.03 px off.
    """

    def __init__(self, spec: SceneSpec, board: Board) -> None:
        self.spec, self.board, self.rig, self.true = spec, board, rig_of(spec), true_calibration(spec)
        self.rays = [rays_of(camera) for camera in (self.true.spike, self.true.rgb)]
        self.effects = [e for e in self.rig.effects if e.name not in ("misalignment", "distortion")]

    def view(self, number: int, pose: Floats) -> tuple[SpikeStream, Frame]:
        """What both arms record of the board at spike_from_board [3,4], mm."""
        exposure = self.spec.exposure
        margin, ticks = exposure.margin_ticks, exposure.ticks
        knots = np.unique([-margin, 0, ticks, ticks + margin]).astype(np.int64)
        poses = (pose, _compose(_step_mm(self.spec), pose))
        light, arm = (
            np.tile(board_picture(rays, p, self.board), (len(knots) - 1, 1, 1, 1))
            for rays, p in zip(self.rays, poses, strict=True)
        )
        t0_ns = start_ns(exposure, number) - round(margin * exposure.tick_ns)
        both = Light(light, knots + margin, (margin, margin + ticks), exposure.rate_hz, t0_ns, arm)
        seen = simulate(both, self.rig.sensor, self.effects, self.rig.seed, FIRST + number, self.rig.camera)
        return seen.spikes, seen.frame


def record_boards(
    spec: SceneSpec,
    board: Board,
    views: int,
    folder: Path,
    *,
    force: bool = False,
    done: Callable[[], object] = lambda: None,
) -> dict[str, Any]:
    """Write spike/NN.npz, rgb/NN.png and true.json into a folder: what `calib board` takes, and what it should find.

    Args:
        spec: the scene, its effects chosen.
        board: a checkerboard.
        views: how many.
        folder: to write to.
        force: replace the files.
        done: called after each view.

    Returns:
        What was made, JSON-ready.
    """
    from spikerig.dataset.images import write_image
    from spikerig.dataset.spikes import write_spikes

    shots, poses = Shots(spec, board), board_poses(spec, board, views)
    for name in ("spike", "rgb"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for k, pose in enumerate(poses):
        spikes, frame = shots.view(k, pose)
        write_spikes(folder / "spike" / f"{k:02d}.npz", spikes, force=force)
        write_image(folder / "rgb" / f"{k:02d}.png", frame.pixels, force=force)
        done()
    record = replace(shots.true, depth_mm=(float(poses[:, 2, 3].min()), float(poses[:, 2, 3].max())))
    write_calibration(folder / "true.json", record, force=force)
    return {
        "spike": str(folder / "spike"),
        "rgb": str(folder / "rgb"),
        "true": str(folder / "true.json"),
        "views": views,
        "pattern": f"{board.cols}x{board.rows}",
        "square_mm": board.square_mm,
        "model": record.model,
        "mirrored": record.mirrored,
        "depth_mm": list(record.depth_mm),
    }
