"""What a stream of spikes says about its sensor: four numbers, the same for a real clip and for its simulated twin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError
from spikerig.dataset.kernels import count, unpack
from spikerig.dataset.spikes import SpikeStream
from spikerig.rigctl.sim.effects import Effect
from spikerig.rigctl.sim.sensor import Light
from spikerig.rigctl.sim.simulate import simulate
from spikerig.rigctl.sim.spec import Sensor

Floats = NDArray[np.float64]
WINDOW = 41  # ticks of a count: what public work counts over
AROUND = 9  # pixels of the neighbourhood that a pixel's rate is compared to
FLAT = 0.01  # relative change of the neighbourhood's rate a pixel, below which a place is flat
LEAST = 3  # intervals of a pixel whose regularity is looked at
STRETCH = 40  # ticks whose picture is registered with the next's


@dataclass(frozen=True, slots=True)
class Statistics:
    """Four statistics of a stream, over some of its pixels.

    Args:
        pixels: how many.
        rate: spikes a pixel and tick.
        regular: share of the intervals that are floor or ceil of their pixel's mean interval, of pixels with at least
            three; 1 for steady light without noise.
        count_variance: of a pixel's counts over windows of 41 ticks one after the other, averaged over pixels.
        phase_variance: what it would be for steady light without noise: f (1 - f), f the fraction of the mean count.
        fpn: fixed pattern: robust relative spread (1.4826 x median deviation) of a pixel's rate, one over its mean
            interval, about the mean of the 9 x 9 around it, where a pixel has one. Texture counts as pattern.
    """

    pixels: int
    rate: float
    regular: float
    count_variance: float
    phase_variance: float
    fpn: float


def statistics(stream: SpikeStream, flat: bool = False) -> Statistics:
    """The statistics of a stream.

    Args:
        stream: with lost ticks, its longest stretch without any is looked at.
        flat: only where the smoothed picture changes by less than 1 % a pixel, so that motion and texture matter less.

    Raises:
        DataError: fewer than two windows of 41 ticks, or no pixel with three intervals.

    Cost:
        Unpacks a few rows at a time: about 8 bytes a spike and 1 byte a pixel and tick of those rows.
    """
    stream = _whole(stream)
    windows = stream.ticks // WINDOW
    if windows < 2:
        raise DataError("too short for statistics", value=f"{stream.ticks} ticks", expected=f"at least {2 * WINDOW}")
    spikes = count(stream.bits, stream.width, 0, stream.ticks).astype(np.float64)
    interval, intervals, regular = _intervals(stream)
    known = intervals >= 1
    rate = 1 / np.where(known, interval, np.inf)
    around = smooth(rate) / np.maximum(smooth(known.astype(np.float64)), 1e-12)
    used = _slope(smooth(spikes)) < FLAT if flat else np.ones(spikes.shape, bool)
    timed, many = used & known, used & (intervals >= LEAST)
    if not many.any():
        raise DataError("no pixel to take statistics of", value=f"{int(used.sum())}, none with {LEAST} intervals")
    counts = [count(stream.bits, stream.width, k * WINDOW, (k + 1) * WINDOW)[used] for k in range(windows)]
    part = np.modf(WINDOW * rate[used])[0]
    apart = rate[timed] / around[timed] - 1
    return Statistics(
        pixels=int(used.sum()),
        rate=float(spikes[used].mean()) / stream.ticks,
        regular=float(regular[many].sum() / intervals[many].sum()),
        count_variance=float(np.stack(counts).astype(np.float64).var(axis=0, ddof=1).mean()),
        phase_variance=float((part * (1 - part)).mean()),
        fpn=float(1.4826 * np.median(np.abs(apart - np.median(apart)))),
    )


def smooth(picture: Floats, size: int = AROUND) -> Floats:
    """The mean over size x size pixels around each; the edge's pixels stand in for what lies beyond."""
    half = size // 2
    for axis in (0, 1):
        pad = [(half + 1, size - 1 - half) if a == axis else (0, 0) for a in (0, 1)]
        sums = np.cumsum(np.pad(picture, pad, mode="edge"), axis=axis)
        n = picture.shape[axis]
        picture = (np.take(sums, np.arange(size, size + n), axis) - np.take(sums, np.arange(n), axis)) / size
    return picture


def _slope(picture: Floats) -> Floats:
    """Relative change a pixel, from the neighbours on both sides."""
    steps = [np.gradient(picture, axis=a) if picture.shape[a] > 1 else np.zeros_like(picture) for a in (0, 1)]
    return np.hypot(*steps) / np.maximum(picture, 1e-12)


def _whole(stream: SpikeStream) -> SpikeStream:
    """The longest stretch without lost ticks."""
    edges = np.concatenate([[0], np.clip(stream.lost, 0, stream.ticks).reshape(-1), [stream.ticks]]).reshape(-1, 2)
    first, stop = edges[int(np.argmax(edges[:, 1] - edges[:, 0]))]
    return stream.slice(int(first), int(stop))


def _intervals(stream: SpikeStream) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64]]:
    """Of each pixel [H,W]: its mean interval in ticks, how many intervals, and how many are floor or ceil of it."""
    shape = (stream.height, stream.width)
    mean, number, regular = np.zeros(shape), np.zeros(shape, np.int64), np.zeros(shape, np.int64)
    rows = max(1, (1 << 24) // max(1, stream.ticks * stream.width))
    for top in range(0, stream.height, rows):
        part = unpack(np.ascontiguousarray(stream.bits[:, top : top + rows]), stream.width)
        pixel, tick = np.nonzero(part.reshape(stream.ticks, -1).T)
        same = pixel[1:] == pixel[:-1]
        owner, length = pixel[1:][same], np.diff(tick)[same]
        n = part[0].size
        total = np.bincount(owner, minlength=n)
        middle = np.bincount(owner, length, n) / np.maximum(total, 1)
        near = (length == np.floor(middle)[owner]) | (length == np.ceil(middle)[owner])
        for array, values in ((mean, middle), (number, total), (regular, np.bincount(owner[near], minlength=n))):
            array[top : top + rows] = values.reshape(-1, stream.width)
    return mean, number, regular


def twin(stream: SpikeStream, effects: Sequence[Effect], seed: int = 0) -> SpikeStream:
    """A simulation of the light that a stream saw, by a sensor with these effects.

    The light is the stream's own: pictures of 40 ticks each, laid over one another along one straight, steady motion,
    averaged, and smoothed twice over 3 x 3 pixels, which leaves little of the sensor's pattern; less the effects' dark
    current. No number of the noise is taken from the stream.

    Args:
        stream: at least two stretches of 40 ticks.
        effects: of the sensor.
        seed: of the noise.
    """
    stream = _whole(stream)
    parts = stream.ticks // STRETCH
    if parts < 2:
        raise DataError("too short for a twin", value=f"{stream.ticks} ticks", expected=f"at least {2 * STRETCH}")
    pictures = [count(stream.bits, stream.width, k * STRETCH, (k + 1) * STRETCH) / STRETCH for k in range(parts)]
    pace = _pace(pictures)
    still = np.mean([moved(p, -pace * k) for k, p in enumerate(pictures)], axis=0)
    dark = sum(float(getattr(effect, "rate", 0.0)) for effect in effects if effect.name == "dark_current")
    still = np.maximum(smooth(smooth(still, 3), 3) - dark, 0)
    knots = np.unique(np.linspace(0, stream.ticks, 2 * parts + 1).astype(np.int64))
    light = np.stack([moved(still, pace * (k / STRETCH - 0.5)) for k in knots]).astype(np.float32)
    rgb = np.repeat(light[..., None], 3, axis=3)
    whole = Light(rgb, knots, (0, stream.ticks), stream.rate_hz or 20_000.0, stream.t0_ns)
    return simulate(whole, Sensor(gain=1.0, response=(1.0, 0.0, 0.0)), effects, seed).spikes


def moved(picture: Floats, by: Floats) -> Floats:
    """A picture moved by (rows, columns), linear between pixels; the edge's pixels stand in for what lies beyond."""
    for axis in (0, 1):
        n = picture.shape[axis]
        at = np.clip(np.arange(n) - by[axis], 0, n - 1)
        low = np.minimum(at.astype(np.int64), max(n - 2, 0))
        share = (at - low).reshape((-1, 1) if axis == 0 else (1, -1))
        picture = np.take(picture, low, axis) * (1 - share) + np.take(picture, np.minimum(low + 1, n - 1), axis) * share
    return picture


def _pace(pictures: Sequence[Floats]) -> Floats:
    """(rows, columns) a stretch by which the pictures move, to a 16th of a pixel over all: coarse to fine search."""
    soft = [smooth(smooth(p, 5), 5) for p in pictures]
    edge = 10  # what moves in from beyond is not compared
    inside = tuple(slice(edge, n - edge) if n > 4 * edge else slice(None) for n in soft[0].shape)

    def unlike(total: Floats) -> float:
        # ends and middle against the start: the largest motions say most
        return sum(
            float(np.mean((moved(soft[0], total * k / (len(soft) - 1)) - soft[k])[inside] ** 2))
            for k in {len(soft) // 2, len(soft) - 1}
        )

    best = np.zeros(2)
    step = 4.0
    while step >= 1 / 16:
        around = [best + step * np.array([y, x]) for y in range(-2, 3) for x in range(-2, 3)]
        best = min(around, key=unlike)
        step /= 2
    return best / (len(pictures) - 1)
