"""Shot noise: photo-electrons arrive one by one."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist
from typing import ClassVar

import numpy as np

from spikerig.rigctl.sim.effects import Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits


@dataclass(frozen=True, slots=True)
class ShotNoise:
    """Electrons a tick are Poisson around light * threshold_e; those of the dark current, too.

    Each pixel and tick draws one word: below 8 electrons the count is the exact Poisson quantile, above it follows the
    distribution's first three moments (`fire_noisy`). A pixel with a higher threshold is taken to need as many
    electrons as the rest.

    Args:
        threshold_e: electrons that make a spike; 560 explains the count variance of the one real static clip measured
            (SpikingSIM's, about 50 times below Poisson spikes).
    """

    threshold_e: float = limits(560.0, 1, 1e12, "electrons a spike")

    name: ClassVar[str] = "shot_noise"
    stage: ClassVar[Stage] = Stage.PHOTONS
    per: ClassVar[str] = "tick"
    source: ClassVar[str] = "Poisson statistics; SpikingSIM real_spike, 41-frame count variance 0.181 against 0.165"
    vanishes: ClassVar[str] = "threshold_e -> infinity"
    cost_ns: ClassVar[float] = 3.4

    def begin(self, site: Site) -> Hooks:
        """Noise for every pixel and tick of one view."""
        return Hooks(pixel={"shot": (self.threshold_e, site.key(self.name))})

    def magnitude(self, facts: Facts) -> Bound:
        """Charge of sd sqrt(light ticks / threshold_e), in exposure and margin, less what the sensor clips."""
        mean, sd = np.zeros_like(facts.light), np.sqrt(facts.light / self.threshold_e)
        bright = np.flatnonzero(facts.light + 4 * sd > 1)
        z = np.array([NormalDist().inv_cdf((k + 0.5) / 64) for k in range(64)])[:, None]
        seen = np.minimum(facts.light[bright] + sd[bright] * z, 1)
        mean[bright], sd[bright] = seen.mean(0) - np.minimum(facts.light[bright], 1), seen.std(0)
        ticks = np.array([facts.ticks, facts.margin_ticks])[:, None, None]
        within, before = facts.normal(2) * sd * np.sqrt(ticks) + mean * ticks
        rate = facts.most(facts.rate)
        told = f"z sqrt({rate:.3g} x {facts.ticks} / {self.threshold_e:g}), and of {facts.margin_ticks} ticks before"
        return Bound(facts.counted(within, before), 0.0, told)
