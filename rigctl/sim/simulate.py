"""From light to what the two cameras give: spikes and a blurry picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import UsageError
from spikerig.dataset.scene import Camera, Frame
from spikerig.dataset.spikes import SpikeStream
from spikerig.rigctl.sim.effects import Effect, Hooks, Site, in_order
from spikerig.rigctl.sim.rgb import encode, expose, optics
from spikerig.rigctl.sim.sensor import Floats, Light, delayed, integrate, refined, spike_light
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


def simulate(
    light: Light,
    sensor: Sensor,
    effects: Sequence[Effect],
    seed: int,
    view: int = 0,
    camera: Camera | None = None,
) -> Simulated:
    """Spikes and a blurry frame of one view.

    Args:
        light: linear light over the spikes' ticks, the RGB exposure within it.
        sensor: gain and spectral response of the spike camera.
        effects: any order; they act by stage. An effect left out changes no bit and costs nothing.
        seed: of the scene; every effect draws from its own stream of (seed, name, view).
        view: number of the view.
        camera: the pinhole of both arms, for effects that need angles.

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
    ticks = int(light.knots[-1] - light.knots[0])
    site = Site(height, width, view, seed, light.rate_hz, light.t0_ns * 1e-9, ticks, camera)
    steps = [effect.begin(site) for effect in in_order(effects)]
    light = _lit(light, steps)
    spikes, start, left, clipped = _spikes(light, sensor, steps)
    frame, blurry = _frame(light, steps)
    return Simulated(spikes, frame, blurry, start, left, clipped)


def _lit(light: Light, steps: Sequence[Hooks]) -> Light:
    """The light after what happens to it before the arms part."""
    changes = [h.radiance for h in steps if h.radiance is not None]
    if not changes:
        return light
    asked = [h.step_s for h in steps if h.step_s > 0]
    light = refined(light, min(asked, default=0.0))
    at_s = light.at_s
    for change in changes:
        change(light.rgb, at_s)
        if light.arm is not None:
            change(light.arm, at_s)
    return light


def _spikes(
    light: Light, sensor: Sensor, steps: Sequence[Hooks]
) -> tuple[SpikeStream, NDArray[np.float64], NDArray[np.uint32], NDArray[np.float64]]:
    """The spike arm: stream, charge before, charge left, charge clipped."""
    height, width = light.rgb.shape[1:3]
    seen = spike_light(light.rgb, sensor)
    seen = optics(seen[..., None], [h.spike_optics for h in steps])[..., 0]
    seen, knots = delayed(seen, light.knots, _ahead(light, [h.clock_ns for h in steps]))
    start = np.zeros((height, width))
    for h in steps:
        if h.charge is not None:
            h.charge(start)
    bits, left, clipped = integrate(np.ascontiguousarray(seen), knots, start, steps)
    for h in steps:
        if h.bits is not None:
            h.bits(bits, width)
    stream = SpikeStream(bits, width, light.rate_hz, light.t0_ns)
    for h in steps:
        if h.wire is not None:
            stream = h.wire(stream)
    return stream, start, left, clipped


def _ahead(light: Light, clocks: Sequence) -> NDArray[np.float64]:
    """By how many ticks the spike camera's clock is ahead of the rig's at each knot."""
    at_ns = light.t0_ns + np.rint((light.knots - light.knots[0]) * (1e9 / light.rate_hz)).astype(np.int64)
    total = np.zeros(len(at_ns))
    for clock in clocks:
        if clock is not None:
            total += clock(at_ns)
    return total * (light.rate_hz * 1e-9)


def _frame(light: Light, steps: Sequence[Hooks]) -> tuple[Frame, NDArray[np.float64]]:
    """The RGB arm: the frame, and the mean linear light on its sensor."""
    changes = [h.rgb_optics for h in steps]
    row_ns = round(sum(h.row_ns for h in steps))
    if row_ns and any(changes):  # rows see other instants, so the optics cannot wait for the mean
        pictures: Floats = optics(light.rgb if light.arm is None else light.arm, changes)
        blurry = expose(replace(light, rgb=pictures, arm=None), row_ns)
    else:
        mean = expose(light, row_ns)
        blurry = optics(mean[None].astype(np.float32), changes)[0].astype(np.float64) if any(changes) else mean
    begin, end = light.exposure
    tick_ns = 1e9 / light.rate_hz
    start_ns = light.t0_ns + round((begin - int(light.knots[0])) * tick_ns)
    for h in steps:
        if h.frame_clock_ns is not None:
            start_ns += round(float(h.frame_clock_ns(np.array([start_ns]))[0]))
    rows = light.rgb.shape[1] // 2
    frame = Frame(
        encode(blurry, steps),
        start_ns=start_ns - rows * row_ns,
        exposure_ns=round((end - begin) * tick_ns),
        row_ns=row_ns,
    )
    return frame, blurry
