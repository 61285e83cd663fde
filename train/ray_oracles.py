"""Float64 NumPy definitions of what the ray fields compute; the truth in tests, named as what they define."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]


def hash_encode(points: NDArray, table: NDArray, levels: NDArray) -> Doubles:
    """Features [N, 2 L] of points [N,3] in [0,1]: trilinear in each level's cell, vertices hashed where mask >= 0.

    Source: Mueller et al. 2022, Eq. 4: row = (x XOR y * 2654435761 XOR z * 805459861) mod rows.
    """
    out = np.zeros((len(points), 2 * len(levels)))
    for number, (cells, mask, first, _) in enumerate(levels.tolist()):
        for n, point in enumerate(np.clip(np.asarray(points, np.float64), 0, 1)):
            cell = np.minimum((point * cells).astype(np.int64), cells - 1)
            part = point * cells - cell
            for k in range(8):
                bits = np.array([k & 1, k >> 1 & 1, k >> 2])
                x, y, z = (int(v) for v in cell + bits)
                hashed = (x ^ (y * 2654435761) ^ (z * 805459861)) & mask
                row = (z * (cells + 1) + y) * (cells + 1) + x if mask < 0 else hashed
                weight = np.where(bits == 1, part, 1 - part).prod()
                out[n, 2 * number : 2 * number + 2] += weight * np.asarray(table[first + row], np.float64)
    return out


def weights_of(density: NDArray, length: NDArray) -> tuple[Doubles, Doubles]:
    """Eq. 3, sample by sample: (weights [B,N], light left [B])."""
    weights = np.zeros(density.shape)
    left = np.ones(len(density))
    for i in range(density.shape[1]):
        thick = np.asarray(density[:, i], np.float64) * np.asarray(length[:, i], np.float64)
        weights[:, i] = left * -np.expm1(-thick)
        left = left * np.exp(-thick)
    return weights, left


def contract(x: NDArray) -> Doubles:
    """Barron et al. 2022, Eq. 10, point by point [N,3]."""
    out = np.array(x, np.float64)
    for point in out:
        length = np.sqrt((point**2).sum())
        if length > 1:
            point[:] = (2 - 1 / length) * point / length
    return out


def contract_jacobian(x: NDArray) -> Doubles:
    """[N,3,3]: (2/r - 1/r^2) I + (2/r^3 - 2/r^2) x x^T / r outside the unit ball, I inside."""
    out = np.zeros((len(x), 3, 3))
    for n, point in enumerate(np.asarray(x, np.float64)):
        r = np.sqrt((point**2).sum())
        out[n] = np.eye(3)
        if r > 1:
            out[n] = (2 / r - 1 / r**2) * np.eye(3) + (2 / r**3 - 2 / r**2) * np.outer(point, point) / r
    return out
