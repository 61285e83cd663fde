"""Two-way probes: host time before and after, the device's between. The fast ones say most; none says all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from spikerig.calib.clock_track import Floats, Int64, Pairs, Track
from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import UsageError
from spikerig.dataset.marks import Probe

WINDOW_S = 1.0  # of each window the fastest probes are kept
KEEP = 16
FLOOR_S = 30.0  # a delay's floor is looked for this far on either side
SHARE = 0.6  # of the excess: standard deviation before anything is known, within -1..1
LEAST_NS = 1000.0  # no probe is trusted closer than this


@dataclass(frozen=True, slots=True)
class Gated:
    """Probes that came through the gate.

    Args:
        pairs: host time (middle of the probe) and device time.
        delay_ns: there and back of each, int64[N].
        bias_ns: no bias can be larger: half the mean floor of the delay. How the floor divides between there and
            back is not observable.
        number: which of the probes given they are.
    """

    pairs: Pairs
    delay_ns: Int64
    bias_ns: float
    number: Int64


def gate(probes: Sequence[Probe], stamp_ns: int = 0) -> Gated:
    """Keep the fastest probes of each second, weighted by how much slower than the floor they were.

    What a probe took beyond the floor may have been lost on the way there, or back, or partly: the share is solved
    for (a constant of the pairs, -1: all on the way back). On full-speed USB answers wait for the next millisecond.

    Args:
        probes: two-way ones (`sent_ns` is an int) of one clock.
        stamp_ns: the device's stamp counts in steps of this (32,000 for Harp; the driver has added half a step):
            the spread is part of the deviation.

    Raises:
        UsageError: a probe whose answer came before the question, or a one-way one.

    Source: minimum delay as in NTP's clock filter; |error| <= delay / 2 always (both ways take some time).
    """
    if any(p.sent_ns is None for p in probes):
        raise UsageError("a one-way probe has no delay", next="fit it by the hull")
    sent, device, received = (
        np.array([getattr(p, name) for p in probes], np.int64) for name in ("sent_ns", "device_ns", "received_ns")
    )
    delay = received - sent
    if (delay < 0).any():
        raise UsageError("an answer came before its question", value=probes[int(np.argmin(delay))])
    kept = fastest(sent, delay)
    least = floor(sent, delay)[kept]
    excess = delay[kept] - least
    middle = sent[kept] + delay[kept] // 2
    sd = np.sqrt(LEAST_NS**2 + stamp_ns**2 / 12 + excess**2 / 12)
    weight = sd**-2
    bias = float((weight * least).sum() / (2 * weight.sum())) if len(kept) else 0.0
    pairs = Pairs(middle, device[kept], sd, excess[:, None] / 2, np.array([SHARE]))
    return Gated(pairs, delay[kept], bias, kept)


def reweighed(pairs: Pairs, track: Track, classes: int = 6) -> Pairs:
    """The same pairs with the deviations that a first track shows, by how slow they were.

    A slow probe is a bad one where either way may have been slow, and a good one where always the same way was.

    Args:
        pairs: of `gate`.
        track: fitted to them.
        classes: of equally many probes; fewer where a class would hold less than 20.
    """
    classes = min(classes, len(pairs.x_ns) // 20)
    if classes < 2:
        return pairs
    off, slow = track.off_ns(pairs), pairs.extra[:, 0]
    sd = pairs.sd_ns.copy()
    for which in np.array_split(np.argsort(slow, kind="stable"), classes):
        seen = off[which]
        spread = 1.4826 * float(np.median(np.abs(seen - np.median(seen))))
        # Never below what a class' own middle is off: a slope alone does not describe every link.
        sd[which] = max(float(np.hypot(spread, np.median(seen))), LEAST_NS)
    return replace(pairs, sd_ns=sd)


def fastest(sent: Int64, delay: Int64) -> Int64:
    """Numbers of the `KEEP` fastest probes of each `WINDOW_S`, in the order of time."""
    if not len(sent):
        return np.zeros(0, np.int64)
    window = (sent - sent.min()) // round(WINDOW_S * NS)
    order = np.lexsort((delay, window))
    starts = np.flatnonzero(np.diff(window[order], prepend=-1))
    rank = np.arange(len(order)) - np.repeat(starts, np.diff(starts, append=len(order)))
    chosen = order[rank < KEEP]
    return chosen[np.argsort(sent[chosen], kind="stable")]


def floor(sent: Int64, delay: Int64) -> Floats:
    """The smallest delay within `FLOOR_S` of each probe: it follows a link whose path changes."""
    if not len(sent):
        return np.zeros(0)
    block = (sent - sent.min()) // round(FLOOR_S * NS)
    least = np.full(int(block.max()) + 3, np.inf)
    np.minimum.at(least, block + 1, delay)
    near = np.minimum(np.minimum(least[:-2], least[1:-1]), least[2:])
    return near[block]
