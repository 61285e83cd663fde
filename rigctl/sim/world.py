"""The analytic world: a room, boxes, spheres and rectangles with procedural textures, one point lamp.

World axes: z up, right-handed, any unit of length. All light is linear; 1.0 is display white.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.limits import Faults, limits, nearest, read_record
from spikerig.rigctl.sim.pattern import Texture

Vec3 = tuple[float, float, float]
FAR = 1e6
MAX_SOLIDS = 5000


@dataclass(frozen=True, slots=True)
class Room:
    """The inside of an axis-aligned box; cameras stand in it. Coordinates of its textures are world coordinates."""

    lo: Vec3 = limits(lo=-FAR, hi=FAR, unit="world units")
    hi: Vec3 = limits(lo=-FAR, hi=FAR, unit="world units")
    floor: Any = limits({})
    ceiling: Any = limits({})
    walls: Any = limits({})


@dataclass(frozen=True, slots=True)
class Box:
    """A box turned about the vertical."""

    centre: Vec3 = limits(lo=-FAR, hi=FAR, unit="world units")
    size: Vec3 = limits(lo=1e-6, hi=FAR, unit="world units")
    yaw_deg: float = limits(0.0, -360, 360, "degrees")
    texture: Any = limits({})


@dataclass(frozen=True, slots=True)
class Sphere:
    """A ball; texture coordinates are azimuth and latitude times the radius."""

    centre: Vec3 = limits(lo=-FAR, hi=FAR, unit="world units")
    radius: float = limits(lo=1e-6, hi=FAR, unit="world units")
    texture: Any = limits({})


@dataclass(frozen=True, slots=True)
class Rect:
    """A flat panel: centre, and two perpendicular half-edges; seen from both sides, casts no shadow."""

    centre: Vec3 = limits(lo=-FAR, hi=FAR, unit="world units")
    right: Vec3 = limits(lo=-FAR, hi=FAR, unit="world units")
    up: Vec3 = limits(lo=-FAR, hi=FAR, unit="world units")
    texture: Any = limits({})


Solid = Room | Box | Sphere | Rect
KINDS: dict[str, type] = {"room": Room, "box": Box, "sphere": Sphere, "rect": Rect}


@dataclass(frozen=True, slots=True)
class Lamp:
    """A point light.

    Args:
        position: where.
        power: light of a white surface one unit away that faces it (r, g, b); falls with the square of distance.
        shadows: whether boxes and spheres throw shadows.
    """

    position: Vec3 = limits((0.0, 0.0, 5.0), -FAR, FAR, "world units")
    power: Vec3 = limits((0.0, 0.0, 0.0), 0, 1e9)
    shadows: bool = limits(True)


@dataclass(frozen=True, slots=True)
class World:
    """All that gives or reflects light.

    Args:
        solids: what is there.
        lamp: the point light.
        ambient: light that comes from everywhere (r, g, b).
        contact: how much boxes and spheres darken the ambient light beside them, 0 to 1.
        sky: light where a ray hits nothing.
    """

    solids: tuple[Solid, ...]
    lamp: Lamp
    ambient: Vec3
    contact: float
    sky: Vec3


@dataclass(frozen=True, slots=True)
class Air:
    """`[world]`: light from everywhere, and what there is.

    Args:
        ambient: light that comes from everywhere (r, g, b).
        contact: how much boxes and spheres darken the ambient light beside them, 0 to 1.
        sky: light where a ray hits nothing.
        lamp, solids: see below.
    """

    ambient: Vec3 = limits((0.5, 0.5, 0.5), 0, 1e9)
    contact: float = limits(0.6, 0, 1)
    sky: Vec3 = limits((0.0, 0.0, 0.0), 0, 1e9)
    lamp: Any = limits({})
    solids: Any = limits({})


def read_world(table: Any, faults: Faults) -> World:
    """A world from the `[world]` table of a scene file; faults are noted, not raised."""
    air = read_record(Air, table, "world", faults)
    lamp = read_record(Lamp, air.lamp, "world.lamp", faults)
    rows = air.solids if air.solids != {} else []
    if not isinstance(rows, list):
        faults.add("world.solids", "is not a list; write [[world.solids]]")
        rows = []
    if not 1 <= len(rows) <= MAX_SOLIDS:
        faults.add("world.solids", f"are {len(rows)}, expected 1 to {MAX_SOLIDS}")
    found = [_read_solid(row, f"world.solids[{k}]", faults) for k, row in enumerate(rows)]
    return World(tuple(s for s in found if s is not None), lamp, air.ambient, air.contact, air.sky)


def _read_solid(row: Any, where: str, faults: Faults) -> Solid | None:
    if not isinstance(row, Mapping):
        faults.add(where, f"is {row!r}, expected a table")
        return None
    kind = str(row.get("kind", ""))
    if kind not in KINDS:
        faults.add(f"{where}.kind", f"is {kind!r}; {nearest(kind, KINDS)}")
        return None
    before = len(faults.found)
    raw = read_record(KINDS[kind], {k: v for k, v in row.items() if k != "kind"}, where, faults)
    textures = {}
    for name in ("floor", "ceiling", "walls") if kind == "room" else ("texture",):
        textures[name] = read_record(Texture, getattr(raw, name), f"{where}.{name}", faults)
        for key in ("luma", "chroma"):
            pair = getattr(textures[name], key)
            if pair[0] > pair[1]:
                faults.add(f"{where}.{name}.{key}", f"is {list(pair)}, expected [low, high]")
    if len(faults.found) > before:
        return None
    values = {name: getattr(raw, name) for name in KINDS[kind].__slots__}
    solid = KINDS[kind](**{**values, **textures})
    if isinstance(solid, Room) and not all(a < b for a, b in zip(solid.lo, solid.hi, strict=True)):
        faults.add(f"{where}.hi", f"is {list(solid.hi)}, expected more than lo = {list(solid.lo)} on every axis")
    if isinstance(solid, Rect):
        right, up = np.array(solid.right), np.array(solid.up)
        scale = np.linalg.norm(right) * np.linalg.norm(up)
        if scale == 0 or abs(right @ up) > 1e-6 * scale:
            faults.add(f"{where}.up", "and right must be perpendicular and not zero")
    return solid


def stands_in(world: World, at: NDArray[np.float64]) -> str:
    """What is wrong with a camera standing at a point: in words, empty when nothing is."""
    for k, solid in enumerate(world.solids):
        if isinstance(solid, Room) and not (np.all(at > solid.lo) and np.all(at < solid.hi)):
            return f"outside world.solids[{k}], the room"
        if isinstance(solid, Sphere) and np.linalg.norm(at - solid.centre) <= solid.radius:
            return f"inside world.solids[{k}], a sphere"
        if isinstance(solid, Box):
            c, s = np.cos(np.radians(solid.yaw_deg)), np.sin(np.radians(solid.yaw_deg))
            q = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ (at - solid.centre)
            if np.all(np.abs(q) <= np.array(solid.size) / 2):
                return f"inside world.solids[{k}], a box"
    return ""
