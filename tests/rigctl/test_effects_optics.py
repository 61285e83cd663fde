"""Between the scene and the sensors: splitter, ghost, mirror, lens, misaligned arms."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hard_effects_arms import drifting, run, same, still
from hard_sim import small

from spikerig.dataset.errors import UsageError
from spikerig.dataset.kernels import count
from spikerig.dataset.scene import Camera
from spikerig.rigctl.sim.capture import take_view
from spikerig.rigctl.sim.caster.light import Stage
from spikerig.rigctl.sim.caster.world import read_world
from spikerig.rigctl.sim.effects import Effect
from spikerig.rigctl.sim.effects.defocus import Defocus
from spikerig.rigctl.sim.effects.distortion import Distortion
from spikerig.rigctl.sim.effects.flip import MirrorFlip
from spikerig.rigctl.sim.effects.ghost import Ghost
from spikerig.rigctl.sim.effects.misalignment import Misalignment
from spikerig.rigctl.sim.effects.splitter import Splitter
from spikerig.rigctl.sim.effects.vignetting import Vignetting
from spikerig.rigctl.sim.limits import Faults
from spikerig.rigctl.sim.warp import bent, blurred, plane_map, resampler, shift_map, straight

ABSENT = [
    Splitter(0.5, 0.0),
    Misalignment((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    Ghost("both", 0.0),
    Distortion("both", 0.0, 0.0, 0.0, 0.0),
    Defocus("both", 0.0),
    Vignetting("both", 0.0, 0.0, 0.0),
]


def impulse(y: int, x: int, height: int = 21, width: int = 31) -> np.ndarray:
    picture = np.zeros((1, height, width, 1), np.float32)
    picture[0, y, x] = 1
    return picture


def centroid(picture: np.ndarray) -> tuple[float, float]:
    weight = picture.reshape(picture.shape[-3:-1]) / picture.sum()
    y, x = np.mgrid[: weight.shape[0], : weight.shape[1]]
    return float((weight * x).sum()), float((weight * y).sum())


@pytest.mark.parametrize("effect", ABSENT, ids=lambda e: e.name)
def test_the_limit_is_absence(effect: Effect) -> None:
    assert same(run(drifting(), effect), run(drifting()))


def test_the_splitter_shares_out_all_the_light() -> None:
    light = still(np.full((4, 9, 3), 0.3))
    for share, loss in ((0.25, 0.0), (0.7, 0.1), (0.0, 0.0), (1.0, 0.0)):
        seen = run(light, Splitter(share, loss))
        spikes = count(seen.spikes.bits, 9, 0, 400)
        assert np.allclose(seen.blurry, 0.3 * 2 * (1 - share) * (1 - loss), rtol=1e-6)
        assert np.abs(spikes - 0.3 * 0.4 * 400 * 2 * share * (1 - loss)).max() <= 1
        assert sum(Splitter(share, loss).gains) == pytest.approx(2 * (1 - loss))


def test_a_ghost_is_a_shifted_copy() -> None:
    light = np.zeros((15, 31, 3), np.float32)
    light[7, 10] = 0.8
    seen = run(still(light), Ghost("rgb", 0.05, 6.0, -2.0)).blurry
    assert seen[7, 10, 0] == pytest.approx(0.8)
    assert seen[5, 16, 0] == pytest.approx(0.04)
    assert seen.sum() == pytest.approx(light.sum() * 1.05)
    between = run(still(light), Ghost("rgb", 0.05, 6.5, 0.0)).blurry - run(still(light)).blurry
    assert between[..., :1].sum() == pytest.approx(0.04, rel=0.2)  # cubic's negative lobes are cut
    assert np.array_equal(run(still(light), Ghost("rgb", 0.05)).spikes.bits, run(still(light)).spikes.bits)


def test_a_flip_mirrors_one_arm_and_twice_is_none() -> None:
    light = drifting()
    bare = run(light)
    for axis, back in (("x", np.s_[:, ::-1]), ("y", np.s_[::-1])):
        flipped = run(light, MirrorFlip("rgb", axis))
        assert np.allclose(flipped.blurry, bare.blurry[back], atol=1e-6)
        assert np.array_equal(flipped.spikes.bits, bare.spikes.bits)
        spikes = run(light, MirrorFlip("spike", axis)).spikes
        assert np.array_equal(count(spikes.bits, 27, 0, 400), count(bare.spikes.bits, 27, 0, 400)[back])
        pictures = light.rgb
        assert np.array_equal(MirrorFlip("both", axis).flipped(MirrorFlip("both", axis).flipped(pictures)), pictures)


def test_vignetting_at_a_radius() -> None:
    light = still(np.full((61, 81, 3), 0.5))
    f = 81 / 2 / np.tan(np.radians(30))
    seen = run(light, Vignetting("rgb", 4.0)).blurry[..., 0] / 0.5
    assert seen[30, 40] == pytest.approx(1)
    assert seen[30, 70] == pytest.approx(np.cos(np.arctan(30 / f)) ** 4, rel=1e-5)
    assert seen[10, 25] == pytest.approx(np.cos(np.arctan(25 / f)) ** 4, rel=1e-5)
    shape = run(light, Vignetting("rgb", 0.0, -0.3, -0.1)).blurry[..., 0] / 0.5
    r = 30 / (np.hypot(61, 81) / 2)
    assert shape[30, 70] == pytest.approx(1 - 0.3 * r**2 - 0.1 * r**4, rel=1e-5)
    cut = run(light, Vignetting("both", 0.0, -1.5))
    assert cut.blurry[0, 0, 0] == 0
    assert count(cut.spikes.bits, 81, 0, 400)[0, 0] == 0


@pytest.mark.parametrize("radius", [0.2, 0.7, 3.3, 40.0])
def test_blur_keeps_energy_and_moment(radius: float) -> None:
    kernel = Defocus("both", radius).kernel
    y, x = np.indices(kernel.shape) - kernel.shape[0] // 2
    assert kernel.shape[0] % 2 == 1
    assert kernel.sum() == pytest.approx(1)
    for axis in (x, y):
        assert (kernel * axis).sum() == pytest.approx(0, abs=1e-9)
        assert (kernel * axis**2).sum() == pytest.approx(radius**2 / 4)
    flat = np.full((1, 9, 12, 3), 0.37, np.float32)
    assert np.allclose(blurred(flat, kernel), flat, atol=1e-5)
    if radius < 5:
        spot = blurred(impulse(10, 15), kernel)
        assert spot.sum() == pytest.approx(1, abs=1e-5)
        assert centroid(spot) == pytest.approx((15, 10), abs=1e-4)


def test_blur_of_a_wide_disk_is_even_inside_and_nothing_outside() -> None:
    kernel = Defocus("both", 8.0).kernel
    y, x = np.indices(kernel.shape) - kernel.shape[0] // 2
    r = np.hypot(x, y)
    assert np.allclose(kernel[r < 6.5], 1 / (np.pi * 64), rtol=0.25)
    assert np.abs(kernel[r > 10]).max() < 0.02 / (np.pi * 64)


def test_a_whole_shift_copies_and_a_part_keeps_quadratics() -> None:
    picture = np.random.default_rng(0).random((2, 12, 17, 3)).astype(np.float32)
    moved = resampler(12, 17, shift_map(3, -2))(picture)
    assert np.array_equal(moved[:, :10, 3:], picture[:, 2:, :14])
    y, x = np.mgrid[:12, :17].astype(np.float32)
    curve = (0.3 * x * x - x * y + 2 * y + 5)[None, :, :, None]
    part = resampler(12, 17, shift_map(0.37, 0.81))(curve)
    wanted = 0.3 * (x - 0.37) ** 2 - (x - 0.37) * (y - 0.81) + 2 * (y - 0.81) + 5
    assert np.allclose(part[0, 3:-3, 3:-3, 0], wanted[3:-3, 3:-3], atol=1e-4)


def test_shrinking_averages() -> None:
    y, x = np.mgrid[:60, :60]
    checker = ((x + y) % 2).astype(np.float32)[None, :, :, None]
    shrunk = resampler(60, 60, lambda u, v: (3 * (u - 30) + 30, 3 * (v - 30) + 30))(checker)
    assert np.abs(shrunk[0, 24:36, 24:36] - 0.5).max() < 0.1
    same_size = resampler(60, 60, lambda u, v: (u, v))(checker)
    assert np.array_equal(same_size, checker)


@pytest.mark.parametrize("k", [(-0.2, 0.03, 0.0, 0.0), (0.1, 0.0, 0.004, -0.003), (-0.05, -0.02, 0.01, 0.01)])
def test_the_lens_and_its_inverse(k: tuple[float, float, float, float]) -> None:
    x, y = np.random.default_rng(1).uniform(-0.7, 0.7, (2, 500))
    u, v = bent(x, y, k)
    points = np.stack([x, y, np.ones(500)], 1)
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(k))[0].reshape(-1, 2)
    assert np.allclose(np.stack([u, v], 1), theirs, atol=1e-12)
    back = straight(u, v, k)
    assert np.allclose(back, (x, y), atol=1e-9)


def test_a_point_lands_where_the_lens_puts_it() -> None:
    camera = Camera.pinhole(81, 61, 60)
    f = camera.K[0, 0]
    k = (-0.15, 0.05, 0.005, -0.004)
    light = np.full((61, 81, 3), 0.1, np.float32)
    light[12, 66] = light[50, 8] = 0.9
    seen = run(still(light), Distortion("rgb", *k)).blurry[..., 0] - 0.1
    for y, x in ((12, 66), (50, 8)):
        u, v = bent((x + 0.5 - 40.5) / f, (y + 0.5 - 30.5) / f, k)
        at = np.array([u * f + 40.5 - 0.5, v * f + 30.5 - 0.5])
        i, j = np.rint(at).astype(int)
        patch = np.zeros((61, 81))
        patch[j - 3 : j + 4, i - 3 : i + 4] = np.maximum(seen[j - 3 : j + 4, i - 3 : i + 4], 0)
        assert centroid(patch[None, ..., None]) == pytest.approx(tuple(at), abs=0.12)
        assert np.hypot(*(at - (x, y))) > 0.8
    flat = run(still(np.full((20, 30, 3), 0.25)), Distortion("both", -0.3)).blurry
    assert np.allclose(flat, 0.25, atol=1e-6)


def test_a_lens_that_folds_is_refused() -> None:
    with pytest.raises(UsageError, match="folds over"):
        run(still(np.full((40, 60, 3), 0.25)), Distortion("rgb", -1.5))


def plane_world(z: float) -> Stage:
    """A wall across the axis at a depth, dark left and bright right of x = 0, seen by the camera of pose (1 | 0)."""
    faults = Faults("test")
    dark, bright = ({"kind": "plain", "a": [a, a, a]} for a in (0.1, 0.9))
    half = 50.0
    solids = [
        {"kind": "rect", "centre": [side * half, 0, z], "right": [half, 0, 0], "up": [0, half, 0], "texture": skin}
        for side, skin in ((-1, dark), (1, bright))
    ]
    world = read_world({"ambient": [1.0, 1.0, 1.0], "contact": 0.0, "solids": solids}, faults)
    faults.raise_any()
    return Stage(world)


@pytest.mark.parametrize(("z", "b"), [(2.0, 0.05), (5.0, 0.05), (5.0, -0.2)])
def test_a_shifted_arm_sees_parallax(z: float, b: float) -> None:
    """The edge moves by f b / z pixels."""
    camera, pose = Camera.pinhole(120, 8, 60), np.eye(3, 4)[None]
    stage, arm = plane_world(z), Misalignment((0.0, 0.0, 0.0), (b, 0.0, 0.0))

    def edge(at: np.ndarray) -> float:
        row = stage.picture(camera, at, 8)[4, :, 0]
        return float(np.sum((0.9 - row) / 0.8))  # how many pixels are dark

    moved = edge(arm.rgb_poses(pose)[0]) - edge(pose[0])
    assert moved == pytest.approx(camera.K[0, 0] * b / z, abs=0.08)


def test_which_way_an_arm_turns() -> None:
    """A point on the spike camera's axis lies to the right of the RGB camera's after a turn about y (down); below for
    a turn back about x; one on the right goes down for a turn about z. First x, then y, then z."""
    ahead, right = np.array([0, 0, 1.0]), np.array([1.0, 0, 0])

    def turned(x: float, y: float, z: float, point: np.ndarray) -> np.ndarray:
        return Misalignment((x, y, z)).rgb_from_spike[:, :3] @ point

    s, c = np.sin(np.radians(10)), np.cos(np.radians(10))
    assert np.allclose(turned(0, 10, 0, ahead), (s, 0, c))
    assert np.allclose(turned(-10, 0, 0, ahead), (0, s, c))
    assert np.allclose(turned(0, 0, 10, right), (c, s, 0))
    assert np.allclose(turned(90, 90, 0, ahead), turned(0, 90, 0, turned(90, 0, 0, ahead)))


def test_a_turned_arm_is_a_homography() -> None:
    """What is cast from the turned pose and what is redrawn from the other agree where both see."""
    spec = small(camera__width=120, camera__height=90)
    stage, camera = Stage(spec.world), Camera.pinhole(120, 90, 60)
    pose = take_view(spec, 0, stage).view.pose.cam_from_world[None]
    arm = Misalignment((1.5, -2.0, 4.0), (0.0, 0.0, 0.0))
    here = stage.picture(camera, pose[0], 6)
    there = stage.picture(camera, arm.rgb_poses(pose)[0], 6)
    redrawn = resampler(90, 120, plane_map(arm.spike_from_rgb(camera.K, np.inf)))(here[None])[0]
    inside = np.s_[12:-12, 12:-12]
    wrong = resampler(90, 120, plane_map(np.linalg.inv(arm.spike_from_rgb(camera.K, np.inf))))(here[None])[0]
    assert np.abs(redrawn - there)[inside].mean() < 0.02
    assert np.abs(wrong - there)[inside].mean() > 0.1


def test_a_scene_with_misaligned_arms() -> None:
    """Spikes and labels stay; the picture is that of the other pose; what is done is in the effects."""
    spec = replace(small(), effects=())
    apart = replace(spec, effects=(Misalignment((0.0, 0.0, 0.0), (0.3, 0.0, 0.0)),))
    none = replace(spec, effects=(ABSENT[1],))
    bare, seen, same_arm = (take_view(s, 0) for s in (spec, apart, none))
    assert np.array_equal(seen.view.spikes.bits, bare.view.spikes.bits)  # type: ignore[union-attr]
    assert np.array_equal(seen.view.pose.cam_from_world, bare.view.pose.cam_from_world)
    assert np.array_equal(seen.light, bare.light)
    assert np.abs(seen.view.frame.pixels.astype(int) - bare.view.frame.pixels).mean() > 5
    assert np.array_equal(same_arm.view.frame.pixels, bare.view.frame.pixels)


def test_a_shift_needs_geometry() -> None:
    with pytest.raises(UsageError, match="depth behind every pixel") as caught:
        run(drifting(), Misalignment((0.1, 0.0, 0.0), (0.01, 0.0, 0.0)))
    assert "translation = [0, 0, 0]" in caught.value.next
    turned = run(drifting(), Misalignment((0.0, 3.0, 0.0)))
    assert not np.array_equal(turned.frame.pixels, run(drifting()).frame.pixels)
    assert np.array_equal(turned.spikes.bits, run(drifting()).spikes.bits)


def test_arms_are_told_apart() -> None:
    light, bare = drifting(), run(drifting())
    for effect in (Ghost, Distortion, Defocus, Vignetting, MirrorFlip):
        spike, rgb = run(light, effect(arm="spike")), run(light, effect(arm="rgb"))
        assert np.array_equal(spike.frame.pixels, bare.frame.pixels)
        assert not np.array_equal(spike.spikes.bits, bare.spikes.bits)
        assert np.array_equal(rgb.spikes.bits, bare.spikes.bits)
        assert not np.array_equal(rgb.frame.pixels, bare.frame.pixels)
        both = run(light, effect(arm="both"))
        assert np.array_equal(both.spikes.bits, spike.spikes.bits)
        assert np.array_equal(both.frame.pixels, rgb.frame.pixels)
