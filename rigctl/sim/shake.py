"""Hand shake: a smooth, seeded path of the camera over one exposure and its margins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.spec import Exposure, Shake

Floats = NDArray[np.float64]
LOOKS = 129  # instants at which the length of a path is measured


@dataclass(frozen=True, slots=True)
class ShakePath:
    """A uniform cubic B-spline of rotation vector and translation around a base pose (SO(3) x R^3, twice smooth).

    Args:
        base: cam_from_world float64[3,4] at mid-exposure, where the shake is zero.
        controls: float64[M,6], rotation vector (rad) and translation (world units) in the camera's frame.
        start: phase at which control 1 counts most; phase 0 and 1 are the ends of the exposure.
        step: phase between controls.
    """

    base: Floats
    controls: Floats
    start: float
    step: float

    def offset(self, phase: ArrayLike) -> Floats:
        """Rotation vector and translation at phases of the exposure, float64[N,6]."""
        s = (np.atleast_1d(np.asarray(phase, np.float64)) - self.start) / self.step
        k = np.clip(np.floor(s).astype(int), 0, len(self.controls) - 4)
        u = (s - k)[:, None]
        weights = ((1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3)
        return sum(w * self.controls[k + j] for j, w in enumerate(weights)) / 6  # type: ignore[return-value]

    def poses(self, phase: ArrayLike) -> Floats:
        """cam_from_world float64[N,3,4] at phases of the exposure (0 its start, 1 its end; beyond is fine)."""
        moved = self.offset(phase) - self.offset(0.5)
        turn = rotation(moved[:, :3])
        R = turn @ self.base[:, :3]
        t = (turn @ self.base[:, 3, None])[:, :, 0] + moved[:, 3:]
        return np.concatenate([R, t[:, :, None]], 2)


def rotation(vector: Floats) -> Floats:
    """Rotation matrices float64[N,3,3] from rotation vectors [N,3] (Rodrigues; exact to rounding at zero)."""
    angle = np.linalg.norm(vector, axis=1)[:, None, None]
    x, y, z = vector.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)
    half = np.sinc(angle / (2 * np.pi))  # sin(a/2) / (a/2)
    return np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * half**2 * (cross @ cross)


def path_px(path: ShakePath, camera: Camera, depth: float) -> float:
    """Length in pixels that a point straight ahead at `depth` draws in the picture over the exposure."""
    point = path.base[:, :3].T @ (np.array([0, 0, depth]) - path.base[:, 3])
    poses = path.poses(np.linspace(0, 1, LOOKS))
    seen = (poses[:, :, :3] @ point + poses[:, :, 3]) @ camera.K.T
    return float(np.linalg.norm(np.diff(seen[:, :2] / seen[:, 2:], axis=0), axis=1).sum())


def shake_path(
    shake: Shake, exposure: Exposure, camera: Camera, base: Floats, depth: float, rng: np.random.Generator
) -> ShakePath:
    """A random path whose image-centre length over the exposure lies in `shake.path_px`.

    Args:
        shake: how.
        exposure: for the margins.
        camera: for pixels.
        base: cam_from_world float64[3,4], the pose at mid-exposure.
        depth: of the point whose path is measured, world units.
        rng: the view's stream of shake.
    """
    step = 0.5
    margin = exposure.margin_ticks / exposure.ticks
    count = int(np.ceil((1 + 2 * margin) / step)) + 4
    length = rng.uniform(*shake.path_px)
    heading = rng.uniform(0, 2 * np.pi)
    across = np.array([np.cos(heading), np.sin(heading)])
    turning, moving = 1 - shake.translation, shake.translation * depth
    scale = np.array([turning, turning, turning * shake.roll, moving, moving, moving])
    heading = rng.uniform(0, 2 * np.pi)
    drift = np.array([*across, rng.normal(), np.cos(heading), np.sin(heading), 0.3 * rng.normal()])
    bends = rng.normal(size=(count, 6))
    controls = (drift * np.arange(count)[:, None] + shake.curvature * bends) * scale
    if length == 0 or not np.any(controls):
        return ShakePath(base, np.zeros((count, 6)), -margin - step, step)
    path = ShakePath(base, controls * 1e-4, -margin - step, step)
    for _ in range(8):  # nearly linear in the scale: converges in two or three
        path = ShakePath(base, path.controls * (length / path_px(path, camera, depth)), path.start, step)
    return path
