"""Mains flicker: lamps on alternating current pulse at twice its frequency."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.effects import Floats, Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits
from spikerig.rigctl.sim.rgb import wave_means

PIXELS = 4000  # of a look that the bound is computed from
OFF = 1e-3  # of the light: how far the light between samples may lie off the wave


@dataclass(frozen=True, slots=True)
class Flicker:
    """All light is multiplied by 1 + depth cos(2 pi hz t + phase); its mean over whole periods stays.

    A lamp's power follows the square of the mains voltage, which is a sine again, at twice the mains frequency. Light
    is sampled so densely that the straight lines between samples lie within 0.1 % of the light from the wave
    (depth (2 pi hz step)^2 / 8).

    Args:
        hz: of the light: 100 or 120, twice the mains.
        depth: (most - least) / (most + least), IEEE 1789's percent flicker: 0.1 to 0.2 for filament lamps, 0.3 for
            fluorescent tubes on magnetic ballasts, up to 1 for LED lamps without smoothing.
        phase: `random` in each view; or `fixed`: it runs on through the take.
        phase_deg: at the start of the take, where fixed.
    """

    hz: float = limits(100.0, 1, 1e5, "Hz")
    depth: float = limits(0.2, 0, 1, "of the mean light")
    phase: str = limits("random", unit="word", choices=("random", "fixed"))
    phase_deg: float = limits(0.0, -360, 360, "degrees")

    name: ClassVar[str] = "flicker"
    stage: ClassVar[Stage] = Stage.LIGHT
    per: ClassVar[str] = "knot"
    source: ClassVar[str] = "power of a resistive lamp: sin^2 of the mains phase; depths: IEEE 1789-2015"
    vanishes: ClassVar[str] = "depth = 0"
    cost_ns: ClassVar[float] = 20.0

    @property
    def step_s(self) -> float:
        """Longest time between light samples."""
        return min(np.sqrt(8 * OFF / max(self.depth, OFF)) / (2 * np.pi), 0.25) / self.hz

    def begin(self, site: Site) -> Hooks:
        """The phase of one view."""
        if self.depth == 0:
            return Hooks()
        shift = np.radians(self.phase_deg)
        if self.phase == "random":
            shift = site.draw(self.name).uniform(0, 2 * np.pi)

        def radiance(rgb: Floats, at_s: NDArray[np.float64]) -> None:
            factor = 1 + self.depth * np.cos(2 * np.pi * self.hz * at_s + shift)
            rgb *= factor.astype(np.float32)[:, None, None, None]

        tick = 1 / site.rate_hz  # samples lie on ticks: a step may come out a tick longer
        return Hooks(step_s=max(self.step_s - tick, tick), radiance=radiance)

    def magnitude(self, facts: Facts) -> Bound:
        """depth |mean over the exposure of light x cos|, over the phases of all views."""
        if self.depth == 0:
            return Bound(0.0, 0.0, "no flicker")
        if self.phase == "random":
            phases = np.arange(16) * (np.pi / 8)
        else:
            views = np.unique(np.linspace(1, facts.views, min(facts.views, 32)).astype(int))
            phases = np.radians(self.phase_deg) + 2 * np.pi * self.hz * facts.period_s * views
        looks = [self._sampled(facts, k) for k in range(len(facts.looks))]
        rgb, cosine, sine = (np.concatenate([look[k] for look in looks]) for k in range(3))
        waves = [self.depth * (np.cos(phase) * cosine - np.sin(phase) * sine) for phase in phases]
        gray, response = rgb @ np.array(facts.response), np.array(facts.response)
        cut = np.where(gray * (1 + self.depth) > 1, gray * self.depth / np.pi, 0)  # the tops of the wave, at most
        change = [(np.clip(gray + wave @ response, 0, 1) - np.minimum(gray, 1) - cut) * facts.ticks for wave in waves]
        lag = 2 * np.pi * self.hz * facts.margin_ticks / facts.rate_hz
        swing = self.depth * facts.rate_hz / (2 * np.pi * self.hz) * (np.sin(phases) - np.sin(phases - lag))
        spikes = facts.counted(np.array(change), swing[:, None] * np.minimum(gray, 1))
        dn = facts.dn_between(rgb, rgb + np.array(waves))
        q = self.hz * facts.exposure_s
        return Bound(
            spikes, dn, f"{self.depth:g} x light x |sinc {q:.3g}| = {abs(np.sinc(q)):.3g}, and what moves meanwhile"
        )

    def _sampled(self, facts: Facts, k: int) -> tuple[Floats, ...]:
        """Of some pixels of a look: mean linear light, and light x cos and x sin, float64[n,3] each."""
        rgb = facts.means[k][1].reshape(-1, 3)
        step = max(1, len(rgb) // PIXELS)
        return rgb[::step], *(wave.reshape(-1, 3)[::step] for wave in wave_means(facts.looks[k], self.hz))
