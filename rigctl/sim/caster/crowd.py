"""Parts made ready for casting: which rays can touch which, where they hit, what lies between them and the lamp."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.caster.hits import NEAR, TINY, Axes, Floats, dot3, vec3
from spikerig.rigctl.sim.caster.parts import SIDES, Ints, Parts, Vector, inner_normal, meet, present, surface
from spikerig.rigctl.sim.caster.solids import Vec3

PAIRS = 1 << 17  # of a ray and a part, taken at once: they stay in the second-level cache
CELLS = 128  # of the lamp's view of a crowd, along each axis
BEFORE = np.float32(1 - 1e-3)  # what is nearer to a point than this share of its way to the lamp is the point itself


class Crowd:
    """Parts, and the tables that casting looks up.

    Args:
        parts: the solids.
        first: number of the first side of the first part among a stage's faces.
    """

    def __init__(self, parts: Parts, first: int = 0) -> None:
        self.parts, self.first = parts, first
        self.local = parts.local.astype(np.float32)
        self.centre = parts.centre.astype(np.float32)
        self.hollow = parts.sides > SIDES[parts.shape]

    def hit(
        self,
        cam_from_world: NDArray[np.float64],
        x: NDArray[np.float64],
        y: NDArray[np.float64],
        depth: Floats,
        face: NDArray[np.int32],
    ) -> None:
        """Enter the nearest hits of a grid of camera rays into the depth and face they have so far.

        Args:
            cam_from_world: float64[3,4].
            x, y: slopes of the rays, increasing, float64[W] and [H].
            depth, face: [H,W], changed in place.
        """
        R = cam_from_world[:, :3]
        lo, hi = bounds(self.parts, cam_from_world)
        x0, x1 = np.searchsorted(x, lo[:, 0]), np.searchsorted(x, hi[:, 0], "right")
        y0, y1 = np.searchsorted(y, lo[:, 1]), np.searchsorted(y, hi[:, 1], "right")
        seen = np.flatnonzero((x1 > x0) & (y1 > y0))
        if len(seen) == 0:
            return
        part, row = runs(y0[seen], y1[seen])
        part = seen[part]
        # A ray is R0 x + R1 y + R2, so in a part's own axes it is linear in x along a row.
        start = np.einsum("nij,nj->ni", self.parts.local, -R.T @ cam_from_world[:, 3] - self.parts.centre)
        step, down, ahead = (self.parts.local @ R[k] for k in range(3))
        begin = (ahead[part] + down[part] * y[row][:, None]).astype(np.float32).T
        start32, step32, x32 = start.astype(np.float32), step.astype(np.float32), x.astype(np.float32)
        depth, face = depth.reshape(-1), face.reshape(-1)
        width = x1[part] - x0[part]
        for some in pieces(width):
            run, column = runs(x0[part[some]], x1[part[some]])
            who = part[some][run]
            slope = x32[column]
            d = axes3(begin[k][some][run] + step32[:, k][who] * slope + TINY for k in range(3))
            o = axes3(start32[:, k][who] for k in range(3))
            ray = (row[some] * len(x))[run] + column
            self._keep(who, o, d, ray, depth, face)

    def _keep(self, who: Ints, o: Vector, d: Vector, ray: Ints, depth: Floats, face: NDArray[np.int32]) -> None:
        for part, t, side, at in self._hits(who, o, d, depth[ray]):
            rays = ray[at]
            np.minimum.at(depth, rays, t)
            first = t == depth[rays]  # of two parts at the same depth the later one shows
            face[rays[first]] = self.first + part[first] * self.parts.sides + side[first]

    def _hits(self, who: Ints, o: Vector, d: Vector, limit: Floats) -> Iterator[tuple[Ints, Floats, Ints, Ints]]:
        """Hits beyond NEAR and before a limit: part, distance, side, and which line; first near, then far ones."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            t0, near, t1, far = meet(self.parts.shape, o, d)
        for t, side in ((t0, near), (t1, far + SIDES[self.parts.shape])) if self.hollow else ((t0, near),):
            at = np.flatnonzero((t > NEAR) & (t < limit))
            part, t, side = who[at], t[at], side[at]
            if self.parts.texture.cut != "none":
                q = axes3(o[k][at] + t * d[k][at] for k in range(3))
                there = present(self.parts, part, q, side)
                at, part, t, side = at[there], part[there], t[there], side[there]
            yield part, t, side.astype(np.int32), at

    @cached_property
    def blob(self) -> tuple[Vec3, float]:
        """Centre and radius of the ball that covers as much sky as the parts do, seen from afar."""
        h = self.parts.half
        size = {"rect": np.sqrt(2 / np.pi * h[:, 0] * h[:, 1]), "rod": np.cbrt(1.5 * h.prod(1))}
        each = size.get(self.parts.shape, np.cbrt(h.prod(1)) * (1.24 if self.parts.shape == "box" else 1))
        c = self.parts.centre
        middle = c.mean(0)
        whole = float(np.sqrt(((c - middle) ** 2).sum(1).mean()) + each.mean())
        return vec3(middle), min(float(np.sqrt((each**2).sum())), whole)

    def shadowed(self, lamp: Vec3, p: Axes) -> NDArray[np.bool_]:
        """Whether parts lie between points (float32[n] an axis) and a lamp."""
        lamp32 = np.array(lamp, np.float32)
        away = axes3(p[k] - lamp32[k] for k in range(3))
        start = np.einsum("nij,nj->ni", self.parts.local, np.array(lamp) - self.parts.centre).astype(np.float32)
        dark = np.zeros(len(away[0]), bool)
        for point, who in self._candidates(lamp, away):
            M = self.local[who]
            d = axes3(dot3(list(M[:, k].T), [c[point] for c in away]) + TINY for k in range(3))
            o = axes3(start[:, k][who] for k in range(3))
            for _, _, _, at in self._hits(who, o, d, np.broadcast_to(BEFORE, point.shape)):
                dark[point[at]] = True
        return dark

    def _candidates(self, lamp: Vec3, away: Vector) -> Iterator[tuple[Ints, Ints]]:
        """Pairs of points and parts that may lie before them, some at a time."""
        grid = self._grid(lamp)
        if grid is None:  # the lamp is among the parts
            everyone = np.arange(len(self.parts))
            for some in pieces(np.full(len(away[0]), len(self.parts))):
                yield np.repeat(some, len(everyone)), np.tile(everyone, len(some))
            return
        R, lo, scale, begin, member = grid
        R32 = R.astype(np.float32)
        z = dot3(R32[2], away)
        cell = np.zeros(z.shape, np.int64)
        inside = z > 0
        with np.errstate(divide="ignore", invalid="ignore"):
            for k in (1, 0):
                at = (dot3(R32[k], away) / z - lo[k]) * scale[k]
                inside &= (at >= 0) & (at < CELLS)
                cell = cell * CELLS + np.where(inside, at, 0).astype(np.int64)
        points = np.flatnonzero(inside)
        points = points[begin[cell[points] + 1] > begin[cell[points]]]
        for some in pieces(begin[cell[points] + 1] - begin[cell[points]]):
            run, slot = runs(begin[cell[points[some]]], begin[cell[points[some]] + 1])
            yield points[some][run], member[slot]

    def _grid(self, lamp: Vec3) -> tuple[Floats, Floats, Floats, Ints, Ints] | None:
        """The lamp's view of the parts in cells: rotation, corner, cells a slope, and each cell's parts."""
        if lamp in self._grids:
            return self._grids[lamp]
        ahead = self.parts.centre.mean(0) - lamp
        self._grids[lamp] = None
        if np.linalg.norm(ahead) > 0:
            ahead = ahead / np.linalg.norm(ahead)
            right = np.cross(ahead, np.eye(3)[np.argmin(np.abs(ahead))])
            right /= np.linalg.norm(right)
            R = np.stack([right, np.cross(ahead, right), ahead])
            lo, hi = bounds(self.parts, np.concatenate([R, -(R @ np.array(lamp))[:, None]], 1))
            if np.isfinite(lo).all() and np.isfinite(hi).all():
                corner, far = lo.min(0), hi.max(0)
                scale = CELLS / (1.001 * (far - corner) + 1e-9)
                first = np.floor((lo - corner) * scale).astype(int)
                last = np.minimum(np.floor((hi - corner) * scale).astype(int), CELLS - 1) + 1
                part, row = runs(first[:, 1], last[:, 1])
                some, column = runs(first[part, 0], last[part, 0])
                cell = row[some] * CELLS + column
                order = np.argsort(cell, kind="stable")
                begin = np.searchsorted(cell[order], np.arange(CELLS * CELLS + 1))
                self._grids[lamp] = R, corner, scale, begin, part[some][order]
        return self._grids[lamp]

    @cached_property
    def _grids(self) -> dict:
        return {}

    def read(self, number: Ints, p: Axes) -> tuple[Ints, Ints, Vector, tuple[Floats, Floats, Floats, Floats]]:
        """Part, side, place in the part's own axes, and `surface` of it, of points by their face number."""
        part, side = np.divmod(number - self.first, self.parts.sides)
        M, c = self.local[part], self.centre[part]
        away = [p[k] - c[:, k] for k in range(3)]
        q = axes3(dot3(list(M[:, k].T), away) for k in range(3))
        return part, side, q, surface(self.parts, part, q, side)

    def normals(self, part: Ints, side: Ints, q: Vector) -> Vector:
        """Unit normals of places in the parts' own axes, on the side that is seen."""
        inner = inner_normal(self.parts.shape, np.stack(q), side)
        M = self.local[part]
        n = [dot3(list(M[:, :, j].T), list(inner)) for j in range(3)]
        size = 1 / np.sqrt(dot3(n, n))
        return axes3(c * size for c in n)


def axes3(values: object) -> Vector:
    """Three arrays, axis by axis."""
    x, y, z = values  # type: ignore[misc]
    return x, y, z


def runs(first: Ints, last: Ints) -> tuple[Ints, Ints]:
    """All of first[k] .. last[k]-1 one after another: which k, and the number."""
    length = last - first
    which = np.repeat(np.arange(len(first)), length)
    return which, np.arange(len(which)) - np.repeat(np.cumsum(length) - length - first, length)


def pieces(length: Ints) -> Iterator[Ints]:
    """Consecutive index ranges whose lengths sum to about PAIRS at most."""
    total = np.cumsum(length)
    at = 0
    while at < len(length):
        done = total[at - 1] if at else 0
        end = max(int(np.searchsorted(total, done + PAIRS, "right")), at + 1)
        yield np.arange(at, end)
        at = end


def bounds(parts: Parts, cam_from_world: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Slopes (x/z, y/z) between which parts are seen, float64[N,2] each.

    Edges:
        A part behind the camera has no slopes between lowest (infinite) and highest (-infinite); one beside it has all.
    """
    R = cam_from_world[:, :3]
    c = parts.centre @ R.T + cam_from_world[:, 3]
    A = parts.axes @ R.T
    if parts.shape == "ball":
        # Planes x = k z touch an ellipsoid where (c_x - k c_z)^2 = |A_x - k A_z|^2.
        spread = np.sqrt((A[:, :, 2] ** 2).sum(1))
        near, far = c[:, 2] - spread, c[:, 2] + spread
        S = np.einsum("nki,nkj->nij", A, A)
        a = c[:, 2] ** 2 - S[:, 2, 2]
        b = c[:, :2] * c[:, 2:] - S[:, :2, 2]
        e = c[:, :2] ** 2 - np.stack([S[:, 0, 0], S[:, 1, 1]], 1)
        root = np.sqrt(np.maximum(b**2 - a[:, None] * e, 0))
        with np.errstate(divide="ignore", invalid="ignore"):
            lo, hi = (b - root) / a[:, None], (b + root) / a[:, None]
    else:
        signs = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
        if parts.shape == "rect":
            signs = signs[signs[:, 2] < 0] * [1, 1, 0]
        corners = c[:, None] + np.einsum("mk,nki->nmi", signs, A)
        near, far = corners[:, :, 2].min(1), corners[:, :, 2].max(1)
        with np.errstate(divide="ignore", invalid="ignore"):
            slopes = corners[:, :, :2] / corners[:, :, 2:]
        lo, hi = slopes.min(1), slopes.max(1)
    beside, behind = near <= NEAR, far <= NEAR
    lo[beside], hi[beside] = -np.inf, np.inf
    lo[behind], hi[behind] = np.inf, -np.inf
    return lo, hi
