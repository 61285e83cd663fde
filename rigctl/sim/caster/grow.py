"""From what a scene file says to parts: single solids as they are, many by a seed. The same seed, the same parts."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.caster.parts import Parts
from spikerig.rigctl.sim.caster.pattern import Texture
from spikerig.rigctl.sim.caster.solids import (
    Box,
    Bricks,
    Cylinder,
    Ellipsoid,
    Plant,
    Rect,
    Room,
    Scatter,
    Solid,
    Sphere,
)
from spikerig.rigctl.sim.draws import stream

Floats = NDArray[np.float64]
GOLDEN = np.pi * (3 - np.sqrt(5))
UP = np.array([0.0, 0.0, 1.0])


@lru_cache(maxsize=4096)
def parts_of(solid: Solid) -> tuple[Parts, ...]:
    """The parts of a solid; none for a room."""
    if isinstance(solid, Room):
        return ()
    if isinstance(solid, Scatter):
        return (_scatter(solid),)
    if isinstance(solid, Bricks):
        return _bricks(solid)
    if isinstance(solid, Plant):
        return _plant(solid)
    if isinstance(solid, Rect):
        right, up = np.array(solid.right), np.array(solid.up)
        normal = np.cross(right, up)
        return (_single("rect", solid.centre, [right, up, normal / np.linalg.norm(normal)], solid.texture),)
    if isinstance(solid, Cylinder):
        base, top = np.array(solid.base), np.array(solid.top)
        axes = upright((top - base)[None] / 2)[0] * [[solid.radius], [solid.radius], [1.0]]
        return (_single("rod", (base + top) / 2, axes, solid.texture),)
    if isinstance(solid, Sphere):
        return (_single("ball", solid.centre, np.eye(3) * solid.radius, solid.texture),)
    radii = np.array(solid.radii) if isinstance(solid, Ellipsoid) else np.array(solid.size) / 2
    axes = yaw(np.radians([solid.yaw_deg]))[0] * radii[:, None]
    return (_single("box" if isinstance(solid, Box) else "ball", solid.centre, axes, solid.texture),)


def _single(shape: str, centre: object, axes: object, texture: Texture) -> Parts:
    one = np.asarray(centre, np.float64)[None], np.asarray(axes, np.float64)[None]
    return Parts(shape, *one, texture, np.ones((1, 3), np.float32), np.zeros((1, 2), np.float32))


def yaw(angle: Floats) -> Floats:
    """Axes (rows) turned about the vertical, [N,3,3]."""
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.stack([c, s, zero, -s, c, zero, zero, zero, one], 1).reshape(-1, 3, 3)


def upright(third: Floats) -> Floats:
    """Axes (rows) whose third is given, [N,3,3]: first and second of unit length, the first horizontal."""
    unit = third / np.linalg.norm(third, axis=1, keepdims=True)
    first = np.cross(UP, unit)
    size = np.linalg.norm(first, axis=1, keepdims=True)
    first = np.where(size > 1e-9, first / np.maximum(size, 1e-9), [1.0, 0.0, 0.0])
    return np.stack([first, np.cross(unit, first), third], 1)


def _directions(rng: np.random.Generator, n: int) -> Floats:
    """Unit vectors spread evenly over all directions."""
    z, azimuth = rng.uniform(-1, 1, n), rng.uniform(0, 2 * np.pi, n)
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], 1)


def _turned(axes: Floats, angle: Floats) -> Floats:
    """Axes turned about their third by angles."""
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return np.stack([c * axes[:, 0] + s * axes[:, 1], c * axes[:, 1] - s * axes[:, 0], axes[:, 2]], 1)


def _lean(rng: np.random.Generator, third: Floats, most_deg: float) -> Floats:
    """Unit vectors leaning by up to an angle from given ones, to any side."""
    n = len(third)
    frame = _turned(upright(third), rng.uniform(0, 2 * np.pi, n))
    lean = np.radians(rng.uniform(0, most_deg, n))[:, None]
    return np.cos(lean) * third + np.sin(lean) * frame[:, 0]


def _tints(rng: np.random.Generator, n: int, shade: tuple[float, float], palette: tuple) -> NDArray[np.float32]:
    level = rng.uniform(*shade, n)[:, None]
    colours = np.array(palette or ((1.0, 1.0, 1.0),))
    return (colours[rng.integers(0, len(colours), n)] * level).astype(np.float32)


def _shifts(rng: np.random.Generator, n: int, texture: Texture) -> NDArray[np.float32]:
    return np.rint(rng.uniform(0, 64, (n, 2))).astype(np.float32) * np.float32(texture.size)


def _scatter(spec: Scatter) -> Parts:
    rng, n, middle, spread = stream(spec.seed, "scatter"), spec.count, np.array(spec.centre), np.array(spec.spread)
    if spec.layout == "line":
        spots = np.linspace(-1, 1, n)[:, None] * np.ones(3) if n > 1 else np.zeros((1, 3))
    elif spec.layout == "box":
        spots = rng.uniform(-1, 1, (n, 3))
    else:
        spots = _directions(rng, n) * (rng.uniform(0, 1, (n, 1)) ** (1 / 3) if spec.layout == "ball" else 1)
    centre = middle + spots * spread
    if spec.facing == "any":
        third = _directions(rng, n)
    elif spec.facing == "up":
        third = np.tile(UP, (n, 1))
    else:
        away = centre - middle
        size = np.linalg.norm(away, axis=1, keepdims=True)
        third = np.where(size > 1e-9, away / np.maximum(size, 1e-9), UP)
    axes = _turned(upright(_lean(rng, third, spec.lean_deg)), rng.uniform(0, 2 * np.pi, n))
    edges = np.array(spec.size) / 2 * (1 + spec.vary * rng.uniform(-1, 1, (n, 1)))
    if spec.shape == "rect":
        edges[:, 2] = 1
    tint = _tints(rng, n, spec.shade, spec.palette)
    return Parts(spec.shape, centre, axes * edges[:, :, None], spec.texture, tint, _shifts(rng, n, spec.texture))


def _hill(rng: np.random.Generator, cells: tuple[int, int]) -> Floats:
    """Smooth random numbers over a grid, 0 to 1: lowest 0, greatest 1."""
    x, y = (np.linspace(-1, 1, n) if n > 1 else np.zeros(1) for n in cells)
    x, y = np.meshgrid(x, y, indexing="ij")
    hill = 1.2 * (1 - (x * x + y * y) / 2)
    for _ in range(6):
        a, b, phase = rng.uniform(-4, 4), rng.uniform(-4, 4), rng.uniform(0, 2 * np.pi)
        hill += rng.uniform(0.1, 0.4) * np.cos(a * x + b * y + phase)
    span = hill.max() - hill.min()
    return (hill - hill.min()) / span if span > 0 else np.ones(cells)


def _bricks(spec: Bricks) -> tuple[Parts, ...]:
    rng, cells = stream(spec.seed, "bricks"), (int(spec.cells[0]), int(spec.cells[1]))
    lo, hi = spec.layers
    height = np.rint(lo + (hi - lo) * _hill(rng, cells)).astype(int)
    found = [brick for layer in range(height.max(initial=0)) for brick in _layer(rng, height, layer)]
    boxes = np.array(found, np.float64).reshape(-1, 5)  # x, y, wide, deep, layer
    i, j = np.nonzero(height)
    edges = np.array(spec.size)
    middle = [(boxes[:, :2] + boxes[:, 2:4] / 2 - np.array(cells) / 2) * edges[:2], (boxes[:, 4:] + 0.5) * edges[2]]
    half = np.concatenate([boxes[:, 2:4] - spec.gap, np.ones((len(boxes), 1))], 1) * edges / 2
    turn = yaw(np.radians([spec.yaw_deg]))[0]
    made = []
    tint = _tints(rng, len(boxes), spec.shade, spec.palette)
    if len(boxes):
        centre = np.array(spec.base) + np.concatenate(middle, 1) @ turn
        shift = _shifts(rng, len(boxes), spec.texture)
        made.append(Parts("box", centre, turn * half[:, :, None], spec.texture, tint, shift))
    if spec.stud[0] > 0 and len(i):
        owner = np.full((*cells, height.max()), 0)
        for k, (x, y, wide, deep, layer) in enumerate(boxes.astype(int)):
            owner[x : x + wide, y : y + deep, layer] = k
        tall = spec.stud[1] * edges[2]
        at = np.stack([(i + 0.5 - cells[0] / 2) * edges[0], (j + 0.5 - cells[1] / 2) * edges[1]], 1)
        up = height[i, j, None] * edges[2] + tall / 2
        wide = spec.stud[0] * edges[:2].min()
        axes = np.tile(turn * np.array([[wide], [wide], [tall / 2]]), (len(i), 1, 1))
        centre = np.array(spec.base) + np.concatenate([at, up], 1) @ turn
        colours = tint[owner[i, j, height[i, j] - 1]]
        made.append(Parts("rod", centre, axes, spec.texture, colours, np.zeros((len(i), 2), np.float32)))
    return tuple(made)


def _layer(rng: np.random.Generator, height: NDArray[np.int_], layer: int) -> list[tuple[int, int, int, int, int]]:
    """Bricks that fill the cells of a layer: x, y, wide, deep, layer. Those that nobody can see are left out."""
    free, found = height > layer, []
    for x, y in np.argwhere(free):
        if not free[x, y]:
            continue
        sizes = [(int(wide), int(deep)) for wide, deep in rng.permutation([(2, 2), (2, 1), (1, 2), (1, 1)])]
        wide, deep = next(s for s in sizes if (b := free[x : x + s[0], y : y + s[1]]).shape == s and b.all())
        free[x : x + wide, y : y + deep] = False
        around = height[max(x - 1, 0) : x + wide + 1, max(y - 1, 0) : y + deep + 1]
        edge = x == 0 or y == 0 or x + wide == len(height) or y + deep == height.shape[1]
        if edge or around.min() <= layer + 1:
            found.append((int(x), int(y), wide, deep, layer))
    return found


def _plant(spec: Plant) -> tuple[Parts, Parts]:
    rng, foot, n = stream(spec.seed, "plant"), np.array(spec.foot), spec.branches
    start, end, thick = [foot], [foot + UP * spec.height], [spec.trunk]
    twigs = []
    for k in range(n):
        share = 0.25 + 0.75 * (k + 0.5) / n
        azimuth = GOLDEN * k + rng.uniform(-0.3, 0.3)
        rise = np.radians(spec.rise_deg + rng.uniform(-15, 15))
        ahead = np.array([np.cos(azimuth) * np.cos(rise), np.sin(azimuth) * np.cos(rise), np.sin(rise)])
        at, length = foot + UP * spec.height * share, spec.reach * (1 - 0.6 * share) * rng.uniform(0.8, 1.2)
        for step in range(3):  # bends outward and thins out
            ahead = ahead + 0.25 * _directions(rng, 1)[0] - UP * 0.12 * spec.droop
            ahead /= np.linalg.norm(ahead)
            start.append(at)
            at = at + ahead * length / 3
            end.append(at)
            thick.append(spec.trunk * (0.5, 0.35, 0.22)[step])
            twigs.append((start[-1], at))
    a, b = np.array(start), np.array(end)
    axes = upright((b - a) / 2) * np.stack([thick, thick, np.ones(len(thick))], 1)[:, :, None]
    plain = np.ones((len(a), 3), np.float32), np.zeros((len(a), 2), np.float32)
    return Parts("rod", (a + b) / 2, axes, spec.bark, *plain), _leaves(spec, rng, np.array(twigs))


def _leaves(spec: Plant, rng: np.random.Generator, twigs: Floats) -> Parts:
    """Leaves along twigs float64[M,2,3], outward and drooping, their faces mostly up."""
    n = spec.leaves
    pick = rng.integers(0, len(twigs), n)
    a, b = twigs[pick, 0], twigs[pick, 1]
    ahead = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    stalk = a + (b - a) * rng.uniform(0.1, 1.05, (n, 1))
    out = ahead + 0.9 * _directions(rng, n) - UP * spec.droop
    out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-9)
    face = UP + 0.7 * _directions(rng, n)
    second = np.cross(face, out)
    second /= np.maximum(np.linalg.norm(second, axis=1, keepdims=True), 1e-9)
    size = np.array(spec.leaf_size) / 2 * (1 + 0.3 * rng.uniform(-1, 1, (n, 1)))
    centre = stalk + out * (size[:, :1] + 0.4 * spec.trunk)
    axes = np.stack([out * size[:, :1], second * size[:, 1:], np.cross(out, second)], 1)
    tint = _tints(rng, n, spec.shade, ())
    return Parts("rect", centre, axes, spec.leaf, tint, _shifts(rng, n, spec.leaf))
