"""The analytic world: solids with procedural textures (see `solids`), one point lamp, light from everywhere.

World axes: z up, right-handed, any unit of length. All light is linear; 1.0 is display white.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.caster.grow import parts_of
from spikerig.rigctl.sim.caster.parts import holds
from spikerig.rigctl.sim.caster.pattern import Texture
from spikerig.rigctl.sim.caster.solids import (
    FAR,
    KINDS,
    Bricks,
    Cylinder,
    Plant,
    Rect,
    Room,
    Scatter,
    Solid,
    Vec3,
    skins,
)
from spikerig.rigctl.sim.caster.solids import Box as Box  # readers of a world find its plain solids here
from spikerig.rigctl.sim.caster.solids import Sphere as Sphere
from spikerig.rigctl.sim.limits import Faults, limits, nearest, read_record

MAX_SOLIDS = 5000


@dataclass(frozen=True, slots=True)
class Lamp:
    """A point light.

    Args:
        position: where.
        power: light of a white surface one unit away that faces it (r, g, b); falls with the square of distance.
        shadows: whether solids throw shadows.
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
        contact: how much solids darken the ambient light beside them, 0 to 1.
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
        contact: how much solids darken the ambient light beside them, 0 to 1.
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
    changes: dict[str, Any] = {}
    for name in skins(kind):
        changes[name] = read_record(Texture, getattr(raw, name), f"{where}.{name}", faults)
        _check_texture(changes[name], kind, getattr(raw, "shape", ""), f"{where}.{name}", faults)
    if "palette" in KINDS[kind].__slots__:
        changes["palette"] = _read_palette(raw.palette, f"{where}.palette", faults)
    if len(faults.found) > before:
        return None
    solid = replace(raw, **changes)
    _check_solid(solid, where, faults)
    return solid


def _check_texture(texture: Texture, kind: str, shape: str, where: str, faults: Faults) -> None:
    for key in ("luma", "chroma"):
        _check_pair(getattr(texture, key), f"{where}.{key}", faults)
    flat = kind in ("rect", "plant") or shape == "rect"
    if texture.cut != "none" and (kind == "room" or (texture.cut in ("leaf", "disc") and not flat)):
        fits = (
            "a room has no other side" if kind == "room" else "that is the outline of a panel; known here: mesh, grille"
        )
        faults.add(f"{where}.cut", f"is {texture.cut!r}; {fits}")


def _check_pair(pair: tuple[float, float], where: str, faults: Faults) -> None:
    if pair[0] > pair[1]:
        faults.add(where, f"is {list(pair)}, expected [low, high]")


def _read_palette(rows: Any, where: str, faults: Faults) -> tuple[Vec3, ...]:
    good = isinstance(rows, list | tuple) and all(
        isinstance(row, list | tuple) and len(row) == 3 and all(isinstance(v, int | float) and 0 <= v <= 1 for v in row)
        for row in rows
    )
    if not good:
        faults.add(where, f"is {rows!r}, expected a list of colours [r, g, b], each 0 to 1")
        return ()
    return tuple((float(r), float(g), float(b)) for r, g, b in rows)


def _check_solid(solid: Solid, where: str, faults: Faults) -> None:
    """Faults that need more than one key of a solid to see."""
    if isinstance(solid, Room) and not all(a < b for a, b in zip(solid.lo, solid.hi, strict=True)):
        faults.add(f"{where}.hi", f"is {list(solid.hi)}, expected more than lo = {list(solid.lo)} on every axis")
    if isinstance(solid, Rect):
        right, up = np.array(solid.right), np.array(solid.up)
        scale = np.linalg.norm(right) * np.linalg.norm(up)
        if scale == 0 or abs(right @ up) > 1e-6 * scale:
            faults.add(f"{where}.up", "and right must be perpendicular and not zero")
    if isinstance(solid, Cylinder) and np.linalg.norm(np.subtract(solid.top, solid.base)) < 1e-6:
        faults.add(f"{where}.top", "is where base is: a cylinder needs a length")
    if isinstance(solid, Scatter | Bricks | Plant):
        _check_pair(solid.shade, f"{where}.shade", faults)
    if isinstance(solid, Bricks):
        _check_pair(solid.layers, f"{where}.layers", faults)
        for key in ("cells", "layers"):
            if any(v != int(v) for v in getattr(solid, key)):
                faults.add(f"{where}.{key}", f"is {list(getattr(solid, key))}, expected whole numbers")
    if isinstance(solid, Plant) and solid.trunk > solid.height:
        faults.add(f"{where}.trunk", f"is {solid.trunk:g}, more than the height, {solid.height:g}")


def stands_in(world: World, at: NDArray[np.float64]) -> str:
    """What is wrong with a camera standing at a point: in words, empty when nothing is."""
    for k, solid in enumerate(world.solids):
        if isinstance(solid, Room):
            if not (np.all(at > solid.lo) and np.all(at < solid.hi)):
                return f"outside world.solids[{k}], the room"
            continue
        for parts in parts_of(solid):
            if holds(parts, at).any():
                name = next(name for name, kind in KINDS.items() if isinstance(solid, kind))
                return f"inside world.solids[{k}], a{'n' if name[0] in 'aeiou' else ''} {name}"
    return ""
