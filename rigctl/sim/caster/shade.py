"""Light that reaches surfaces: one lamp with shadows, ambient light with contact shading, tables of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.caster.crowd import Crowd
from spikerig.rigctl.sim.caster.hits import NEAR, Axes, Floats, box_frame, dot, dot3, vec3
from spikerig.rigctl.sim.caster.parts import Ints, place
from spikerig.rigctl.sim.caster.pattern import Texture, lattice
from spikerig.rigctl.sim.caster.solids import Box, Rect, Room, Sphere, Vec3
from spikerig.rigctl.sim.caster.world import World

TEXELS = 256  # along the longest edge of any face
CROWDED = 256  # along the edges of a crowd's sides at most
MOST = 400_000  # texels of a crowd at most
POINTS = 1 << 16  # of a crowd lit at once


@dataclass(frozen=True, slots=True, eq=False)
class Face:
    """One texture on one surface, and how its points get their coordinates u and v.

    Args:
        texture, table: what is on it, and the table of its pattern.
        normal: outward (inward for a room); None for a sphere.
        centre: where u = v = 0.
        along_u, along_v: unit vectors.
        lo, hi: extent in u and v.
        radius: of a sphere, whose u and v are azimuth and latitude times the radius.
    """

    texture: Texture
    table: Floats
    normal: Vec3 | None
    centre: Vec3
    along_u: Vec3
    along_v: Vec3
    lo: tuple[float, float]
    hi: tuple[float, float]
    radius: float = 0.0

    def coordinates(self, p: Axes) -> tuple[Floats, Floats]:
        """u and v of points, float32[n] each."""
        q = [p[a] - np.float32(self.centre[a]) if self.centre[a] else p[a] for a in range(3)]
        if self.normal is not None:
            return dot(q, self.along_u), dot(q, self.along_v)
        r = np.float32(self.radius)
        return np.arctan2(q[1], q[0]) * r, np.arcsin(np.clip(q[2] / r, -1, 1)) * r

    def normals(self, p: Axes, flip: bool) -> Axes:
        """Unit normals at points of the face; of the other side where `flip`."""
        if self.normal is None:
            return [(p[a] - np.float32(self.centre[a])) * np.float32(1 / self.radius) for a in range(3)]
        size = np.linalg.norm(self.normal) * (-1 if flip else 1)
        return [np.broadcast_to(np.float32(self.normal[a] / size), np.shape(p[0])) for a in range(3)]

    def place(self, u: Floats, v: Floats, flip: bool) -> tuple[Axes, Axes]:
        """Points and unit normals at coordinates; the other side's normals where `flip`. The inverse of the above."""
        c = np.array(self.centre)[:, None]
        if self.normal is None:
            a, b = u / self.radius, v / self.radius
            n = np.stack([np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)])
            p = c + n * self.radius
        else:
            p = c + np.array(self.along_u)[:, None] * u + np.array(self.along_v)[:, None] * v
            n = np.broadcast_to(np.array(self.normal)[:, None] * (-1 if flip else 1), p.shape)
        return list(p.astype(np.float32)), list(n.astype(np.float32))


def faces_of(solid: Room | Box | Sphere | Rect) -> list[Face]:
    """The faces of a solid, in the order its hit function numbers them."""
    if isinstance(solid, Sphere):
        skin, r = solid.texture, solid.radius
        lo, hi = (-np.pi * r, -np.pi * r / 2), (np.pi * r, np.pi * r / 2)
        return [Face(skin, lattice(skin), None, solid.centre, (1, 0, 0), (0, 1, 0), lo, hi, r)]
    if isinstance(solid, Rect):
        edges = [np.array(v) for v in (solid.right, solid.up)]
        half = tuple(float(np.linalg.norm(v)) for v in edges)
        right, up = (v / h for v, h in zip(edges, half, strict=True))
        lo, hi = (-half[0], -half[1]), (half[0], half[1])
        normal = vec3(np.cross(right, up))
        return [Face(solid.texture, lattice(solid.texture), normal, solid.centre, vec3(right), vec3(up), lo, hi)]
    return [_side(solid, side) for side in range(6)]


def _side(solid: Room | Box, side: int) -> Face:
    """Side 0..5: low and high side of each axis."""
    axis, high = divmod(side, 2)
    sign = 1 if high else -1
    u, v = ((1, 2), (0, 2), (0, 1))[axis]
    if isinstance(solid, Room):
        skin = (solid.walls, solid.walls, solid.floor)[axis] if side != 5 else solid.ceiling
        axes = np.eye(3)
        centre = vec3(axes[axis] * (solid.hi if high else solid.lo))
        lo, hi = (solid.lo[u], solid.lo[v]), (solid.hi[u], solid.hi[v])
        normal = vec3(-sign * axes[axis])
    else:
        skin = solid.texture
        c, s = np.cos(np.radians(solid.yaw_deg)), np.sin(np.radians(solid.yaw_deg))
        axes = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])  # rows: the box's axes in the world
        centre = vec3(np.array(solid.centre) + sign * axes[axis] * solid.size[axis] / 2)
        hi = (solid.size[u] / 2, solid.size[v] / 2)
        lo = (-hi[0], -hi[1])
        normal = vec3(sign * axes[axis])
    return Face(skin, lattice(skin), normal, centre, vec3(axes[u]), vec3(axes[v]), lo, hi)


def irradiance(world: World, p: Axes, n: Axes, crowds: Sequence[Crowd] = ()) -> tuple[Floats, Floats]:
    """Light on surface points.

    Args:
        world: lamp and solids.
        p: points, float32[n] an axis.
        n: unit normals, float32[n] or scalar an axis.
        crowds: what else throws shadows.

    Returns:
        direct float32[n]: the lamp's power is multiplied by this (cosine over squared distance, 0 in shadow); open
        float32[n]: the share of the ambient light that is not covered.
    """
    to = [np.float32(world.lamp.position[a]) - p[a] for a in range(3)]
    r2 = dot3(to, to)
    direct = np.maximum(dot3(to, n), 0) / (r2 * np.sqrt(r2))
    shut = np.zeros_like(direct)
    for solid in world.solids:
        if isinstance(solid, Sphere | Box) and solid.texture.cut == "none":
            away = [p[a] - np.float32(solid.centre[a]) for a in range(3)]
            if world.contact > 0:
                shut += _contact(solid, away, n)
            if world.lamp.shadows:
                direct *= ~_shadowed(solid, away, to, r2)
    for crowd in crowds:
        if world.contact > 0:
            centre, size = crowd.blob
            shut += _cover([p[a] - np.float32(centre[a]) for a in range(3)], n, size)
        if world.lamp.shadows:
            lit = np.flatnonzero(direct)
            direct[lit] *= ~crowd.shadowed(world.lamp.position, [np.asarray(c)[lit] for c in p])
    return direct, 1 - np.float32(world.contact) * np.minimum(shut, 1)


@dataclass(frozen=True, slots=True, eq=False)
class LightMap:
    """Irradiance of a face, tabulated: [rows (v), columns (u)] texels over its extent, read bilinearly.

    A texel is the mean of 2x2 points, so shadow edges are as soft as a texel: those of a lamp of some size.
    """

    direct: Floats
    open: Floats
    columns: int
    rows: int
    scale: tuple[float, float]
    lo: tuple[float, float]

    def at(self, u: Floats, v: Floats) -> tuple[Floats, Floats]:
        """`irradiance` at coordinates, float32[n] each."""
        x = u * np.float32(self.scale[0]) - np.float32(self.lo[0] * self.scale[0] + 0.5)
        y = v * np.float32(self.scale[1]) - np.float32(self.lo[1] * self.scale[1] + 0.5)
        np.clip(x, 0, np.float32(self.columns - 1.001), out=x)
        np.clip(y, 0, np.float32(self.rows - 1.001), out=y)
        i, j = x.astype(np.intp), y.astype(np.intp)
        x -= i
        y -= j
        j *= self.columns
        j += i
        corners = [j, j + 1, j + self.columns, j + (self.columns + 1)]
        return _bilinear(self.direct, corners, x, y), _bilinear(self.open, corners, x, y)


def _bilinear(table: Floats, corners: list[NDArray[np.intp]], x: Floats, y: Floats) -> Floats:
    a, b, c, d = (table.take(k, mode="clip") for k in corners)
    b -= a
    b *= x
    a += b
    d -= c
    d *= x
    c += d
    c -= a
    c *= y
    a += c
    return a


def light_map(world: World, face: Face, flip: bool, texel: float, crowds: Sequence[Crowd] = ()) -> LightMap:
    """The table of a face, seen from the side of its normal or (`flip`) from the other; texels of that size."""
    counts = [int(np.clip(np.ceil((face.hi[k] - face.lo[k]) / texel), 16, 4 * TEXELS)) for k in (0, 1)]
    spots = [
        face.lo[k] + (np.arange(2 * counts[k]) + 0.5) * ((face.hi[k] - face.lo[k]) / (2 * counts[k])) for k in (0, 1)
    ]
    u, v = np.meshgrid(*spots)
    p, n = face.place(u.reshape(-1), v.reshape(-1), flip)
    tables = []
    for part in irradiance(world, p, n, crowds):
        cells = part.reshape(counts[1], 2, counts[0], 2)
        tables.append(cells.mean((1, 3), dtype=np.float32).reshape(-1))
    scale = (counts[0] / (face.hi[0] - face.lo[0]), counts[1] / (face.hi[1] - face.lo[1]))
    return LightMap(tables[0], tables[1], counts[0], counts[1], scale, face.lo)


@dataclass(frozen=True, slots=True, eq=False)
class CrowdMap:
    """Irradiance of every side of every part of a crowd: [part, side, rows, columns] texels, read bilinearly.

    Args:
        direct, open: the tables, flat.
        shape, sides: of the parts; a ball's and a rod's round side close around it.
        edge: rows, and columns, of a side.
    """

    direct: Floats
    open: Floats
    shape: str
    sides: int
    edge: int

    def at(self, part: Ints, side: Ints, s: Floats, t: Floats) -> tuple[Floats, Floats]:
        """`irradiance` at places 0 to 1 along the sides' u and v, float32[n] each."""
        top = np.float32(self.edge - 1.001)
        x, y = (c * np.float32(self.edge) - np.float32(0.5) for c in (s, t))
        y = np.clip(y, 0, top)
        if self.shape == "rect" or self.shape == "box":
            x = np.clip(x, 0, top)
        elif self.shape == "rod":
            x = np.where(side % 3 == 0, x, np.clip(x, 0, top))
        left, j = np.floor(x), y.astype(np.intp)
        x, y, i = x - left, y - j, left.astype(np.intp) % self.edge
        at = ((part * self.sides + side).astype(np.intp) * self.edge + j) * self.edge
        right = at + (i + 1) % self.edge
        at += i
        corners = [at, right, at + self.edge, right + self.edge]
        return _bilinear(self.direct, corners, x, y), _bilinear(self.open, corners, x, y)


def crowd_map(world: World, crowd: Crowd, texel: float, crowds: Sequence[Crowd]) -> CrowdMap:
    """The table of a crowd, texels of about that size, at most MOST of them but no fewer than 2x2 a side."""
    parts = crowd.parts
    n, sides = len(parts), parts.sides
    longest = parts.half.max() * (2 * np.pi if parts.shape in ("ball", "rod") else 2)
    edge = int(min(np.ceil(longest / texel), np.sqrt(MOST / (n * sides)), CROWDED))
    edge = max(edge, 2)
    spots = (np.arange(2 * edge) + 0.5) / (2 * edge)
    s, t = (c.reshape(-1) for c in np.meshgrid(spots, spots))
    tables = [np.empty((n, sides, edge, edge), np.float32) for _ in range(2)]
    for side in range(sides):
        points, normals = place(parts, side, s, t)
        for k in range(0, n, step := max(1, POINTS // len(s))):
            p, m = (list(c[k : k + step].reshape(-1, 3).T.astype(np.float32)) for c in (points, normals))
            for table, part in zip(tables, irradiance(world, p, m, crowds), strict=True):
                table[k : k + step, side] = part.reshape(-1, edge, 2, edge, 2).mean((2, 4), dtype=np.float32)
    return CrowdMap(tables[0].reshape(-1), tables[1].reshape(-1), parts.shape, sides, edge)


def _shadowed(solid: Sphere | Box, away: Axes, to: Axes, r2: Floats) -> NDArray[np.bool_]:
    """Whether a solid lies between points (given from its centre) and the lamp at `away + to`."""
    if isinstance(solid, Sphere):
        b, c = dot3(away, to), dot3(away, away) - np.float32((solid.radius * 1.0005) ** 2)
        return (b < 0) & (-b < r2) & (c > 0) & (b * b > r2 * c)
    with np.errstate(divide="ignore", invalid="ignore"):
        o, d = box_frame(solid, away, to)
        enter, leave = np.float32(-np.inf), np.float32(np.inf)
        for axis in range(3):
            inv = 1 / d[axis]
            half, mid = np.float32(solid.size[axis] / 2) * np.abs(inv), -o[axis] * inv
            enter = np.maximum(enter, mid - half)
            leave = np.minimum(leave, mid + half)
        return np.asarray((enter < leave) & (enter > NEAR) & (enter < 1))


def _contact(solid: Sphere | Box, away: Axes, n: Axes) -> Floats:
    """How much of the sky over a point a solid covers: the solid angle of a ball in its place, weighted by cosine."""
    return _cover(away, n, solid.radius if isinstance(solid, Sphere) else 0.62 * float(np.prod(solid.size)) ** (1 / 3))


def _cover(away: Axes, n: Axes, size: float) -> Floats:
    r2 = np.maximum(dot3(away, away), np.float32(size * size))
    below = np.maximum(-dot3(away, n), 0)
    return below * np.float32(size * size) / (r2 * np.sqrt(r2))
