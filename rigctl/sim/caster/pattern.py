"""Procedural textures: albedo as a function of surface coordinates, in linear light, float32, vectorised."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.limits import limits

Floats = NDArray[np.floating]  # float32 unless said
KINDS = ("plain", "tiles", "checker", "stripes", "noise", "star", "edge", "weave")
CUTS = ("none", "leaf", "disc", "mesh", "grille")
CELLS = 64  # tiles, noise and threads repeat after this many cells
SIDES, DIVES = 0.7, 0.4  # how dark a thread gets at its sides, and where it dives under another


@dataclass(frozen=True, slots=True)
class Texture:
    """What a surface looks like.

    Args:
        kind: plain (a), tiles (random colour a cell), checker (a and b), stripes (a to b, a cosine along u turned by
            `angle_deg`), noise (value noise a to b, two octaves), star (Siemens star of `spokes`, on b), edge (a | b,
            slanted by `angle_deg`), weave (plain weave of round threads: a runs along v, b along u, one a cell).
        size: edge of a cell or the period, in world units.
        a, b: linear reflectances (r, g, b).
        luma, chroma: ranges of a tile's luma (Rec.601 of linear light) and chroma; hue is uniform. Each thread of a
            weave is times a number from the range `luma`.
        tint: multiplies all of it (r, g, b): tiles and patterns of one hue.
        spokes: pairs of the star.
        seed: of tiles and noise; the world does not change with the scene's seed.
        emit: light given off, as a multiple of the albedo; > 0 makes a lamp (HDR when the product exceeds 1).
        cut: what is cut away, and seen and lit through: none, all but a pointed `leaf` or an ellipse (`disc`) on a
            panel, the square holes of a `mesh`, the round holes of a `grille`.
        cut_size: from hole to hole; on round solids the nearest that closes around them.
        open: share of a mesh or grille that is hole.
        gloss: mirror reflectance seen head-on (plastic 0.04, metal 0.9); 0 is matt. Mirrors show the room (or the sky)
            and the lamp, no solids.
        rough: width of the lamp's highlight and blur of the mirror; GGX-like alpha is its square.
        metal: 1 gives the mirror the texture's colour and takes the matt part away.
    """

    kind: str = limits("plain", choices=KINDS)
    size: float = limits(0.4, 1e-3, 1e3, "world units")
    a: tuple[float, float, float] = limits((0.8, 0.8, 0.8), 0, 1)
    b: tuple[float, float, float] = limits((0.1, 0.1, 0.1), 0, 1)
    luma: tuple[float, float] = limits((0.15, 0.75), 0, 1)
    chroma: tuple[float, float] = limits((0.0, 0.1), 0, 1)
    tint: tuple[float, float, float] = limits((1.0, 1.0, 1.0), 0, 1)
    angle_deg: float = limits(0.0, -360, 360, "degrees")
    spokes: int = limits(18, 1, 1000)
    seed: int = limits(0, 0, 2**32 - 1)
    emit: float = limits(0.0, 0, 1e9)
    cut: str = limits("none", choices=CUTS)
    cut_size: float = limits(0.02, 1e-4, 1e3, "world units")
    open: float = limits(0.5, 0.01, 0.9)
    gloss: float = limits(0.0, 0, 1)
    rough: float = limits(0.3, 0.1, 1)
    metal: float = limits(0.0, 0, 1)


def lattice(texture: Texture) -> Floats:
    """What patterns look up: float32[3, CELLS*CELLS] tile colours, [1, CELLS*CELLS] noise, [2, CELLS] threads."""
    rng = np.random.default_rng(np.random.SeedSequence([texture.seed, KINDS.index(texture.kind)]))
    n = CELLS * CELLS
    if texture.kind == "noise":
        return rng.random((1, n), dtype=np.float32)
    if texture.kind == "weave":
        return rng.uniform(*texture.luma, (2, CELLS)).astype(np.float32)
    if texture.kind != "tiles":
        return np.zeros((3, 0), np.float32)
    luma = rng.uniform(*texture.luma, n)
    chroma = rng.uniform(*texture.chroma, n)
    hue = rng.uniform(0, 2 * np.pi, n)
    # Red and blue move on a circle, green keeps the Rec.601 luma where it was; then chroma gives way to the gamut.
    red, blue = chroma * np.cos(hue), chroma * np.sin(hue)
    offset = np.stack([red, -(0.299 * red + 0.114 * blue) / 0.587, blue])
    room = np.where(offset > 0, (1 - luma) / np.maximum(offset, 1e-9), luma / np.maximum(-offset, 1e-9)).min(0)
    return ((luma + offset * np.minimum(room, 1)) * np.array(texture.tint)[:, None]).astype(np.float32)


def albedo(texture: Texture, table: Floats, u: Floats, v: Floats) -> Floats:
    """Reflectance at surface coordinates.

    Args:
        texture: what to draw.
        table: `lattice(texture)`.
        u, v: float32[n], world units on the surface.

    Returns:
        float32[3,n], linear, 0 to 1.

    Cost:
        About 10 ns a point for tiles, less for the plain kinds.
    """
    if texture.kind == "plain":
        return np.broadcast_to((np.array(texture.a) * texture.tint).astype(np.float32)[:, None], (3, u.size))
    if texture.kind == "tiles":
        return np.take(table, _cell(u, v, texture.size), axis=1)
    if texture.kind == "weave":
        return _weave(texture, table, u, v)
    return _mix(texture, _weight(texture, table, u, v))


def _mix(texture: Texture, weight: Floats) -> Floats:
    a, b = ((np.array(c) * texture.tint).astype(np.float32) for c in (texture.a, texture.b))
    return b[:, None] + (a - b)[:, None] * weight[None]


def _cell(u: Floats, v: Floats, size: float) -> NDArray[np.int32]:
    scale = np.float32(1 / size)
    i = np.floor(u * scale).astype(np.int32) & (CELLS - 1)
    j = np.floor(v * scale).astype(np.int32) & (CELLS - 1)
    return (i << 6) | j


def _weight(texture: Texture, table: Floats, u: Floats, v: Floats) -> Floats:
    """How much of colour a (1) against b (0) there is at each point, float32[n]."""
    scale = np.float32(1 / texture.size)
    if texture.kind == "checker":
        return ((np.floor(u * scale) + np.floor(v * scale)).astype(np.int32) & 1).astype(np.float32)
    turn = np.radians(texture.angle_deg)
    along = u * np.float32(np.cos(turn)) + v * np.float32(np.sin(turn))
    if texture.kind == "stripes":
        return np.float32(0.5) + np.float32(0.5) * np.cos(along * np.float32(2 * np.pi / texture.size))
    if texture.kind == "edge":
        return (along > 0).astype(np.float32)
    if texture.kind == "star":
        spoke = np.arctan2(v, u) * np.float32(texture.spokes / np.pi)
        inside = u * u + v * v < np.float32((texture.size / 2) ** 2)
        return (((np.floor(spoke).astype(np.int32) & 1) == 0) & inside).astype(np.float32)
    coarse = _noise(table, u * scale, v * scale)
    fine = _noise(table, u * (2 * scale) + np.float32(17), v * (2 * scale) + np.float32(29))
    return coarse * np.float32(2 / 3) + fine * np.float32(1 / 3)


def _weave(texture: Texture, table: Floats, u: Floats, v: Floats) -> Floats:
    """Threads over and under each other: a thread is darker towards its sides and where it dives under."""
    scale = np.float32(1 / texture.size)
    x, y = u * scale, v * scale
    i, j = np.floor(x), np.floor(y)
    x, y = x - i - np.float32(0.5), y - j - np.float32(0.5)
    i, j = i.astype(np.int32), j.astype(np.int32)
    top = ((i + j) & 1).astype(bool)  # the thread along v (colour a, one a column) is on top
    across, along = np.where(top, x, y), np.where(top, y, x)
    shade = (1 - np.float32(4 * SIDES) * across * across) * (1 - np.float32(4 * DIVES) * along * along)
    shade *= np.where(top, table[0].take(i & (CELLS - 1)), table[1].take(j & (CELLS - 1)))
    a, b = ((np.array(c) * texture.tint).astype(np.float32)[:, None] for c in (texture.a, texture.b))
    return np.where(top, a, b) * shade


def _noise(table: Floats, x: Floats, y: Floats) -> Floats:
    fx, fy = np.floor(x), np.floor(y)
    i, j = fx.astype(np.int32), fy.astype(np.int32)
    x, y = x - fx, y - fy
    x, y = x * x * (3 - 2 * x), y * y * (3 - 2 * y)
    wrap = CELLS - 1
    i0, i1, j0, j1 = (i & wrap) << 6, ((i + 1) & wrap) << 6, j & wrap, (j + 1) & wrap
    flat = table[0]
    low = flat[i0 | j0] + (flat[i0 | j1] - flat[i0 | j0]) * y
    high = flat[i1 | j0] + (flat[i1 | j1] - flat[i1 | j0]) * y
    return low + (high - low) * x
