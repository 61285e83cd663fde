"""What `sim_kernels.fire_noisy` computes, a tick at a time in NumPy: its definition, and the referee of its tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset import philox
from spikerig.dataset.oracles import Bits, light_of_ticks, pack
from spikerig.dataset.philox import F, Key

ONE = np.int64(2**32)
MOST = np.int64(2**30 - 1)  # whole thresholds a pixel can owe


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
    """Integrate and fire with noise: each tick the light, what noise makes of it, what counts, and a decision."""
    height, width = light.shape[1:]
    pixels = np.arange(height * width, dtype=np.uint32).reshape(height, width)
    begin = int(knots[0]) if span is None else span[0]
    total, lost = charge.astype(np.int64), np.zeros((height, width), object)
    fired = np.zeros((height, width), bool)
    if before is not None:
        fired = np.unpackbits(before, axis=1, bitorder="little", count=width) != 0
    out = []
    for now, taken in enumerate(light_of_ticks(light, knots, hold, span), begin if first_tick is None else first_tick):
        if shot is not None:
            electrons = np.broadcast_to(np.asarray(shot[0], F), (height, width))
            taken = shot_noise(taken, electrons, philox.words(shot[1], now, pixels))
        gone = np.where(fired, share_of(taken, reset_loss), 0)
        counted = taken - gone
        if not carry:
            counted = np.minimum(counted, ONE)
        total = total + counted
        over = np.maximum((total >> 32) - MOST, 0) << 32
        total = total - over
        lost += taken - counted + over
        seen = total
        if comparator is not None:
            z = philox.normal(philox.words(comparator[1], now, pixels))
            seen = total + ((z * (F(comparator[0]) * F(2.0**28))).astype(np.int32).astype(np.int64) << 4)
        fired = seen >= ONE
        total = total - (fired.astype(np.int64) << 32)
        out.append(fired)
    spikes = np.array(out).reshape(-1, height, width)
    return pack(spikes), total, (lost / 2**32).astype(np.float64)


def shot_noise(light: NDArray[np.int64], electrons: NDArray[np.float32], word: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Light plus (Poisson count - mean) / electrons, mean = light * electrons; never negative.

    The mean and the difference are float32; the difference is held to 2^-31 of a threshold.
    """
    whole, rest = (light >> 32).astype(F), (light & 0xFFFFFFFF).astype(F)
    mean = (whole + rest * F(2.0**-32)) * electrons
    off = (philox.poisson(mean, word) - mean) * (F(1) / electrons)
    near = np.rint(off)
    change = (near.astype(np.int64) << 32) + (((off - near) * F(2.0**31)).astype(np.int64) << 1)
    return np.maximum(light + change, 0)


def share_of(light: NDArray[np.int64], share: float) -> NDArray[np.int64]:
    """The part of the light that a share takes, rounded down; the share is held to 2^-32."""
    part = np.int64(fixed_share(share))
    return (light >> 32) * part + (((light & 0xFFFFFFFF).astype(np.uint64) * np.uint64(part)) >> np.uint64(32)).astype(
        np.int64
    )


def fixed_share(share: float) -> int:
    """A share in units of 2^-32; of one, all but a unit."""
    return min(round(share * 2**32), 2**32 - 1)
