"""Textures from spikes: what the light was, and where that is known.

A spike at tick b holds the light of (a, b], where a is the spike before it. Two families read that:

* TFP (texture from playback): spikes in a half-open window / its length.
* TFI (texture from interval): 1 / the interval around the instant.

Light 1.0 is a spike every tick. An instant `at` may be a fraction; it means the tick it lies in, floor(at). No texture
holds an infinity, or a zero that stands for "not known": light is 0 there and `known` is False.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset import kernels
from spikerig.dataset.clocktime import frozen_array
from spikerig.dataset.errors import UsageError
from spikerig.dataset.spikes import SpikeStream

WINDOWS = (8, 16, 32, 64, 128, 256)


@dataclass(frozen=True, slots=True)
class Texture:
    """Light from spikes: light float32[H,W] (1.0 = a spike every tick), known bool[H,W]; light is 0 where not known.

    `at` is the instant or window centre in ticks, `method` says how it was made.
    """

    light: NDArray[np.float32]
    known: NDArray[np.bool_]
    at: float
    method: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "light", frozen_array(self.light, np.float32))
        object.__setattr__(self, "known", frozen_array(self.known, np.bool_))

    def with_nan(self) -> NDArray[np.float32]:
        """The light, NaN where it is not known: what `.npy` and `.exr` files hold."""
        return np.where(self.known, self.light, np.float32(np.nan))


def window_sum(stream: SpikeStream, t0: int, t1: int) -> NDArray[np.uint32]:
    """Spikes a pixel in ticks [t0, t1), 0 <= t0 <= t1 <= T: uint32[H,W]; lost ticks count as dark."""
    return kernels.count(stream.bits, stream.width, t0, t1)


def tfp_window(at: float, window: int) -> tuple[int, int]:
    """The window of TFP: [c - window//2, c - window//2 + window) with c = floor(at).

    An odd window has tick c in its middle; an even one has the start of tick c in its middle.
    """
    if window < 1:
        raise UsageError("a window has at least one tick", value=window)
    first = int(np.floor(at)) - window // 2
    return first, first + window


def tfp(stream: SpikeStream, at: float, window: int) -> Texture:
    """Texture from playback: spikes in the window around an instant / the window's length.

    Args:
        stream: the spikes.
        at: the instant in ticks, 0 <= at <= T; fractions mean the tick they lie in.
        window: ticks, any parity, >= 1; see `tfp_window`.

    Returns:
        A Texture; a steady light is right to within one spike, 1/window.

    Raises:
        UsageError: the instant leaves the stream or the window is empty.

    Edges:
        Where the window sticks out of the stream the part inside counts, divided by that part's length. No pixel is
        known where the part inside is empty or touches a lost tick.

    Cost:
        Reads `window` ticks once.

    Source:
        The paper's P = N_w / w.
    """
    _instant(stream, at)
    t0, t1 = (min(max(t, 0), stream.ticks) for t in tfp_window(at, window))
    lost = stream.lost_before()
    known = t1 > t0 and lost[t1] == lost[t0]
    light = window_sum(stream, t0, t1) / max(t1 - t0, 1) * known
    return Texture(light.astype(np.float32), np.full(light.shape, known), at, f"tfp-{window}")


def tfi(stream: SpikeStream, at: float, *, causal: bool = False, intervals: int = 1) -> Texture:
    """Texture from interval: intervals around an instant / the ticks they span.

    Enclosing (default): light = 1/(b - a), a the last spike < t, b the first spike >= t. Causal, the paper's words:
    light = 1/(t - a). With k intervals the light is k/(b - a): of the k + 1 spikes k//2 + 1 lie before t and the
    others at or after it; causal, a is the k-th last spike before t and the light k/(t - a).

    Args:
        stream: the spikes.
        at: the instant in ticks, 0 <= at <= T; t = floor(at).
        causal: look at the past only.
        intervals: k >= 1.

    Returns:
        A Texture.

    Raises:
        UsageError: the instant leaves the stream or intervals < 1.

    Edges:
        Not known: a needed spike is missing, or a tick between the outermost two (causal: between a and t) was lost.
        The causal estimate is biased: t falls anywhere in an interval of length n, and the mean of 1/d over
        d = 1..n is H_n/n, 2.9 times too bright at n = 10. It is there to reproduce the paper.

    Cost:
        Scans outward from t until every pixel has its spikes.

    Source:
        Enclosing: Dong et al. 2017, as every public code reads it; causal: the paper's P = Omega / d.
    """
    _instant(stream, at)
    if intervals < 1:
        raise UsageError("TFI needs at least one interval", value=intervals)
    t = int(np.floor(at))
    before, after = (intervals, 1) if causal else (intervals // 2 + 1, (intervals + 1) // 2)
    a, b = kernels.tfi_at(stream.bits, stream.width, t, before=before, after=after)
    if causal:
        b = np.full_like(a, t)
    known = (a >= 0) & (b >= 0)
    if len(stream.lost):
        lost = stream.lost_before()
        known &= lost[np.maximum(b, 0)] == lost[np.minimum(a + 1, stream.ticks)]
    light = np.divide(intervals, b - a, out=np.zeros(a.shape), where=known)
    name = ("tfi-causal" if causal else "tfi") + (f"-{intervals}" if intervals > 1 else "")
    return Texture(light.astype(np.float32), known, at, name)


def tfp_adaptive(stream: SpikeStream, at: float, *, windows: Sequence[int] = WINDOWS, margin: float = 1.0) -> Texture:
    """TFP with a window for each pixel: as long as the contrast over time stays below the noise of counting.

    A window of n ticks that counts N spikes of a steady light L has |N - n L| < 1, so L lies within 1/n of N/n. From
    the shortest window on, a pixel's window grows while the ranges N/n -+ margin/n of all windows so far still share
    a point, that is while nothing says the light has changed; the last such window's N/n is the light. In steady
    light every pixel ends with the longest window; where an edge passes, the window stops before reaching it.

    Args:
        stream: the spikes.
        at: the instant in ticks, 0 <= at <= T.
        windows: ticks, increasing; each placed as in `tfp_window`.
        margin: how far a count of steady light may be off, in spikes: 1 for counting alone, more for a noisy sensor,
            less (0.75) where motion is textured and faint changes matter more than noise.

    Returns:
        A Texture.

    Raises:
        UsageError: the instant leaves the stream, windows do not increase, or the margin is not positive.

    Edges:
        At the ends of the stream windows are cut as in `tfp`; windows that touch a lost tick are not used, and no
        pixel is known where the shortest does.

    Cost:
        Reads the longest window about twice.

    Source:
        The paper's "adjusting the size of the time window according to different contrast levels"; the rule is the
        intersection of confidence intervals (Goldenshluger and Nemirovski 1997).
    """
    light, _, known = adaptive_windows(stream, at, windows, margin)
    return Texture(light.astype(np.float32), known, at, "tfp-adaptive")


def adaptive_windows(
    stream: SpikeStream, at: float, windows: Sequence[int] = WINDOWS, margin: float = 1.0
) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.bool_]]:
    """What `tfp_adaptive` decides: (light float64[H,W], window int32[H,W] in ticks, 0 = none, known bool[H,W])."""
    _instant(stream, at)
    if len(windows) < 1 or any(a >= b for a, b in itertools.pairwise(windows)) or not margin > 0:
        raise UsageError("windows must increase and the margin be positive", value=(tuple(windows), margin))
    lost = stream.lost_before()
    shape = (stream.height, stream.width)
    light, chosen = np.zeros(shape), np.zeros(shape, np.int32)
    low, high = np.full(shape, -np.inf), np.full(shape, np.inf)
    for window in windows:
        t0, t1 = (min(max(t, 0), stream.ticks) for t in tfp_window(at, window))
        if t0 == t1 or lost[t0] != lost[t1]:
            break
        mean = window_sum(stream, t0, t1) / (t1 - t0)
        np.maximum(low, mean - margin / (t1 - t0), out=low)
        np.minimum(high, mean + margin / (t1 - t0), out=high)
        growing = low <= high  # once apart, the ranges stay apart
        light[growing], chosen[growing] = mean[growing], window
    return light, chosen, chosen > 0


def _instant(stream: SpikeStream, at: float) -> None:
    if not 0 <= at <= stream.ticks:
        raise UsageError("the instant leaves the stream", value=f"tick {at}", expected=f"0 .. {stream.ticks}")
