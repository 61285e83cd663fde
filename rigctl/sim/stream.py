"""Spikes of a take of any length in bounded memory: pictures in, blocks of bits out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import NumericsError, UsageError
from spikerig.dataset.kernels import fire
from spikerig.dataset.sim_kernels import fire_noisy

Bits = NDArray[np.uint8]
Floats = NDArray[np.floating]  # float32 unless said
PICTURES = 64  # of light that are held at once


@dataclass(slots=True)
class Account:
    """Where a stream of spikes stands; it moves on with every block.

    Args:
        charge: int64[H,W], left after the last tick, 2^-32 thresholds.
        lost: float64[H,W], light that never became charge, thresholds: clipped, or gone in resets.
        ticks: made so far.
        before: spikes of the last tick.
    """

    charge: NDArray[np.int64]
    lost: NDArray[np.float64]
    ticks: int = 0
    before: Bits | None = None


def opened(start: NDArray[np.float64]) -> Account:
    """The account of a stream that starts with a charge.

    Args:
        start: float64[H,W] thresholds, 0 to below 1; rounded down to whole 2^-32.

    Raises:
        NumericsError: it is out of range.
    """
    if start.size and not (start.min() >= 0 and start.max() < 1):  # also catches NaN
        raise NumericsError(
            "charge starts from 0 to below one threshold", value=f"between {start.min()} and {start.max()}"
        )
    return Account(np.floor(np.asarray(start, np.float64) * 2.0**32).astype(np.int64), np.zeros(start.shape))


def spike_blocks(
    pictures: Iterable[tuple[int, Floats]],
    start: NDArray[np.float64] | Account | None = None,
    *,
    hold: bool,
    block_ticks: int = 4096,
    pixel: Mapping[str, Any] | None = None,
) -> Iterator[Bits]:
    """Integrate and fire under light that comes picture by picture.

    Args:
        pictures: (tick, float32[H,W] thresholds a tick), ticks rising: light is linear between them, or each picture
            holds until the next one's tick. The last one ends the stream.
        start: float64[H,W] charge before the first tick, thresholds, 0 to below 1; None: none. Or an account, which is
            then up to date whenever a block has come out, and from which another stream can go on.
        hold: pictures hold.
        block_ticks: longest block that comes out.
        pixel: arguments of `fire_noisy`: shot, comparator, reset_loss, carry.

    Yields:
        uint8[n,H,ceil(W/8)], n <= block_ticks, one after the other; together the bits of `fire` (or `fire_noisy`, its
        draws counted by the pictures' ticks) of all pictures at once, whatever `block_ticks` is.

    Raises:
        UsageError: ticks do not rise, or pictures differ in size.
        NumericsError: light is negative or not finite; charge out of range.

    Edges:
        One picture or none: no blocks. Pictures may come at every tick, or millions of ticks apart.

    Cost:
        Holds at most 64 pictures, twice, and one block (12.5 kB a tick at 400x250).
    """
    if block_ticks < 1:
        raise UsageError("a block has at least one tick", value=block_ticks)
    options = dict(pixel or {})
    more = iter(pictures)
    held = _next(more, None)
    if held is None:
        return
    knots, rows = [held[0]], [held[1]]
    shape = rows[0].shape
    state = start if isinstance(start, Account) else opened(np.zeros(shape) if start is None else start)
    tick, ended = knots[0], False
    while True:
        while not ended and knots[-1] < tick + block_ticks and len(knots) < PICTURES:
            held = _next(more, (knots[-1], shape))
            ended = held is None
            if held is not None:
                knots.append(held[0])
                rows.append(held[1])
        end = min(tick + block_ticks, knots[-1])
        if end > tick:
            yield _run(np.stack(rows), np.array(knots), (tick, end), hold, options, state)
            tick = end
            past = max(k for k in range(len(knots)) if knots[k] <= tick)
            del knots[:past], rows[:past]
        elif ended:
            return


def _next(
    pictures: Iterator[tuple[int, Floats]], last: tuple[int, tuple[int, ...]] | None
) -> tuple[int, Floats] | None:
    """The next picture, checked against the one before; None after the last."""
    found = next(pictures, None)
    if found is None:
        return None
    tick, picture = int(found[0]), np.ascontiguousarray(found[1], np.float32)
    if picture.ndim != 2 or (last is not None and picture.shape != last[1]):
        raise UsageError("pictures of light are [H,W], all of one size", value=picture.shape)
    if last is not None and tick <= last[0]:
        raise UsageError("pictures come in the order of their ticks", value=tick, expected=f"above {last[0]}")
    return tick, picture


def _run(
    light: Floats, knots: NDArray[np.int64], span: tuple[int, int], hold: bool, pixel: dict[str, Any], state: Account
) -> Bits:
    """The bits of a span of ticks; the account moves on."""
    charge: NDArray[Any] = state.charge
    if not set(pixel) <= {"carry"}:
        bits, charge, lost = fire_noisy(light, knots, charge, hold=hold, span=span, before=state.before, **pixel)
    elif pixel.get("carry"):
        bits, charge, lost = fire(light, knots, charge, hold=hold, span=span, carry=True)
    else:
        bits, charge, lost = fire(light, knots, charge.astype(np.uint32), hold=hold, span=span)
    state.charge = charge.astype(np.int64)
    state.lost += lost
    state.ticks += len(bits)
    state.before = bits[-1].copy()
    return bits
