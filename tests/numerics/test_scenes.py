"""Hard inputs of small parts, cut-outs and gloss: finite light, no hole, the known limit."""

import numpy as np
import pytest

from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.caster.crowd import Crowd, bounds
from spikerig.rigctl.sim.caster.grow import parts_of
from spikerig.rigctl.sim.caster.light import Stage
from spikerig.rigctl.sim.caster.parts import meet
from spikerig.rigctl.sim.caster.pattern import Texture
from spikerig.rigctl.sim.caster.solids import Bricks, Cylinder, Ellipsoid, Rect, Room, Scatter, Sphere
from spikerig.rigctl.sim.caster.world import Lamp, World
from spikerig.rigctl.sim.orbit import Orbit, orbit_pose

WHITE = Texture(a=(1, 1, 1))
HERE = np.eye(3, 4)


def world(*solids: object, lamp: Lamp | None = None, sky: tuple[float, float, float] = (0, 0, 0)) -> World:
    return World(tuple(solids), lamp or Lamp(), (1, 1, 1), 0.5, sky)  # type: ignore[arg-type]


def test_a_panel_seen_edge_on() -> None:
    """Rays in the plane of a panel, and along it at its height: a thin line at most, nothing that is not finite."""
    panel = Rect((0, 0, 2), (0, 0, 1), (1, 0, 0), WHITE, True)
    for centre in (15.5, 15.5001, 15.49):  # through a row of pixel centres, and beside it
        camera = Camera(np.array([[40.0, 0, 16], [0, 40, centre], [0, 0, 1]]), np.zeros(0), 32, 32)
        stage = Stage(world(panel))
        assert np.isfinite(stage.picture(camera, HERE, 1)).all()
        assert np.isfinite(stage.depth(camera, HERE)).sum() <= 32
    with np.errstate(all="ignore"):
        zero, one = np.zeros(1, np.float32), np.ones(1, np.float32)
        for shape in ("rect", "box", "ball", "rod"):
            t, *_ = meet(shape, (zero - 5, zero, zero + 1), (one, zero, zero))  # within the face z = 1
            assert not (t > 0) or t == np.inf or t == pytest.approx(4, abs=1.1)


def test_a_rod_seen_along_its_axis() -> None:
    rod = Cylinder((0, 0, 3), (0, 0, 7), 0.5, WHITE)
    camera = Camera.pinhole(101, 101, 60)
    depth = Stage(world(rod)).depth(camera, HERE)
    x, y = ((c + 0.5 - 50.5) / camera.K[0, 0] * 3 for c in np.meshgrid(np.arange(101), np.arange(101)))
    inside = np.hypot(x, y) < 0.499
    assert np.allclose(depth[inside], 3, rtol=1e-5)
    assert not np.isfinite(depth[np.hypot(x, y) > 0.501]).any()


def test_tiny_and_far() -> None:
    """A ball of 1e-3 at 100 units: as wide and as far as it is, though float32 has seven digits."""
    for radius, distance in ((1e-3, 100.0), (1e-4, 50.0)):
        ball = Ellipsoid((0, 0, distance), (radius,) * 3, 0.0, WHITE)
        f = 20 * distance / radius
        camera = Camera(np.array([[f, 0, 24], [0, f, 24], [0, 0, 1]]), np.zeros(0), 48, 48)
        depth = Stage(world(ball)).depth(camera, HERE)
        seen = np.isfinite(depth)
        assert seen.sum() == pytest.approx(np.pi * 20**2, rel=0.02)
        assert np.allclose(depth[seen], distance, rtol=2e-5)


def test_parts_around_the_camera() -> None:
    """Parts behind, beside, across the picture's plane and within NEAR: bounds hold, the picture is finite."""
    cloud = Scatter("box", 400, (0, 0, 0), (1.5, 1.5, 1.5), (0.2, 0.1, 0.15), seed=2, facing="any", texture=WHITE)
    parts = parts_of(cloud)[0]
    lo, hi = bounds(parts, HERE)
    behind = parts.centre[:, 2] + parts.radius < 0
    assert (lo[behind] > hi[behind]).all()
    camera = Camera.pinhole(40, 30, 80)
    stage = Stage(world(cloud))
    picture, depth = stage.picture(camera, HERE, 2), stage.depth(camera, HERE)
    assert np.isfinite(picture).all()
    assert depth.min() > 0
    # What the bounds leave out is not hit: as with bounds that hold everything.
    crowd = Crowd(parts)
    x, y = (np.arange(40) + 0.5 - 20) / camera.K[0, 0], (np.arange(30) + 0.5 - 15) / camera.K[1, 1]
    every, face = np.full((30, 40), np.inf, np.float32), np.full((30, 40), -1, np.int32)
    with pytest.MonkeyPatch.context() as patch:
        wide = (np.full((400, 2), -np.inf), np.full((400, 2), np.inf))
        patch.setattr("spikerig.rigctl.sim.caster.crowd.bounds", lambda *_: wide)
        crowd.hit(HERE, x, y, every, face)
    assert np.array_equal(every, depth)


def test_twenty_thousand_parts() -> None:
    many = Scatter("ball", 20_000, (0, 0, 4), (2, 2, 1), (0.02, 0.02, 0.02), seed=1, texture=WHITE)
    stage = Stage(world(many, lamp=Lamp((0, -3, 0), (9, 9, 9))))
    picture = stage.picture(Camera.pinhole(48, 30, 60), HERE, 1)
    assert np.isfinite(picture).all()
    assert 0.2 < (picture > 0).mean() < 1


def test_nothing_to_build() -> None:
    """Bricks of height zero, a lamp at a part's centre and on a part's surface, a part that shines."""
    empty = Bricks((0, 0, 0), (4, 4), (0.1, 0.1, 0.1), (0, 0), texture=WHITE)
    assert parts_of(empty) == ()
    pose, camera = orbit_pose(Orbit(views=1, radius=2.0, height=1.0), 0), Camera.pinhole(20, 12, 60)
    assert not Stage(world(empty)).picture(camera, pose, 1).any()
    for at in ((0, 0, 0), (0, 0, 0.3), (0.1, 0.1, 0.30001)):
        ball = Ellipsoid((0, 0, 0), (0.3, 0.3, 0.3), 0.0, WHITE)
        assert np.isfinite(Stage(world(ball, lamp=Lamp(at, (1, 1, 1)))).picture(camera, pose, 2)).all()
    shining = Scatter("rod", 3, (0, 0, 0), (0.3, 0.3, 0.3), (0.2, 0.2, 0.2), texture=Texture(a=(1, 1, 1), emit=30.0))
    assert Stage(world(shining)).picture(camera, pose, 1).max() == pytest.approx(30, rel=1e-5)


def test_gloss_at_grazing_angles() -> None:
    """A polished floor to the horizon under a lamp at the height of the eye: finite, no darker than matt and mirror."""
    floor = Texture(a=(0.2, 0.2, 0.2), gloss=0.04, rough=0.1)
    room = Room((-500, -500, 0), (500, 500, 300), floor, WHITE, WHITE)
    lamp = Lamp((0, 400, 1.0), (1e4, 1e4, 1e4), False)
    pose = orbit_pose(Orbit(views=1, start_deg=-90, radius=300.0, height=1.0, target=(0, 0, 0.9)), 0)
    picture = Stage(world(room, lamp=lamp)).picture(Camera.pinhole(60, 40, 40), pose, 2)
    assert np.isfinite(picture).all()
    assert picture.min() > 0
    ball = Sphere((0, 0, 3), 1.0, Texture(a=(0, 0, 0), gloss=0.04, rough=1.0))
    rim = Stage(world(ball, sky=(1, 1, 1))).depth(Camera.pinhole(200, 200, 45), HERE)
    light = Stage(world(ball, sky=(1, 1, 1))).picture(Camera.pinhole(200, 200, 45), HERE, 1)
    assert np.isfinite(light).all()
    assert light[np.isfinite(rim)].max() <= 1 + 1e-5
    assert light[np.isfinite(rim)].max() > 0.5  # nearly all is mirrored at the rim
