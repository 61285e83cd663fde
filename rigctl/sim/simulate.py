"""From light to what the two cameras give: spikes and a blurry picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import UsageError
from spikerig.dataset.scene import Frame
from spikerig.dataset.spikes import SpikeStream
from spikerig.rigctl.sim.effects import Effect, Site, in_order
from spikerig.rigctl.sim.sensor import Light, encode, expose, integrate, spike_light
from spikerig.rigctl.sim.spec import Sensor


@dataclass(frozen=True, slots=True)
class Simulated:
    """One view as the cameras saw it, and what only the simulator knows.

    Args:
        spikes: over all of the light's ticks.
        frame: sRGB, 8 bits.
        blurry: float64[H,W,3], the exposure's mean linear light before any response.
        start: float64[H,W], charge before the first tick, thresholds.
        left: uint32[H,W], charge after the last tick, 2^-32 thresholds.
        clipped: float64[H,W], charge beyond one spike a tick, thresholds.
    """

    spikes: SpikeStream
    frame: Frame
    blurry: NDArray[np.float64]
    start: NDArray[np.float64]
    left: NDArray[np.uint32]
    clipped: NDArray[np.float64]


def simulate(light: Light, sensor: Sensor, effects: Sequence[Effect], seed: int, view: int = 0) -> Simulated:
    """Spikes and a blurry frame of one view.

    Args:
        light: linear light over the spikes' ticks, the RGB exposure within it.
        sensor: gain and spectral response of the spike camera.
        effects: any order; they act by stage. An effect left out changes no bit and costs nothing.
        seed: of the scene; every effect draws from its own stream of (seed, name, view).
        view: number of the view.

    Raises:
        UsageError: an effect is listed twice.
        NumericsError: light is negative or not finite.

    Source:
        Eq. 5 and 6 of SpikeNVS, threshold 1/gain; the frame is the mean over the exposure in linear light, then clip,
        sRGB, read noise, 8 bits.
    """
    names = [effect.name for effect in effects]
    if len(set(names)) < len(names):
        raise UsageError("an effect is listed twice", value=", ".join(sorted(n for n in names if names.count(n) > 1)))
    height, width = light.rgb.shape[1:3]
    site = Site(height, width, view, seed)
    steps = [(effect.per_tick, effect.begin(site)) for effect in in_order(effects)]
    start = np.zeros((height, width))
    for _, hooks in steps:
        if hooks.charge is not None:
            hooks.charge(start)
    bits, left, clipped = integrate(spike_light(light.rgb, sensor), light.knots, start, steps)
    blurry = expose(light)
    begin, end = light.exposure
    tick_ns = 1e9 / light.rate_hz
    frame = Frame(
        encode(blurry, [hooks for _, hooks in steps]),
        start_ns=light.t0_ns + round((begin - int(light.knots[0])) * tick_ns),
        exposure_ns=round((end - begin) * tick_ns),
    )
    return Simulated(SpikeStream(bits, width, light.rate_hz, light.t0_ns), frame, blurry, start, left, clipped)
