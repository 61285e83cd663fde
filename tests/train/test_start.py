"""Where a fit starts: spacing of points, their number, the gauge."""

import numpy as np
import pytest

from spikerig.dataset.errors import DataError
from spikerig.dataset.rigid import exp_se3
from spikerig.dataset.scene import Points
from spikerig.train.gauge import Gauge, gauge_of
from spikerig.train.methods import configure
from spikerig.train.start import SH0, fill, spacing, start_splats


def surface(n: int, seed: int = 0) -> np.ndarray:
    u = np.random.default_rng(seed).uniform(-1, 1, (n, 2))
    return np.stack([u[:, 0], u[:, 1], 0.3 * np.sin(3 * u[:, 0])], 1)


def test_spacing_is_nearly_that_of_an_exhaustive_search():
    xyz = surface(900)
    far = np.linalg.norm(xyz[:, None] - xyz[None], axis=2)
    exact = np.sort(far, axis=1)[:, 1:4].mean(1)
    found = spacing(xyz)
    assert (found >= exact - 1e-12).all()
    assert np.mean(found > exact * 1.001) < 0.03


def test_spacing_of_awkward_points():
    assert spacing(np.zeros((1, 3))).tolist() == [0.1]
    assert spacing(np.zeros((5, 3))).tolist() == [0] * 5
    assert spacing(np.array([[0.0, 0, 0], [1, 0, 0]])).tolist() == [1, 1]


def test_points_are_filled_up_or_thinned_to_the_wanted_number():
    rng = np.random.default_rng(1)
    xyz, rgb = surface(100), np.random.default_rng(0).uniform(size=(100, 3))
    more, colours = fill(xyz, rgb, 130, rng)
    assert np.array_equal(more[:100], xyz)
    assert len(more) == len(colours) == 130
    away = np.linalg.norm(more[100:, None] - xyz[None], axis=2).min(1)
    assert 0 < away.max() < 5 * spacing(xyz).max()
    fewer, _ = fill(xyz, rgb, 40, rng)
    assert len(np.unique(fewer, axis=0)) == 40
    assert len(fill(xyz, rgb, 350, rng)[0]) == 350


def test_the_start_has_the_points_colours_and_sizes():
    points = Points(surface(300), np.full((300, 3), 51, np.uint8), "simulator")
    config = configure("plain", "draft", splats=300, sh_degree=1)
    found = start_splats(points, Gauge((0.0, 0.0, 0.0), 2.0), config)
    assert found["sh"].shape == (300, 4, 3)
    assert (found["sh"][:, 0] * SH0 + 0.5).numpy() == pytest.approx(np.full((300, 3), 0.2), abs=1e-6)
    assert not found["sh"][:, 1:].any()
    scale = np.exp(found["log_scales"].numpy()).mean()
    assert scale == pytest.approx(config.init_scale * 2 * spacing(points.xyz).mean(), rel=0.2)


def test_no_points_is_an_error_unless_random_ones_are_asked_for(capsys):
    for none in (None, Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "sfm")):
        with pytest.raises(DataError, match="no sparse points"):
            start_splats(none, Gauge((0.0, 0.0, 0.0), 1.0), configure())
    config = configure("plain", "draft", splats=50, init="random")
    assert len(start_splats(None, Gauge((0.0, 0.0, 0.0), 1.0), config)["means"]) == 50
    assert "10 dB" in capsys.readouterr().err


def test_the_gauge_leaves_pictures_as_they_are():
    poses = np.stack([exp_se3(np.array([0.1 * k, 0.2, 0, k, -1.0, 3.0])) for k in range(4)])
    xyz = surface(200) * 7 + np.array([100.0, -50, 20])
    gauge = gauge_of(xyz, poses)
    inside = gauge.inside(xyz)
    assert np.abs(inside).max() <= 1.1
    assert np.allclose(gauge.world(inside), xyz, atol=1e-9)
    for pose in poses:
        a = xyz @ pose[:, :3].T + pose[:, 3]
        moved = gauge.pose(pose).astype(np.float64)
        b = inside @ moved[:, :3].T + moved[:, 3]
        assert np.allclose(a[:, :2] / a[:, 2:], b[:, :2] / b[:, 2:], atol=1e-4)


def test_a_scene_without_extent_is_told():
    with pytest.raises(DataError, match="no extent"):
        gauge_of(np.zeros((0, 3)), np.eye(4)[None, :3])
    with pytest.raises(DataError, match="no extent"):
        gauge_of(np.full((3, 3), np.nan), np.eye(4)[None, :3])
