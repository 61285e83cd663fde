"""An event camera under the same light as the spike camera: events where the log of light crosses thresholds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import NumericsError
from spikerig.dataset.events import EventStream
from spikerig.dataset.kernels import Noise, events
from spikerig.rigctl.sim.draws import stream
from spikerig.rigctl.sim.limits import limits

Floats = NDArray[np.floating]  # float32 unless said


@dataclass(frozen=True, slots=True)
class EventCamera:
    """`[events]`: an event camera in the spike camera's place; simulated only where this table is present.

    Args:
        threshold_pos, threshold_neg: change of log(light + eps) that makes an event up, or down.
        threshold_sd: of both between pixels, the same in every view; never below a tenth of the threshold.
        eps: light that a dark pixel sees: below it, contrast fades.
        refractory_ns: how long a pixel is held in reset after an event; its reference is the light at the end of it.
        cutoff_hz: of the photoreceptor, a first-order low-pass of the light; 0 leaves it out.
        leak_hz: events up a pixel and second that come by themselves.
        noise_hz: events of either polarity a pixel and second that come by themselves.
        most: more events than this in a view are refused.
    """

    threshold_pos: float = limits(0.2, 1e-3, 10, "of log light")
    threshold_neg: float = limits(0.2, 1e-3, 10, "of log light")
    threshold_sd: float = limits(0.0, 0, 1, "of log light")
    eps: float = limits(1e-3, 1e-9, 1e3, "of RGB white")
    refractory_ns: int = limits(0, 0, 10**12, "ns")
    cutoff_hz: float = limits(0.0, 0, 1e9, "Hz")
    leak_hz: float = limits(0.0, 0, 1e6, "a pixel and second")
    noise_hz: float = limits(0.0, 0, 1e6, "a pixel and second")
    most: int = limits(20_000_000, 1, 1_000_000_000, "events")


def simulate_events(
    light: Floats,
    knots: NDArray[np.int64],
    rate_hz: float,
    camera: EventCamera,
    seed: int = 0,
    view: int = 0,
    *,
    t0_ns: int = 0,
) -> EventStream:
    """What an event camera gives for light over time.

    Args:
        light: float32[K,H,W], linear light on its pixels, 1.0 = RGB white.
        knots: ticks, int64[K] (light is linear in between) or int64[K+1] (picture k holds for knots k to k+1).
        rate_hz: ticks a second.
        camera: thresholds and faults.
        seed: of the scene; fixed patterns and noise come from streams of their own.
        view: number of the view.
        t0_ns: start of tick knots[0].

    Returns:
        Events in the order of (t, y, x), watched from the first knot to the last on the clock "rig".

    Raises:
        NumericsError: light is negative or not finite, or more than `camera.most` events.
        UsageError: shapes or knots that do not fit.

    Edges:
        The reference of a pixel starts as its light at the first knot, so a span shorter than its first crossing gives
        nothing. Of light that jumps (pictures that hold), a jump over n thresholds is n events at one time.

    Cost:
        As `kernels.events`; draws of the faults only where they are not 0.

    Source:
        Rebecq et al., ESIM (CoRL 2018); reset and refractory time: Lichtsteiner et al. 2008; leak and noise as v2e
        (Hu et al. 2021) has them. Crossings are exact, since our light is linear between knots: ESIM's adaptive step
        is only needed to choose the knots (`adaptive.adaptive_phases`).
    """
    at_ns = (knots - knots[0]) * (NS / rate_hz)
    size, span_ns = (light.shape[1], light.shape[2]), round(float(at_ns[-1]))
    found = events(
        light,
        at_ns,
        _thresholds(camera, size, seed),
        hold=len(knots) == len(light) + 1,
        eps=camera.eps,
        refractory_ns=camera.refractory_ns,
        tau_ns=NS / (2 * np.pi * camera.cutoff_hz) if camera.cutoff_hz else 0.0,
        noise=_noise(camera, size, span_ns, seed, view),
        most=camera.most,
    )
    t, x, y, polarity = found
    return EventStream(t + t0_ns, x, y, polarity, *size, t0_ns, t0_ns + span_ns)


def _thresholds(camera: EventCamera, size: tuple[int, ...], seed: int) -> tuple[NDArray, NDArray]:
    both = np.array([camera.threshold_pos, camera.threshold_neg])[:, None, None]
    if not camera.threshold_sd:
        up, down = np.broadcast_to(both, (2, *size))
        return up, down
    drawn = both + camera.threshold_sd * stream(seed, "event_threshold").standard_normal((2, *size))
    up, down = np.maximum(drawn, 0.1 * both)
    return up, down


def _noise(camera: EventCamera, size: tuple[int, ...], span_ns: int, seed: int, view: int) -> Noise | None:
    """Poisson events of the leak (up) and of the background (either way), each from its own stream."""
    parts: list[Noise] = []
    for name, rate_hz in (("event_leak", camera.leak_hz), ("event_noise", camera.noise_hz)):
        mean = rate_hz * span_ns / NS * size[0] * size[1]
        if mean > camera.most:
            raise NumericsError("more noise events than allowed", value=f"{mean:.3g} on average, over {camera.most}")
        if mean:
            rng = stream(seed, name, view)
            n = int(rng.poisson(mean))
            pixel, when = rng.integers(0, size[0] * size[1], n), rng.random(n) * span_ns
            up = np.ones(n, np.int8) if name == "event_leak" else rng.choice(np.array([-1, 1], np.int8), n)
            parts.append((pixel, when, up))
    if not parts:
        return None
    pixel, when, sign = (np.concatenate(column) for column in zip(*parts, strict=True))
    return pixel, when, sign
