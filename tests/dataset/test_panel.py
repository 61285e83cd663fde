"""The LED panel: its code, its edges, and that they tell the same story."""

import numpy as np
import pytest

from spikerig.dataset.errors import UsageError
from spikerig.dataset.panel import Led, Panel, count_from_gray, gray

S = 1_000_000_000


def test_gray_neighbours_differ_in_one_bit_and_decode() -> None:
    n = np.concatenate([np.arange(5000), 2**40 + np.arange(50), [2**62 - 1]])
    np.testing.assert_array_equal(count_from_gray(gray(n)), n)
    assert {int(a ^ b).bit_count() for a, b in zip(gray(n[:5000]), gray(n[1:5000]), strict=False)} == {1}


@pytest.mark.parametrize("start", [0, -(10**7), 1_700_000_000 * S + 12_345, 100_000 * 2**12 - 3_000_000])
def test_edges_are_where_the_state_changes(start: int) -> None:
    panel = Panel(bits=12, slow=4)
    grid = start + np.arange(0, 300 * panel.step_ns, panel.step_ns // 4)
    state = panel.state(grid)
    k, led = np.nonzero(state[1:] != state[:-1])
    edges = panel.edges(int(grid[0]) + 1, int(grid[-1]) + 1)
    assert list(zip(k, led, state[1:][k, led], strict=True)) == [
        (-(-(int(t) - start) // 25_000) - 1, n, up) for t, n, up in zip(*edges, strict=True)
    ]
    for t, n, up in zip(*edges, strict=True):  # to the nanosecond
        assert panel.state(t)[n] == up != panel.state(t - 1)[n]


def test_slow_bits_toggle_one_at_a_time_and_rarely() -> None:
    panel = Panel()
    slow = [k for k, led in enumerate(panel.leds) if led.bit >= panel.slow and not led.inverted]
    edges = panel.edges(0, S, slow)
    assert np.diff(edges.at_ns).min() == panel.step_ns << panel.slow
    assert abs(int(edges.rising.sum()) - int((~edges.rising).sum())) <= 5


def test_one_bit_is_a_square_wave() -> None:
    wave = Panel(step_ns=500_000_000, bits=1, slow=0, leds=(Led(0, False, 0, 0),))
    edges = wave.edges(0, 3 * S)
    np.testing.assert_array_equal(edges.at_ns, np.arange(6) * S // 2)
    np.testing.assert_array_equal(edges.rising, [False, True] * 3)


def test_corners_are_always_on_and_bad_panels_are_refused() -> None:
    panel = Panel(bits=8, slow=2)
    assert panel.state(np.arange(0, 10**8, 77_777))[:, -4:].all()
    for wrong in ({"bits": 0}, {"step_ns": 0}, {"slow": 26}, {"bits": 8, "leds": (Led(8, False, 0, 0),)}):
        with pytest.raises(UsageError):
            Panel(**wrong)
