"""What each spike pixel makes of light: gain, dark rate, faults, from recordings of an even field.

    rate = gain * light + dark        spikes a tick of one pixel; gain is relative, with mean 1

`light` is what an average pixel would fire, less its dark rate. Without a recording in the dark (or the true light of
two levels) the dark rate cannot be known: what all pixels fire too much looks like light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.flat import FlatField
from spikerig.dataset.spikes import SpikeFile
from spikerig.dataset.texture import window_sum

Floats = NDArray[np.float64]
FULL = 0.98  # spikes a tick from which on a pixel may be saturated
WEAK, STRONG = 0.2, 5.0  # gains outside are no gains: a dead or a stuck pixel
HOT = 0.2  # dark spikes a tick


@dataclass(frozen=True, slots=True)
class Level:
    """Spikes counted under one light: counts float64[H,W] over `ticks` ticks, and their variance in short and long
    windows: (window in ticks, mean variance of its counts) twice, None where the recording is too short for that."""

    name: str
    counts: Floats
    ticks: int
    spread: tuple[tuple[int, float], tuple[int, float]] | None = None

    @property
    def rate(self) -> Floats:
        """Spikes a tick, float64[H,W]."""
        return self.counts / self.ticks


def count_level(name: str, file: SpikeFile) -> Level:
    """Count a whole recording, lost ticks left out; memory is bounded.

    Raises:
        DataError: fewer than 256 good ticks.
    """
    total = np.zeros((file.height, file.width))
    ticks, short = 0, max(16, min(256, file.ticks // 64))
    moments = {n: [np.zeros_like(total), np.zeros_like(total), 0.0] for n in (short, 4 * short)}
    block = 4 * short * max(1, (4 << 20) // max(4 * short * file.height * ((file.width + 7) // 8), 1))
    for stream in file.blocks(block):
        lost = stream.lost_before()
        for n, held in moments.items():
            for t0 in range(0, stream.ticks - n + 1, n):
                if lost[t0] == lost[t0 + n]:
                    counted = window_sum(stream, t0, t0 + n).astype(np.float64)
                    held[0] += counted
                    held[1] += counted**2
                    held[2] += 1
                    if n == short:
                        total, ticks = total + counted, ticks + n
    if ticks < 256:
        raise DataError(
            "the recording is too short to count", value=f"{name}: {ticks} good ticks", expected="256 or more"
        )
    spread = [(n, _variance(*held)) for n, held in moments.items()] if moments[4 * short][2] >= 4 else None
    return Level(name, total, ticks, (spread[0], spread[1]) if spread else None)


def _variance(sums: Floats, squares: Floats, n: float) -> float:
    """Mean over pixels of the counts' variance over time; stuck pixels take no part."""
    mean = sums / n
    return float(np.mean(((squares / n - mean**2) * (n / (n - 1)))[mean > 0])) if (mean > 0).any() else 0.0


def flat_field(
    levels: Sequence[Level], dark: Sequence[Level] = (), lux: Sequence[float] | None = None
) -> tuple[FlatField, dict[str, Any]]:
    """Fit gain and dark rate of every pixel.

    Args:
        levels: recordings of an even field, at one level or more, none of them dark.
        dark: recordings with the cap on.
        lux: the light of each level in any unit, where it is known; at least two levels then do without a dark one.

    Returns:
        The maps, and what else came out, JSON-ready: light of the levels, the pattern's strength, falloff towards the
        corners, electrons a spike, numbers of bad pixels.

    Raises:
        UsageError: no level; neither dark nor lux; sizes that differ.
        DataError: everything is dark, or saturated.

    Edges:
        A level at which a pixel fires (nearly) every tick does not count for that pixel.
    """
    _check(levels, dark, lux)
    rates = np.stack([level.rate for level in levels])
    weight = np.stack([np.where(level.rate < FULL, float(level.ticks), 0.0) for level in levels])
    if not (weight > 0).any():
        raise DataError("all recordings are saturated", value=f"{rates.mean():.3f} spikes a tick",
                        next="use less light, or a smaller aperture")  # fmt: skip
    if dark:
        offset = np.sum([d.counts for d in dark], axis=0) / sum(d.ticks for d in dark)
        light = np.array([_median((r - offset)[w > 0]) for r, w in zip(rates, weight, strict=True)])
        gain = _slope(rates - offset, weight, light)
        for _ in range(4):  # where some pixels are saturated, the others' gains say what the level was
            told = np.divide(rates - offset, gain, out=np.zeros_like(rates), where=gain > WEAK)
            light = np.array([_median(t[(w > 0) & (gain > WEAK)]) for t, w in zip(told, weight, strict=True)])
            gain = _slope(rates - offset, weight, light)
    else:
        light = np.asarray(lux, np.float64)
        n = np.maximum(weight.sum(0), 1e-300)
        middle, mean = (weight * light[:, None, None]).sum(0) / n, (weight * rates).sum(0) / n
        gain = _slope(rates - mean, weight, light[:, None, None] - middle)
        offset = np.maximum(mean - gain * middle, 0)
        scale = _median(gain)
        gain, light = gain / max(scale, 1e-300), light * scale
    if not light.max() > 1e-5:
        raise DataError("the recordings show no light", value=f"{light.max():.3g} spikes a tick above the dark",
                        cause="the cap was on, or levels and dark recordings are swapped")  # fmt: skip
    good = (gain > WEAK) & (gain < STRONG) & (offset < HOT) & (weight > 0).any(0)
    if not good.any():
        raise DataError("no pixel behaves like one", value=f"{rates.mean():.3g} spikes a tick")
    mean_gain = float(gain[good].mean())
    gain, light = gain / mean_gain, light * mean_gain
    maps = np.where(good, gain, 1), np.where(good, offset, 0).clip(0, 1), smooth_part(gain, good)
    flat = FlatField(maps[0].astype(np.float32), maps[1].astype(np.float32), good, maps[2].astype(np.float32))
    return flat, _told(flat, levels, bool(dark), light, rates, weight, lux)


def _check(levels: Sequence[Level], dark: Sequence[Level], lux: Sequence[float] | None) -> None:
    if not levels:
        raise UsageError("a flat field needs a recording of an even field")
    if lux is not None and (len(lux) != len(levels) or not all(np.isfinite(v) and v > 0 for v in lux)):
        raise UsageError(
            "the light of the levels is one positive number each", value=list(lux), expected=f"{len(levels)} of them"
        )
    if not dark and (lux is None or len(set(lux)) < 2):
        raise UsageError(
            "the dark rate cannot be told from light",
            value=f"{len(levels)} levels, none dark",
            next="record with the cap on (--dark FILE), or give the light of two levels (--lux)",
        )
    shapes = {level.counts.shape for level in (*levels, *dark)}
    if len(shapes) > 1:
        raise UsageError("the recordings differ in size", value=sorted(shapes))


def _median(values: Floats) -> float:
    return float(np.median(values)) if values.size else 0.0


def _slope(y: Floats, weight: Floats, x: Floats) -> Floats:
    """Weighted least squares of y = slope * x over the first axis; 0 where nothing weighs."""
    x = x.reshape(len(y), *x.shape[1:]) if x.ndim == y.ndim else x[:, None, None]
    down = (weight * x * x).sum(0)
    return np.divide((weight * x * y).sum(0), down, out=np.zeros_like(down), where=down > 1e-12)


def smooth_part(gain: Floats, good: NDArray[np.bool_]) -> Floats:
    """Vignetting: even powers of the radius up to the fourth, and a tilt, fitted to good pixels; mean 1."""
    y, x = (np.indices(gain.shape) + 0.5 - np.array(gain.shape).reshape(2, 1, 1) / 2) / np.hypot(*gain.shape) * 2
    r2 = x * x + y * y
    terms = np.stack([np.ones_like(r2), x, y, r2, r2 * r2], -1)
    smooth = terms @ np.linalg.lstsq(terms[good], gain[good], rcond=None)[0]
    return np.maximum(smooth / smooth[good].mean(), 1e-3)


def _told(
    flat: FlatField, levels: Sequence[Level], dark: bool, light: Floats, rates: Floats, weight: Floats,
    lux: Sequence[float] | None,
) -> dict[str, Any]:  # fmt: skip
    good, (h, w) = flat.good, flat.gain.shape
    own = (flat.gain / flat.smooth)[good].astype(np.float64)
    spikes = sum(level.counts[good].mean() for level in levels)
    # what counting alone scatters is no pattern: a sixth of a spike squared, for all recordings together
    pattern = float(np.sqrt(max(own.var() - len(levels) / 6 / spikes**2, 0)))
    rim = float(np.mean([flat.smooth[0, 0], flat.smooth[0, -1], flat.smooth[-1, 0], flat.smooth[-1, -1]]))
    rows: list[dict[str, Any]] = []
    for level, value, rate, weigh in zip(levels, light, rates, weight, strict=True):
        used = (weigh > 0) & good
        off = _median((rate - flat.gain * value - flat.dark)[used]) / value if lux is not None else None
        rows.append({"name": level.name, "ticks": level.ticks, "light": float(value), "saturated": 1 - float(
            (weigh > 0).mean()), "nonlinearity": off})  # fmt: skip
    return {
        "levels": rows,
        "dark_rate": {"mean": float(flat.dark[good].mean()), "sd": float(flat.dark[good].std()), "measured": dark},
        "pattern_sd": pattern,
        "falloff": 1 - rim / float(flat.smooth[h // 2, w // 2]),
        "threshold_e": _electrons(levels, light),
        "bad_pixels": int((~good).sum()),
        "pixels": int(good.size),
    }


def _electrons(levels: Sequence[Level], light: Floats) -> float | None:
    """Electrons a spike, from how the variance of counts grows with the window: by rate / threshold_e a tick."""
    grown = [(level.spread, float(v)) for level, v in zip(levels, light, strict=True) if level.spread and v > 0.01]
    slopes = [(long[1] - short[1]) / ((long[0] - short[0]) * v) for (short, long), v in grown]
    mean = float(np.mean(slopes)) if slopes else 0.0
    return 1 / mean if mean > 1e-6 else None
