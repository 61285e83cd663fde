"""Where rays meet solids: the nearest depth and the face hit, over the part of the picture a solid can touch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.caster.solids import Box, Rect, Room, Sphere

Floats = NDArray[np.floating]  # float32 unless said
Axes = Sequence[Floats | np.floating]  # a vector, axis by axis
NEAR = np.float32(1e-3)
TINY = np.float32(1e-30)  # keeps a ray along an axis from dividing by zero; lost in the rounding of any other


def vec3(v: NDArray[np.float64]) -> tuple[float, float, float]:
    """Three plain floats."""
    return (float(v[0]), float(v[1]), float(v[2]))


def dot3(a: Axes, b: Axes) -> Floats:
    """a . b of vectors given axis by axis."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def dot(p: Axes, axis: tuple[float, float, float]) -> Floats:
    """p . axis, skipping axes that are zero: most faces are axis-aligned."""
    terms = [p[a] if axis[a] == 1 else p[a] * np.float32(axis[a]) for a in range(3) if axis[a] != 0]
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return np.asarray(total)


def screen(
    solid: Room | Box | Sphere | Rect,
    cam_from_world: NDArray[np.float64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
) -> tuple[slice, slice] | None:
    """The part of the band that a solid's bounding ball can touch, as slices; None when it is out of sight."""
    if isinstance(solid, Room):
        return slice(None), slice(None)
    if isinstance(solid, Sphere):
        radius = solid.radius
    elif isinstance(solid, Box):
        radius = float(np.linalg.norm(solid.size)) / 2
    else:
        radius = float(np.hypot(np.linalg.norm(solid.right), np.linalg.norm(solid.up)))
    c = cam_from_world[:, :3] @ np.array(solid.centre) + cam_from_world[:, 3]
    near, far = c[2] - radius, c[2] + radius
    if far <= NEAR:
        return None
    if near <= NEAR:
        return slice(None), slice(None)
    slices = []
    for rays, at in ((y, c[1]), (x, c[0])):
        lo = (at - radius) / (near if at < radius else far)
        hi = (at + radius) / (near if at > -radius else far)
        first, last = np.searchsorted(rays, lo), np.searchsorted(rays, hi)
        if first >= last:
            return None
        slices.append(slice(first, last))
    return slices[0], slices[1]


def _hit_room(room: Room, first: int, o: Axes, d: Axes, depth: Floats, face: NDArray[np.int32]) -> None:
    for axis in range(3):
        up = d[axis] > 0
        t = (np.where(up, np.float32(room.hi[axis]), np.float32(room.lo[axis])) - o[axis]) / d[axis]
        nearer = t < depth
        np.copyto(depth, t, where=nearer)
        np.copyto(face, up + np.int32(first + 2 * axis), where=nearer)


def _hit_box(box: Box, first: int, o: Axes, d: Axes, depth: Floats, face: NDArray[np.int32]) -> None:
    o, d = box_frame(box, [o[a] - np.float32(box.centre[a]) for a in range(3)], d)
    enter, leave, side = np.float32(-np.inf), np.float32(np.inf), np.int32(0)
    for axis in range(3):
        inv = 1 / d[axis]
        half = np.float32(box.size[axis] / 2) * np.abs(inv)
        mid = -o[axis] * inv
        a, b = mid - half, mid + half
        low = (d[axis] < 0) + np.int32(first + 2 * axis)  # moving up the axis it enters by the low side
        side = np.where(a > enter, low, side)
        enter, leave = np.maximum(enter, a), np.minimum(leave, b)
    hit = (enter < leave) & (enter > NEAR) & (enter < depth)
    np.copyto(depth, enter, where=hit)
    np.copyto(face, side, where=hit)


def box_frame(box: Box, o: Axes, d: Axes) -> tuple[Axes, Axes]:
    """Points (from the box's centre) and directions, turned into the box's own axes."""
    if box.yaw_deg == 0:
        return o, d
    c, s = np.float32(np.cos(np.radians(box.yaw_deg))), np.float32(np.sin(np.radians(box.yaw_deg)))
    turned = [c * d[0] + s * d[1] + TINY, c * d[1] - s * d[0] + TINY, d[2]]
    return [c * o[0] + s * o[1], c * o[1] - s * o[0], o[2]], turned


def _hit_sphere(ball: Sphere, first: int, o: Axes, d: Axes, depth: Floats, face: NDArray[np.int32]) -> None:
    q = [np.float32(o[a] - np.float32(ball.centre[a])) for a in range(3)]
    a, b = dot3(d, d), dot3(d, q)
    c = np.float32(float(q[0]) ** 2 + float(q[1]) ** 2 + float(q[2]) ** 2 - ball.radius**2)
    inside = b * b - a * c
    t = (-b - np.sqrt(inside)) / a
    hit = (inside > 0) & (t > NEAR) & (t < depth)
    np.copyto(depth, t, where=hit)
    np.copyto(face, np.int32(first), where=hit)


def _hit_rect(rect: Rect, first: int, o: Axes, d: Axes, depth: Floats, face: NDArray[np.int32]) -> None:
    right, up = np.array(rect.right), np.array(rect.up)
    n = vec3(np.cross(right, up))
    q = [np.float32(rect.centre[a]) - o[a] for a in range(3)]
    t = np.float32(sum(float(q[a]) * n[a] for a in range(3))) / dot(d, n)
    away = [t * d[a] - q[a] for a in range(3)]
    u, v = dot(away, vec3(right / (right @ right))), dot(away, vec3(up / (up @ up)))
    hit = (np.abs(u) < 1) & (np.abs(v) < 1) & (t > NEAR) & (t < depth)
    np.copyto(depth, t, where=hit)
    np.copyto(face, np.int32(first), where=hit)


HIT = {Room: _hit_room, Box: _hit_box, Sphere: _hit_sphere, Rect: _hit_rect}
