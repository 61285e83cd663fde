"""Shot noise: photo-electrons arrive one by one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.effects import Floats, Hooks, Site, Stage
from spikerig.rigctl.sim.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits

FEW = 4.0  # electrons a tick below which counts are drawn exactly


@dataclass(frozen=True, slots=True)
class ShotNoise:
    """Electrons a tick are Poisson around light * threshold_e.

    Each pixel and tick takes one normal draw z. Below 4 electrons the count is the exact Poisson quantile of z; above,
    (sqrt(m - 1/4) + z/2)^2, never negative, with mean m and variance m - 1/8.

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
    cost_ns: ClassVar[float] = 14.0

    def begin(self, site: Site) -> Hooks:
        """Noise for every pixel and tick of one view."""
        rng = site.draw(self.name)
        electrons = np.float32(self.threshold_e)

        def light(block: Floats) -> None:
            z = rng.standard_normal(block.shape, dtype=np.float32)
            block *= electrons
            dim = np.flatnonzero(block < FEW)
            few = poisson_quantile(block.reshape(-1)[dim], z.reshape(-1)[dim])
            np.subtract(block, np.float32(0.25), out=block)
            np.maximum(block, 0, out=block)
            np.sqrt(block, out=block)
            z *= np.float32(0.5)
            block += z
            np.multiply(block, block, out=block)
            block.reshape(-1)[dim] = few
            block /= electrons

        return Hooks(light=light, per_tick=True)

    def magnitude(self, facts: Facts) -> Bound:
        """Charge of standard deviation sqrt(light ticks / threshold_e), in the exposure and in the margin before."""
        sd = np.sqrt(facts.rate / self.threshold_e)
        within, before = facts.normal(2) * sd * np.sqrt([[[facts.ticks]], [[facts.margin_ticks]]])
        rate = facts.most(facts.rate)
        told = f"z sqrt({rate:.3g} x {facts.ticks} / {self.threshold_e:g}), and of {facts.margin_ticks} ticks before"
        return Bound(facts.counted(within, before), 0.0, told)


def normal_cdf(z: NDArray[np.float64]) -> NDArray[np.float64]:
    """The normal distribution function to 1e-7 (Abramowitz and Stegun 26.2.17); NumPy has no erf."""
    k = 1 / (1 + 0.2316419 * np.abs(z))
    poly = k * (0.319381530 + k * (-0.356563782 + k * (1.781477937 + k * (-1.821255978 + k * 1.330274429))))
    tail = np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi) * poly
    return np.where(z > 0, 1 - tail, tail)


def poisson_quantile(mean: Floats, z: Floats) -> Floats:
    """The Poisson count (mean < 4) whose distribution function first reaches that of the normal z; float32[n]."""
    mean64 = mean.astype(np.float64)
    u = normal_cdf(z.astype(np.float64))
    count = np.zeros(mean.shape, np.float32)
    term = np.exp(-mean64)
    below = term.copy()
    for k in range(1, 25):
        more = u > below
        if not more.any():
            break
        count += more
        term = term * mean64 / k
        below += term
    return count
