"""What a world is made of, as the scene file says it: one record a kind of solid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from spikerig.rigctl.sim.limits import limits

Vec3 = tuple[float, float, float]
FAR = 1e6
MAX_PARTS = 20_000
SHAPES = ("rect", "box", "ball", "rod")


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
    """A flat panel: centre, and two perpendicular half-edges; seen from both sides.

    Args:
        centre, right, up: where.
        texture: what is on it; a `leaf` cut points along `right`.
        shadows: whether it throws one.
    """

    centre: Vec3 = limits(lo=-FAR, hi=FAR, unit="world units")
    right: Vec3 = limits(lo=-FAR, hi=FAR, unit="world units")
    up: Vec3 = limits(lo=-FAR, hi=FAR, unit="world units")
    texture: Any = limits({})
    shadows: bool = limits(False)


@dataclass(frozen=True, slots=True)
class Ellipsoid:
    """A ball of three radii, turned about the vertical; texture coordinates as on a sphere of mean radius."""

    centre: Vec3 = limits(lo=-FAR, hi=FAR, unit="world units")
    radii: Vec3 = limits(lo=1e-6, hi=FAR, unit="world units")
    yaw_deg: float = limits(0.0, -360, 360, "degrees")
    texture: Any = limits({})


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A closed cylinder between the centres of its two ends; texture coordinates run around and along it."""

    base: Vec3 = limits(lo=-FAR, hi=FAR, unit="world units")
    top: Vec3 = limits(lo=-FAR, hi=FAR, unit="world units")
    radius: float = limits(lo=1e-6, hi=FAR, unit="world units")
    texture: Any = limits({})


@dataclass(frozen=True, slots=True)
class Scatter:
    """Many parts of one shape, placed by a seed.

    Args:
        shape: `rect` (a panel across its third axis), `box`, `ball`, or `rod` (a cylinder along its third axis).
        count: how many.
        centre, spread: the middle of it all, and its half extents; a line runs from centre - spread to centre + spread.
        size: edges of a part: length, width, height; of a ball and a rod diameters and length.
        layout: centres spread evenly within a `box` or a `ball`, over the `shell` of one, or equally along a `line`.
        seed: of the placing.
        vary: each part's size is times 1 +- this.
        facing: what the third axis does: `any` direction, `up`, or `out` from the centre; turned at random about it.
        lean_deg: how far it leans from there at most.
        shade: each part's colour is times a number of this range.
        palette: colours [r, g, b] a part takes one of, times the texture's.
    """

    shape: str = limits(choices=SHAPES)
    count: int = limits(lo=1, hi=MAX_PARTS)
    centre: Vec3 = limits(lo=-FAR, hi=FAR, unit="world units")
    spread: Vec3 = limits(lo=-FAR, hi=FAR, unit="world units")
    size: Vec3 = limits(lo=1e-6, hi=FAR, unit="world units")
    layout: str = limits("box", choices=("box", "ball", "shell", "line"))
    seed: int = limits(0, 0, 2**32 - 1)
    vary: float = limits(0.0, 0, 0.95)
    facing: str = limits("up", choices=("any", "up", "out"))
    lean_deg: float = limits(0.0, 0, 180, "degrees")
    shade: tuple[float, float] = limits((1.0, 1.0), 0, 1)
    palette: Any = limits(())
    texture: Any = limits({})


@dataclass(frozen=True, slots=True)
class Bricks:
    """Stacked bricks of one, two and four cells with a stud on every free cell, built by a seed.

    Args:
        base: the middle of the lowest face.
        cells: along x and y.
        size: edges of a one-cell brick.
        layers: lowest and greatest height of a stack, bricks; the heights are a smooth random hill.
        gap: share of an edge that is left free between bricks.
        stud: radius and height of a stud, shares of the cell's edge and height; radius 0 for none.
        seed: of the building.
        yaw_deg: turn of it all about the vertical through `base`.
        shade, palette: as for `scatter`.
    """

    base: Vec3 = limits(lo=-FAR, hi=FAR, unit="world units")
    cells: tuple[float, float] = limits((8.0, 8.0), 1, 64)
    size: Vec3 = limits((0.1, 0.1, 0.06), 1e-6, FAR, "world units")
    layers: tuple[float, float] = limits((0.0, 5.0), 0, 64)
    gap: float = limits(0.04, 0, 0.5)
    stud: tuple[float, float] = limits((0.3, 0.3), 0, 0.5)
    seed: int = limits(0, 0, 2**32 - 1)
    yaw_deg: float = limits(0.0, -360, 360, "degrees")
    shade: tuple[float, float] = limits((1.0, 1.0), 0, 1)
    palette: Any = limits(())
    texture: Any = limits({})


@dataclass(frozen=True, slots=True)
class Plant:
    """A trunk, branches that thin out, and leaves along them, grown by a seed.

    Args:
        foot: where the trunk leaves the ground.
        height: of the trunk.
        trunk: its radius; branches begin at half of it.
        reach: length of the lowest branches; the highest have 40 % of it.
        branches: how many, from 25 % to 100 % of the height, a golden angle apart.
        rise_deg: how steeply branches leave the trunk.
        leaves: how many in all.
        leaf_size: length and width of a leaf, times 1 +- 30 %.
        droop: how much leaves hang down, 0 to 1.
        seed: of the growth.
        shade: each leaf's colour is times a number of this range.
        bark, leaf: textures; leaves are cut as `leaf.cut` says.
    """

    foot: Vec3 = limits(lo=-FAR, hi=FAR, unit="world units")
    height: float = limits(lo=1e-6, hi=FAR, unit="world units")
    trunk: float = limits(lo=1e-6, hi=FAR, unit="world units")
    reach: float = limits(lo=1e-6, hi=FAR, unit="world units")
    branches: int = limits(12, 1, 1000)
    rise_deg: float = limits(40.0, -80, 80, "degrees")
    leaves: int = limits(200, 1, MAX_PARTS)
    leaf_size: tuple[float, float] = limits((0.12, 0.05), 1e-6, FAR, "world units")
    droop: float = limits(0.4, 0, 1)
    seed: int = limits(0, 0, 2**32 - 1)
    shade: tuple[float, float] = limits((0.6, 1.0), 0, 1)
    bark: Any = limits({})
    leaf: Any = limits({})


Solid = Room | Box | Sphere | Rect | Ellipsoid | Cylinder | Scatter | Bricks | Plant
KINDS: dict[str, type] = {
    "room": Room, "box": Box, "sphere": Sphere, "rect": Rect, "ellipsoid": Ellipsoid, "cylinder": Cylinder,
    "scatter": Scatter, "bricks": Bricks, "plant": Plant,
}  # fmt: skip
SKINS = {"room": ("floor", "ceiling", "walls"), "plant": ("bark", "leaf")}


def skins(kind: str) -> tuple[str, ...]:
    """The keys of a kind of solid that hold textures."""
    return SKINS.get(kind, ("texture",))
