"""Sightings of the LED panel as comparisons of a camera's clock with the panel's; pulses without names get numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from spikerig.calib.clock_track import Floats, Int64, Pairs, Track
from spikerig.dataset.errors import DataError
from spikerig.dataset.marks import Sight

RESPONSE_NS = 300_000.0  # a wrong response curve moves edges by up to a quarter of 1/240 s, on and off oppositely
ALLOWED_NS = {"spike": 3_000.0, "rgb": 10_000.0}  # for what no constant describes: an eighth of a tick; 1/200 exposure
LAG_NS = 300_000.0  # what an encoder leaves out of a change is believed below this, both ways; 2 % of 1/120 s was seen
ROW_NS = 400.0  # a row's time may be off by 5 % of 8 us


def sight_pairs(sights: Sequence[Sight], lags: bool = False) -> Pairs:
    """Sightings as pairs (camera, panel), with the constants to solve for.

    The first constant is what the response moves rising edges by (falling ones: the opposite), ns. The second, of a
    rolling shutter, is what a row takes longer than was assumed, ns: LEDs at top and bottom tell it; where all lie in
    one row it stays unknown, and the map's sigma says so. The third, of a coded video, is how late edges seem in frames
    that were coded as changes to another: their encoder leaves out the last of a change, on or off. Frames that were
    coded by themselves tell it.

    Args:
        sights: of one clock and epoch.
        lags: give the second and third constant, though these sights may not need them.

    Source: t = t_frame + row * (row_ns + constant) + where in the exposure the edge was; t_frame is of row 0.
    """
    told = [(s.device_ns, s.panel_ns, s.sigma_ns, 1.0 if s.rising else -1.0, s.row, s.predicted) for s in sights]
    device, panel = (np.array([t[k] for t in told], np.int64) for k in (0, 1))
    sd, sign, row, late = (np.array([t[k] for t in told], np.float64) for k in (2, 3, 4, 5))
    if not len(told):
        raise DataError("a camera never saw the panel", next="bring the LED panel into both views, and look again")
    many = 3 if lags or late.any() else 2 if (row != 0).any() else 1
    extra = np.stack([sign, row, -late][:many], 1)
    return Pairs(device, panel, sd, extra, np.array([RESPONSE_NS, ROW_NS, LAG_NS][:many]))


def pooled(found: Sequence[Floats], found_sd: Sequence[Floats], prior: Floats) -> tuple[Floats, Floats]:
    """What clips of one camera share (constants, frequency), and how far a clip's own may lie from it.

    Args:
        found, found_sd: float64[E] of each clip, fitted by itself.
        prior: float64[E], deviations from 0 they were fitted with.

    Returns:
        (mean, sd) float64[E]: sd holds what is unknown of the mean and what clips differ by.

    Source: DerSimonian, Laird 1986, on what each clip's own sights say (the prior taken off).
    """
    said, sd = np.array(found), np.array(found_sd)
    weight = np.maximum(1 / sd**2 - 1 / prior**2, 1e-3 / prior**2)
    own = said / sd**2 / weight
    mean = (weight * own).sum(0) / weight.sum(0)
    spread = (weight * (own - mean) ** 2).sum(0) - (len(said) - 1)
    between = np.maximum(spread / (weight.sum(0) - (weight**2).sum(0) / weight.sum(0)), 0)
    weight = 1 / (1 / weight + between)
    mean = (weight * own).sum(0) / (weight.sum(0) + 1 / prior**2)
    return mean, np.minimum(np.sqrt(between + 1 / (weight.sum(0) + 1 / prior**2)), prior)


def around(pairs: Pairs, mean: Floats, sd: Floats) -> Pairs:
    """Pairs whose constants are known beforehand: taken off, what is left of them still solved for."""
    off = np.rint(pairs.extra @ mean).astype(np.int64)
    return replace(pairs, y_ns=pairs.y_ns - off, prior=sd)


def named(track: Track) -> dict[str, float]:
    """The constants of a fit to sightings by name, ns."""
    names = ("response_ns", "row_ns", "lag_ns")[: len(track.constants)]
    told = {name: float(v) for name, v in zip(names, track.constants, strict=True)}
    return told | {f"{n}_sd": float(v) for n, v in zip(names, track.constants_sd, strict=True)}


def number_pulses(seen_ns: Int64, period_ns: float, slack: float = 0.3) -> tuple[Int64, Int64]:
    """Give pulses of one period their numbers, though some are missing, doubled, or no pulses at all.

    Args:
        seen_ns: int64[N] arrivals on any clock that is off by less than 1000 ppm, in any order.
        period_ns: nominal.
        slack: how far, in periods, a pulse may lie from where the ones before it say it should be.

    Returns:
        (which, number): of the arrivals that are pulses, their places in `seen_ns` and their numbers, counted from
        the first; every number once.

    Edges:
        The period in use follows the pulses, so long gaps need 1 / (gap in periods) of its accuracy: after 1000
        missing pulses a frequency that changed by more than 300 ppm would miscount.
    """
    order = np.argsort(seen_ns, kind="stable")
    at = (seen_ns[order] - seen_ns[order[0]]).astype(np.float64) if len(order) else np.zeros(0)
    begin = _start(at, period_ns, slack)
    which: list[int] = []
    number: list[int] = []
    last, count, period = 0.0, 0, float(period_ns)
    for k in range(begin, len(at)):
        steps = (at[k] - last) / period if which else 0.0
        turn = round(steps)
        if which and (turn == 0 or abs(steps - turn) > slack):
            continue  # doubled, or a stray
        if which and turn:
            period += 0.1 * ((at[k] - last) / turn - period)
        last, count = float(at[k]), count + turn
        which.append(int(order[k]))
        number.append(count)
    return np.array(which, np.int64), np.array(number, np.int64)


def _start(at: Floats, period_ns: float, slack: float) -> int:
    """The first arrival that most of the next ones agree with."""
    for k in range(len(at)):
        steps = (at[k + 1 : k + 12] - at[k]) / period_ns
        if not len(steps) or np.mean(np.abs(steps - np.rint(steps)) <= slack / 2) > 0.5:
            return k
    return 0
