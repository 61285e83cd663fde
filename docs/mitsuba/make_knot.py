"""A torus knot as knot.ply and knot.obj, beside this file or in a folder: python docs/mitsuba/make_knot.py [FOLDER]

NumPy only. Mitsuba reads both; knot.xml loads the PLY.
"""

import sys
from pathlib import Path

import numpy as np

AROUND, ALONG, THICK = 24, 400, 0.16


def knot() -> tuple[np.ndarray, np.ndarray]:
    """Vertices float32[N,3] and triangles int32[M,3] of a (2,3) torus knot, standing on z = 0."""
    t = np.arange(ALONG) * (2 * np.pi / ALONG)
    r = np.cos(3 * t) + 2
    path = np.stack([r * np.cos(2 * t), r * np.sin(2 * t), -np.sin(3 * t)], 1) / 3
    ahead = np.roll(path, -1, 0) - np.roll(path, 1, 0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    side = np.cross(ahead, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    angle = np.arange(AROUND) * (2 * np.pi / AROUND)
    ring = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * np.cross(side, ahead)[:, None]
    vertices = (path[:, None] + THICK * ring).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(ALONG), np.arange(AROUND), indexing="ij")
    i2, j2 = (i + 1) % ALONG, (j + 1) % AROUND
    a, b, c, d = (u * AROUND + v for u, v in ((i, j), (i2, j), (i2, j2), (i, j2)))
    faces = np.concatenate([np.stack([a, c, d], -1).reshape(-1, 3), np.stack([a, b, c], -1).reshape(-1, 3)])
    vertices[:, 2] -= vertices[:, 2].min()
    return vertices.astype(np.float32), faces.astype(np.int32)


def main() -> None:
    """Write both files."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    vertices, faces = knot()
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), [("n", "u1"), ("i", "<i4", 3)])
    rows["n"], rows["i"] = 3, faces
    (folder / "knot.ply").write_bytes(head.encode() + vertices.astype("<f4").tobytes() + rows.tobytes())
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    (folder / "knot.obj").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
