"""Exact pictures of a checkerboard, by casting rays through a known lens; and what a spike sensor makes of them."""

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from spikerig.calib.bundle import turn
from spikerig.calib.lens import directions, project
from spikerig.dataset.kernels import fire
from spikerig.dataset.scene import Camera
from spikerig.dataset.spikes import SpikeStream

COLS, ROWS, SQUARE = 9, 6, 16.0  # mm


def corners(cols: int = COLS, rows: int = ROWS, square: float = SQUARE) -> np.ndarray:
    """float64[N,3], row by row, about the middle."""
    xy = np.stack(np.meshgrid(np.arange(cols), np.arange(rows)), -1).reshape(-1, 2) * square
    return np.concatenate([xy - xy.mean(0), np.zeros((len(xy), 1))], 1)


@dataclass
class Lens:
    """A camera that casts `samples` x `samples` rays a pixel; their directions are found once.

    The rays lie staggered, all at different heights and all in different columns, so that an edge along the pixels
    is as exact as any other.
    """

    camera: Camera
    samples: int = 4
    rays: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        s, cam = self.samples, self.camera
        i, j = np.meshgrid(np.arange(s), np.arange(s))
        px = np.stack([(i + (j + 0.5) / s) / s, (j + (i + 0.5) / s) / s], -1).reshape(-1, 2)  # within a pixel
        x, y = np.arange(cam.width + 1), np.arange(cam.height + 1)

        def at(across: np.ndarray, down: np.ndarray) -> np.ndarray:
            return directions(cam, np.stack(np.meshgrid(across, down), -1))[..., :2]

        middle = at(x[:-1] + 0.5, y[:-1] + 0.5)
        by = [np.diff(at(x, y[:-1] + 0.5), axis=1), np.diff(at(x[:-1] + 0.5, y), axis=0)]
        # within a pixel a lens is straight to 1e-4 px
        self.rays = np.stack([middle + by[0] * (a - 0.5) + by[1] * (b - 0.5) for a, b in px]).astype(np.float32)

    def on_board(self, pose: np.ndarray, curl: float = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where rays meet a board at cam_from_board that curls by z = curl x^2: x, y in mm, and how far ahead."""
        q = pose[:, :3].T @ pose[:, 3]
        x, y = self.rays[..., 0], self.rays[..., 1]
        u, v, w = (np.float32(r[0]) * x + np.float32(r[1]) * y + np.float32(r[2]) for r in pose[:, :3].T)
        z, ahead = np.float32(0), np.float32(q[2]) / w
        for _ in range(5 if curl else 0):
            z = np.float32(curl) * (u * ahead - np.float32(q[0])) ** 2
            ahead = (np.minimum(z, 20) + np.float32(q[2])) / w
        return u * ahead - np.float32(q[0]), v * ahead - np.float32(q[1]), ahead

    def picture(self, pose: np.ndarray, black: float = 0.05, white: float = 0.8, behind: float = 0.3,
                cols: int = COLS, rows: int = ROWS, square: float = SQUARE, curl: float = 0,
                art: np.ndarray | None = None) -> np.ndarray:  # fmt: skip
        """Linear light float32[H,W] of a board with a white rim at cam_from_board; `art`: what is printed on it,
        bool[rows + 1 squares, cols + 1 squares] in any number of dots a square, where it is no checkerboard."""
        x, y, ahead = self.on_board(pose, curl)
        i, j = x / np.float32(square) + (cols + 1) / 2, y / np.float32(square) + (rows + 1) / 2
        if art is None:
            bright = (np.floor(i).astype(np.int32) + np.floor(j).astype(np.int32)) & 1 == 0
        else:
            high, wide = art.shape
            down, across = (np.clip(k * (n / (m + 1)), 0, n - 1).astype(np.int32) for k, n, m in (
                (j, high, rows), (i, wide, cols)))  # fmt: skip
            bright = art[down, across]
        light = np.where(bright, np.float32(white), np.float32(black))
        light[(i < 0) | (i > cols + 1) | (j < 0) | (j > rows + 1)] = white
        light[(i < -1) | (i > cols + 2) | (j < -1) | (j > rows + 2) | (ahead <= 0)] = behind
        return light.mean(0)

    def corners(self, pose: np.ndarray, **board: float) -> np.ndarray:
        """Where the corners truly are, float64[N,2]."""
        return project(self.camera, corners(**board) @ pose[:, :3].T + pose[:, 3])


def charuco(cols: int, rows: int, dictionary: str = "DICT_4X4_50", marker: float = 0.75) -> np.ndarray:
    """What is printed on a ChArUco board of so many inner corners: bool, 48 dots a square, True where white."""
    import cv2

    n = 48
    kind = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    made = cv2.aruco.CharucoBoard((cols + 1, rows + 1), 1.0, marker, kind)
    return np.asarray(made.generateImage((n * (cols + 1), n * (rows + 1)))) > 127


@lru_cache
def lens(arm: str, samples: int, **rig_of: object) -> Lens:
    """The camera of an arm of `calib_rigs.rig(**rig_of)`, its rays cast once a session."""
    from calib_rigs import rig

    return Lens(rig(**rig_of).camera(arm), samples)  # type: ignore[arg-type]


def poses(count: int, seed: int = 0, tilt_deg: float = 40, near: float = 330, far: float = 620) -> np.ndarray:
    """spike_from_board float64[V,3,4]: at many depths, tilted about many axes, in every part of the picture.

    The boards' corners lie within 0.31 x 0.185 of the axis, which 400x250 pixels at f = 620 px wholly show.
    """
    rng = np.random.default_rng(seed)
    rim = corners() * [(COLS + 0.6) / (COLS - 1), (ROWS + 0.6) / (ROWS - 1), 1]
    parts = np.array([[-1, -1], [1, 1], [1, -1], [-1, 1], [0, 0], [-1, 0.2], [1, -0.2]])
    found: list[np.ndarray] = []
    for k in range(count):
        about = 2 * np.pi * (0.38 * k + 0.05 * rng.standard_normal())
        w = np.radians(tilt_deg) * rng.uniform(0.5, 1) * np.array([np.cos(about), np.sin(about), 0])
        R = turn(np.array([0, 0, rng.uniform(-0.2, 0.2)])) @ turn(w)
        z = near + (far - near) * ((0.62 * k + rng.uniform(0, 0.2)) % 1)
        for out in np.linspace(1, 0, 51):  # as far out as the picture allows
            t = np.array([*(parts[k % len(parts)] * out * [0.31, 0.185] * z), z])
            p = rim @ R.T + t
            if np.all(np.abs(p[:, :2] / p[:, 2:]) < [0.31, 0.185]):
                break
        found.append(np.concatenate([R, t[:, None]], 1))
    return np.stack(found)


def spikes(light: np.ndarray, ticks: int, seed: int, *, noisy: bool = True, fpn: float = 0.04) -> SpikeStream:
    """Integrate and fire, random phase; noisy: threshold FPN (the same for a sensor) and shot noise of 560 e-."""
    rng = np.random.default_rng([seed, 7])
    held = light[None].astype(np.float32)
    phase = rng.integers(0, 2**32, light.shape, dtype=np.uint32)
    if noisy:
        held = held / (1 + fpn * np.random.default_rng(99).standard_normal(light.shape)).astype(np.float32)
        shot = rng.standard_normal((ticks, *light.shape), dtype=np.float32) * np.sqrt(held / 560)
        bits, _, _ = fire(np.maximum(held + shot, 0), np.arange(ticks + 1), phase, hold=True)
    else:
        bits, _, _ = fire(held, np.array([0, ticks]), phase, hold=True)
    return SpikeStream(bits, light.shape[1], 40_000.0)
