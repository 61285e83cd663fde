"""Many small solids of one shape and texture, handled together: every part is a unit shape, stretched and turned.

In its own axes a part is the square |x|, |y| < 1 at z = 0 (`rect`), the cube |x|, |y|, |z| < 1 (`box`), the unit ball
(`ball`) or the unit cylinder along z with its caps (`rod`). Rays are taken there; distances along
them stay what they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.caster.cut import round_grid, whole
from spikerig.rigctl.sim.caster.pattern import Texture

Floats = NDArray[np.floating]  # float32 unless said
Ints = NDArray[np.integer]
Vector = tuple[Floats, Floats, Floats]  # axis by axis
SIDES = {"rect": 2, "box": 6, "ball": 1, "rod": 3}
NEVER = np.float32(np.inf)
FLAT = np.float32(1e-30)  # a ray along a rod has no slope across it


@dataclass(frozen=True, eq=False)
class Parts:
    """Solids that share a shape and a texture.

    Args:
        shape: `rect`, `box`, `ball` or `rod`.
        centre: float64[N,3].
        axes: float64[N,3,3], rows: the half edges of each part in the world, at right angles (a rect's third: its unit
            normal).
        texture: of all.
        tint: float32[N,3], times the texture's colour.
        shift: float32[N,2], added to texture coordinates, so that neighbours differ.
    """

    shape: str
    centre: NDArray[np.float64]
    axes: NDArray[np.float64]
    texture: Texture
    tint: Floats
    shift: Floats

    def __len__(self) -> int:
        return len(self.centre)

    @property
    def sides(self) -> int:
        """Sides of a part: a rect's front and back; a box's low and high along x, y, z; a ball's one; a rod's round
        one, bottom and top. Where parts are cut, as many again: the same from inside.
        """
        return SIDES[self.shape] * (2 if self.texture.cut != "none" and self.shape != "rect" else 1)

    @cached_property
    def half(self) -> NDArray[np.float64]:
        """Half edges, float64[N,3] in world units."""
        return np.linalg.norm(self.axes, axis=2)

    @cached_property
    def local(self) -> NDArray[np.float64]:
        """local_from_world, float64[N,3,3], for differences from the centre."""
        return self.axes / (self.half**2)[:, :, None]

    @cached_property
    def radius(self) -> NDArray[np.float64]:
        """Of a ball around each part, float64[N]."""
        h = self.half
        return {"rect": np.hypot(h[:, 0], h[:, 1]), "ball": h.max(1)}.get(self.shape, np.linalg.norm(h, axis=1))


def holds(parts: Parts, at: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which parts a point lies in, bool[N]; never in a rect."""
    q = np.einsum("nij,nj->ni", parts.local, at - parts.centre)
    if parts.shape == "rect":
        return np.zeros(len(parts), bool)
    if parts.shape == "ball":
        return (q**2).sum(1) <= 1
    if parts.shape == "rod":
        return ((q[:, :2] ** 2).sum(1) <= 1) & (np.abs(q[:, 2]) <= 1)
    return np.all(np.abs(q) <= 1, axis=1)


def meet(shape: str, o: Vector, d: Vector) -> tuple[Floats, Ints, Floats, Ints]:
    """Where lines o + t d in the parts' own axes enter and leave them.

    Args:
        shape: of the parts.
        o, d: float32[n] an axis.

    Returns:
        t and side of entering, t and side of leaving, [n] each; t is infinite (or NaN) on a miss.
    """
    return {"rect": _meet_rect, "box": _meet_box, "ball": _meet_ball, "rod": _meet_rod}[shape](o, d)


def _meet_rect(o: Vector, d: Vector) -> tuple[Floats, Ints, Floats, Ints]:
    t = -o[2] / d[2]
    hit = (np.abs(o[0] + t * d[0]) < 1) & (np.abs(o[1] + t * d[1]) < 1)
    side = (o[2] < 0).astype(np.int8)
    return np.where(hit, t, NEVER), side, np.full_like(t, NEVER), side


def _meet_box(o: Vector, d: Vector) -> tuple[Floats, Ints, Floats, Ints]:
    enter, leave = np.full_like(d[0], -np.inf), np.full_like(d[0], np.inf)
    near, far = np.zeros(d[0].shape, np.int8), np.zeros(d[0].shape, np.int8)
    for axis in range(3):
        inv = 1 / d[axis]
        mid, half = -o[axis] * inv, np.abs(inv)
        low, high = mid - half, mid + half
        down = (d[axis] < 0).astype(np.int8)
        np.copyto(near, down + np.int8(2 * axis), where=low > enter)
        np.copyto(far, np.int8(2 * axis + 1) - down, where=high < leave)
        enter, leave = np.maximum(enter, low), np.minimum(leave, high)
    hit = enter < leave
    return np.where(hit, enter, NEVER), near, np.where(hit, leave, NEVER), far


def _meet_ball(o: Vector, d: Vector) -> tuple[Floats, Ints, Floats, Ints]:
    # By the point nearest to the centre: no difference of large squares, however small and far the ball.
    a = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    s = -(o[0] * d[0] + o[1] * d[1] + o[2] * d[2]) / a
    x, y, z = (o[k] + s * d[k] for k in range(3))
    deep = 1 - (x * x + y * y + z * z)
    root = np.sqrt(deep / a)
    side = np.zeros(a.shape, np.int8)
    return np.where(deep > 0, s - root, NEVER), side, np.where(deep > 0, s + root, NEVER), side


def _meet_rod(o: Vector, d: Vector) -> tuple[Floats, Ints, Floats, Ints]:
    a = np.maximum(d[0] * d[0] + d[1] * d[1], FLAT)
    s = -(o[0] * d[0] + o[1] * d[1]) / a
    x, y = o[0] + s * d[0], o[1] + s * d[1]
    deep = 1 - (x * x + y * y)
    root = np.sqrt(deep / a)
    inv = 1 / d[2]
    mid, half = -o[2] * inv, np.abs(inv)
    down = (d[2] < 0).astype(np.int8)
    enter, leave = np.maximum(s - root, mid - half), np.minimum(s + root, mid + half)
    near = np.where(mid - half > s - root, 1 + down, 0).astype(np.int8)
    far = np.where(mid + half < s + root, 2 - down, 0).astype(np.int8)
    hit = (deep > 0) & (enter < leave)
    return np.where(hit, enter, NEVER), near, np.where(hit, leave, NEVER), far


def present(parts: Parts, which: Ints, q: Vector, side: Ints) -> NDArray[np.bool_]:
    """Whether there is something at points of the surface, bool[n]: False in what the texture cuts away.

    Args:
        parts: the solids.
        which: the part of each point.
        q: float32[n] an axis, in the part's own axes.
        side: of each point, as `meet` numbers them.
    """
    cut = parts.texture.cut
    if cut == "none":
        return np.ones(len(which), bool)
    half = parts.half.astype(np.float32)[which].T
    if parts.shape == "ball":
        return whole(parts.texture, *round_grid(q, half.mean(0), parts.texture.cut_size))
    u, v, lu, lv = _flat(parts.shape, q, half, side)
    around = np.asarray(side == 0) if parts.shape == "rod" else np.zeros(len(u), bool)
    step = np.float32(parts.texture.cut_size)
    turns = np.maximum(np.rint(2 * np.float32(np.pi) * half[0] / step), 3)
    u = np.where(around, u / (2 * np.float32(np.pi) * half[0]) * turns, u / step)
    return whole(parts.texture, u, v / step, u * step / lu, v / lv)


def _flat(shape: str, q: Vector, half: Floats, side: Ints) -> tuple[Floats, Floats, Floats, Floats]:
    """Texture coordinates of points of all but balls, in world units, and their greatest values."""
    if shape == "rect":
        return q[0] * half[0], q[1] * half[1], half[0], half[1]
    if shape == "rod":
        round_ = side % 3 == 0
        u = np.where(round_, np.arctan2(q[1], q[0]), q[0]) * half[0]
        v = np.where(round_, q[2] * half[2], q[1] * half[1])
        return u, v, np.where(round_, np.float32(np.pi), 1) * half[0], np.where(round_, half[2], half[1])
    axis = side % 6 // 2
    first, last = axis == 0, axis == 2
    u = np.where(first, q[1] * half[1], q[0] * half[0])
    v = np.where(last, q[1] * half[1], q[2] * half[2])
    return u, v, np.where(first, half[1], half[0]), np.where(last, half[1], half[2])


def surface(parts: Parts, which: Ints, q: Vector, side: Ints) -> tuple[Floats, Floats, Floats, Floats]:
    """Texture coordinates u and v of points of the surface (world units), and both again as 0 to 1 over a side.

    Args:
        parts, which, q, side: as for `present`; side as hits number it, 0 to parts.sides.
    """
    half = parts.half.astype(np.float32)[which].T
    if parts.shape == "ball":
        r = half.mean(0)
        azimuth, latitude = np.arctan2(q[1], q[0]), np.arcsin(np.clip(q[2], -1, 1))
        turn = np.float32(np.pi)
        return azimuth * r, latitude * r, azimuth / (2 * turn) + np.float32(0.5), latitude / turn + np.float32(0.5)
    u, v, lu, lv = _flat(parts.shape, q, half, side)
    return u, v, (u / lu + 1) / 2, (v / lv + 1) / 2


def place(parts: Parts, side: int, s: Floats, t: Floats) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points of one side of every part, and their normals: the inverse of `surface`.

    Args:
        parts: the solids.
        side: 0 to parts.sides.
        s, t: float64[n], in 0 to 1.

    Returns:
        Points and unit normals in the world, float64[N,n,3].
    """
    q, kind = np.zeros((len(s), 3)), side % SIDES[parts.shape]
    a, b = 2 * s - 1, 2 * t - 1
    if parts.shape == "ball":
        azimuth, latitude = a * np.pi, b * np.pi / 2
        q[:] = np.stack([np.cos(azimuth) * np.cos(latitude), np.sin(azimuth) * np.cos(latitude), np.sin(latitude)], 1)
    elif parts.shape == "rod" and kind == 0:
        q[:] = np.stack([np.cos(a * np.pi), np.sin(a * np.pi), b], 1)
    elif parts.shape == "box":
        axis = kind // 2
        u, v = ((1, 2), (0, 2), (0, 1))[axis]
        q[:, u], q[:, v], q[:, axis] = a, b, 2 * (kind % 2) - 1
    else:
        q[:, 0], q[:, 1] = a, b
        q[:, 2] = 0 if parts.shape == "rect" else 2 * kind - 3
    p = parts.centre[:, None] + np.einsum("nij,mi->nmj", parts.axes, q)
    n = np.einsum("nij,mi->nmj", parts.local, inner_normal(parts.shape, q.T, np.full(len(s), side)).T)
    return p, n / np.linalg.norm(n, axis=2, keepdims=True)


def inner_normal(shape: str, q: Floats, side: Ints) -> Floats:
    """Normals [3,n] in the parts' own axes, not of unit length; inward where a side is the inside."""
    n = np.zeros_like(q)
    kind = side % SIDES[shape]
    if shape == "rect":
        n[2] = 1 - 2 * side
        return n
    if shape == "ball":
        n[:] = q
    elif shape == "rod":
        n[:2] = np.where(kind == 0, q[:2], 0)
        n[2] = np.where(kind == 0, 0, 2 * kind - 3)
    else:
        for axis in range(3):
            n[axis] = np.where(kind // 2 == axis, 2 * (kind % 2) - 1, 0)
    return n * np.where(side >= SIDES[shape], -1, 1).astype(q.dtype)
