"""A plain blinking LED as a rolling shutter sees it: which of its edges each half-lit frame holds, and when it was."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.led_read import Beat, Blinks
from spikerig.calib.panel_frames import SURE, Look, Seen, blocks, shares
from spikerig.calib.panel_read import Spot
from spikerig.dataset.errors import DataError, RefusedError
from spikerig.dataset.marks import Sight

Floats = NDArray[np.float64]
Int64 = NDArray[np.int64]
EXTEND_NS = 5_000_000_000  # that a steady LED is believed to go on evenly beyond what was seen
FITS, APART = 0.08, 0.04  # least misfit (light, mean of frames) that is a match; how far any other must lie above it
WHITE = 0.99  # light above which an LED is clipped: its shares would lie
FEWEST = 8  # frames that must be compared
BLOCK = 100_000  # frames whose levels are found together: a clip


@dataclass(frozen=True, slots=True)
class Timeline:
    """When the LED went on and off, on its own time; between first and last that is all it did.

    Args:
        at_ns: int64[E], rising.
        rising: bool[E], by turns.
        first_ns, last_ns: outside, nothing is known.
        period_ns: 0 where it does not repeat.
    """

    at_ns: Int64
    rising: NDArray[np.bool_]
    first_ns: int
    last_ns: int
    period_ns: float

    def lit_ns(self, at_ns: Int64) -> Floats:
        """How long it has been on since its first edge."""
        at = (at_ns - self.at_ns[0]).astype(np.float64)
        edge = (self.at_ns - self.at_ns[0]).astype(np.float64)
        on = np.concatenate([[0.0], np.cumsum(np.diff(edge) * self.rising[:-1])])
        k = np.clip(np.searchsorted(edge, at, side="right") - 1, 0, len(edge) - 1)
        before = at < 0
        return np.where(before, at * ~self.rising[0], on[k] + (at - edge[k]) * self.rising[k])


def timeline(blinks: Blinks, beat: Beat, start_ns: int, add_ns: int) -> Timeline:
    """What is known of the LED about a viewpoint.

    Args:
        blinks: what its spikes show.
        beat: of the LED, and the viewpoint's own start in it.
        add_ns: from the spike camera's time to the LED's.

    Raises:
        DataError: edges of an unsteady LED do not come by turns: some were missed.
    """
    if not beat.period_ns:
        if (blinks.rising[1:] == blinks.rising[:-1]).any():
            raise DataError("some of an unsteady LED's edges were missed", value=f"{len(blinks.at_ns)} were seen")
        first, last = (t + add_ns for t in blinks.span_ns)
        return Timeline(blinks.at_ns + add_ns, blinks.rising, first, last, 0.0)
    first, last = blinks.span_ns[0] - EXTEND_NS, blinks.span_ns[1] + EXTEND_NS
    turns = np.arange(np.floor((first - start_ns) / beat.period_ns) - 1, (last - start_ns) / beat.period_ns + 1)
    ons = start_ns + np.rint(turns * beat.period_ns).astype(np.int64)
    at = np.stack([ons, ons + round(beat.on_ns)], 1).reshape(-1) + add_ns
    return Timeline(at, np.arange(len(at)) % 2 == 0, first + add_ns, last + add_ns, beat.period_ns)


def spike_sights(blinks: Blinks, line: Timeline, epoch: int, add_ns: int) -> list[Sight]:
    """What the spikes saw of a timeline's edges."""
    told = []
    for at, rising, sd in zip(blinks.at_ns.tolist(), blinks.rising.tolist(), blinks.sd_ns.tolist(), strict=True):
        same = line.at_ns[line.rising == rising]
        edge = int(same[np.argmin(np.abs(same - add_ns - at))])
        told.append(Sight("spike", epoch, at, edge, sd, rising, 0))
    return told


def frame_sights(
    looks: Iterable[Look], spots: Sequence[Spot], row_ns: float, line: Timeline, between_ns: tuple[int, int], epoch: int
) -> list[Sight]:
    """Sightings in a clip: each frame whose exposure holds one edge of the LED gives one.

    Args:
        looks: all frames of the clip.
        spots: where the LED is, or several that blink alike.
        row_ns: time from row to row.
        line: when it went on and off.
        between_ns: what the LED's time minus the clip's media time may be.
        epoch: the clip.

    Raises:
        DataError: the LED is not seen, is clipped, or does otherwise than in the spikes.
        RefusedError: more than one such difference fits: the LED repeats too soon.
    """
    seen = next(blocks(looks, spots, BLOCK), None)
    found = None if seen is None else shares(seen.light)
    if seen is None or found is None or not found[2].any():
        raise DataError("the LED does not blink in the clip", value=f"{len(spots)} places",
                        cause="another place, too dim, or it is not in view")  # fmt: skip
    if float(np.percentile(seen.light, 95)) > WHITE:
        raise DataError("the LED is clipped in the clip: its light tells no time", value="white",
                        next="a dimmer LED, or a piece of paper before it")  # fmt: skip
    share, contrast, sure = found
    share, contrast = share[:, sure], contrast[sure]
    seen = replace(seen, light=seen.light[:, sure], noise=seen.noise[:, sure], row=seen.row[sure])
    step = int(max(seen.exposure_ns.min() // 8, 100_000))
    ahead = _ahead(seen, share, row_ns, line, between_ns, step)
    sd = np.hypot(seen.noise / contrast, 0.002)
    told: list[Sight] = []
    for tolerance in (2 * step, step // 2):
        told = [
            sight for k, n in np.argwhere((share > SURE) & (share < 1 - SURE)).tolist()
            if (sight := _sight(seen, k, n, float(share[k, n]), float(sd[k, n]), row_ns, line, ahead, tolerance, epoch))
        ]  # fmt: skip
        if not told:
            break
        ahead = round(float(np.median([s.panel_ns - s.device_ns - ahead for s in told]))) + ahead
    if not told:
        raise DataError("no frame's exposure holds an edge of the LED", value=f"{len(share)} frames",
                        next="longer clips or exposures, or an LED that blinks faster")  # fmt: skip
    return told


def _ahead(seen: Seen, share: Floats, row_ns: float, line: Timeline, between_ns: tuple[int, int], step: int) -> int:
    """LED time minus media time, to a step: where what the frames show is what the LED did."""
    begin = seen.start_ns[:, None] + np.rint(seen.row * row_ns).astype(np.int64)
    end = begin + seen.exposure_ns[:, None]
    tried = np.arange(between_ns[0], between_ns[1] + step, step)
    misfit = np.full(len(tried), np.inf)
    for k, ahead in enumerate(tried.tolist()):
        known = (begin + ahead >= line.first_ns) & (end + ahead <= line.last_ns)
        if known.sum() >= FEWEST * share.shape[1] and (np.ptp(share[known]) > 0.5 or line.period_ns):
            told = (line.lit_ns(end + ahead) - line.lit_ns(begin + ahead)) / (end - begin)
            misfit[k] = np.abs(told - share)[known].mean()
    best = int(np.argmin(misfit))
    open_ms = (between_ns[1] - between_ns[0]) / 1e6
    if not misfit[best] <= FITS:
        raise DataError("the LED does otherwise in the clip than in the spikes", value=f"misfit {misfit[best]:.3f}",
                        expected=f"at most {FITS} somewhere within {open_ms:.0f} ms",
                        cause="another lamp, an LED that is not steady, or stamps of another computer")  # fmt: skip
    near = np.abs(tried - tried[best]) <= max(line.period_ns / 4, 4 * int(seen.exposure_ns.max()))
    rival = float(misfit[~near].min(initial=np.inf))
    if rival < misfit[best] + APART:
        period = f"one of more than {open_ms:.0f} ms" if line.period_ns else "longer viewpoints, or a wilder pattern"
        raise RefusedError(
            "which of the LED's periods a clip saw cannot be told",
            value=f"period {line.period_ns / 1e6:.1f} ms, {open_ms:.0f} ms are left open by when the clip was started "
            "and stopped",
            expected=f"an LED that repeats later: {period}", next="a slower LED (docs/clock.md), or a clock box",
        )  # fmt: skip
    return int(tried[best])


def _sight(
    seen: Seen, frame: int, spot: int, share: float, sd: float, row_ns: float, line: Timeline, ahead: int,
    tolerance: int, epoch: int,
) -> Sight | None:  # fmt: skip
    """The edge that a frame's exposure holds; None where it holds none, several, or another than the share says."""
    row, length = float(seen.row[spot]), int(seen.exposure_ns[frame])
    begin = int(seen.start_ns[frame]) + round(row * row_ns)
    near = np.flatnonzero(
        (line.at_ns >= begin + ahead - tolerance) & (line.at_ns <= begin + length + ahead + tolerance)
    )
    if len(near) != 1:
        return None
    edge, rising = int(line.at_ns[near[0]]), bool(line.rising[near[0]])
    at = begin + round((1 - share if rising else share) * length)
    if abs(edge - ahead - at) > tolerance:
        return None
    return Sight("rgb", epoch, at, edge, sd * length, rising, 0, row, bool(seen.predicted[frame]))
