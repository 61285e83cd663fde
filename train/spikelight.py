"""Light from a view's spikes at instants of its exposure: textures by kind, the exposure's mean, row by row."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.straight import Straight
from spikerig.dataset.clocktime import ClockModel
from spikerig.dataset.errors import DataError
from spikerig.dataset.scene import View
from spikerig.dataset.spikes import SpikeStream
from spikerig.dataset.texture import Texture, tfi, tfp, window_sum
from spikerig.train import rolling


def spikes_of(view: View) -> SpikeStream:
    """The spikes of a view that must have them."""
    if view.spikes is None:
        raise DataError(
            f"view '{view.name}' has no spikes, and this method trains on them",
            next="--method plain or average needs none",
        )
    return view.spikes


def spike_tick(view: View, at_ns: float, clock: ClockModel | None) -> float:
    """The (fractional) tick of a view's spikes at an instant of its frame's clock.

    Raises:
        DataError: the spikes are on another clock and the scene has no map to it.
    """
    stream = spikes_of(view)
    if stream.clock == view.frame.clock:
        return stream.tick_at(round(at_ns))
    if clock is None:
        raise DataError(
            f"the frame and spikes of view '{view.name}' are on different clocks",
            value=f"{view.frame.clock} and {stream.clock}",
            expected="one clock, or the scene's map between them",
        )
    return stream.tick_at(int(clock.device_from_rig(np.int64(round(at_ns)))))


def windowed_tfi(stream: SpikeStream, tick: float, window: int) -> Texture:
    """TFI over the most intervals (1, 3 or 9: as many before as after) that fit into a window of ticks.

    One interval where even three are longer. Bright pixels get the low noise of a window, dark ones no zero counts:
    on the demo scene its error is half that of TFP over 32 ticks.
    """
    first = tfi(stream, tick)
    light, known = first.light.copy(), first.known
    for k in (3, 9):
        longer = tfi(stream, tick, intervals=k)
        fits = longer.known & (k <= window * longer.light)
        light[fits] = longer.light[fits]
    return Texture(light, known, tick, f"tfi-window-{window}")


def textures_at(stream: SpikeStream, tick: float, kind: str, window: int) -> list[Texture]:
    """The textures of an instant by kind: tfp, tfi, both of them, tfi-window, or raw (the one tick's spikes)."""
    made: dict[str, Callable[[], list[Texture]]] = {
        "tfp": lambda: [tfp(stream, tick, window)],
        "tfi": lambda: [tfi(stream, tick)],
        "both": lambda: [tfp(stream, tick, window), tfi(stream, tick)],
        "tfi-window": lambda: [windowed_tfi(stream, tick, window)],
        "raw": lambda: [tfp(stream, tick, 1)],
    }
    return made[kind]()


def average_texture(found: list[Texture]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Mean over the textures known at each pixel: (light [H,W], known where any is)."""
    known = np.stack([t.known for t in found])
    light = np.where(known, np.stack([t.light for t in found]), 0).sum(0)
    return (light / np.maximum(known.sum(0), 1)).astype(np.float32), np.asarray(known.any(0), np.bool_)


def exposure_mean(view: View, stream: SpikeStream, t0: int, t1: int) -> Texture:
    """Spikes a tick over an exposure from tick t0 to t1, of a view's raw spikes."""
    if not (0 <= t0 < t1 <= stream.ticks):
        raise DataError(
            f"the spikes of view '{view.name}' do not cover its exposure",
            value=f"exposure ticks {t0}..{t1}, stream 0..{stream.ticks}",
            expected="spikes from before its start to after its end",
            next="spikerig data verify FILE",
        )
    lost = any(a < t1 and b > t0 for a, b in stream.lost)
    light = np.asarray(window_sum(stream, t0, t1), np.float32) / np.float32(t1 - t0)
    return Texture(light, np.full(light.shape, not lost), (t0 + t1) / 2, "exposure")


def exposures(view: View, clock: ClockModel | None) -> Callable[[SpikeStream, float], list[Texture]]:
    """(stream, tick of mid-exposure) -> its mean: what `light_at` takes for a view's own exposure."""
    ends = [spike_tick(view, view.instant_ns(phase), clock) for phase in (0.0, 1.0)]
    before, after = (end - spike_tick(view, view.instant_ns(0.5), clock) for end in ends)
    return lambda stream, tick: [exposure_mean(view, stream, round(tick + before), round(tick + after))]


def light_at(
    view: View,
    phase: float,
    late: NDArray[np.float32] | None,
    clock: ClockModel | None,
    straight: Straight,
    make: Callable[[SpikeStream, float], list[Texture]],
) -> list[Texture]:
    """What `make` (stream, tick) makes of a view's spikes at a phase of the exposure, on the scene's camera."""
    stream = spikes_of(view)
    if late is None:
        return [straight.texture(t) for t in make(stream, spike_tick(view, view.instant_ns(phase), clock))]
    return rolling.textures_by_row(
        stream,
        late,
        lambda later: spike_tick(view, view.instant_ns(phase + later), clock),
        lambda some, tick: [straight.texture(t) for t in make(some, tick)],
        whole=straight.resamples,
    )
