"""What is cut out of a surface: leaf outlines, ellipses, the holes of meshes and grilles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.caster.pattern import Texture

Floats = NDArray[np.floating]  # float32 unless said


def whole(texture: Texture, u: Floats, v: Floats, along: Floats, across: Floats) -> NDArray[np.bool_]:
    """Whether a surface is there at points, bool[n].

    Args:
        texture: its `cut` and `open`.
        u, v: texture coordinates, in steps from hole to hole.
        along, across: the same, -1 to 1 from edge to edge of a panel.

    Edges:
        A leaf covers 2/3 of its panel, a disc pi/4; a mesh and a grille all but `open` of a wide one.
    """
    if texture.cut == "leaf":
        return np.asarray(np.abs(across) < 1 - along * along)
    if texture.cut == "disc":
        return np.asarray(along * along + across * across < 1)
    if texture.cut == "mesh":
        hole = np.float32(np.sqrt(texture.open) / 2)
        return (np.abs(u - np.rint(u)) > hole) | (np.abs(v - np.rint(v)) > hole)
    # Round holes on a triangular grid of step 1 along u: two rectangular grids, one shifted by half a cell.
    tall = np.float32(np.sqrt(3))
    r2 = np.float32(texture.open * np.sqrt(3) / (2 * np.pi))
    v = v / tall
    a, b = u - np.rint(u), (v - np.rint(v)) * tall
    c, d = u - np.floor(u) - np.float32(0.5), (v - np.floor(v) - np.float32(0.5)) * tall
    return np.asarray(np.minimum(a * a + b * b, c * c + d * d) > r2)


def round_grid(q: tuple[Floats, Floats, Floats], radius: Floats, step: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Steps across a ball for meshes and grilles: a cube's six sides blown up, so that holes stay nearly equal.

    Args:
        q: points of the unit ball, float32[n] an axis.
        radius: of the ball, world units.
        step: from hole to hole, world units; the nearest that fits a quarter turn is taken.

    Returns:
        u and v in steps, and both again from -1 to 1 over a side.
    """
    x, y, z = (np.abs(c) for c in q)
    first, second = (x >= y) & (x >= z), (y > x) & (y >= z)
    main = np.where(first, q[0], np.where(second, q[1], q[2]))
    one, other = np.where(first, q[1], q[0]), np.where(first | second, q[2], q[1])
    quarter = np.float32(np.pi / 2)
    u, v = np.arctan(one / main) / quarter, np.arctan(other / main) / quarter  # -1/2 to 1/2
    cells = np.maximum(np.rint(quarter * radius / np.float32(step)), 1)
    return u * cells, v * cells, 2 * u, 2 * v
