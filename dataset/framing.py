"""Where ticks begin in a stream of bare bits, and which period it has: told from the picture that the bits hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset import m1k40
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.wire import WireProfile

Bytes = NDArray[np.uint8]
Rates = NDArray[np.float64]  # of every bit of a tick, spikes a tick, in the order of the wire
FEWEST = 16  # ticks from which anything is told
_SLAB = 32  # ticks unpacked at once
_DEPENDENT = 16.0  # neighbouring pixels see the same edges: that many of them count as one witness
_BINS = 24  # of differences
_NEED = 4.0  # ln of odds that a candidate must win over all the others to count, on top of their number


@dataclass(frozen=True, slots=True)
class Phase:
    """Where the first whole tick begins.

    Args:
        offset: bytes from the first one, 0 <= offset < tick_bytes.
        confidence: 0 to 1, that it is this very byte.
        how: "tags" (of M1K40 blocks), "like" (an earlier picture's) or "seam" (top meets bottom, left meets right).
        rival: the second-best offset outside the best one's row and column; None with tags.
    """

    offset: int
    confidence: float
    how: str
    rival: int | None = None


def fold(data: Bytes, tick_bytes: int, most: int = 512) -> tuple[Rates, int]:
    """Mean of every bit of a tick over the ticks of a stretch, whatever its phase.

    Args:
        data: uint8[n]; what is over whole ticks is left out.
        tick_bytes: period.
        most: ticks looked at.

    Returns:
        float64[8 * tick_bytes] in 0..1, and how many ticks.

    Raises:
        DataError: less than 16 ticks.

    Cost:
        About 0.01 ms a tick of 12,500 bytes.
    """
    ticks = min(len(data) // tick_bytes, most)
    if ticks < FEWEST:
        raise DataError("too few bytes to tell the framing", value=f"{len(data)} bytes",
                        expected=f"at least {FEWEST} ticks of {tick_bytes} bytes")  # fmt: skip
    rows = data[: ticks * tick_bytes].reshape(ticks, tick_bytes)
    counts = np.zeros(8 * tick_bytes, np.uint32)
    for t in range(0, ticks, _SLAB):
        counts += np.unpackbits(rows[t : t + _SLAB], axis=1, bitorder="little").sum(axis=0, dtype=np.uint8)
    return counts / ticks, ticks


def find_phase(data: Bytes, profile: WireProfile, like: Rates | None = None) -> Phase:
    """Where ticks begin in a gapless stretch of wire bytes.

    Args:
        data: uint8[n], at least 16 ticks; 256 are better.
        profile: geometry of the wire.
        like: float64[8 * tick_bytes], rates of a tick from its beginning, of the same view before a loss (`rates_at`).

    Returns:
        The likeliest offset, and how likely it is. On noise, or where the picture has no seam (black edges all
        around), the confidence is low: it is then no answer.

    Raises:
        DataError: less than 16 ticks.

    Source:
        Likelihood of the differences across the seam, as between strangers, against those inside the picture; with
        `like`, the normalised correlation at every byte.
    """
    if profile.framing == "m1k40":
        start = m1k40.find_start(data, sure=True)
        return Phase(0, 0.0, "tags") if start is None else Phase(start, 1.0, "tags")
    rates, _ = fold(data, profile.tick_bytes)
    if like is not None and like.shape != rates.shape:
        raise UsageError("the earlier picture has another size", value=like.shape, expected=str(rates.shape))
    score = _seams(rates, profile) if like is None else _alike(rates, like)
    return _best(score, profile, "seam" if like is None else "like")


def rates_at(data: Bytes, profile: WireProfile, offset: int) -> Rates:
    """Rates of a tick's bits from its beginning, for `find_phase(like=...)` later.

    Args:
        data: uint8[n], a gapless stretch.
        profile: of the wire.
        offset: of a tick's first byte.
    """
    return fold(data[offset % profile.tick_bytes :], profile.tick_bytes)[0]


def period_gain(data: Bytes, tick_bytes: int, most: int = 512) -> float:
    """What a period explains: nats by which the rates of one half of the ticks foretell the bits of the other half
    better than one rate for all does. Around 0 or below for a wrong period or noise.

    Raises:
        DataError: less than 32 ticks.
    """  # fmt: skip
    half = min(len(data) // tick_bytes, most) // 2
    first, n = fold(data, tick_bytes, half)
    second, m = fold(data[half * tick_bytes :], tick_bytes, half)
    mean = float(np.clip(first.mean(), 1e-6, 1 - 1e-6))
    # a pixel's rate as the posterior mean over a prior around the common rate, so that a rate of 0 costs no infinity
    own = (first * n + mean) / (n + 1)
    return float(m * np.sum(second * np.log(own / mean) + (1 - second) * np.log((1 - own) / (1 - mean))))


def row_lag(rates: Rates, least: int = 64, most: int = 2048) -> tuple[int, float]:
    """The lag in bits at which a tick's bits are most like themselves beyond their neighbourhood: the length of a row.

    Args:
        rates: float64[n] of a whole tick, any phase.
        least, most: lags looked at.

    Returns:
        The lag, and how far it stands out: its correlation above the median of the others, in their scatter.
    """
    flat = rates - rates.mean()
    power = np.abs(np.fft.rfft(flat)) ** 2
    lags = np.fft.irfft(power, len(flat))[: min(most, len(flat) // 2)]
    if lags[0] <= 0:
        return 0, 0.0
    # the curvature makes the peak of a row stand out from slow changes
    curve = 2 * lags[1:-1] - lags[:-2] - lags[2:]
    inside = curve[least - 1 :]
    best = int(np.argmax(inside))
    scatter = 1.4826 * float(np.median(np.abs(inside - np.median(inside))))
    return best + least, float((inside[best] - np.median(inside)) / max(scatter, 1e-12 * lags[0]))


def byte_counts(data: Bytes, tick_bytes: int) -> Rates:
    """Spikes in each byte of a tick, summed over whole ticks: a cheap picture, eight pixels wide.

    Args:
        data: uint8[n], at most 65,535 / 8 ticks; what is over whole ticks is left out.
        tick_bytes: period.

    Returns:
        float64[tick_bytes].

    Cost:
        0.05 ms for 32 ticks of 12,500 bytes.
    """
    ticks = len(data) // tick_bytes
    rows = data[: ticks * tick_bytes].reshape(ticks, tick_bytes)
    return np.bitwise_count(rows).sum(axis=0, dtype=np.uint16).astype(np.float64)


def find_shift(counts: Rates, like: Rates, sure: float = 0.999) -> int:
    """By how many bytes ticks begin later in a stretch than in an earlier one, by their `byte_counts`.

    Args:
        counts, like: float64[tick_bytes], of now and of then.
        sure: least confidence.

    Returns:
        0 where they begin at the same byte, and where it cannot be told.

    Cost:
        0.4 ms for 12,500 bytes; `find_phase(like=...)` sees single pixels and takes ten times as long.
    """
    score = _alike(counts, like, 8)
    best = int(np.argmax(score))
    return best if best and confidence_of(score, best) > sure else 0


def seam_scores(data: Bytes, profile: WireProfile) -> Rates:
    """Of every byte, how likely a tick begins there, by the picture's edges; of several stretches they may be added.

    Args:
        data: uint8[n], at least 16 ticks.
        profile: of the wire, without tags.

    Returns:
        float64[tick_bytes], ln of likelihood ratios.

    Raises:
        DataError: too few ticks.
    """
    return _seams(fold(data, profile.tick_bytes)[0], profile)


def _seams(rates: Rates, profile: WireProfile) -> Rates:
    """ln of the likelihood ratio of every byte to be a tick's first, by what meets across rows and columns."""
    row, width, n = profile.row_bits, profile.width, len(rates)
    strangers = np.abs(rates - np.roll(rates, n // 2 + row // 3))
    down = _witness(np.abs(np.roll(rates, -row) - rates), strangers)
    across = _witness(np.abs(np.roll(rates, -1) - rates), strangers)
    ends = np.concatenate([[0.0], np.cumsum(np.concatenate([down, down[:width]]))])
    start = 8 * np.arange(n // 8)
    last_row = (start - row) % n
    score = (ends[last_row + width] - ends[last_row]) / _DEPENDENT
    columns = across.reshape(-1, row).sum(axis=0) / _DEPENDENT
    score += columns[(start + width - 1) % row]
    if row > width:
        score += columns[(start - 1) % row]
    return score


def _witness(neighbours: Rates, strangers: Rates) -> Rates:
    """ln p(difference | strangers) - ln p(difference | neighbours) of the neighbours, from how often each occurs.

    Two black pixels tell little: they are common among strangers, too.
    """
    edges = np.unique(np.quantile(np.concatenate([neighbours, strangers]), np.linspace(0, 1, _BINS + 1)[1:-1]))
    own = np.searchsorted(edges, neighbours, "right")
    near = np.bincount(own, minlength=len(edges) + 1) + 1.0
    far = np.bincount(np.searchsorted(edges, strangers, "right"), minlength=len(edges) + 1) + 1.0
    return np.log(far / near)[own]


def _alike(rates: Rates, like: Rates, pixels: int = 1) -> Rates:
    """ln of the likelihood of every byte to be a tick's first, by correlation with an earlier tick's rates.

    A value is of so many pixels: 1, or a byte's 8.
    """
    a, b = rates - rates.mean(), like - like.mean()
    size = np.sqrt(np.sum(a * a) * np.sum(b * b))
    if size <= 0:
        return np.zeros(len(rates) * pixels // 8)
    shift = np.fft.irfft(np.fft.rfft(a) * np.conj(np.fft.rfft(b)), len(a))[:: 8 // pixels] / size
    shift = np.clip(shift, 0.0, 1 - 1e-9)
    return -len(rates) / 2 * np.log1p(-(shift**2)) * (pixels / _DEPENDENT)


def _best(score: Rates, profile: WireProfile, how: str) -> Phase:
    best = int(np.argmax(score))
    confidence = confidence_of(score, best)
    row = profile.row_bits // 8
    at = np.arange(len(score))
    apart = (at - best + row) % len(score)
    other = np.where((apart > 2 * row) & ((at - best) % row != 0), score, -np.inf)
    rival = int(np.argmax(other)) if np.isfinite(other).any() else None
    return Phase(best, confidence, how, rival)


def confidence_of(score: Rates, best: int) -> float:
    """How likely the best of some scores (ln of likelihood ratios) is right; low where none stands out."""
    odds = score - score[best]
    nothing = np.log(len(score)) + _NEED + float(np.median(odds))  # all candidates alike, and the wish for proof
    return float(1.0 / (np.exp(odds).sum() + np.exp(np.clip(nothing, -700, 700))))
