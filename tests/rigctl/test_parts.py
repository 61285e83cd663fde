"""Small parts: where rays meet them, what is cut out of them, how seeds place them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from spikerig.dataset.errors import UsageError
from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.caster.crowd import Crowd, pieces, runs
from spikerig.rigctl.sim.caster.grow import parts_of
from spikerig.rigctl.sim.caster.light import Stage
from spikerig.rigctl.sim.caster.parts import SIDES, Parts, holds, inner_normal, meet, place, surface
from spikerig.rigctl.sim.caster.pattern import Texture
from spikerig.rigctl.sim.caster.solids import Box, Bricks, Cylinder, Ellipsoid, Plant, Rect, Scatter, Sphere
from spikerig.rigctl.sim.caster.world import Lamp, World
from spikerig.rigctl.sim.orbit import Orbit, orbit_pose
from spikerig.rigctl.sim.spec import load_scene_toml, read_scene

WHITE = Texture(a=(1, 1, 1))
SHAPES = sorted(SIDES)


def crossings(shape: str, o: np.ndarray, d: np.ndarray) -> list[tuple[float, int]]:
    """All crossings of a line with a unit shape, in order, by plane and quadratic, in float64: (t, side)."""
    found = []

    def plane(axis: int, at: float, side: int) -> None:
        t = (at - o[axis]) / d[axis]
        q = np.delete(o + t * d, axis)
        if (q @ q < 1) if shape == "rod" else (np.abs(q) < 1).all():
            found.append((t, side))

    def curve(n: int) -> None:
        for root in np.roots([d[:n] @ d[:n], 2 * d[:n] @ o[:n], o[:n] @ o[:n] - 1]):
            if abs(root.imag) < 1e-12 and (n == 3 or abs(o[2] + root.real * d[2]) < 1):
                found.append((root.real, 0))

    if shape == "rect":
        plane(2, 0.0, int(o[2] < 0))
    elif shape == "ball":
        curve(3)
    elif shape == "rod":
        curve(2)
        plane(2, -1.0, 1)
        plane(2, 1.0, 2)
    else:
        for axis in range(3):
            plane(axis, -1.0, 2 * axis)
            plane(axis, 1.0, 2 * axis + 1)
    return sorted(found)


@pytest.mark.parametrize("shape", SHAPES)
def test_meeting_a_unit_shape(shape: str) -> None:
    rng = np.random.default_rng(3)
    o = rng.uniform(-4, 4, (400, 3))
    o += 3 * o / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.uniform(-0.9, 0.9, (400, 3)) - o
    with np.errstate(all="ignore"):
        t0, near, t1, far = meet(shape, *(tuple(c.astype(np.float32)) for c in (o.T, d.T)))
    hits = 0
    for k in range(400):
        expected = crossings(shape, o[k].astype(np.float32).astype(float), d[k].astype(np.float32).astype(float))
        if not expected:
            assert not np.isfinite(t0[k])
            continue
        hits += 1
        assert t0[k] == pytest.approx(expected[0][0], abs=1e-5)
        assert near[k] == expected[0][1]
        if shape != "rect":
            assert t1[k] == pytest.approx(expected[-1][0], abs=1e-5)
            assert far[k] == expected[-1][1]
    assert hits > 100


@pytest.mark.parametrize("shape", SHAPES)
def test_places_and_coordinates_are_inverse(shape: str) -> None:
    """place(s, t) lies on the part, and surface() gives s and t back; its normal is that of the hit side."""
    rng = np.random.default_rng(4)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    axes = (turn * np.array([[0.5], [0.2], [0.3 if shape != "rect" else 1.0]]))[None]
    cut = Texture(cut="mesh")
    parts = Parts(
        shape, np.array([[1.0, -2, 0.5]]), axes, cut, np.ones((1, 3), np.float32), np.zeros((1, 2), np.float32)
    )
    crowd = Crowd(parts, 7)
    s, t = rng.uniform(0.05, 0.95, (2, 50))
    for side in range(parts.sides):
        p, n = place(parts, side, s, t)
        points = list(p[0].T.astype(np.float32))
        part, sides, q, (u, v, s2, t2) = crowd.read(np.full(50, 7 + side), points)
        assert (part == 0).all()
        assert (sides == side).all()
        assert np.allclose(s2, s, atol=1e-4)
        assert np.allclose(t2, t, atol=1e-4)
        assert np.allclose(crowd.normals(part, sides, q), n[0].T, atol=1e-4)
        sign = -1 if shape != "rect" and side >= SIDES[shape] else 1
        if shape != "rect":
            assert ((p[0] - parts.centre) * n[0] * sign).sum(1).min() > 0
        assert np.ptp(u) <= 2 * np.pi * 0.5 + 1e-6
        assert np.ptp(v) <= np.pi * 0.5 + 1e-6


def test_one_part_looks_like_the_plain_solid() -> None:
    """The two casters agree: depth to rounding, light to the resolution of their tables."""
    camera, pose = Camera.pinhole(60, 40, 40), orbit_pose(Orbit(views=1, start_deg=35, radius=2.0, height=1.0), 0)
    lamp, panel = Lamp((0.7, -1.5, 2.0), (3, 3, 3)), ((0, 0, 0), (0.5, 0.1, 0), (-0.05, 0.25, 0.4), WHITE)
    scattered = Scatter("box", 1, (0, 0, 0), (0, 0, 0), (0.8, 0.6, 0.7), texture=WHITE)
    first = parts_of(scattered)[0].axes[0, 0]
    for plain, crowded in (
        (Box((0, 0, 0), (0.8, 0.6, 0.7), float(np.degrees(np.arctan2(first[1], first[0]))), WHITE), scattered),
        (Sphere((0, 0.1, 0), 0.5, WHITE), Ellipsoid((0, 0.1, 0), (0.5, 0.5, 0.5), 0.0, WHITE)),
        (Rect(*panel), Rect(*panel, True)),
    ):
        stages = [Stage(World((solid,), lamp, (0.3, 0.3, 0.3), 0.0, (0, 0, 0))) for solid in (plain, crowded)]
        assert [len(stage.crowds) for stage in stages] == [0, 1]
        one, other = (stage.depth(camera, pose) for stage in stages)
        seen = np.isfinite(one)
        assert seen.sum() > 80
        assert np.array_equal(seen, np.isfinite(other))
        assert np.allclose(one[seen], other[seen], rtol=2e-5)
        one, other = (stage.picture(camera, pose, 2) for stage in stages)
        assert np.abs(one - other).mean() < 4e-3


def test_depth_of_many_parts_against_the_definition() -> None:
    solids = [
        Scatter(shape, 7, (0, 0, 0), (0.7, 0.7, 0.5), (0.3, 0.2, 0.25), "ball", seed, 0.3, "any", texture=WHITE)
        for seed, shape in enumerate(SHAPES)
    ]
    stage, camera = Stage(World(tuple(solids), Lamp(), (1, 1, 1), 0.0, (0, 0, 0))), Camera.pinhole(25, 16, 50)
    pose = orbit_pose(Orbit(views=1, start_deg=20, radius=2.5, height=0.8), 0)
    depth, R = stage.depth(camera, pose), pose[:, :3]
    origin = -R.T @ pose[:, 3]
    for y in range(16):
        for x in range(25):
            d = R.T @ np.array([(x + 0.5 - 12.5) / camera.K[0, 0], (y + 0.5 - 8) / camera.K[1, 1], 1])
            found = [np.inf]
            for solid in solids:
                (parts,) = parts_of(solid)
                for centre, local in zip(parts.centre, parts.local, strict=True):
                    found += [t for t, _ in crossings(parts.shape, local @ (origin - centre), local @ d)]
            assert depth[y, x] == pytest.approx(min(found), rel=2e-5), (x, y)
    assert 0.2 < np.isfinite(depth).mean() < 0.9


def test_runs_and_pieces() -> None:
    which, number = runs(np.array([3, 5, 0]), np.array([5, 5, 3]))
    assert which.tolist() == [0, 0, 2, 2, 2]
    assert number.tolist() == [3, 4, 0, 1, 2]
    lengths = np.random.default_rng(0).integers(0, 90_000, 50)
    split = list(pieces(lengths))
    assert np.array_equal(np.concatenate(split), np.arange(50))
    assert all(lengths[some].sum() <= 1 << 17 or len(some) == 1 for some in split)
    assert [p.tolist() for p in pieces(np.array([1 << 20, 1 << 20]))] == [[0], [1]]


def test_scatter_keeps_to_its_place() -> None:
    where: dict[str, Any] = {"centre": (1, 2, 3), "spread": (0.5, 1, 2), "size": (0.1, 0.1, 0.3)}
    spec: dict[str, Any] = {"shape": "rod", "count": 500, **where, "texture": WHITE}
    one, same, other = (parts_of(Scatter(**spec, seed=s))[0] for s in (1, 1, 2))
    assert np.array_equal(one.centre, same.centre)
    assert not np.array_equal(one.centre, other.centre)
    off = (one.centre - [1, 2, 3]) / [0.5, 1, 2]
    assert np.abs(off).max() <= 1
    assert np.abs(off).max(0).min() > 0.95
    ball, shell = (
        (parts_of(Scatter(**spec, layout=layout))[0].centre - [1, 2, 3]) / [0.5, 1, 2] for layout in ("ball", "shell")
    )
    assert np.allclose(np.linalg.norm(shell, axis=1), 1)
    r = np.linalg.norm(ball, axis=1)
    assert (r**3).mean() == pytest.approx(0.5, abs=0.04)  # even in volume
    line = parts_of(Scatter(**{**spec, "count": 5}, layout="line"))[0].centre
    assert np.allclose(np.diff(line, axis=0), np.array([0.5, 1, 2]) / 2)
    assert np.allclose(line[0], [0.5, 1, 1])
    for facing, lean in (("up", 0), ("up", 20), ("out", 0)):
        parts = parts_of(Scatter(**spec, facing=facing, lean_deg=lean, vary=0.5))[0]
        third = parts.axes[:, 2] / parts.half[:, 2:]
        away = parts.centre - [1, 2, 3]
        to = np.array([0, 0, 1]) if facing == "up" else away / np.linalg.norm(away, axis=1, keepdims=True)
        angle = np.degrees(np.arccos(np.clip((third * to).sum(1), -1, 1)))
        assert angle.max() <= lean + 1e-3
        assert angle.max() >= 0.9 * lean
        grown = parts.half / [0.05, 0.05, 0.15]
        assert np.allclose(grown, grown[:, :1])
        assert 0.5 <= grown.min() < 0.55
        assert 1.45 < grown.max() <= 1.5
        assert np.allclose(np.einsum("nik,njk->nij", parts.local, parts.axes), np.eye(3), atol=1e-12)


def test_bricks_fill_their_hill_once() -> None:
    spec = Bricks((1, 2, 0), (9, 7), (0.1, 0.1, 0.06), (1, 5), 0.0, (0.3, 0.3), seed=2, texture=WHITE, yaw_deg=30)
    boxes, studs = parts_of(spec)
    c, s = np.cos(np.radians(30)), np.sin(np.radians(30))
    flat = (boxes.centre - [1, 2, 0]) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]).T
    filled = np.zeros((9, 7, 5), int)
    for centre, half in zip(flat, boxes.half, strict=True):
        lo, hi = (np.rint((centre + k * half) / [0.1, 0.1, 0.06] + [4.5, 3.5, 0]).astype(int) for k in (-1, 1))
        filled[lo[0] : hi[0], lo[1] : hi[1], lo[2] : hi[2]] += 1
    assert filled.max() == 1
    height = filled.shape[2] - np.argmax(filled[:, :, ::-1], axis=2)
    assert height.min() >= 1
    assert height.max() == 5
    hidden = (np.arange(5) < height[:, :, None]) & (filled == 0)
    for i, j, layer in np.argwhere(hidden):  # left out only where nobody can see it
        assert height[i, j] > layer + 1
        assert 0 < i < 8
        assert 0 < j < 6
        assert height[i - 1 : i + 2, j - 1 : j + 2].min() > layer
    assert hidden.sum() > 3
    assert len(studs) == 63
    tops = np.sort(np.rint((studs.centre[:, 2] - 0.009) / 0.06).astype(int))
    assert np.array_equal(tops, np.sort(height.ravel()))


def test_leaves_sit_on_twigs() -> None:
    spec = Plant((0, 0, 0.3), 0.9, 0.03, 0.6, 10, 40.0, 80, (0.12, 0.05), seed=6, bark=WHITE, leaf=Texture(cut="leaf"))
    wood, leaves = parts_of(spec)
    assert (len(wood), len(leaves)) == (1 + 3 * 10, 80)
    assert np.allclose(wood.centre[0], (0, 0, 0.75))
    foot = leaves.centre - leaves.axes[:, 0]
    ends = wood.centre[1:, None] + wood.axes[1:, 2][:, None] * np.array([-1, 1])[:, None]
    a, b = ends[:, 0], ends[:, 1]
    along = np.clip(np.einsum("lmk,mk->lm", foot[:, None] - a, b - a) / ((b - a) ** 2).sum(1), 0, 1.06)
    off = np.linalg.norm(foot[:, None] - a - along[..., None] * (b - a), axis=2).min(1)
    assert off.max() < 0.4 * 0.03 + 0.01
    assert np.allclose(leaves.half[:, 0] / leaves.half[:, 1], 0.12 / 0.05)


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ({"kind": "ellipsoid", "centre": [0, 0, 0], "radii": [0.1, 0, 0.1]}, "radii: is [0.1, 0, 0.1], expected 1e-06"),
        ({"kind": "cylinder", "base": [0, 0, 1], "top": [0, 0, 1], "radius": 0.1}, "top: is where base is"),
        ({"kind": "cylinder", "base": [0, 0, 1], "top": [0, 0, 2], "radius": 0}, "radius: is 0"),
        ({"kind": "sphere", "centre": [0, 0, 0], "radius": 1, "texture": {"cut": "leaf"}}, "known here: mesh, grille"),
        (
            {"kind": "room", "lo": [0, 0, 0], "hi": [1, 1, 1], "walls": {"cut": "mesh"}},
            "walls.cut: is 'mesh'; a room has no other side",
        ),
        ({"kind": "bricks", "base": [0, 0, 0], "cells": [2.5, 2]}, "cells: is [2.5, 2.0], expected whole numbers"),
        ({"kind": "bricks", "base": [0, 0, 0], "layers": [3, 2]}, "layers: is [3.0, 2.0], expected [low, high]"),
        ({"kind": "bricks", "base": [0, 0, 0], "palette": [[1, 2, 3]]}, "expected a list of colours"),
        ({"kind": "plant", "foot": [0, 0, 0], "height": 1, "trunk": 2, "reach": 1}, "trunk: is 2, more than"),
        ({"kind": "scatter", "shape": "cone", "count": 3}, "shape: is 'cone'"),
        (
            {
                "kind": "scatter",
                "shape": "ball",
                "count": 30_000,
                "centre": [0, 0, 0],
                "spread": [0, 0, 0],
                "size": [1, 1, 1],
            },
            "count: is 30000, expected 1 to 20000",
        ),
    ],
)
def test_faults_of_solids(row: dict, words: str) -> None:
    with pytest.raises(UsageError) as caught:
        read_scene({"world": {"solids": [row]}})
    assert words in str(caught.value)


def test_cameras_stand_outside() -> None:
    """Inside a part is refused, within a crowd but beside its parts is not."""
    table = {"orbit": {"views": 2, "radius": 1.0, "height": 0.0, "arc_deg": 90, "test_every": 0}}
    inside = {"kind": "ellipsoid", "centre": [1, 0, 0], "radii": [0.2, 0.3, 0.2]}
    with pytest.raises(UsageError) as caught:
        read_scene({**table, "world": {"solids": [inside]}})
    assert "view 0 stands inside world.solids[0], an ellipsoid" in str(caught.value)
    beside = {
        "kind": "scatter",
        "shape": "box",
        "count": 40,
        "centre": [0, 0, 0],
        "spread": [2, 2, 2],
        "size": [0.1] * 3,
    }
    spec = read_scene({**table, "world": {"solids": [beside]}})
    picture = Stage(spec.world).picture(Camera.pinhole(40, 30, 70), orbit_pose(spec.orbit, 0), 2)
    assert np.isfinite(picture).all()
    assert picture.max() > 0
    rod = parts_of(Cylinder((0, 0, 0), (0, 2, 0), 0.5, WHITE))[0]
    for point, inside_it in (((0.4, 1, 0), True), ((0.4, 1, 0.4), False), ((0, 2.1, 0), False)):
        assert holds(rod, np.array(point))[0] == inside_it


def test_built_in_scenes_are_what_they_say() -> None:
    """Each loads, holds what it is named for, and is in the range of the sensor."""
    for name, words in (
        ("leaves", {"plant"}), ("parts", {"bricks", "scatter"}), ("glossy", {"sphere"}), ("mesh", {"sphere", "rect"}),
        ("fabric", {"box", "ellipsoid"}), ("round", {"ellipsoid"}),
    ):  # fmt: skip
        spec = load_scene_toml(name)
        assert spec.name == name
        assert (spec.lens.width, spec.lens.height) == (400, 250)
        assert words <= {type(s).__name__.lower() for s in spec.world.solids}
        camera = Camera.pinhole(40, 25, spec.lens.fov_deg)
        world = replace(spec.world, lamp=replace(spec.world.lamp, shadows=False))
        light = Stage(world).picture(camera, orbit_pose(spec.orbit, 7), 1) @ np.array(spec.sensor.response)
        spikes = np.minimum(light * spec.sensor.gain, 1) * spec.exposure.ticks
        assert 40 < spikes.mean() < 100, name
        assert np.percentile(spikes, 95) < 160, name
        assert (light * spec.sensor.gain > 1).mean() < 0.01, name


def test_normals_point_out() -> None:
    q = np.array([[0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]).T
    assert np.allclose(inner_normal("ball", q, np.array([0, 1])), q * [1, -1])
    assert np.allclose(inner_normal("rod", q, np.array([0, 2])).T, [[0.6, 0.8, 0], [0, 0, 1]])
    assert np.allclose(inner_normal("rect", q, np.array([0, 1])).T, [[0, 0, 1], [0, 0, -1]])
    assert np.allclose(inner_normal("box", q, np.array([4, 9])).T, [[0, 0, -1], [0, -1, 0]])
    assert surface.__doc__
