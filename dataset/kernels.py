"""The native spike kernels behind checked calls; `oracles` holds a readable function of the same name for each.

Packed spikes are uint8[T,H,ceil(W/8)]: top row first, rows padded to bytes, LSB first (pixel x is bit x%8 of byte
x//8). Every kernel returns the same bits on every instruction set and for any number of threads.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from spikerig import _native
from spikerig.dataset.errors import NumericsError, UsageError

Bits = NDArray[np.uint8]
Noise = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int8]]  # pixel y*W+x, time in ns, polarity
MAX_LIGHT = float(2**18)  # thresholds a tick: fixed-point light stays exact in a float64
MAX_CHARGE = 2**62  # 2^-32 of a threshold


def unpack(bits: Bits, width: int) -> NDArray[np.uint8]:
    """One byte a pixel.

    Args:
        bits: uint8[T,H,ceil(W/8)] packed spikes.
        width: W.

    Returns:
        uint8[T,H,W], 0 or 1.

    Raises:
        UsageError: `bits` is not packed spikes of that width.

    Cost:
        Writes T*H*W bytes; memory-bound.
    """
    bits = _packed(bits, width)
    out = np.empty((*bits.shape[:2], width), np.uint8)
    _native.unpack(bits, width, out)
    return out


def count(bits: Bits, width: int, t0: int, t1: int) -> NDArray[np.uint32]:
    """Spikes a pixel in the half-open window [t0, t1).

    Args:
        bits: uint8[T,H,ceil(W/8)] packed spikes.
        width: W.
        t0, t1: ticks, 0 <= t0 <= t1 <= T.

    Returns:
        uint32[H,W].

    Raises:
        UsageError: the window leaves the stream, or `bits` is not packed spikes of that width.

    Edges:
        An empty window counts zero.

    Cost:
        Reads the window once without unpacking it, about 5 operations a vector of 512 (or 256) pixels and tick.
    """
    bits = _packed(bits, width)
    if not 0 <= t0 <= t1 <= len(bits):
        raise UsageError("a window must lie in the stream", value=f"[{t0}, {t1})", expected=f"within [0, {len(bits)})")
    out = np.empty((bits.shape[1], width), np.uint32)
    _native.count(bits, width, t0, t1, out)
    return out


def tfi_at(
    bits: Bits, width: int, tick: int, *, before: int = 1, after: int = 1
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """The spikes around an instant.

    Args:
        bits: uint8[T,H,ceil(W/8)] packed spikes.
        width: W.
        tick: the instant, 0 <= tick <= T.
        before: which spike before the instant: 1 the last, 2 the one before it, ...
        after: which spike at or after the instant: 1 the first, ...

    Returns:
        (previous, next) int32[H,W] each: the tick of the `before`-th last spike < tick and of the `after`-th first
        spike >= tick; -1 where there is none.

    Raises:
        UsageError: the tick leaves the stream, a rank is < 1, or `bits` is not packed spikes of that width.

    Cost:
        Scans outward and stops, 64 pixels at a time, once all of them are found; a dark pixel costs its 64
        neighbours a look at every tick.
    """
    bits = _packed(bits, width)
    if not 0 <= tick <= len(bits):
        raise UsageError("an instant must lie in the stream", value=tick, expected=f"0 .. {len(bits)}")
    if before < 1 or after < 1:
        raise UsageError("spikes around an instant are counted from 1", value=(before, after))
    previous, following = (np.empty((bits.shape[1], width), np.int32) for _ in range(2))
    _native.tfi_at(bits, width, tick, before, after, previous, following)
    return previous, following


def tfi_all(bits: Bits, width: int) -> NDArray[np.uint16]:
    """The enclosing inter-spike interval at every tick.

    Args:
        bits: uint8[T,H,ceil(W/8)] packed spikes.
        width: W.

    Returns:
        uint16[T,H,W]: b - a for the last spike a < t and the first spike b >= t; 0 where either is missing.

    Raises:
        UsageError: `bits` is not packed spikes of that width.

    Edges:
        Intervals of 65535 ticks and more read 65535.

    Cost:
        Writes T*H*W*2 bytes twice; memory-bound.
    """
    bits = _packed(bits, width)
    out = np.empty((*bits.shape[:2], width), np.uint16)
    _native.tfi_all(bits, width, out)
    return out


def fire(
    light: NDArray[np.float32],
    knots: NDArray[np.int64],
    charge: NDArray,
    *,
    hold: bool,
    span: tuple[int, int] | None = None,
    carry: bool = False,
) -> tuple[Bits, NDArray, NDArray[np.float64]]:
    """Integrate light and fire a spike at every threshold.

    Args:
        light: float32[K,H,W], thresholds a tick at the knots.
        knots: int64, ticks, strictly increasing. Ramps (hold=False): K knots, light linear between them and taken at
            the middle of each tick. Steps (hold=True): light[k] holds for ticks [knots[k], knots[k+1]), with K + 1
            knots (or K: then the last light row is not used).
        charge: uint32[H,W] at the start, in 2^-32 of a threshold; with `carry` also int64. It is left as it is.
        hold: steps instead of ramps.
        span: ticks to run, [first, end) within the knots; None: all. Spans that follow each other, each with the charge
            the last one left, give the bits of all, wherever they part.
        carry: what a tick brings beyond one spike waits, and fires in the ticks after.

    Returns:
        (bits uint8[T,H,ceil(W/8)], charge at the end: uint32[H,W], with `carry` int64[H,W], whole thresholds above the
        low 32 bits; clipped float64[H,W] in thresholds), with T the ticks of the span.

    Raises:
        NumericsError: light is negative, not finite, or above 2^18 thresholds a tick.
        UsageError: shapes or knots that do not fit.

    Edges:
        Light of one threshold a tick or more fires every tick; what is above one is clipped and counted, or with
        `carry` kept (2^30 - 1 whole thresholds at most, then it is clipped too). The sum of light = spikes + (charge
        after - charge before)/2^32 + clipped, exactly in units of 2^-32 (clipped to 2^53 units). T = 0 gives no bits
        and the charge unchanged.

    Cost:
        About half an operation a pixel and tick with AVX-512 below one threshold a tick, some three times that for 64
        neighbours of which one is brighter.

    Source:
        Integrate-and-fire with the surplus kept, Eq. 5-6 of the paper; definition in `oracles.fire`.
    """
    light, knots, (first, end) = checked_light(light, knots, charge, hold=hold, span=span)
    if charge.dtype != np.uint32 and not (carry and charge.dtype == np.int64):
        raise UsageError("charge is uint32, in 2^-32 of a threshold (with `carry` also int64)", value=charge.dtype)
    left = checked_charge(charge, low=0)
    height, width = light.shape[1:]
    bits = np.empty((end - first, height, (width + 7) // 8), np.uint8)
    clipped = np.empty((height, width), np.float64)
    _native.fire(light, knots, hold, first, carry, left, bits, clipped)
    return bits, left if carry else left.astype(np.uint32), clipped


def checked_light(
    light: NDArray[np.float32], knots: NDArray[np.int64], charge: NDArray, *, hold: bool, span: tuple[int, int] | None
) -> tuple[NDArray[np.float32], NDArray[np.int64], tuple[int, int]]:
    """Light, knots and span as the native side takes them, or the faults that `fire` lists."""
    light = np.ascontiguousarray(light, np.float32)
    knots = np.ascontiguousarray(knots, np.int64)
    if light.ndim != 3 or knots.ndim != 1 or charge.shape != light.shape[1:] or light.shape[2] < 1:
        raise UsageError(
            "light is [K,H,W], knots [K], charge [H,W]", value=(light.shape, knots.shape, np.shape(charge))
        )
    fits = (len(light), len(light) + 1) if hold else (len(light),)
    if len(knots) not in fits or len(knots) < 1 or np.any(np.diff(knots) <= 0):
        raise UsageError(
            "knots must increase strictly, one for each row of light",
            value=knots[:8],
            expected=f"{' or '.join(map(str, fits))} of them",
        )
    if light.size:
        low, high = float(light.min()), float(light.max())
        if not (low >= 0 and high <= MAX_LIGHT):  # also catches NaN
            raise NumericsError(
                "light must be finite, not negative, and not absurdly bright",
                value=f"between {low} and {high} thresholds a tick",
                expected=f"0 .. {MAX_LIGHT:.0f}",
                cause="a division by zero, or light in other units than thresholds a tick",
            )
    first, end = (int(knots[0]), int(knots[-1])) if span is None else span
    if not knots[0] <= first <= end <= knots[-1]:
        raise UsageError("a span must lie within the knots", value=span, expected=f"{knots[0]} .. {knots[-1]}")
    return light, knots, (first, end)


def checked_charge(charge: NDArray, *, low: int) -> NDArray[np.int64]:
    """A copy of the charge as int64, within `low` .. 2^62 - 1."""
    left = np.array(charge, np.int64, order="C")
    if left.size and not (int(left.min()) >= low and int(left.max()) < MAX_CHARGE):
        raise NumericsError(
            "charge is out of range",
            value=f"between {int(left.min())} and {int(left.max())} in 2^-32 of a threshold",
            expected=f"{low} .. 2^62 - 1",
        )
    return left


def events(
    light: NDArray[np.float32],
    at_ns: NDArray[np.float64],
    thresholds: tuple[NDArray[np.float64], NDArray[np.float64]],
    *,
    hold: bool,
    eps: float,
    refractory_ns: int = 0,
    tau_ns: float = 0.0,
    noise: Noise | None = None,
    most: int = 20_000_000,
) -> tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.int8]]:
    """When the log of light has grown or fallen by a threshold since a pixel's last event.

    Args:
        light: float32[K,H,W], linear, at the knots.
        at_ns: float64, times of the knots from the first one, strictly increasing: K of them (light linear in between)
            or, with hold, K + 1 (light[k] holds from knot k to k + 1).
        thresholds: float64[H,W] each, of log(light + eps): up, down; > 0.
        hold: steps instead of ramps.
        eps: added to light before the log, >= 1e-300.
        refractory_ns: how long a pixel is held in reset after an event; its reference is the light at the end of it.
        tau_ns: time constant of a first-order low-pass of the light, 0 for none.
        noise: events that come by themselves, (pixel y*W+x, time, polarity) of each in any order; one that falls into
            a pixel's reset is lost, any other resets the pixel.
        most: more events than this are refused, before memory is asked for.

    Returns:
        (t_ns int64[N], x uint16[N], y uint16[N], polarity int8[N]) in the order of (t, y, x); whole nanoseconds from
        the first knot, before the last.

    Raises:
        NumericsError: light is negative or not finite; more than `most` events.
        UsageError: shapes, knots or numbers that do not fit.

    Edges:
        A level reached exactly is an event; one reached just at the end is left out. The reference starts as the light
        at the first knot. A jump (hold) over n thresholds is n events of one time, or one with a refractory time.

    Cost:
        Each crossing is solved for, no time step is taken; two passes, the first of which counts; some 0.2 us an event
        and 0.5 us with tau_ns, 3 ns a pixel and knot. Peak memory 40 B an event.

    Source:
        ESIM (Rebecq et al. 2018), with exact crossings; definition in `oracles.events`.
    """
    light, at_ns = np.ascontiguousarray(light, np.float32), np.ascontiguousarray(at_ns, np.float64)
    pixels = _event_pixels(light, at_ns, hold)
    up, down = (np.broadcast_to(np.asarray(t, np.float64), light.shape[1:]).ravel() for t in thresholds)
    if not (min(up.min(), down.min()) >= 1e-6 and max(up.max(), down.max()) <= 100 and 1e-300 <= eps < np.inf):
        raise UsageError("thresholds lie in 1e-6 .. 100, eps above 0", value=(up.min(), down.min(), eps))
    if refractory_ns < 0 or not 0 <= tau_ns < np.inf:
        raise UsageError("times of an event camera are not negative", value=(refractory_ns, tau_ns))
    sensor = np.exp(up), np.exp(-down), eps, float(refractory_ns), tau_ns, round(at_ns[-1] - at_ns[0])
    args = light.reshape(len(light), pixels), at_ns - at_ns[0], hold, *sensor, *_by_pixel(noise, pixels)
    counts = np.empty(pixels, np.int64)
    if _native.count_events(*args, most, counts) > most:
        raise NumericsError(
            "more events than allowed",
            value=f"over {most}",
            cause="thresholds too small, light of too much contrast, or a long span",
            next="raise the thresholds or the limit, or simulate a shorter span",
        )
    first = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)])
    t, polarity = np.empty(first[-1], np.int64), np.empty(first[-1], np.int8)
    _native.events(*args, first, t, polarity)
    by_time = np.argsort(t, kind="stable")  # pixels come in the order of (y, x)
    y, x = np.divmod(np.repeat(np.arange(pixels, dtype=np.uint32), counts)[by_time], np.uint32(light.shape[2]))
    return t[by_time], x.astype(np.uint16), y.astype(np.uint16), polarity[by_time]


def _by_pixel(noise: Noise | None, pixels: int) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int8]]:
    """Where each pixel's noise events start, their times in order, their polarities."""
    start = np.zeros(pixels + 1, np.int64)
    if noise is None or not len(noise[0]):
        return start, np.zeros(0), np.zeros(0, np.int8)
    pixel, when, sign = noise
    if not (
        np.all((pixel >= 0) & (pixel < pixels)) and np.isfinite(when).all() and len(when) == len(sign) == len(pixel)
    ):
        raise UsageError("noise events have a pixel, a time and a polarity", value=(len(pixel), len(when), len(sign)))
    start[1:] = np.cumsum(np.bincount(pixel, minlength=pixels))
    order = np.lexsort((when, pixel))
    return start, np.ascontiguousarray(when[order], np.float64), np.ascontiguousarray(sign[order], np.int8)


def _event_pixels(light: NDArray[np.float32], at_ns: NDArray[np.float64], hold: bool) -> int:
    if light.ndim != 3 or not 1 <= light.shape[1] <= 65536 or not 1 <= light.shape[2] <= 65536:
        raise UsageError("light is [K,H,W], at most 65536 pixels a side", value=light.shape)
    wanted = len(light) + hold
    if len(light) < 1 or at_ns.shape != (wanted,) or not np.all(np.diff(at_ns) > 0) or not np.isfinite(at_ns).all():
        raise UsageError("knots must increase strictly", value=at_ns[:8], expected=f"{wanted} of them")
    if not (float(light.min()) >= 0 and float(light.max()) < np.inf):  # also catches NaN
        raise NumericsError("light must be finite and not negative", value=f"between {light.min()} and {light.max()}")
    return light.shape[1] * light.shape[2]


def _packed(bits: Bits, width: int) -> Bits:
    if width < 1 or bits.ndim != 3 or bits.dtype != np.uint8 or bits.shape[2] != (width + 7) // 8:
        raise UsageError("packed spikes are uint8[T,H,ceil(W/8)]", value=(bits.shape, str(bits.dtype), width))
    return np.ascontiguousarray(bits)
