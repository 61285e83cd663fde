"""Small worlds of cameras for the tests of calibration."""

import numpy as np


def turn(*vector: float) -> np.ndarray:
    import cv2

    return cv2.Rodrigues(np.array(vector, np.float64))[0]


def ring(n: int, radius: float = 2.0) -> np.ndarray:
    """Cameras on half a circle that look at the middle."""
    poses = []
    for a in np.linspace(0, np.pi, n):
        at = radius * np.array([np.cos(a), np.sin(a), 0.3])
        z = -at / np.linalg.norm(at)
        x = np.cross(z, [0, 0, 1])
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(z, x), z])
        poses.append(np.column_stack([R, -R @ at]))
    return np.array(poses)


def moved(poses: np.ndarray, scale: float, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The same cameras in a world x' = scale R x + t."""
    out = []
    for pose in poses:
        Q = pose[:, :3] @ R.T
        out.append(np.column_stack([Q, scale * pose[:, 3] - Q @ t]))
    return np.array(out)


def path(at: np.ndarray) -> np.ndarray:
    """A shake: turning and moving as a cubic of the phase."""
    rows = []
    for s in np.asarray(at):
        R = turn(0.02 * s, -0.03 * s**2, 0.01 * s**3) @ turn(0.4, 0.2, -1.0)
        rows.append(np.column_stack([R, [0.1 * s, 0.02 * s**2, 2.0 - 0.01 * s]]))
    return np.array(rows)
