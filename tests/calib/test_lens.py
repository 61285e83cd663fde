"""Directions to pixels and back, against OpenCV and against themselves."""

import numpy as np
import pytest
from hard_calib import LENSES

from spikerig.calib.lens import (
    bend,
    bent_only,
    by_coefficients,
    cv_matrix,
    directions,
    our_matrix,
    project,
    reach,
    stored,
)
from spikerig.dataset.errors import UsageError
from spikerig.dataset.scene import Camera

K = np.array([[520.0, 0, 205], [0, 523, 122], [0, 0, 1]])


def points(n: int = 200) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(n, 3)) * [0.5, 0.4, 0.2] + [0, 0, 2.5]


@pytest.mark.parametrize("name", LENSES)
def test_project_is_opencvs_half_a_pixel_over(name: str) -> None:
    import cv2

    x = points()
    told, jacobian = cv2.projectPoints(x, np.zeros(3), np.zeros(3), cv_matrix(K), LENSES[name])
    camera = Camera(K, LENSES[name], 400, 250)
    inside = np.hypot(x[:, 0], x[:, 1]) / x[:, 2] < reach(LENSES[name])
    assert inside.mean() > 0.9
    np.testing.assert_allclose(project(camera, x)[inside], told[inside, 0] + 0.5, atol=1e-9)
    assert np.isnan(project(camera, x)[~inside]).all()
    by_k = by_coefficients(x[:, :2] / x[:, 2:], LENSES[name]) * np.diag(K)[:2, None]
    own = jacobian.reshape(len(x), 2, -1)[:, :, 10 : 10 + len(LENSES[name])]
    np.testing.assert_allclose(by_k, own, atol=1e-9)


@pytest.mark.parametrize("name", LENSES)
def test_derivatives_are_those_of_small_steps(name: str) -> None:
    xy, h = points(50)[:, :2] / 3, 1e-6
    bent, by_xy = bend(xy, LENSES[name])
    np.testing.assert_allclose(bent_only(xy, LENSES[name]), bent, rtol=1e-14)
    for axis, step in enumerate(np.eye(2) * h):
        slope = (bent_only(xy + step, LENSES[name]) - bent_only(xy - step, LENSES[name])) / (2 * h)
        np.testing.assert_allclose(by_xy[..., axis], slope, atol=1e-7)


@pytest.mark.parametrize("name", LENSES)
def test_directions_undo_project_wherever_the_lens_reaches(name: str) -> None:
    x = points(2000)
    camera = Camera(K, LENSES[name], 400, 250)
    px = project(camera, x)
    seen = np.isfinite(px[:, 0]) & (np.hypot(x[:, 0], x[:, 1]) / x[:, 2] < 0.98 * reach(LENSES[name]))
    back = directions(camera, px[seen])
    np.testing.assert_allclose(back[:, :2], x[seen, :2] / x[seen, 2:], atol=1e-8)


def test_a_lens_that_folds_is_not_followed_beyond_its_fold() -> None:
    camera = Camera(K, np.array([-0.6, 0, 0, 0]), 400, 250)  # r (1 - 0.6 r2) turns back at r = 0.745
    assert reach(camera.distortion) == pytest.approx(np.sqrt(1 / 1.8), abs=0.006)
    assert np.isnan(project(camera, [[1.0, 0, 1], [0, 0, -1]])).all()
    rim = project(camera, [[0.74, 0, 1]])[0]
    assert np.isfinite(rim).all()
    assert np.isnan(directions(camera, rim + np.array([20, 0]))).any()


def test_stored_and_matrices() -> None:
    np.testing.assert_array_equal(stored(np.array([0.1])), [0.1, 0, 0, 0])
    np.testing.assert_array_equal(our_matrix(cv_matrix(K)), K)
    with pytest.raises(UsageError):
        stored(np.zeros(3))
