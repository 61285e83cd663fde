"""The native kernel that fires with noise, behind a checked call; `sim_oracles` has a readable function of its name."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from spikerig import _native
from spikerig.dataset.errors import UsageError
from spikerig.dataset.kernels import MAX_CHARGE, Bits, checked_charge, checked_light
from spikerig.dataset.philox import Key
from spikerig.dataset.sim_oracles import fixed_share

MAX_SD = 1.0  # thresholds of comparator noise: 6.4 of them fit the fixed point
MAX_ELECTRONS = 1e12


def fire_noisy(
    light: NDArray[np.float32],
    knots: NDArray[np.int64],
    charge: NDArray,
    *,
    hold: bool,
    span: tuple[int, int] | None = None,
    first_tick: int | None = None,
    shot: tuple[float | NDArray, Key] | None = None,
    comparator: tuple[float, Key] | None = None,
    reset_loss: float = 0.0,
    before: NDArray[np.uint8] | None = None,
    carry: bool = False,
) -> tuple[Bits, NDArray[np.int64], NDArray[np.float64]]:
    """Integrate light and fire, with noise of every pixel and tick.

    Each tick: the light as in `kernels.fire`; shot noise on it; the share lost after a spike; what is beyond one
    threshold clipped (or with `carry` kept); the rest added to the charge; a spike where charge + comparator noise
    reaches one threshold, which takes one threshold off the charge. Without noise this is `kernels.fire`, bit for bit.

    Args:
        light: float32[K,H,W], thresholds a tick at the knots, as for `kernels.fire`.
        knots: int64, ticks, as for `kernels.fire`.
        charge: int64 (or uint32) [H,W] at the start, in 2^-32 of a threshold; it is left as it is.
        hold: steps instead of ramps.
        span: ticks to run, as for `kernels.fire`.
        first_tick: absolute number of the first tick that is run, by which draws are counted; None: as the knots count.
        shot: (electrons that make a threshold, key): the tick's electrons are Poisson around light * electrons. One
            number, 1 .. 1e12, or float32[H,W] where pixels differ.
        comparator: (standard deviation in thresholds, 0 .. 1, key): normal noise on each decision, drawn anew every
            tick and not kept in the charge.
        reset_loss: share 0 .. 1 of a tick's light that is lost where the tick before had a spike, to 2^-32.
        before: uint8[H,ceil(W/8)], spikes of the tick before the first, for `reset_loss`; None: no spikes.
        carry: light beyond one spike a tick waits, and fires in the ticks after.

    Returns:
        (bits uint8[T,H,ceil(W/8)], charge int64[H,W] at the end, lost float64[H,W] in thresholds: clipped, and gone
        in resets). Charge may be negative (comparator noise fired early) or above one threshold (late, or carried).

    Raises:
        NumericsError: light is negative, not finite, or above 2^18 thresholds a tick; charge beyond +-2^62.
        UsageError: shapes or knots that do not fit; an effect's number out of range.

    Edges:
        Draws depend on (key, absolute tick, pixel y * W + x) only: blocks of any length, on any instruction set and
        any number of threads, give the same bits. A key draws one word a tick and pixel, so give each effect its own.
        Light after shot noise = spikes + (charge after - charge before)/2^32 + lost, exactly.
        Shot noise is the Poisson distribution's inverse: below a mean of 8 electrons a tick exact to 1e-6 of
        probability, above it mean, variance and skewness within 2.5e-6, 4e-4 and 1e-3; see `philox.poisson`.

    Cost:
        On one thread of an AMD EPYC with AVX-512, nanoseconds a pixel and tick (`cost kernels` measures them): 0.35
        without noise, 0.5 with reset loss, 1.7 with comparator noise, 2.8 with shot noise, 4.1 with all three. Light
        given for every single tick instead of at knots: 3 without noise, 10 with shot noise.

    Source:
        Definition in `sim_oracles.fire_noisy`; effects as in SCSim (arXiv 2304.03129).
    """
    light, knots, (first, end) = checked_light(light, knots, charge, hold=hold, span=span)
    height, width = light.shape[1:]
    if charge.dtype not in (np.uint32, np.int64):
        raise UsageError("charge is int64 or uint32, in 2^-32 of a threshold", value=charge.dtype)
    left = checked_charge(charge, low=-MAX_CHARGE)
    if before is not None and (before.shape != (height, (width + 7) // 8) or before.dtype != np.uint8):
        raise UsageError("before is uint8[H,ceil(W/8)]", value=(before.shape, before.dtype))
    if not 0 <= reset_loss <= 1:
        raise UsageError("reset_loss is a share from 0 to 1", value=reset_loss)
    sd, comparator_key = comparator or (0.0, (0, 0))
    if not 0 <= sd <= MAX_SD:
        raise UsageError("comparator noise is 0 .. 1 thresholds", value=sd)
    electrons, shot_key = (None, (0, 0)) if shot is None else (_electrons(shot[0], (height, width)), shot[1])
    bits = np.empty((end - first, height, (width + 7) // 8), np.uint8)
    lost = np.empty((height, width), np.float64)
    _native.fire_noisy(
        light, knots, hold, first, first if first_tick is None else first_tick, carry, electrons, _key(shot_key), sd,
        _key(comparator_key), fixed_share(reset_loss), None if before is None else np.ascontiguousarray(before),
        left, bits, lost,
    )  # fmt: skip
    return bits, left, lost


def _electrons(value: float | NDArray, shape: tuple[int, int]) -> NDArray[np.float32]:
    given = np.asarray(value, np.float32)
    if given.shape not in ((), shape):
        raise UsageError(
            "electrons that make a threshold are one number or [H,W]", value=given.shape, expected=f"{shape}"
        )
    if given.size and not (given.min() >= 1 and given.max() <= np.float32(MAX_ELECTRONS)):  # also catches NaN
        raise UsageError(
            "electrons that make a threshold are 1 .. 1e12", value=f"between {given.min()} and {given.max()}"
        )
    return np.ascontiguousarray(np.broadcast_to(given, shape))


def _key(key: Key) -> Key:
    if len(key) != 2 or not all(0 <= word < 2**32 for word in key):
        raise UsageError("a key is two words, 0 .. 2^32 - 1", value=key)
    return int(key[0]), int(key[1])
