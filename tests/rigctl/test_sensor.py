"""The two sensors: weights of the exposure, blending between knots, encoding."""

import numpy as np
import pytest

from spikerig.dataset.errors import UsageError
from spikerig.dataset.kernels import count
from spikerig.rigctl.sim.rgb import encode, expose, window_weights
from spikerig.rigctl.sim.sensor import Light, delayed, integrate, refined, spike_light
from spikerig.rigctl.sim.simulate import simulate
from spikerig.rigctl.sim.spec import Sensor


def ramp(knots: list[int], exposure: tuple[int, int], pictures: int | None = None) -> Light:
    """Light that rises by 1/1000 a tick, the same everywhere."""
    values = np.array(knots[: pictures or len(knots)], np.float32) / 1000
    return Light(np.tile(values[:, None, None, None], (1, 2, 3, 3)), np.array(knots), exposure, 1e4, 500)


def test_trapezoid_is_exact_for_ramps() -> None:
    light = ramp([0, 10, 13, 40, 100, 120], (10, 100))
    weights = window_weights(light, np.array([10.0]))[0]
    assert weights.sum() == pytest.approx(1)
    assert weights[[0, 5]].tolist() == [0, 0]
    assert np.allclose(expose(light), 0.055)


def test_slots_weigh_by_their_length() -> None:
    light = ramp([0, 10, 30, 40], (10, 40), 3)
    assert light.hold
    assert np.allclose(window_weights(light, np.array([10.0])), [[0, 2 / 3, 1 / 3]])


def test_light_between_knots_is_at_tick_midpoints() -> None:
    """The charge of a ramp over whole intervals is the integral, for knots and for ticks alike."""
    light = ramp([0, 64, 320], (0, 320)).rgb[..., 0]
    knots = np.array([0, 64, 320])
    fine = np.tile(((np.arange(320) + 0.5) / 1000).astype(np.float32)[:, None, None], (1, 2, 3))
    bits, left, _ = integrate(fine, np.arange(321), np.zeros((2, 3)))
    whole, left_whole, _ = integrate(light.copy(), knots, np.zeros((2, 3)))
    assert count(bits, 3, 0, 320)[0, 0] == count(whole, 3, 0, 320)[0, 0] == 51  # 0.32^2 / 2 * 1000 = 51.2
    assert left[0, 0] / 2**32 == pytest.approx(0.2, abs=1e-4)
    assert left_whole[0, 0] / 2**32 == pytest.approx(0.2, abs=1e-4)


def test_gain_and_response() -> None:
    rgb = np.zeros((1, 1, 3, 3), np.float32)
    rgb[0, 0] = np.eye(3) * 0.5
    light = spike_light(rgb, Sensor(gain=0.8, response=(0.25, 0.4, 0.35)))
    assert np.allclose(light[0, 0], [0.1, 0.16, 0.14])


def test_known_encoded_values() -> None:
    linear = np.array([[[0, 0.0031308, 0.21404114], [0.5, 1.0, 7.0]]])
    assert encode(linear).tolist() == [[[0, 10, 127], [188, 255, 255]]] or encode(linear).tolist() == [
        [[0, 10, 128], [188, 255, 255]]
    ]


def test_blur_is_averaged_in_linear_light() -> None:
    rgb = np.zeros((2, 1, 1, 3), np.float32)
    rgb[1] = 1
    seen = simulate(Light(rgb, np.array([0, 8]), (0, 8), 1e3), Sensor(), [], 0)
    assert (seen.frame.pixels == 188).all()  # half the light, not half the code value
    assert seen.frame.exposure_ns == 8_000_000


def test_times() -> None:
    seen = simulate(ramp([5, 10, 100, 120], (10, 100)), Sensor(), [], 0)
    assert seen.spikes.ticks == 115
    assert seen.spikes.t0_ns == 500
    assert seen.frame.start_ns == 500 + 5 * 100_000
    assert seen.frame.exposure_ns == 90 * 100_000


@pytest.mark.parametrize(
    ("shape", "knots", "exposure", "says"),
    [
        ((2, 3, 4), [0, 1], (0, 1), "rgb"),
        ((2, 3, 4, 3), [0, 1, 2, 3], (0, 1), "K or K"),
        ((2, 3, 4, 3), [0, 0], (0, 0), "increase"),
        ((2, 3, 4, 3), [0, 9], (0, 8), "starts and ends at knots"),
    ],
)
def test_light_that_does_not_fit(shape: tuple, knots: list, exposure: tuple, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        Light(np.zeros(shape, np.float32), np.array(knots), exposure, 1e4)


def test_refined_light_is_the_same_light() -> None:
    light = ramp([0, 10, 13, 40, 100, 120], (10, 100))
    fine = refined(light, 7e-4)
    assert np.diff(fine.knots).max() <= 7
    assert set(light.knots.tolist()) <= set(fine.knots.tolist())
    assert np.allclose(fine.rgb[:, 0, 0, 0], fine.knots / 1000)
    held = refined(ramp([0, 10, 30, 40], (10, 40), 3), 7e-4)
    assert held.hold
    assert np.allclose(window_weights(held, np.array([10.0])).sum(), 1)
    assert np.allclose(expose(held), expose(ramp([0, 10, 30, 40], (10, 40), 3)))
    copy = refined(light, 0.0)
    copy.rgb[:] = 0
    assert light.rgb.any()


@pytest.mark.parametrize("hold", [False, True])
def test_a_clock_that_is_ahead_sees_the_past(hold: bool) -> None:
    light = ramp([0, 10, 20, 40, 80], (0, 80), 4 if hold else 5)
    seen, knots = delayed(light.rgb[..., 0], light.knots, np.full(5, 5.0))
    if hold:  # the first picture also stands in for what came before it
        assert knots.tolist() == [0, 5, 15, 25, 45, 80]
        assert np.allclose(seen[:, 0, 0], [0, 0, 0.01, 0.02, 0.04])
    else:
        assert np.allclose(np.interp([30, 60, 80], knots, seen[:, 0, 0]), [0.025, 0.055, 0.075])
        assert seen[0, 0, 0] == 0
    same, _ = delayed(light.rgb[..., 0], light.knots, np.zeros(5))
    assert np.array_equal(same, light.rgb[..., 0])
    with pytest.raises(UsageError, match="backwards"):
        delayed(light.rgb[..., 0], light.knots, np.array([0.0, -11.0, 0.0, 0.0, 0.0]))


def test_rows_of_a_rolling_shutter_see_their_own_time() -> None:
    """On a ramp in time each row's mean is the ramp at the middle of that row's exposure; row H//2 is on time."""
    knots = np.array([0, 50, 100, 200])
    rgb = np.tile((knots / 1000).astype(np.float32)[:, None, None, None], (1, 5, 2, 3))
    light = Light(rgb, knots, (50, 100), 1e4)
    rows = expose(light, row_ns=1e5 * 8)[:, 0, 0]  # eight ticks a row
    assert np.allclose(rows, 0.075 + 0.008 * (np.arange(5) - 2))
    with pytest.raises(UsageError, match="reads out for longer"):
        expose(light, row_ns=1e5 * 30)
