"""The panel's light in the emulated cameras, against its state asked many times."""

import numpy as np
import pytest

from spikerig.dataset.errors import UsageError
from spikerig.dataset.panel import Panel
from spikerig.rigctl.sim.emulate.panel_light import PanelInView, lit_ns, with_panel

PANEL = Panel(step_ns=100_000, bits=6, slow=3)


def view(light=0.5, radius=1.5, panel=PANEL, height=40, width=64):
    centres = np.array([(4 + 7 * (k % 8), 5.3 + 9 * (k // 8)) for k in range(len(panel.leds))])
    return PanelInView(panel, centres, radius, light, height, width)


@pytest.mark.parametrize("bits", [1, 2, 6])
@pytest.mark.parametrize("start", [-12_345_678, 0, 999_999_999_999])
def test_lit_time_is_the_sum_of_the_states(bits, start):
    panel = Panel(step_ns=1000, bits=bits, slow=0)
    at = start + np.arange(200) * 777
    fine = start + np.arange(200 * 777)
    state = panel.state(fine)
    summed = np.add.reduceat(state, np.arange(0, len(fine), 777), axis=0)
    np.testing.assert_array_equal(np.diff(lit_ns(panel, np.append(at, at[-1] + 777)), axis=0), summed)


def test_a_tick_across_an_edge_has_its_share():
    seen = view()
    light = seen.of_ticks(np.array([75_000, 100_000, 125_000, 150_000]) - 10_000)
    first = seen.led == 0  # bit 0 rises at 1 T = 0.1 ms
    np.testing.assert_allclose(light[:, first].T, [[0, 0.6 * 0.5, 0.5]] * seen.weight[first, None], rtol=1e-6)


def test_rows_of_a_rolling_shutter_make_a_ramp():
    panel = Panel(step_ns=10_000_000, bits=1, slow=0)
    centres = np.array([(10, 3), (30, 60), (50, 3), (50, 60), (10, 60), (30, 3)], float)
    seen = PanelInView(panel, centres, 2, 1.0, 64, 64)
    starts = 5_000_000 + np.arange(64) * 100_000
    light = seen.of_rows(starts, 8_000_000) / seen.weight
    begin = starts[seen.rows[seen.led == 0]]
    np.testing.assert_allclose(light[seen.led == 0], np.clip((begin + 8e6 - 10e6) / 8e6, 0, 1), atol=1e-6)
    assert (light[seen.led >= 2] > 0.99).all()  # always on


def test_spikes_with_a_panel_keep_the_rest_and_count_its_light():
    rng = np.random.default_rng(0)
    bits = rng.integers(0, 256, (400, 40, 8), np.uint8)
    still = np.full((40, 64), 0.05)
    seen = view()
    bounds = 1_000_000 + np.arange(401) * 25_000
    made, charge = with_panel(bits, still, seen, bounds)
    before, after = (np.unpackbits(b, axis=2, bitorder="little") for b in (bits, made))
    elsewhere = np.ones((40, 64), bool)
    elsewhere[seen.rows, seen.columns] = False
    np.testing.assert_array_equal(before[:, elsewhere], after[:, elsewhere])
    expected = (seen.of_ticks(bounds) + 0.05).sum(0)
    assert np.abs(after[:, seen.rows, seen.columns].sum(0) - expected).max() <= 1
    half, left = with_panel(bits[:200], still, seen, bounds[:201])
    rest, left = with_panel(bits[200:], still, seen, bounds[200:], left)
    np.testing.assert_array_equal(np.concatenate([half, rest]), made)
    np.testing.assert_array_equal(left, charge)


def test_a_panel_that_cannot_be_seen_is_refused():
    with pytest.raises(UsageError, match="outside"):
        view(height=8)
    with pytest.raises(UsageError, match="overlap"):
        view(radius=5)
    with pytest.raises(UsageError):
        PanelInView(PANEL, np.zeros((3, 2)), 1, 1, 40, 64)
