"""Ticks and nanoseconds, and clock models."""

import numpy as np
import pytest

from spikerig.dataset.clocktime import ClockModel, ns_from_tick, tick_from_ns
from spikerig.dataset.errors import UsageError


@pytest.mark.parametrize("rate_hz", [40000.0, 20000.0, 39999.4, 28800.7])
def test_ticks_round_trip_at_unix_times(rate_hz: float) -> None:
    t0 = 1_700_000_000_000_000_000
    ticks = np.array([0, 1, 320, 40000 * 60, 2_000_000])
    np.testing.assert_allclose(tick_from_ns(ns_from_tick(ticks, rate_hz, t0), rate_hz, t0), ticks, atol=1e-4)


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan"), float("inf")])
def test_a_bad_rate_is_refused(rate_hz: float) -> None:
    with pytest.raises(UsageError, match="rate"):
        ns_from_tick(0, rate_hz, 0)


def test_clock_model_keeps_nanoseconds_at_unix_times_and_inverts() -> None:
    start = 1_700_000_000_000_000_000
    device = np.array([0, 10**10, 3 * 10**10], np.int64)
    rig = start + np.array([5, 10**10 + 430_005, 3 * 10**10 + 1_290_007], np.int64)
    model = ClockModel(device, rig, np.array([100.0, 50.0, 100.0]), drift_ppm=10)
    np.testing.assert_array_equal(model.rig_from_device(device), rig)
    at = np.arange(-(10**9), 4 * 10**10, 77_777_777)
    assert np.abs(model.device_from_rig(model.rig_from_device(at)) - at).max() <= 1


def test_clock_uncertainty_grows_in_hold_over() -> None:
    model = ClockModel(np.array([0, 100]), np.array([0, 100]), np.array([4.0, 8.0]), drift_ppm=1e6)
    np.testing.assert_allclose(model.sigma_at([50, 100, 110, -10]), [6.0, 8.0, 18.0, 14.0])


def test_identity_and_steps_back() -> None:
    at = np.array([-5, 0, 2**62])
    np.testing.assert_array_equal(ClockModel.identity().rig_from_device(at), at)
    with pytest.raises(UsageError, match="strictly"):
        ClockModel(np.array([0, 10]), np.array([0, 0]), np.zeros(2))
