"""What each spike kernel computes, in a few lines of NumPy: the definitions, and the referees of the tests.

Same names, arguments and results as in `kernels`, without its checks and without its speed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Bits = NDArray[np.uint8]


def unpack(bits: Bits, width: int) -> NDArray[np.uint8]:
    """One byte a pixel: uint8[T,H,W]."""
    return np.unpackbits(bits, axis=2, bitorder="little")[:, :, :width]


def pack(spikes: NDArray) -> Bits:
    """The inverse of `unpack`: bool or 0/1 [T,H,W] to uint8[T,H,ceil(W/8)], padding bits zero."""
    return np.packbits(spikes != 0, axis=2, bitorder="little")


def count(bits: Bits, width: int, t0: int, t1: int) -> NDArray[np.uint32]:
    """Spikes a pixel in [t0, t1): uint32[H,W]."""
    return unpack(bits[t0:t1], width).sum(0, dtype=np.uint32)


def tfi_at(
    bits: Bits, width: int, tick: int, *, before: int = 1, after: int = 1
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Ticks of the `before`-th last spike < tick and the `after`-th first spike >= tick, -1 where there is none."""
    spikes = unpack(bits, width)

    def nth(run: NDArray[np.uint8], n: int) -> NDArray[np.intp]:
        seen = run.cumsum(0, dtype=np.int64) >= n
        return np.where(seen.any(0), seen.argmax(0), -1) if len(run) else np.full(run.shape[1:], -1)

    back, forth = nth(spikes[:tick][::-1], before), nth(spikes[tick:], after)
    previous, following = np.where(back < 0, -1, tick - 1 - back), np.where(forth < 0, -1, tick + forth)
    return previous.astype(np.int32), following.astype(np.int32)


def tfi_all(bits: Bits, width: int) -> NDArray[np.uint16]:
    """The enclosing interval at every tick: uint16[T,H,W], 0 where not known, 65535 and more as 65535."""
    spikes, ticks = unpack(bits, width) != 0, len(bits)
    now = np.arange(ticks)[:, None, None]
    last = np.maximum.accumulate(np.where(spikes, now, -1), axis=0)
    before = np.concatenate([np.full_like(last[:1], -1), last])[:ticks]  # last spike < t
    after = np.minimum.accumulate(np.where(spikes, now, ticks)[::-1], axis=0)[::-1]  # first spike >= t
    return np.where((before < 0) | (after == ticks), 0, np.minimum(after - before, 65535)).astype(np.uint16)


def fixed_light(light: NDArray[np.float32], knots: NDArray[np.int64], *, hold: bool) -> NDArray[np.int64]:
    """The light of every tick in units of 2^-32 threshold, as `fire` integrates it: int64[T,H,W].

    A ramp from a to b over n ticks, both rounded to units, gives tick j floor(a + D/2 + j D) with D = (b - a)/n; D and
    D/2 are rounded up to 2^-32 of a unit, so that the light of a million ticks is right to a quarter of a unit and no
    ramp falls below zero.
    """
    unit = 2.0**32
    rows = [np.zeros((0, *light.shape[1:]), np.int64)]
    for k in range(len(knots) - 1):
        n = int(knots[k + 1] - knots[k])
        a = np.rint(light[k].astype(np.float64) * unit)
        b = a if hold else np.rint(light[k + 1].astype(np.float64) * unit)
        slope = (b - a) * (1.0 / n)
        step, step_low = _parts(slope)
        start, start_low = _parts(slope * 0.5)
        j = np.arange(n, dtype=np.int64)[:, None, None]
        rows.append(a.astype(np.int64) + start + j * step + ((start_low + j * step_low) >> 32))
    return np.concatenate(rows)


def _parts(x: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    whole = np.rint(x)
    return whole.astype(np.int64), np.ceil((x - whole) * 2.0**32).astype(np.int64)


def light_of_ticks(
    light: NDArray[np.float32], knots: NDArray[np.int64], hold: bool, span: tuple[int, int] | None
) -> NDArray[np.int64]:
    """`fixed_light` of the ticks from span[0] to before span[1]; None: of all."""
    first, last = (knots[0], knots[-1]) if span is None else span
    return fixed_light(light, knots, hold=hold)[first - knots[0] : last - knots[0]]


def fire(
    light: NDArray[np.float32],
    knots: NDArray[np.int64],
    charge: NDArray,
    *,
    hold: bool,
    span: tuple[int, int] | None = None,
    carry: bool = False,
) -> tuple[Bits, NDArray, NDArray[np.float64]]:
    """Integrate and fire, in closed form: spikes so far = floor of the charge so far, in thresholds.

    Every tick adds at most one threshold; what light is above that is clipped. With `carry` every tick adds all of
    its light, and whole thresholds wait for the ticks after: a tick at a time, at most 2^30 - 1 of them.
    """
    every = light_of_ticks(light, knots, hold, span)
    if carry:
        return _carried(every, charge)
    taken = np.minimum(every, 2**32)
    total = charge.astype(np.int64) + np.concatenate([np.zeros((1, *charge.shape), np.int64), taken]).cumsum(0)
    fired = np.diff(total >> 32, axis=0)
    clipped = _sum(every - taken) / 2**32
    return pack(fired), (total[-1] & 0xFFFFFFFF).astype(np.uint32), clipped.astype(np.float64)


def _carried(every: NDArray[np.int64], charge: NDArray) -> tuple[Bits, NDArray[np.int64], NDArray[np.float64]]:
    total, fired, lost = charge.astype(np.int64), np.zeros(every.shape, bool), np.zeros_like(every)
    for t, light in enumerate(every):
        total = total + light
        lost[t] = np.maximum((total >> 32) - (2**30 - 1), 0) << 32
        total = total - lost[t]
        fired[t] = total >= 2**32
        total = total - (fired[t].astype(np.int64) << 32)
    return pack(fired), total, (_sum(lost) / 2**32).astype(np.float64)


def _sum(x: NDArray[np.int64]) -> NDArray:
    """Over ticks, beyond 64 bits: Python's integers."""
    return (x >> 26).sum(0).astype(object) * 2**26 + (x & (2**26 - 1)).sum(0)


def events(
    light: NDArray[np.float32],
    at_ns: NDArray[np.float64],
    thresholds: tuple[NDArray[np.float64], NDArray[np.float64]],
    *,
    hold: bool,
    eps: float,
    refractory_ns: int = 0,
    tau_ns: float = 0.0,
    noise: tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int8]] | None = None,
    step_ns: float = 10.0,
) -> tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.uint16], NDArray[np.int8]]:
    """An event camera looked at every `step_ns`: the same events, up to a step late.

    A pixel compares b = log(light + eps) with its reference: at b >= reference + up an event of +1 and the reference
    rises by `up`, likewise down; with a refractory time the pixel is held and its reference is b at the end of it.
    """
    up, down = (np.broadcast_to(t, light.shape[1:]) for t in thresholds)
    pixel, when, sign = noise or (np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int8))
    seen = light[0].astype(np.float64)
    level, free = np.log(seen + eps), np.full(seen.shape, -np.inf)
    held = np.zeros(seen.shape, bool)
    rows: list[NDArray] = []

    def fire(where: NDArray[np.bool_], at: float, polarity: int) -> None:
        y, x = np.nonzero(where)
        rows.append(np.stack([np.full(len(y), at), y, x, np.full(len(y), polarity)], 1))
        if refractory_ns:
            free[where], held[where] = at + refractory_ns, True

    last, end = 0.0, float(at_ns[-1] - at_ns[0])
    for now in np.append(np.arange(step_ns, end, step_ns), end - 1e-6):
        given = _light_at(light, at_ns - at_ns[0], now, hold)
        seen = given if not tau_ns else given + (seen - given) * np.exp((last - now) / tau_ns)
        b = np.log(seen + eps)
        level = np.where(held & (free <= now), b, level)
        held &= free > now
        for polarity, threshold in ((1, up), (-1, down)):
            while np.any(over := ~held & (polarity * (b - level) >= threshold)):
                fire(over, now, polarity)
                level = np.where(over, level + polarity * threshold, level)
        for k in np.flatnonzero((when > last) & (when <= now)):
            y, x = divmod(int(pixel[k]), light.shape[2])
            one = np.zeros(seen.shape, bool)
            one[y, x] = not held[y, x]
            fire(one, now, int(sign[k]))
            level[one] = b[one]
        last = now
    found = np.concatenate([np.zeros((0, 4)), *rows])
    found = found[np.rint(found[:, 0]) < end]
    found = found[np.lexsort((found[:, 2], found[:, 1], found[:, 0]))]
    t, y, x, polarity = np.rint(found).astype(np.int64).T
    return t, x.astype(np.uint16), y.astype(np.uint16), polarity.astype(np.int8)


def _light_at(light: NDArray[np.float32], at_ns: NDArray[np.float64], now: float, hold: bool) -> NDArray[np.float64]:
    k = min(max(int(np.searchsorted(at_ns, now, side="right")) - 1, 0), len(at_ns) - 2)
    if hold:
        return light[k].astype(np.float64)
    w = (now - at_ns[k]) / (at_ns[k + 1] - at_ns[k])
    return light[k] * (1 - w) + light[k + 1].astype(np.float64) * w
