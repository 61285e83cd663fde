"""Cameras that look at the LED panel: spikes and frames with a known time."""

import numpy as np

from spikerig.calib.panel_read import Spot
from spikerig.dataset.clocktime import NS
from spikerig.dataset.stream import SpikeStream


def spots(panel, width=400, height=250, radius=2.3):
    """Every LED of the panel somewhere in a picture, top row high, bottom row low."""
    x = np.array([led.x_mm for led in panel.leds])
    y = np.array([led.y_mm for led in panel.leds])
    x = 12 + x / x.max() * (width - 24)
    y = 0.08 * height + y / y.max() * 0.84 * height
    return [Spot(k, x[k], y[k], radius) for k in range(len(panel.leds))]


def lit_share(panel, led, start, stop):
    """Share of [start, stop) (panel ns, float64[N] beside an int64 base) an LED is on: exact, by its edges."""
    edges = panel.edges(int(start.min()) - 1, int(stop.max()) + 2, [led])
    ends = np.concatenate([[int(start.min()) - 1], edges.at_ns]).astype(np.int64)
    on = np.concatenate([[panel.state(ends[0])[led]], edges.rising]).astype(float)
    zero = ends[0]
    total = np.concatenate([[0.0], np.cumsum(np.diff(ends) * on[:-1])])

    def integral(at):
        k = np.searchsorted(ends, at, side="right") - 1
        return total[k] + on[k] * (at - ends[k])

    assert zero <= start.min()
    return (integral(stop) - integral(start)) / (stop - start)


def spikes_of(panel, places, ticks, panel_from_device, *, rate_hz=40_000.0, on=0.7, off=0.01, t0_ns=0, seed=0,
              shape=(250, 400)):  # fmt: skip
    """An integrate-and-fire camera with 3 % gain spread and random phases that sees only the panel."""
    rng = np.random.default_rng(seed)
    edge = np.rint(np.arange(ticks + 1) * (NS / rate_hz)).astype(np.int64) + t0_ns
    at = panel_from_device(edge)
    frames = np.zeros((ticks, *shape), np.uint8)
    for place in places:
        light = off + (on - off) * lit_share(panel, place.led, at[:-1], at[1:])
        rows, columns, inside = place.disk(*shape)
        gain = 1 + 0.03 * rng.standard_normal(inside.shape)
        charge = rng.random(inside.shape) + np.cumsum(light)[:, None, None] * gain
        fired = np.diff(np.floor(charge), axis=0, prepend=np.floor(charge[:1] - light[0] * gain))
        frames[:, rows, columns] |= np.minimum(fired, 1).astype(np.uint8) * inside
    packed = np.packbits(frames, axis=2, bitorder="little")
    return SpikeStream(packed, shape[1], rate_hz, t0_ns, "spike")


def frames_of(panel, places, starts, exposure_ns, row_ns, panel_from_device, *, noise=0.03, gamma=1.0, seed=0,
              shape=(270, 480)):  # fmt: skip
    """Frames of a rolling shutter, linear light 0.02..0.9, with the noise of 30 pixels a spot and a wrong response."""
    rng = np.random.default_rng(seed)
    for start in starts:
        picture = np.full(shape, 0.02, np.float32)
        for place in places:
            rows, columns, inside = place.disk(*shape)
            begin = np.rint(start + np.arange(rows.start, rows.stop) * row_ns).astype(np.int64)
            lit = lit_share(panel, place.led, panel_from_device(begin), panel_from_device(begin + exposure_ns))
            picture[rows, columns] = np.where(inside, 0.02 + 0.88 * lit[:, None] ** gamma, picture[rows, columns])
        yield int(start), int(exposure_ns), picture + noise * rng.standard_normal(shape).astype(np.float32) * picture
