"""The panel read from spikes and from frames whose times are known."""

import numpy as np
import panel_worlds as worlds
import pytest

from spikerig.calib.clock import fit_rig
from spikerig.calib.panel_frames import _edge, read_frames
from spikerig.calib.panel_read import Spot, read_spikes
from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.panel import Led, Panel
from spikerig.dataset.stream import SpikeStream

BASE = 1_700_000_000 * NS + 271_828_182


def ahead(device_ns):
    """The panel's clock from the camera's."""
    return device_ns + BASE + np.rint(device_ns * 30e-6).astype(np.int64)


def off(sights):
    """Camera times that were read minus the true ones, ns; and the claimed deviations."""
    seen = ahead(np.array([s.device_ns for s in sights])) - np.array([s.panel_ns for s in sights])
    return seen.astype(float), np.array([s.sigma_ns for s in sights])


@pytest.fixture(scope="module")
def looked():
    panel = Panel(bits=16)
    places = worlds.spots(panel)
    return panel, places, worlds.spikes_of(panel, places, 6000, ahead, t0_ns=77)


def test_spikes_tell_the_panels_time(looked):
    panel, places, stream = looked
    sights = read_spikes(stream, panel, places, ahead_ns=BASE + NS, epoch=3)  # the code repeats after 6.5 s
    error, claimed = off(sights)
    assert len({s.led for s in sights}) >= 24
    assert np.sqrt(np.mean(error**2)) < 4_000  # a sixth of a tick
    rising = np.array([s.rising for s in sights])
    assert abs(error[rising].mean()) < 1_500
    assert abs(error[~rising].mean()) < 1_500
    assert (np.abs(error) <= 2 * claimed).mean() > 0.9
    assert {s.epoch for s in sights} == {3}


def test_lost_ticks_are_not_read_as_dark(looked):
    panel, places, stream = looked
    bits = stream.bits.copy()
    bits[3000:3300] = 0
    holes = SpikeStream(bits, stream.width, stream.rate_hz, 77, "spike", np.array([[3000, 3300]]))
    error, _ = off(read_spikes(holes, panel, places, ahead_ns=BASE))
    assert np.abs(error).max() < 25_000
    worse, _ = off(read_spikes(SpikeStream(bits, stream.width, stream.rate_hz, 77), panel, places, ahead_ns=BASE))
    assert np.abs(worse).max() > np.abs(error).max()


def test_an_edge_whose_ticks_were_lost_makes_no_mark(looked):
    panel, places, stream = looked
    rate = NS / 40_000
    edges = panel.edges(int(ahead(77)) + 20_000_000, int(ahead(77)) + 130_000_000, [9])
    assert len(edges.at_ns) == 1  # bit 9 toggles every 102.4 ms
    tick = round((int(edges.at_ns[0]) - BASE - 77) / (1 + 30e-6) / rate)
    bits = stream.bits.copy()
    bits[tick + 5 : tick + 25] = 0
    holes = SpikeStream(bits, stream.width, stream.rate_hz, 77, "spike", np.array([[tick + 5, tick + 25]]))
    found = {(s.led, s.rising) for s in read_spikes(holes, panel, places, ahead_ns=BASE)}
    whole = {(s.led, s.rising) for s in read_spikes(stream, panel, places, ahead_ns=BASE)}
    assert (9, bool(edges.rising[0])) in whole - found


def test_a_dim_panel_at_20_khz():
    panel = Panel(bits=14)
    places = worlds.spots(panel, radius=4.2)
    stream = worlds.spikes_of(panel, places, 5000, ahead, rate_hz=20_000.0, on=0.1, off=0.002)
    error, claimed = off(read_spikes(stream, panel, places, ahead_ns=BASE))
    assert np.sqrt(np.mean(error**2)) < 25_000
    assert abs(error.mean()) < 10_000
    assert (np.abs(error) <= 3 * claimed).mean() > 0.9


def test_a_square_wave_is_read_too():
    wave = Panel(step_ns=10_000_000, bits=1, slow=0, leds=(Led(0, False, 0.0, 0.0),))
    place = [Spot(0, 30.0, 20.0, 3.0)]
    stream = worlds.spikes_of(wave, place, 8000, ahead, shape=(40, 64))
    error, _ = off(read_spikes(stream, wave, place, ahead_ns=BASE + 8_000_000))
    assert np.abs(error).max() < 12_500
    late, _ = off(read_spikes(stream, wave, place, ahead_ns=BASE + 12_000_000))  # beyond half of 20 ms
    np.testing.assert_allclose(late, error - 20_000_000, atol=10)


def test_a_panel_that_is_not_there_is_told(looked):
    panel, places, stream = looked
    dark = SpikeStream(np.zeros_like(stream.bits[:500]), stream.width, 40_000.0)
    rng = np.random.default_rng(0)
    noisy = SpikeStream.from_pixels(rng.random((800, 250, 400), np.float32) < 0.3, 40_000.0)
    for stream in (dark, noisy):
        with pytest.raises(DataError):
            read_spikes(stream, panel, places)
    with pytest.raises(DataError):
        read_spikes(SpikeStream(looked[2].bits, 400), panel, places)  # no rate
    with pytest.raises(UsageError, match="outside"):
        read_spikes(looked[2], panel, [Spot(0, 500.0, 20.0)])


ROW_NS = 26_000.0  # of a small picture: the same read-out time as 1080 rows of 6.5 us


def shot(gamma=1.0, frames=240, row_ns=ROW_NS, slow=5, **more):
    panel = Panel(bits=16, slow=slow)
    places = worlds.spots(panel, 480, 270, 3.1)
    starts = (np.arange(frames) * NS / 119.88).astype(np.int64)
    looks = worlds.frames_of(panel, places, starts, 2_083_333, row_ns, ahead, gamma=gamma, **more)
    return panel, places, looks


def test_frames_tell_the_panels_time():
    panel, places, looks = shot()
    sights = read_frames(looks, panel, places, ROW_NS, ahead_ns=BASE - NS)
    error, claimed = off(sights)
    assert len(sights) > 200  # about one edge a frame, seen at top and bottom
    assert np.sqrt(np.mean(error**2)) < 12_000
    assert abs(error.mean()) < 2_000
    assert (np.abs(error) <= 2 * claimed).mean() > 0.9
    assert {s.row > 135 for s in sights} == {False, True}


@pytest.mark.parametrize("last", [0.3, 0.6, 1.5])
def test_an_led_that_comes_on_as_the_clip_ends_makes_no_false_time(last):
    # Too few of its frames show what it is when on: a share of that would be off by milliseconds.
    panel, exposure = Panel(bits=16, slow=7), 8_000_000
    places = worlds.spots(panel, 480, 270, 3.1)
    (number,) = [k for k, led in enumerate(panel.leds) if led.bit == 13 and not led.inverted]
    toggles = panel.edges(BASE, BASE + 20 * NS, [number])
    begins = round((int(toggles.at_ns[toggles.rising][0]) - BASE) / (1 + 30e-6))
    step = NS / 119.88
    starts = begins + np.rint((np.arange(51) - 50 + last) * step).astype(np.int64)
    looks = worlds.frames_of(panel, places, starts, exposure, 10_000.0, ahead, noise=0.005)
    sights = read_frames(looks, panel, places, 10_000.0, ahead_ns=BASE)
    error, _ = off(sights)
    assert len(sights) > 20
    assert np.abs(error).max() < 200_000


def test_a_wrong_response_and_a_wrong_readout_are_solved_for():
    panel, places, looks = shot(gamma=0.8, row_ns=ROW_NS * 1.05)
    sights = read_frames(looks, panel, places, ROW_NS, ahead_ns=BASE)
    error, _ = off(sights)
    assert np.abs(error).mean() > 100_000  # as they come
    clocks = fit_rig(sights + list(_spike_of()))
    told = clocks.fit("rgb").constants
    assert told["row_ns"] == pytest.approx(0.05 * ROW_NS, abs=100)
    assert told["response_ns"] == pytest.approx(133_000, abs=15_000)
    at = np.arange(0, 3 * NS, NS // 10)
    true = at + np.rint(at * 30e-6).astype(np.int64)  # of row 0; the spike camera here runs with the panel
    wrong = clocks.fit("rgb").model.rig_from_device(at) - (true + BASE - _SPIKE - clocks.origin_ns)
    assert np.abs(wrong).max() < 25_000


_SPIKE = 5 * NS


def _spike_of():
    from spikerig.dataset.marks import Sight

    for k, at in enumerate(range(BASE, BASE + 3 * NS, NS // 5)):
        yield Sight("spike", 0, at - _SPIKE, at, 5_000.0, bool(k % 2), 0)


def test_frames_refuse_what_cannot_be_told():
    panel, places, looks = shot(frames=20, slow=4)
    with pytest.raises(UsageError, match="too long"):
        read_frames(looks, panel, places, ROW_NS)
    panel, places, looks = shot(frames=3)
    dark = [(t, e, np.zeros_like(v)) for t, e, v in looks]
    with pytest.raises(DataError):
        read_frames(dark, panel, places, ROW_NS)
    with pytest.raises(UsageError, match="slow"):
        read_frames(dark, panel, [p for p in places if panel.leds[p.led].bit < 5], ROW_NS)


def test_an_led_that_failed_makes_no_false_time():
    panel, places, looks = shot(frames=120)
    lamp = next(p for p in places if panel.leds[p.led].bit == 7 and not panel.leds[p.led].inverted)
    rows, columns, inside = lamp.disk(270, 480)

    def broken():
        for start, exposure, light in looks:
            light[rows, columns][inside] = 0.02
            yield start, exposure, light

    error, _ = off(read_frames(broken(), panel, places, ROW_NS, ahead_ns=BASE))
    assert np.median(np.abs(error)) < 12_000
    assert (np.abs(error) < 50_000).mean() > 0.6  # the other row still reads; what is wrong is by whole steps


def test_words_that_are_no_neighbours_are_misread():
    bit, word = np.arange(3), 3_200_000

    def edge(n, turning, near=0):
        code = (n >> bit & 1).astype(float)
        code[turning] = 0.5
        return _edge(code, bit == turning, bit, word, near)

    assert edge(0b000, 0) == (1 * word, True)  # 0 -> 1
    assert edge(0b010, 0) == (3 * word, False)  # 011 is 2, 010 is 3
    assert edge(0b000, 1) is None  # 000 is 0, 010 is 3
    assert edge(0b000, 2, 102 * word) == (104 * word, False)  # the wrap, the turn nearest to 102
