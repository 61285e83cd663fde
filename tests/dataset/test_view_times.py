"""When a view's middle row was exposed: by the sensor's rows, whatever was cropped or warped."""

import numpy as np
import pytest

from spikerig.dataset.scene import Frame, Pose, View


def view(rows: np.ndarray, valid: np.ndarray | None = None, row_ns: int = 10) -> View:
    frame = Frame(np.zeros((*rows.shape, 3), np.uint8), start_ns=1000, exposure_ns=81, row_ns=row_ns)
    valid = np.ones(rows.shape, bool) if valid is None else valid
    return View("v", frame, None, rows.astype(np.float32), valid, Pose(np.eye(4)[:3]), None)


def rows_of(height: int, first: float = 0, width: int = 4) -> np.ndarray:
    return np.repeat(first + np.arange(height, dtype=np.float64)[:, None], width, 1)


def test_a_whole_picture_is_in_the_middle_of_its_sensor() -> None:
    assert view(rows_of(11)).middle_row == 5
    assert view(rows_of(11)).mid_ns == 1000 + 50 + 40, "half of 81 ns is 40.5, to even"
    assert [view(rows_of(11)).instant_ns(p) for p in (0.0, 1.0)] == [1050, 1131]


def test_a_crop_is_read_when_its_own_rows_were() -> None:
    whole, crop = view(rows_of(100)), view(rows_of(10, first=70))
    assert crop.middle_row == 75
    assert crop.mid_ns - whole.mid_ns == 25 * 10


def test_a_shrunken_picture_skips_rows() -> None:
    assert view(4 * rows_of(10) + 1.5).instant_ns(0) == 1000 + round(10 * (4 * 5 + 1.5))


def test_rows_of_pixels_that_are_not_seen_do_not_count() -> None:
    rows, valid = rows_of(9, first=40), np.ones((9, 4), bool)
    rows[4, :3], valid[4, :3] = 0, False
    assert view(rows, valid).middle_row == 44
    rows[4], valid[4] = 0, False
    assert view(rows, valid).middle_row == pytest.approx(44, abs=1), "the median of all others"
    assert view(rows, np.zeros((9, 4), bool)).middle_row == 4


def test_a_global_shutter_has_one_time() -> None:
    assert view(rows_of(10, first=70), row_ns=0).instant_ns(0.5) == view(rows_of(10), row_ns=0).instant_ns(0.5) == 1040
