"""The two sensors: weights of the exposure, blending between knots, encoding."""

import numpy as np
import pytest

from spikerig.dataset.errors import UsageError
from spikerig.dataset.kernels import count
from spikerig.rigctl.sim.sensor import Light, encode, expose, integrate, spike_light
from spikerig.rigctl.sim.simulate import simulate
from spikerig.rigctl.sim.spec import Sensor


def ramp(knots: list[int], exposure: tuple[int, int], pictures: int | None = None) -> Light:
    """Light that rises by 1/1000 a tick, the same everywhere."""
    values = np.array(knots[: pictures or len(knots)], np.float32) / 1000
    return Light(np.tile(values[:, None, None, None], (1, 2, 3, 3)), np.array(knots), exposure, 1e4, 500)


def test_trapezoid_is_exact_for_ramps() -> None:
    light = ramp([0, 10, 13, 40, 100, 120], (10, 100))
    assert light.weights().sum() == pytest.approx(1)
    assert light.weights()[[0, 5]].tolist() == [0, 0]
    assert np.allclose(expose(light), 0.055)


def test_slots_weigh_by_their_length() -> None:
    light = ramp([0, 10, 30, 40], (10, 40), 3)
    assert light.hold
    assert np.allclose(light.weights(), [0, 2 / 3, 1 / 3])


def test_light_between_knots_is_at_tick_midpoints() -> None:
    """The charge of a ramp over whole intervals is the integral, for knots and for ticks alike."""
    light = ramp([0, 64, 320], (0, 320)).rgb[..., 0]
    seen = []

    def spy(block: np.ndarray) -> None:
        seen.append(block[:, 0, 0].copy())

    from spikerig.rigctl.sim.effects import Hooks

    knots = np.array([0, 64, 320])
    bits, left, _ = integrate(light.copy(), knots, np.zeros((2, 3)), [(True, Hooks(light=spy))])
    assert np.allclose(np.concatenate(seen), (np.arange(320) + 0.5) / 1000, atol=1e-7)
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
