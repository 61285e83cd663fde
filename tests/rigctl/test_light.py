"""Casting against a slow float64 definition, shading against closed forms, textures against their words."""

import numpy as np
import pytest
from hard_sim import small

from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.caster.light import Stage
from spikerig.rigctl.sim.caster.pattern import Texture, albedo, lattice
from spikerig.rigctl.sim.caster.shade import irradiance
from spikerig.rigctl.sim.caster.world import Box, Lamp, Rect, Room, Sphere, World
from spikerig.rigctl.sim.orbit import Orbit, orbit_pose


def nearest_hit(world: World, o: np.ndarray, d: np.ndarray) -> float:
    """Distance along d to the first surface, by planes and quadratics, one ray at a time, in float64."""
    found = [np.inf]
    for solid in world.solids:
        if isinstance(solid, Sphere):
            q = o - solid.centre
            roots = np.roots([d @ d, 2 * d @ q, q @ q - solid.radius**2])
            found += [r.real for r in roots if abs(r.imag) < 1e-12]
            continue
        if isinstance(solid, Rect):
            sides = [(np.array(solid.centre), np.array(solid.right), np.array(solid.up))]
        else:
            lo, hi = (
                (solid.lo, solid.hi)
                if isinstance(solid, Room)
                else (-np.array(solid.size) / 2, np.array(solid.size) / 2)
            )
            angle = 0.0 if isinstance(solid, Room) else np.radians(solid.yaw_deg)
            axes = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
            at = np.zeros(3) if isinstance(solid, Room) else np.array(solid.centre)
            mid, half = (np.array(lo) + hi) / 2, (np.array(hi) - lo) / 2
            sides = []
            for k in range(3):
                for sign in (-1, 1):
                    i, j = (k + 1) % 3, (k + 2) % 3
                    local = mid + sign * half[k] * np.eye(3)[k]
                    sides.append((at + axes.T @ local, axes[i] * half[i], axes[j] * half[j]))
        for centre, u, v in sides:
            n = np.cross(u, v)
            if abs(d @ n) < 1e-14:
                continue
            t = (centre - o) @ n / (d @ n)
            p = o + t * d - centre
            if abs(p @ u) <= u @ u and abs(p @ v) <= v @ v:
                found.append(t)
    return min(t for t in found if t > 1e-3)


def test_depth_against_the_definition() -> None:
    spec = small()
    stage, camera = Stage(spec.world), Camera.pinhole(23, 14, 75)
    for number in range(4):
        pose = orbit_pose(spec.orbit, number)
        depth = stage.depth(camera, pose)
        o = -pose[:, :3].T @ pose[:, 3]
        for y in range(14):
            for x in range(23):
                d = pose[:, :3].T @ np.array([(x + 0.5 - 11.5) / camera.K[0, 0], (y + 0.5 - 7) / camera.K[1, 1], 1])
                assert depth[y, x] == pytest.approx(nearest_hit(spec.world, o, d), rel=2e-5), (number, x, y)


def test_nothing_hit_is_sky() -> None:
    world = World((Sphere((0, 0, 5), 1.0, Texture(a=(1, 1, 1))),), Lamp(), (1, 1, 1), 0.0, (0.1, 0.2, 0.3))
    camera = Camera.pinhole(21, 21, 90)
    stage = Stage(world)
    light, depth = stage.picture(camera, np.eye(3, 4), 1), stage.depth(camera, np.eye(3, 4))
    assert np.allclose(light[0, 0], (0.1, 0.2, 0.3))
    assert np.isinf(depth[0, 0])
    assert np.allclose(light[10, 10], 1)
    assert depth[10, 10] == pytest.approx(4, rel=1e-5)


def test_supersampling_is_coverage() -> None:
    """A white panel over part of a pixel: the share covered, exactly, for any samples that divide it."""
    panel = Rect((0.05, 0, 1.0), (0.1, 0, 0), (0, 1, 0), Texture(a=(1, 1, 1)))
    camera = Camera(np.array([[10.0, 0, 1.5], [0, 10, 0.5], [0, 0, 1]]), np.zeros(0), 4, 1)
    world = World((panel,), Lamp(), (1, 1, 1), 0.0, (0, 0, 0))  # x from -0.05 to 0.15: pixels 1.0 to 3.0
    assert np.allclose(Stage(world).picture(camera, np.eye(3, 4), 4)[0, :, 0], [0, 1, 1, 0])
    moved = np.eye(3, 4)
    moved[0, 3] = 0.025  # a quarter of a pixel
    assert np.allclose(Stage(world).picture(camera, moved, 4)[0, :, 0], [0, 0.75, 1, 0.25])


def test_lamp_and_shadow() -> None:
    """Cosine over squared distance; nothing behind a ball or a box; the box's own lit side is lit."""
    ball, box = Sphere((0, 0, 1), 0.5, Texture()), Box((5, 0, 1), (1, 1, 1), 30.0, Texture())
    above = Sphere((0, 0, 4.5), 1.0, Texture())  # beyond the lamp: throws no shadow on the floor
    world = World((ball, box, above), Lamp((0, 0, 3), (1, 1, 1)), (1, 1, 1), 0.0, (0, 0, 0))
    x = np.array([0, 2, -3, 0.3, 7.3], np.float32)
    p = [x, np.zeros(5, np.float32), np.zeros(5, np.float32)]
    up = [np.float32(0), np.float32(0), np.float32(1)]
    direct, open_ = irradiance(world, p, up)
    far = np.hypot(x, 3)
    assert np.allclose(direct[1:3], (3 / far / far**2)[1:3], rtol=1e-5)
    assert direct[0] == direct[3] == direct[4] == 0
    assert (open_ == 1).all()
    lit, _ = irradiance(world, [np.array([5], np.float32), np.array([0], np.float32), np.array([1.5], np.float32)], up)
    assert lit[0] == pytest.approx(1.5 / np.hypot(5, 1.5) ** 3, rel=1e-5)


def test_the_lit_side_of_a_box_is_the_one_to_the_lamp() -> None:
    """Faces are numbered right: the side seen has its own normal, whichever way the box is turned."""
    for yaw in (0.0, 30.0):
        box = Box((0, 0, 0), (1, 1, 1), yaw, Texture(a=(1, 1, 1)))
        world = World((box,), Lamp((-4, 0, 0), (9, 9, 9)), (0.1, 0.1, 0.1), 0.0, (0, 0, 0))
        stage, camera = Stage(world), Camera.pinhole(5, 5, 10)
        lit, dark = (orbit_pose(Orbit(views=1, start_deg=a, radius=3.0, height=0.0), 0) for a in (180, 0))
        assert stage.picture(camera, lit, 1).min() > 0.3
        if yaw == 0:
            assert stage.picture(camera, lit, 1)[2, 2, 0] == pytest.approx(0.1 + 9 / 3.5**2, rel=1e-3)
        assert np.allclose(stage.picture(camera, dark, 1), 0.1)


def test_contact_darkens_and_fades() -> None:
    world = World((Sphere((0, 0, 1), 0.9, Texture()),), Lamp(), (1, 1, 1), 0.8, (0, 0, 0))
    x = np.array([0.0, 1, 3, 30], np.float32)
    up = [np.float32(0), np.float32(0), np.float32(1)]
    _, open_ = irradiance(world, [x, 0 * x, 0 * x], up)
    assert (np.diff(open_) > 0).all()
    assert open_[0] == pytest.approx(1 - 0.8 * 0.81, rel=1e-5)  # the solid angle's share: (r / distance) squared
    assert open_[3] == pytest.approx(1, abs=1e-4)


def test_light_maps_follow_the_definition() -> None:
    """Away from shadow edges the tabulated light is that of the formula."""
    spec = small()
    stage = Stage(spec.world)
    camera = Camera.pinhole(40, 25, 60)
    plain = Texture(a=(1, 1, 1))
    room = Room((-3, -3, 0), (3, 3, 2.6), plain, plain, plain)
    world = World((room,), spec.world.lamp, (0.3, 0.3, 0.3), 0.5, (0, 0, 0))
    stage, pose = Stage(world), orbit_pose(spec.orbit, 1)
    light, depth = stage.picture(camera, pose, 1), stage.depth(camera, pose)
    o = -pose[:, :3].T @ pose[:, 3]
    for y, x in [(24, 3), (20, 20), (23, 37)]:
        ray = pose[:, :3].T @ np.array([(x + 0.5 - 20) / camera.K[0, 0], (y + 0.5 - 12.5) / camera.K[0, 0], 1])
        p = o + depth[y, x] * ray
        assert abs(p[2]) < 1e-5
        to = np.array(world.lamp.position) - p
        expected = 0.3 + to[2] / np.linalg.norm(to) ** 3 * np.array(world.lamp.power)
        assert np.allclose(light[y, x], expected, rtol=2e-3)


def test_emission_is_hdr() -> None:
    lamp = Rect((0, 0, 2), (1, 0, 0), (0, 1, 0), Texture(a=(1.0, 0.5, 0.25), emit=40.0))
    world = World((lamp,), Lamp(), (0, 0, 0), 0.0, (0, 0, 0))
    light = Stage(world).picture(Camera.pinhole(4, 4, 30), np.eye(3, 4), 2)
    assert np.allclose(light, (40, 20, 10))


def test_tiles_keep_luma_and_gamut() -> None:
    texture = Texture("tiles", luma=(0.4, 0.45), chroma=(0.3, 0.5), seed=4)
    table = lattice(texture)
    luma = np.array([0.299, 0.587, 0.114]) @ table
    assert luma.min() > 0.4 - 1e-6
    assert luma.max() < 0.45 + 1e-6
    assert table.min() > -1e-6
    assert table.max() < 1 + 1e-6
    assert (table.max(0) - table.min(0)).mean() > 0.3
    u = np.array([0.05, 0.35, 0.45, -0.05], np.float32)
    colours = albedo(texture, table, u, np.zeros(4, np.float32))
    assert np.array_equal(colours[:, 0], colours[:, 1])  # one cell of 0.4
    assert not np.array_equal(colours[:, 0], colours[:, 2])
    assert not np.array_equal(colours[:, 0], colours[:, 3])


def test_charts() -> None:
    angle = np.radians(np.arange(0.25, 360, 0.5))
    star = Texture("star", size=2.0, spokes=12, a=(1, 1, 1), b=(0, 0, 0))
    ring = albedo(star, lattice(star), *(0.5 * f(angle).astype(np.float32) for f in (np.cos, np.sin)))[0]
    assert int((np.diff(np.append(ring, ring[0])) != 0).sum()) == 24
    assert not albedo(star, lattice(star), np.array([1.1], np.float32), np.zeros(1, np.float32)).any()
    edge = Texture("edge", angle_deg=8, a=(1, 1, 1), b=(0, 0, 0))
    v = np.linspace(-1, 1, 41).astype(np.float32)
    on_line = -v * np.float32(np.tan(np.radians(8)))
    for off, value in ((1e-3, 1), (-1e-3, 0)):
        assert (albedo(edge, lattice(edge), on_line + np.float32(off), v)[0] == value).all()
    checker = Texture("checker", size=0.5, a=(1, 1, 1), b=(0, 0, 0))
    u = np.array([0.25, 0.75, -0.25], np.float32)
    assert albedo(checker, lattice(checker), u, np.full(3, 0.25, np.float32))[0].tolist() == [0, 1, 1]
    stripes = Texture("stripes", size=0.5, a=(1, 1, 1), b=(0, 0, 0))
    u = np.array([0, 0.25, 0.5, 0.125], np.float32)
    assert np.allclose(albedo(stripes, lattice(stripes), u, 0 * u)[0], [1, 0, 1, 0.5], atol=1e-6)


def test_noise_is_continuous() -> None:
    noise = Texture("noise", size=0.3, a=(1, 1, 1), b=(0, 0, 0), seed=8)
    u = np.linspace(-3, 3, 20001).astype(np.float32)
    value = albedo(noise, lattice(noise), u, u * np.float32(0.3))[0]
    assert np.abs(np.diff(value)).max() < 0.01
    assert value.min() >= 0
    assert value.max() <= 1
    assert value.std() > 0.1
