"""From light to what the two cameras give: spikes and a blurry picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import UsageError
from spikerig.dataset.scene import Camera, Frame
from spikerig.dataset.spikes import SpikeStream
from spikerig.rigctl.sim.effects import Effect, Hooks, Site, in_order
from spikerig.rigctl.sim.rgb import encode, expose, optics
from spikerig.rigctl.sim.sensor import Floats, Light, delayed, integrate, refined, spike_light
from spikerig.rigctl.sim.spec import Sensor

if TYPE_CHECKING:
    from spikerig.dataset.events import EventStream
    from spikerig.rigctl.sim.events import EventCamera


@dataclass(frozen=True, slots=True)
class Simulated:
    """One view as the cameras saw it, and what only the simulator knows.

    Args:
        spikes: over all of the light's ticks.
        frame: sRGB, 8 bits.
        blurry: float64[H,W,3], the exposure's mean linear light before any response.
        start: float64[H,W], charge before the first tick, thresholds.
        left: uint32 or int64 [H,W], charge after the last tick, 2^-32 thresholds.
        clipped: float64[H,W], charge beyond one spike a tick (or gone in a reset), thresholds.
        events: of the event camera, None without one.
    """

    spikes: SpikeStream
    frame: Frame
    blurry: NDArray[np.float64]
    start: NDArray[np.float64]
    left: NDArray[np.uint32] | NDArray[np.int64]
    clipped: NDArray[np.float64]
    events: EventStream | None = None


def simulate(
    light: Light,
    sensor: Sensor,
    effects: Sequence[Effect],
    seed: int,
    view: int = 0,
    camera: Camera | None = None,
    events: EventCamera | None = None,
) -> Simulated:
    """Spikes and a blurry frame of one view.

    Args:
        light: linear light over the spikes' ticks, the RGB exposure within it.
        sensor: gain and spectral response of the spike camera.
        effects: any order; they act by stage. An effect left out changes no bit and costs nothing.
        seed: of the scene; every effect draws from its own stream of (seed, name, view).
        view: number of the view.
        camera: the pinhole of both arms, for effects that need angles.
        events: an event camera in the spike camera's place: the same light, behind the same optics.

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
    own_arm = light.arm is not None
    site = Site(height, width, view, seed, light.rate_hz, light.t0_ns * 1e-9, ticks, camera, own_arm)
    steps = [effect.begin(site) for effect in in_order(effects)]
    light = lit(light, steps)
    spikes, start, left, clipped = _spikes(light, sensor, steps)
    frame, blurry = _frame(light, steps)
    seen = None if events is None else _events(light, sensor, steps, events, seed, view)
    return Simulated(spikes, frame, blurry, start, left, clipped, seen)


def lit(light: Light, steps: Sequence[Hooks]) -> Light:
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
) -> tuple[SpikeStream, NDArray[np.float64], NDArray[np.uint32] | NDArray[np.int64], NDArray[np.float64]]:
    """The spike arm: stream, charge before, charge left, charge clipped."""
    height, width = light.rgb.shape[1:3]
    seen, knots = delayed(_arrived(light, sensor, steps), light.knots, _ahead(light, [h.clock_ns for h in steps]))
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


def _arrived(light: Light, sensor: Sensor, steps: Sequence[Hooks]) -> Floats:
    """Light on the pixels behind the spike arm's optics, float32[K,H,W]."""
    changes = [h.spike_optics for h in steps]
    if sensor.bayer is not None:  # optics mix pixels, so they come before colours part
        return spike_light(optics(light.rgb, changes), sensor)
    return optics(spike_light(light.rgb, sensor)[..., None], changes)[..., 0]


def _events(
    light: Light, sensor: Sensor, steps: Sequence[Hooks], camera: EventCamera, seed: int, view: int
) -> EventStream:
    """The event camera in the spike camera's place: it sees gray, with faults of its own."""
    from spikerig.rigctl.sim.events import simulate_events

    gray = _arrived(light, replace(sensor, gain=1.0, colour="mono"), steps)
    return simulate_events(gray, light.knots, light.rate_hz, camera, seed, view, t0_ns=light.t0_ns)


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
