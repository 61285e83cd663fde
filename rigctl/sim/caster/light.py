"""Ray casting of the analytic world: linear light and depth of a pinhole picture. NumPy, float32, no dependency."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.caster.crowd import Crowd
from spikerig.rigctl.sim.caster.gloss import glossy
from spikerig.rigctl.sim.caster.grow import parts_of
from spikerig.rigctl.sim.caster.hits import HIT, TINY, Axes, Floats, screen
from spikerig.rigctl.sim.caster.pattern import albedo, lattice
from spikerig.rigctl.sim.caster.shade import TEXELS, CrowdMap, Face, LightMap, crowd_map, faces_of, light_map
from spikerig.rigctl.sim.caster.solids import Box, Rect, Room, Solid, Sphere
from spikerig.rigctl.sim.caster.world import World

BAND = 32768  # rays cast at once: a band of rows that stays in the second-level cache


class Stage:
    """A world made ready for casting: faces numbered, pattern tables drawn, light maps made when first seen.

    Args:
        world: what to look at.

    Cost:
        `picture` takes 0.1 to 0.2 us a ray on one core, `light_map` 0.3 us a point once a face.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.faces: list[Face] = []
        self.solids: list[tuple[Room | Box | Sphere | Rect, int]] = []
        for solid in world.solids:
            if isinstance(solid, Room | Box | Sphere | Rect) and not _hollow(solid):
                self.solids.append((solid, len(self.faces)))
                self.faces += faces_of(solid)
        self.crowds: list[Crowd] = []
        count = len(self.faces)
        for parts in (parts for solid in world.solids if _many(solid) for parts in parts_of(solid)):
            self.crowds.append(Crowd(parts, count))
            count += len(parts) * parts.sides
        self.starts = np.array([crowd.first for crowd in self.crowds])
        longest = [max(f.hi[0] - f.lo[0], f.hi[1] - f.lo[1]) for f in self.faces]
        longest += [2 * float(crowd.parts.half.max()) for crowd in self.crowds if not longest]
        self.texel = max(longest, default=0) / TEXELS
        self._maps: dict[tuple[int, bool], LightMap] = {}
        self._crowd_maps: dict[int, tuple[CrowdMap, Floats]] = {}

    def picture(self, camera: Camera, cam_from_world: NDArray[np.float64], samples: int = 2) -> Floats:
        """Linear light of a picture, box-filtered over samples x samples rays a pixel.

        Args:
            camera: a pinhole; its distortion is not applied.
            cam_from_world: float64[3,4].
            samples: rays a pixel along each axis, >= 1.

        Returns:
            float32[H,W,3].
        """
        height, width, s = camera.height, camera.width, samples
        out = np.empty((height, width, 3), np.float32)
        rows = max(1, BAND // (width * s * s))
        for top in range(0, height, rows):
            h = min(rows, height - top)
            cells = self._band(camera, cam_from_world, s, top, h)[0].reshape(3, h, s, width, s)
            mean = cells[:, :, 0, :, 0].copy()
            for k in range(1, s * s):
                mean += cells[:, :, k // s, :, k % s]
            mean *= np.float32(1 / (s * s))
            out[top : top + h] = mean.transpose(1, 2, 0)
        return out

    def depth(self, camera: Camera, cam_from_world: NDArray[np.float64]) -> Floats:
        """Depth along z through the pixel centres, float32[H,W]; inf where nothing is hit."""
        return self._band(camera, cam_from_world, 1, 0, camera.height)[1]

    def _band(
        self, camera: Camera, cam_from_world: NDArray[np.float64], samples: int, top: int, rows: int
    ) -> tuple[Floats, Floats]:
        """Light float32[3,n] and depth float32[rows*samples, width*samples] of a band of pixel rows."""
        R = cam_from_world[:, :3]
        origin = -R.T @ cam_from_world[:, 3]
        K = camera.K
        x = ((np.arange(camera.width * samples) + 0.5) / samples - K[0, 2]) / K[0, 0]
        y = ((np.arange(rows * samples) + 0.5) / samples + top - K[1, 2]) / K[1, 1]
        across, down = (R[0, :, None] * x + R[2, :, None]).astype(np.float32), (R[1, :, None] * y).astype(np.float32)
        d = [across[a][None, :] + down[a][:, None] + TINY for a in range(3)]
        o = [np.float32(v) for v in origin]
        depth = np.full(d[0].shape, np.inf, np.float32)
        face = np.full(d[0].shape, -1, np.int32)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for solid, first in self.solids:
                part = screen(solid, cam_from_world, x, y)
                if part is not None:
                    HIT[type(solid)](solid, first, o, [c[part] for c in d], depth[part], face[part])
            for crowd in self.crowds:
                crowd.hit(cam_from_world, x, y, depth, face)
        return self._light(o, d, depth, face), depth

    def _light(self, o: Axes, d: Axes, depth: Floats, face: NDArray[np.int32]) -> Floats:
        light = np.empty((3, face.size), np.float32)
        flat, t = face.reshape(-1), depth.reshape(-1)
        d = [c.reshape(-1) for c in d]
        owner = flat
        if self.crowds:  # a crowd is one owner, however many sides its parts have
            owner = np.where(
                flat < self.starts[0], flat, np.searchsorted(self.starts, flat, "right") + len(self.faces) - 1
            )
        for number in np.flatnonzero(np.bincount(owner + 1)) - 1:
            here = np.flatnonzero(owner == number)
            if number < 0:
                light[:, here] = np.array(self.world.sky, np.float32)[:, None]
                continue
            reach = t.take(here)
            p = [o[a] + reach * d[a].take(here) for a in range(3)]
            if number < len(self.faces):
                colour = self._reflected(int(number), p, o)
            else:
                colour = self._crowded(int(number) - len(self.faces), flat.take(here), p, o)
            for a in range(3):
                light[a][here] = colour[a]
        return light

    def _reflected(self, number: int, p: Axes, o: Axes, matt: bool = False) -> Floats:
        """Light float32[3,n] that points of one face send to a camera at `o`; without gloss where `matt`."""
        face, world = self.faces[number], self.world
        u, v = face.coordinates(p)
        colour = albedo(face.texture, face.table, u, v)
        if face.texture.emit > 0:
            return colour * np.float32(face.texture.emit)
        normal = face.normal or (0.0, 0.0, 0.0)
        flip = sum((float(o[a]) - face.centre[a]) * normal[a] for a in range(3)) < 0
        if (number, flip) not in self._maps:
            self._maps[number, flip] = light_map(world, face, flip, self.texel, self.crowds)
        light = self._maps[number, flip].at(u, v)
        if face.texture.gloss > 0 and not matt:
            return glossy(world, face.texture, colour, p, face.normals(p, flip), o, light, self._around(o))
        return _matt(world, colour, light)

    def _crowded(self, number: int, faces: NDArray[np.int32], p: Axes, o: Axes) -> Floats:
        """Light float32[3,n] that points of a crowd's parts send to a camera at `o`."""
        crowd, world = self.crowds[number], self.world
        parts = crowd.parts
        if number not in self._crowd_maps:
            self._crowd_maps[number] = crowd_map(world, crowd, self.texel, self.crowds), lattice(parts.texture)
        table, pattern = self._crowd_maps[number]
        part, side, q, (u, v, s, t) = crowd.read(faces, p)
        shift = parts.shift[part]
        colour = albedo(parts.texture, pattern, u + shift[:, 0], v + shift[:, 1]) * parts.tint[part].T
        if parts.texture.emit > 0:
            return colour * np.float32(parts.texture.emit)
        light = table.at(part, side, s, t)
        if parts.texture.gloss > 0:
            return glossy(world, parts.texture, colour, p, crowd.normals(part, side, q), o, light, self._around(o))
        return _matt(world, colour, light)

    def _around(self, o: Axes) -> Callable[[Axes, Axes], Floats]:
        """What gives the light that comes to points from directions, for a camera at `o`."""
        return lambda p, d: self._arriving(p, d, o)

    def _arriving(self, p: Axes, d: Axes, o: Axes) -> Floats:
        """Light float32[3,n] that comes to points from directions: that of the room, matt, or of the sky."""
        p, d = [np.asarray(c) for c in p], [np.asarray(c + TINY) for c in d]
        light = np.empty((3, len(p[0])), np.float32)
        light[:] = np.array(self.world.sky, np.float32)[:, None]
        depth, face = np.full(len(p[0]), np.inf, np.float32), np.full(len(p[0]), -1, np.int32)
        for solid, first in self.solids:
            if isinstance(solid, Room):
                HIT[Room](solid, first, p, d, depth, face)
        for number in np.unique(face[face >= 0]):
            here = np.flatnonzero(face == number)
            at = [p[a][here] + depth[here] * d[a][here] for a in range(3)]
            light[:, here] = self._reflected(int(number), at, o, matt=True)
        return light


def _hollow(solid: Box | Sphere | Rect | Room) -> bool:
    """Whether a solid of a plain kind needs what only crowds have: sight through its holes, or a panel's shadow."""
    return not isinstance(solid, Room) and (solid.texture.cut != "none" or getattr(solid, "shadows", False))


def _many(solid: Solid) -> bool:
    return not isinstance(solid, Room | Box | Sphere | Rect) or _hollow(solid)


def _matt(world: World, colour: Floats, light: tuple[Floats, Floats]) -> Floats:
    direct, open_ = light
    out = np.empty((3, direct.size), np.float32)
    for a in range(3):
        np.multiply(open_, np.float32(world.ambient[a]), out=out[a])
        out[a] += direct * np.float32(world.lamp.power[a])
        out[a] *= colour[a]
    return out


@lru_cache(maxsize=2)
def stage_of(world: World) -> Stage:
    """The world made ready, once a process."""
    return Stage(world)
