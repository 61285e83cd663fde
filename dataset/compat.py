"""What other public code makes of the same spikes, bit for bit: for comparison, not for use.

Their conventions differ from ours and from each other: SpikeCV's two TFI functions disagree on half-open sides, both
truncate to 8 bits, and missing intervals become a made-up brightness. `texture` is the one to build on.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset import kernels
from spikerig.dataset.errors import UsageError
from spikerig.dataset.spikes import SpikeStream

Picture = NDArray[np.uint8]


def spikecv_tfp(stream: SpikeStream, half_window: int) -> Picture:
    """SpikeCV's TFP.spikes2images: uint8[T-2h,H,W], the mean of 2h+1 ticks * 255, truncated.

    Raises:
        UsageError: the stream is shorter than 2h ticks.

    Source: SpikeCV, spkProc/reconstruction/tfp.py.
    """
    if half_window < 0 or stream.ticks < 2 * half_window:
        raise UsageError("the stream is too short for the window", value=(stream.ticks, half_window))
    keys = range(half_window, stream.ticks - half_window)
    out = np.empty((len(keys), stream.height, stream.width), np.uint8)
    for i, key in enumerate(keys):
        out[i] = _truncated(_mean(stream, key - half_window, key + half_window + 1))
    return out


def spikecv_tfp_frame(stream: SpikeStream, key: int, half_window: int) -> Picture:
    """SpikeCV's TFP.spikes2frame: uint8[H,W]; at key + h = T it averages 2h ticks and does not say so.

    Raises:
        UsageError: the window leaves the stream by more than that.

    Source: SpikeCV, spkProc/reconstruction/tfp.py.
    """
    if key - half_window < 0 or key + half_window > stream.ticks or half_window < 0:
        raise UsageError("the window leaves the stream", value=(key, half_window), expected=f"0 .. {stream.ticks}")
    return _truncated(_mean(stream, key - half_window, min(key + half_window + 1, stream.ticks)))


def spikecv_tfi(stream: SpikeStream, half_window: int = 20) -> Picture:
    """SpikeCV's TFI.spikes2images: uint8[T-2m,H,W], 255 / enclosing interval (a, b], truncated; missing = 257 = 0.

    The half window only crops the ends; the search has no limit.

    Raises:
        UsageError: the stream is shorter than 2m ticks, or m < 1 (theirs returns nothing then).

    Source: SpikeCV, spkProc/reconstruction/tfi.py.
    """
    if half_window < 1 or stream.ticks < 2 * half_window:
        raise UsageError("the stream is too short for the window", value=(stream.ticks, half_window))
    intervals = kernels.tfi_all(stream.bits, stream.width)[half_window : stream.ticks - half_window]
    table = np.zeros(65536, np.uint8)
    table[1:] = (np.float32(255) / np.arange(1, 65536, dtype=np.float32)).astype(np.uint8)
    return table[intervals]


def spikecv_tfi_frame(stream: SpikeStream, key: int, half_window: int = 20) -> Picture:
    """SpikeCV's TFI.spikes2frame: uint8[H,W], 255 / interval [a, b) within m ticks, truncated; missing = 2m.

    a is the last spike in [max(key-m+1, 1), key], so that a spike at tick 0 is never seen; b the first in
    [key+1, key+m].

    Raises:
        UsageError: key - m//2 < 0 or key + m >= T, where theirs fails.

    Source: SpikeCV, spkProc/reconstruction/tfi.py.
    """
    return (np.float32(255) / _interval(stream, key, half_window)).astype(np.uint8)


def spikezoo_tfp(stream: SpikeStream, window: int = 41) -> NDArray[np.float32]:
    """Spike-Zoo's TFPModel: float32[H,W], the mean of 2 (window//2) + 1 ticks around T//2, cut at the stream's end.

    Raises:
        UsageError: the window begins before the stream, where theirs averages something else or nothing.

    Source: Spike-Zoo, archs/tfp/nets.py.
    """
    middle, side = stream.ticks // 2, window // 2
    if window < 0 or middle - side < 0 or stream.ticks < 1:
        raise UsageError("the window begins before the stream", value=(window, stream.ticks))
    return _mean(stream, middle - side, min(middle + side + 1, stream.ticks))


def spikezoo_tfi(stream: SpikeStream, window: int = 41) -> NDArray[np.float32]:
    """Spike-Zoo's TFIModel: float32[H,W], 1 / interval as `spikecv_tfi_frame` at T//2 with m = window//2.

    Raises:
        UsageError: T//2 + window//2 >= T, where theirs fails.

    Source: Spike-Zoo, archs/tfi/nets.py.
    """
    return np.float32(1) / _interval(stream, stream.ticks // 2, window // 2)


def _mean(stream: SpikeStream, t0: int, t1: int) -> NDArray[np.float32]:
    return kernels.count(stream.bits, stream.width, t0, t1).astype(np.float32) / np.float32(t1 - t0)


def _truncated(light: NDArray[np.float32]) -> Picture:
    return (light * np.float32(255)).astype(np.uint8)


def _interval(stream: SpikeStream, key: int, m: int) -> NDArray[np.float32]:
    if m < 1 or key - m // 2 < 0 or key + m >= stream.ticks:
        raise UsageError("the search leaves the stream", value=(key, m), expected=f"key + m < {stream.ticks}")
    start = max(key - m + 1, 1)
    former, _ = kernels.tfi_at(stream.bits[start : max(key, start - 1) + 1], stream.width, max(key + 1 - start, 0))
    _, latter = kernels.tfi_at(stream.bits[key + 1 : key + m + 1], stream.width, 0)
    found = (former >= 0) & (latter >= 0)
    return np.where(found, latter + (key + 1) - (former + start), 2 * m).astype(np.float32)
