"""A plain LED read by both cameras: its edges, its beat, its place; and which of them a clip saw."""

import numpy as np
import panel_worlds as worlds
import pytest

from spikerig.calib.led_find import find_in_frames, find_in_spikes, periods_to_try
from spikerig.calib.led_frames import Timeline, frame_sights, spike_sights, timeline
from spikerig.calib.led_read import Beat, Blinks, beat_of, spike_blinks
from spikerig.calib.panel_frames import Look
from spikerig.calib.panel_read import Spot
from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DataError, RefusedError
from spikerig.dataset.panel import Edges
from spikerig.dataset.stream import SpikeStream

SPOT = [Spot(0, 20.0, 12.0, 2.3)]
RATE, SHAPE = 20_000.0, (32, 48)


class Lamp:
    """Any pattern of edges (ns, on first), in the panel's stead."""

    def __init__(self, at_ns) -> None:
        self.at_ns = np.asarray(at_ns, np.int64)

    def edges(self, start, stop, leds):
        inside = (self.at_ns >= start) & (self.at_ns < stop)
        rising = np.arange(len(self.at_ns)) % 2 == 0
        return Edges(self.at_ns[inside], np.zeros(int(inside.sum()), np.int64), rising[inside])

    def state(self, at):
        return np.array([np.searchsorted(self.at_ns, at, side="right") % 2 == 1])


def beating(period_ms=400.0, on=0.5, start_ms=130.0, count=8):
    ons = (start_ms + period_ms * np.arange(count)) * 1e6
    return Lamp(np.stack([ons, ons + on * period_ms * 1e6], 1).reshape(-1))


def spikes(lamp, ticks=36_000, t0_ns=0, **more) -> SpikeStream:
    return worlds.spikes_of(lamp, SPOT, ticks, lambda d: d, rate_hz=RATE, t0_ns=t0_ns, shape=SHAPE, **more)


def frames(lamp, ahead_ns, count=200, exposure_ns=NS // 240, row_ns=50_000.0, **more):
    starts = np.rint(np.arange(count) * NS * 1001 / 120_000).astype(np.int64) + 7_000_000
    return [Look(*k) for k in worlds.frames_of(lamp, SPOT, starts, exposure_ns, row_ns, lambda d: d + ahead_ns,
                                               shape=SHAPE, **more)]  # fmt: skip


def seen_of(lamp, **more):
    blinks = spike_blinks([spikes(lamp, **more)], SPOT)
    beat = beat_of([blinks])
    return blinks, beat, timeline(blinks, beat, beat.starts_ns[0], 0)


@pytest.mark.parametrize("on", [0.5, 0.2])
def test_edges_and_beat_are_those_of_the_lamp(on):
    lamp = beating(on=on)
    stream = spikes(lamp)
    half = (
        SpikeStream(stream.bits[:17_003], 48, RATE, 0, "spike"),
        SpikeStream(stream.bits[17_003:], 48, RATE, round(17_003 / RATE * NS), "spike"),
    )
    blinks = spike_blinks(half, SPOT)
    inside = lamp.at_ns[lamp.at_ns < 1.79e9]
    np.testing.assert_allclose(blinks.at_ns, inside, atol=40_000)
    assert blinks.rising.tolist() == (np.arange(len(inside)) % 2 == 0).tolist()
    assert np.sqrt(np.mean((blinks.at_ns - inside) ** 2)) < 1.6 * blinks.sd_ns.mean()
    beat = beat_of([blinks], 412e6)
    assert beat.period_ns == pytest.approx(400e6, abs=15_000)
    assert beat.on_ns == pytest.approx(on * 400e6, abs=25_000)
    assert beat.starts_ns[0] == pytest.approx(130e6, abs=25_000)


def test_viewpoints_share_a_beat_each_with_its_own_start():
    views = []
    for start, first in ((130.0, 0), (77.0, 1)):  # the second begins with an edge down
        at = beating(start_ms=start).at_ns[first : first + 4]
        views.append(Blinks(at + 5 * NS, np.arange(first, first + 4) % 2 == 0, np.full(4, 1e4), (0, 1)))
    beat = beat_of(views)
    assert (beat.period_ns, beat.on_ns) == pytest.approx((400e6, 200e6))
    assert [(s - 5 * NS) % round(4e8) for s in beat.starts_ns] == pytest.approx([130e6, 77e6], abs=1000)
    with pytest.raises(DataError, match="another period"):
        beat_of(views, 800e6)


def test_a_lost_stretch_costs_its_edge_only():
    lamp = beating()
    whole = spikes(lamp)
    tick = round(330e6 / NS * RATE)  # the first edge down
    bits = whole.bits.copy()
    bits[tick - 20 : tick + 5] = 0
    holed = SpikeStream(bits, 48, RATE, 0, "spike", np.array([[tick - 20, tick + 5]]))
    blinks = spike_blinks([holed], SPOT)
    assert not np.any(np.abs(blinks.at_ns - 330e6) < 5e6)
    np.testing.assert_allclose(blinks.at_ns[0], 130e6, atol=40_000)


def test_no_light_no_edges():
    lamp = Lamp(np.array([10 * NS, 11 * NS]))
    with pytest.raises(DataError, match=r"does not blink|neither goes on nor off"):
        spike_blinks([spikes(lamp, ticks=4000)], SPOT)
    with pytest.raises(DataError, match="no viewpoint is long enough"):
        beat_of([Blinks(np.array([5]), np.array([True]), np.ones(1), (0, 9))])
    with pytest.raises(DataError, match="no spikes"):
        spike_blinks([], SPOT)


@pytest.mark.parametrize("ahead_ns", [3_000_000, 150_000_000, -120_000_000])
def test_a_clip_finds_its_place_in_the_beat(ahead_ns):
    lamp = beating(period_ms=410.0, start_ms=-700.0, count=12)
    blinks, _, line = seen_of(lamp)
    told = frame_sights(frames(lamp, ahead_ns, noise=0.01), SPOT, 50_000.0, line, (-170_000_000, 200_000_000), 7)
    assert len(told) >= 4
    off = np.array([s.panel_ns - s.device_ns for s in told]) - ahead_ns
    assert np.abs(off).max() < 150_000
    assert abs(np.median(off)) < 40_000
    assert {s.epoch for s in told} == {7}
    assert all(s.row == pytest.approx(11.5, abs=0.6) for s in told)
    own = spike_sights(blinks, line, 3, 0)
    assert len(own) == len(blinks.at_ns)
    assert np.abs([s.panel_ns - s.device_ns for s in own]).max() < 60_000


def test_a_clip_that_may_have_seen_two_beats_is_refused():
    lamp = beating(period_ms=210.0, start_ms=-700.0, count=20)
    _, _, line = seen_of(lamp)
    with pytest.raises(RefusedError, match="cannot be told") as caught:
        frame_sights(frames(lamp, 80_000_000), SPOT, 50_000.0, line, (-150_000_000, 150_000_000), 0)
    assert "period 210.0 ms" in str(caught.value)
    assert "more than 300 ms" in str(caught.value)


def test_a_light_without_a_beat_is_told_by_its_pattern():
    steps = np.array([31, 45, 22, 68, 90, 27, 55, 140, 33, 61, 24, 77, 105, 42, 58, 29, 83, 36, 66, 49]) * 1e6
    lamp = Lamp(50e6 + np.cumsum(np.tile(steps, 2)))
    blinks, beat, line = seen_of(lamp, ticks=30_000)
    assert beat.period_ns == 0
    ahead = 90_000_000
    told = frame_sights(frames(lamp, ahead, noise=0.01), SPOT, 50_000.0, line, (-400_000_000, 400_000_000), 0)
    off = np.array([s.panel_ns - s.device_ns for s in told]) - ahead
    assert abs(np.median(off)) < 40_000
    with pytest.raises(DataError, match="no even beat"):
        beat_of([blinks], 100e6)


def test_other_lights_and_clipped_ones_are_refused():
    lamp = beating(start_ms=-700.0, count=12)
    _, _, line = seen_of(lamp)
    between = (-100_000_000, 100_000_000)
    other = beating(period_ms=130.0, start_ms=-700.0, count=40)
    with pytest.raises(DataError, match="otherwise"):
        frame_sights(frames(other, 0), SPOT, 50_000.0, line, between, 0)
    bright = [k._replace(light=np.minimum(k.light * 1.3, 1.0)) for k in frames(lamp, 0)]
    with pytest.raises(DataError, match="clipped"):
        frame_sights(bright, SPOT, 50_000.0, line, between, 0)
    with pytest.raises(DataError, match="does not blink in the clip"):
        frame_sights(frames(lamp, 0), [Spot(0, 40.0, 25.0, 2.0)], 50_000.0, line, between, 0)


@pytest.mark.parametrize("told_ms", [412.0, 0.0])
def test_the_lamp_is_found_by_its_beat(told_ms):
    lamp = beating()
    stream = spikes(lamp)
    rng = np.random.default_rng(1)  # a scene that moves beside it
    texture = rng.random(SHAPE) * 0.4
    phase = 0.5 + 0.5 * np.sin(np.arange(stream.ticks) / 230.0)
    frames_ = np.unpackbits(stream.bits, axis=2, bitorder="little")
    frames_[:, :, :14] |= rng.random((stream.ticks, 32, 14)) < texture[:, :14] * phase[:, None, None]
    busy = SpikeStream(np.packbits(frames_, axis=2, bitorder="little"), 48, RATE, 0, "spike")
    (spot,) = find_in_spikes([busy], periods_to_try(told_ms * 1e6, 1.8e9))
    assert (spot.x_px, spot.y_px) == pytest.approx((20, 12), abs=0.5)
    assert spot.radius_px == pytest.approx(2.3, abs=0.6)
    (seen,) = find_in_frames(((k.start_ns, k.light) for k in frames(lamp, 0)), 400e6)
    assert (seen.x_px, seen.y_px) == pytest.approx((20, 12), abs=0.5)
    with pytest.raises(DataError, match="no LED"):
        find_in_spikes([spikes(Lamp(np.array([5 * NS])))], [400e6])
    with pytest.raises(DataError, match="too short"):
        find_in_frames([(0.0, np.zeros(SHAPE))], 400e6)


def test_missed_edges_of_a_light_without_a_beat_are_refused():
    blinks = Blinks(np.array([0, 10, 30]), np.array([True, True, False]), np.ones(3), (0, 50))
    with pytest.raises(DataError, match="were missed"):
        timeline(blinks, Beat(0.0, 0.0, (0,), 1e9), 0, 0)


def test_light_that_changes_once_is_no_led():
    bits = np.zeros((20_000, *SHAPE), np.uint8)
    rng = np.random.default_rng(2)
    bits[:, 4:9, 5:12] = rng.random((20_000, 5, 7)) < np.where(np.arange(20_000) < 11_000, 0.05, 0.7)[:, None, None]
    shadow = SpikeStream(np.packbits(bits, axis=2, bitorder="little"), 48, RATE, 0, "spike")
    with pytest.raises(DataError, match="no LED"):
        find_in_spikes([shadow], periods_to_try(300e6, 1e9))


@pytest.mark.parametrize("first", [True, False])
def test_lit_time_is_that_of_the_edges(first):
    at = np.array([100, 250, 300, 700], np.int64)
    line = Timeline(at, np.arange(4) % 2 == (0 if first else 1), 0, 1000, 0.0)
    fine = np.arange(0, 1001)
    on = (np.searchsorted(at, fine[:-1], side="right") % 2 == 1) == first
    np.testing.assert_array_equal(np.diff(line.lit_ns(fine)), on)
