"""Cut-outs, shadows of parts, gloss and cloth: against closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.caster import crowd as crowd_module
from spikerig.rigctl.sim.caster.crowd import Crowd
from spikerig.rigctl.sim.caster.gloss import exponent, fresnel, highlight
from spikerig.rigctl.sim.caster.grow import parts_of
from spikerig.rigctl.sim.caster.light import Stage
from spikerig.rigctl.sim.caster.pattern import DIVES, SIDES, Texture, albedo, lattice
from spikerig.rigctl.sim.caster.shade import CrowdMap, irradiance
from spikerig.rigctl.sim.caster.solids import Cylinder, Ellipsoid, Rect, Room, Scatter, Solid, Sphere
from spikerig.rigctl.sim.caster.world import Lamp, World
from spikerig.rigctl.sim.orbit import Orbit, orbit_pose

WHITE = Texture(a=(1, 1, 1))
DARK = Lamp()


def shown(solids: tuple[Solid, ...], camera: Camera, samples: int = 4, **world: object) -> np.ndarray:
    """A picture from the origin along z: ambient white, sky black unless said."""
    scene = World(solids, DARK, (1, 1, 1), 0.0, (0, 0, 0))
    return Stage(replace(scene, **world)).picture(camera, np.eye(3, 4), samples)


@pytest.mark.parametrize(
    ("cut", "share"), [("leaf", 2 / 3), ("disc", np.pi / 4), ("mesh", 0.6), ("grille", 0.6), ("none", 1.0)]
)
def test_cut_panels_cover_what_they_should(cut: str, share: float) -> None:
    panel = Rect((0, 0, 2), (0.8, 0, 0), (0, 0.5, 0), Texture(a=(1, 1, 1), cut=cut, cut_size=0.04, open=0.4), True)
    picture = shown((panel,), Camera.pinhole(200, 200, 60))
    f = 100 / np.tan(np.radians(30))
    assert picture[..., 0].sum() / (1.6 * 1.0 * (f / 2) ** 2) == pytest.approx(share, abs=0.013)


def test_a_leaf_has_its_outline() -> None:
    leaf = Rect((0, 0, 1), (0.4, 0, 0), (0, 0.2, 0), Texture(a=(1, 1, 1), cut="leaf"))
    camera = Camera(np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]), np.zeros(0), 100, 100)
    depth = Stage(World((leaf,), DARK, (1, 1, 1), 0.0, (0, 0, 0))).depth(camera, np.eye(3, 4))
    x, y = (c / 100 - 0.5 for c in np.meshgrid(np.arange(100) + 0.5, np.arange(100) + 0.5))
    assert np.array_equal(np.isfinite(depth), np.abs(y) / 0.2 < 1 - (x / 0.4) ** 2)


def test_sight_through_a_mesh_ball() -> None:
    """Half of the rays see the far side through a hole of the near one: at its depth, lit, with holes of its own."""
    ball = Sphere((0, 0, 3), 1.0, Texture(a=(1, 1, 1), cut="mesh", cut_size=0.1, open=0.5))
    camera = Camera.pinhole(300, 300, 20)  # sees the middle: rays meet it nearly head on
    stage = Stage(World((ball,), Lamp((0, 0, 3), (1, 1, 1)), (0, 0, 0), 0.0, (0, 0, 0)))
    depth, light = stage.depth(camera, np.eye(3, 4)), stage.picture(camera, np.eye(3, 4), 1)
    near, far, through = depth < 2.4, (depth > 3.5) & np.isfinite(depth), ~np.isfinite(depth)
    assert near.mean() == pytest.approx(0.5, abs=0.02)
    assert far.mean() == pytest.approx(0.25, abs=0.08)
    assert through.mean() == pytest.approx(0.25, abs=0.08)
    assert depth[near].min() == pytest.approx(2, abs=1e-3)
    assert depth[far].max() == pytest.approx(4, abs=1e-3)
    assert (light[near] == 0).all()  # a lamp in the middle lights only the inside
    assert np.allclose(light[far], 1, atol=5e-3)


def test_a_mesh_rod_is_hollow_and_its_holes_close() -> None:
    rod = Cylinder((0, -5, 3), (0, 5, 3), 1.0, Texture(a=(1, 1, 1), cut="grille", cut_size=0.047, open=0.4))
    stage = Stage(World((rod,), DARK, (1, 1, 1), 0.0, (0, 0, 0)))
    depth = stage.depth(Camera.pinhole(300, 100, 20), np.eye(3, 4))
    assert (depth < 2.5).mean() == pytest.approx(0.6, abs=0.02)
    assert (np.isfinite(depth) & (depth > 3.5)).mean() == pytest.approx(0.4 * 0.6, abs=0.05)


def test_shadow_of_a_disc() -> None:
    """A disc of 0.3 half way to the lamp: a dark ellipse of 0.6 on the floor, and light beyond its panel's corners."""
    disc = Rect((0, 0, 1), (0.3, 0, 0), (0, 0.3, 0), Texture(cut="disc"), True)
    world = World((disc,), Lamp((0, 0, 2), (1, 1, 1)), (0, 0, 0), 0.0, (0, 0, 0))
    x = np.linspace(-1, 1, 401, dtype=np.float32)
    x, y = (c.ravel() for c in np.meshgrid(x, x))
    crowd = Crowd(parts_of(disc)[0])
    direct, _ = irradiance(world, [x, y, 0 * x], [np.float32(0), np.float32(0), np.float32(1)], [crowd])
    r = np.hypot(x, y)
    assert (direct[r < 0.599] == 0).all()
    clear = r > 0.601
    assert np.allclose(direct[clear], 2 / np.hypot(r[clear], 2) ** 3, rtol=1e-5)


def test_light_through_a_mesh() -> None:
    """Below a mesh with 36 % of holes 36 % of the lamp's light arrives on average, and none under a lid."""
    for cut, share in (("mesh", 0.36), ("none", 0.0)):
        lid = Rect((0, 0, 1), (1, 0, 0), (0, 1, 0), Texture(cut=cut, cut_size=0.05, open=0.36), True)
        world = World((lid,), Lamp((0, 0, 200), (4e4, 4e4, 4e4)), (0, 0, 0), 0.0, (0, 0, 0))
        p = np.random.default_rng(0).uniform(-0.9, 0.9, (2, 40_000)).astype(np.float32)
        up = [np.float32(0), np.float32(0), np.float32(1)]
        direct, _ = irradiance(world, [*p, 0 * p[0]], up, [Crowd(parts_of(lid)[0])])
        assert direct.mean() * 4e4 == pytest.approx(share, abs=0.01)


@pytest.mark.parametrize("shape", ["rect", "box", "ball", "rod"])
@pytest.mark.parametrize("lamp", [(0.5, -0.3, 2.5), (0.05, 0.02, 0.1)])
def test_shadows_by_cells_and_one_by_one(shape: str, lamp: tuple[float, float, float]) -> None:
    """The lamp's cells leave nothing out: as every part for every point; also with the lamp among the parts."""
    spec = Scatter(shape, 60, (0, 0, 0), (0.6, 0.6, 0.4), (0.2, 0.1, 0.15), "ball", 3, 0.4, "any", texture=WHITE)
    parts = parts_of(spec)[0]
    crowd = Crowd(parts)
    rng = np.random.default_rng(1)
    p = rng.uniform(-1.5, 1.5, (3, 3000)).astype(np.float32)
    dark = crowd.shadowed(lamp, list(p))
    origin, expected = np.array(lamp), np.zeros(3000, bool)
    with np.errstate(all="ignore"):
        for k in range(len(parts)):
            local = parts.local[k]
            o = local @ (origin - parts.centre[k])
            d = (local @ (p.T - origin).T).astype(np.float32)
            t = crowd_module.meet(shape, tuple(np.full(3000, v, np.float32) for v in o), tuple(d))[0]
            expected |= (t > 1e-3) & (t < 0.999)
    assert (dark != expected).sum() <= 2
    assert 0.02 < dark.mean() < 0.9


def test_bits_do_not_depend_on_how_pairs_are_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = Scatter("rod", 20, (0, 0, 0), (0.6, 0.6, 0.4), (0.1, 0.1, 0.3), facing="any", texture=WHITE)
    world = World((spec,), Lamp((1, 1, 2), (2, 2, 2)), (0.3, 0.3, 0.3), 0.5, (0, 0, 0))
    camera, pose = Camera.pinhole(40, 26, 50), orbit_pose(Orbit(views=1, radius=2.0, height=0.5), 0)
    whole = Stage(world).picture(camera, pose, 2)
    monkeypatch.setattr(crowd_module, "PAIRS", 997)
    monkeypatch.setattr("spikerig.rigctl.sim.caster.light.BAND", 1000)
    assert np.array_equal(Stage(world).picture(camera, pose, 2), whole)


def test_the_highlight_lies_where_a_mirror_would_show_the_lamp() -> None:
    lamp = Lamp((-2.0, 0, 3.0), (1, 1, 1), False)
    floor = Rect((0, 0, 0), (4, 0, 0), (0, 4, 0), Texture(a=(0, 0, 0), gloss=0.5, rough=0.2))
    world = World((floor,), lamp, (0, 0, 0), 0.0, (0, 0, 0))
    eye = np.array([2.0, 0, 1.5])
    ahead = np.array([0.667 - 2, 0, -1.5])
    ahead /= np.linalg.norm(ahead)
    right = np.array([0, 1.0, 0])
    R = np.stack([right, np.cross(ahead, right), ahead])
    camera = Camera.pinhole(121, 121, 40)
    light = Stage(world).picture(camera, np.concatenate([R, -(R @ eye)[:, None]], 1), 1)[..., 0]
    y, x = np.unravel_index(np.argmax(light), light.shape)
    ray = R.T @ np.array([(x + 0.5 - 60.5) / camera.K[0, 0], (y + 0.5 - 60.5) / camera.K[0, 0], 1])
    spot = eye - ray * (eye[2] / ray[2])
    assert np.allclose(spot[:2], (2 / 3, 0), atol=0.06)  # heights 3 and 1.5: the foot points split 4 in 2 to 1
    assert light[0, 0] < 0.01 * light.max()


@pytest.mark.parametrize("rough", [0.2, 0.45, 0.8, 1.0])
def test_a_highlight_gives_back_no_more_than_comes(rough: float) -> None:
    """Light reflected into all directions, of a lamp at any angle: at most the Fresnel share 1 of a perfect mirror."""
    texture = Texture(gloss=1.0, rough=rough, a=(1, 1, 1))
    n_z, n_az = 600, 256
    z = (np.arange(n_z) + 0.5) / n_z
    azimuth = (np.arange(n_az) + 0.5) * 2 * np.pi / n_az
    z, azimuth = (c.ravel() for c in np.meshgrid(z, azimuth, indexing="ij"))
    out = np.stack([np.sqrt(1 - z * z) * np.cos(azimuth), np.sqrt(1 - z * z) * np.sin(azimuth), z]).astype(np.float32)
    zero = np.zeros(len(z), np.float32)
    up = [zero, zero, zero + 1]
    for angle in (0, 30, 60, 80, 89):
        a = np.radians(angle)
        lamp = Lamp((1e3 * np.sin(a), 0, 1e3 * np.cos(a)), (1, 1, 1))
        world = World((), lamp, (0, 0, 0), 0.0, (0, 0, 0))
        head_on = np.ones((3, len(z)), np.float32)
        lobe = highlight(world, texture, head_on, [zero, zero, zero], up, list(out))[0]  # radiance / (irradiance / pi)
        total = (lobe * z).mean() * 2  # integral over the half sphere of lobe cos / pi
        assert total < 1.01
        if angle == 0:
            assert total > 0.9 or rough > 0.7


def test_a_bright_room_stays_as_bright() -> None:
    """White furnace: everything sends light 1, so no surface, however glossy, sends more; a perfect mirror sends 1."""
    camera = Camera.pinhole(60, 60, 60)
    for gloss, rough, metal, least in ((0.04, 0.3, 0, 0.99), (0.9, 0.1, 1, 0.9), (1.0, 0.5, 0.5, 0.99)):
        ball = Ellipsoid((0, 0, 3), (1, 0.8, 0.6), 20.0, Texture(a=(1, 1, 1), gloss=gloss, rough=rough, metal=metal))
        light = shown((ball,), camera, 1, sky=(1, 1, 1))
        assert light.max() < 1 + 1e-5
        assert light.min() > least - 1e-4


def test_mirrors_show_the_room() -> None:
    """A perfect mirror panel at 45 degrees shows the wall beside the camera, at the point that geometry says."""
    wall = Texture("checker", size=0.5, a=(1, 1, 1), b=(0, 0, 0))
    room = Room((-3, -3, -1), (3, 3, 5), Texture(a=(0.5, 0, 0)), Texture(a=(0, 0.5, 0)), wall)
    mirror = Rect((0, 0, 2), (0.5, 0, 0.5), (0, 0.7, 0), Texture(a=(1, 1, 1), gloss=1.0, rough=0.1, metal=1))
    camera = Camera.pinhole(101, 101, 20)
    light = shown((room, mirror), camera, 1)[..., 0]
    f = camera.K[0, 0]
    blur = 1 - 0.9**2
    for y, x in ((50, 50), (40, 60), (57, 33), (62, 41)):
        d = np.array([(x + 0.5 - 50.5) / f, (y + 0.5 - 50.5) / f, 1.0])
        p = d * 2 / (1 - d[0])  # the plane z = 2 + x
        r = np.array([d[2], d[1], d[0]])  # mirrored at it: x and z change places
        q = p + r * (3 - p[0]) / r[0]
        cell = (np.floor(q[1] / 0.5) + np.floor(q[2] / 0.5)) % 2
        if min(abs(c / 0.5 - np.rint(c / 0.5)) for c in q[1:]) < 0.05:
            continue
        assert light[y, x] == pytest.approx(cell + (1 - cell) * blur, abs=1e-4), (y, x)
    assert np.ptp(light[45:56, 45:56]) > 0.5


def test_gloss_follows_the_camera_and_matt_does_not() -> None:
    for gloss, differs in ((0.0, False), (0.3, True)):
        ball = Sphere((0, 0, 0), 0.5, Texture(a=(0.5, 0.5, 0.5), gloss=gloss, rough=0.3))
        room = Room((-3, -3, -3), (3, 3, 3), WHITE, WHITE, Texture("tiles", size=0.5))
        stage = Stage(World((room, ball), Lamp((0, -2.5, 2), (4, 4, 4)), (0.3, 0.3, 0.3), 0.0, (0, 0, 0)))
        seen = []
        for start in (-100, -60):
            pose = orbit_pose(Orbit(views=1, start_deg=start, radius=2.0, height=0.5), 0)
            x, y, z = pose[:, :3] @ np.array([0, -0.4, 0.3]) + pose[:, 3]
            camera = Camera.pinhole(401, 401, 40)
            at = (int(camera.K[1, 1] * y / z + 200.5), int(camera.K[0, 0] * x / z + 200.5))
            seen.append(stage.picture(camera, pose, 2)[at][0])
        assert (abs(seen[0] - seen[1]) > 0.05) == differs, seen


def test_schlick() -> None:
    head_on = np.array([[0.04], [0.5], [1.0]], np.float32)
    assert np.allclose(fresnel(head_on, np.array([1.0])), head_on)
    assert np.allclose(fresnel(head_on, np.array([0.0])), 1)
    assert fresnel(head_on, np.array([0.5]))[0, 0] == pytest.approx(0.04 + 0.96 / 32, rel=1e-6)
    assert exponent(1.0) == 0
    assert exponent(0.2) == pytest.approx(1248)


def test_cloth_is_woven() -> None:
    cloth = Texture("weave", size=0.1, a=(0.8, 0.4, 0.2), b=(0.2, 0.2, 0.6), luma=(0.5, 1.0), seed=3)
    table = lattice(cloth)
    assert table.min() >= 0.5
    assert table.max() <= 1
    n = 400
    u, v = (c.ravel().astype(np.float32) for c in np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n))
    colours = albedo(cloth, table, u * np.float32(0.1), v * np.float32(0.1))  # one cell: i = j = 0, b on top along u
    mean = (1 - SIDES / 3) * (1 - DIVES / 3)
    assert np.allclose(colours.mean(1), np.array(cloth.b) * table[1, 0] * mean, rtol=1e-4)
    middle = np.array([0.05, 0.15, 0.15, 0.05], np.float32), np.array([0.05, 0.05, 0.15, 0.15], np.float32)
    tops = albedo(cloth, table, *middle)
    expected = [np.array(cloth.b) * table[1, 0], np.array(cloth.a) * table[0, 1]]
    expected += [np.array(cloth.b) * table[1, 1], np.array(cloth.a) * table[0, 0]]
    assert np.allclose(tops.T, expected, rtol=1e-5)
    assert np.array_equal(albedo(cloth, table, u + 6.4, v), albedo(cloth, table, u + 6.4, v))
    side, middle = albedo(cloth, table, *(np.array(c, np.float32) for c in ([0.05, 0.05], [0.001, 0.05])))[2]
    assert side < 0.4 * middle


def test_round_things_have_no_seam() -> None:
    """Light on a ball and a rod goes on around the back, where their coordinates begin and end."""
    table = np.random.default_rng(0).random(2 * 3 * 8 * 8, dtype=np.float32)
    ends, height = np.array([1e-6, 1 - 1e-6], np.float32), np.full(2, 0.3, np.float32)
    for shape, sides, side, closes in (
        ("ball", 1, 0, True),
        ("rod", 3, 0, True),
        ("rod", 3, 1, False),
        ("box", 6, 0, False),
    ):
        part, number = np.zeros(2, np.int32), np.full(2, side, np.int32)
        light = CrowdMap(table, table, shape, sides, 8)
        first, last = light.at(part, number, ends, height)[0]
        beside = light.at(part, number, np.array([0.5, 7.5], np.float32) / 8, height)[0]
        assert (abs(first - last) < 1e-4) == closes, shape
        assert (abs(first - beside.mean()) < 1e-4) == closes, shape
    for solid in (Ellipsoid((0, 0, 0), (0.5, 0.5, 0.5), 0.0, WHITE), Cylinder((0, 0, -0.5), (0, 0, 0.5), 0.5, WHITE)):
        world = World((solid,), Lamp((-3, 3, 0.2), (10, 10, 10)), (0.1, 0.1, 0.1), 0.0, (0, 0, 0))
        pose = orbit_pose(Orbit(views=1, start_deg=180, radius=2.5, height=0.0), 0)
        row = Stage(world).picture(Camera.pinhole(200, 3, 20), pose, 1)[1, :, 0]
        lit = row[60:140]
        assert np.ptp(lit) > 0.2
        assert np.abs(np.diff(lit, 2)).max() < 0.02
