"""A device's own clock: an oscillator that is off, drifts with temperature, and wanders."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import UsageError
from spikerig.rigctl.sim.draws import stream

_STEP_NS = NS // 10  # the wander's grid: 1e-8/sqrt(s) moves the phase by 0.3 ns a step, far below a tick


@dataclass
class Oscillator:
    """Device time as a function of true time.

    Args:
        offset_ns: device time at true time 0.
        ppm: frequency error at true time 0, within 1000.
        ramp_ppm_per_min: its steady change, as of a warming crystal.
        walk: random walk of the relative frequency, 1/sqrt(s); 1e-8 for an ordinary crystal.
        seed, name: of the wander; each device its own.

    Edges:
        Times before 0 run at the frequency of time 0. Device time increases strictly (the frequency error is held
        within 10000 ppm).

    Cost:
        Grows by 16 bytes for each 0.1 s looked at.
    """

    offset_ns: int = 0
    ppm: float = 0.0
    ramp_ppm_per_min: float = 0.0
    walk: float = 0.0
    seed: int = 0
    name: str = "oscillator"
    _rng: np.random.Generator = field(init=False, repr=False)
    _extra: NDArray[np.float64] = field(init=False, repr=False)  # device minus true minus offset at the grid, ns
    _rate: float = field(init=False, repr=False)  # relative frequency error after the grid's last point

    def __post_init__(self) -> None:
        if not (abs(self.ppm) <= 1000 and abs(self.ramp_ppm_per_min) <= 1000 and 0 <= self.walk < 1e-4):
            raise UsageError("an oscillator's error is out of range", value=self)
        self._rng = stream(self.seed, self.name)
        self._extra = np.zeros(1)
        self._rate = self.ppm * 1e-6

    def device_from_true(self, true_ns: ArrayLike) -> NDArray[np.int64]:
        """Device time at true times, int64 ns of the same shape."""
        at = np.asarray(true_ns, np.int64)
        self._reach(int(at.max(initial=0)) + _STEP_NS)
        cell = np.clip(at // _STEP_NS, 0, len(self._extra) - 2)
        rate = (self._extra[cell + 1] - self._extra[cell]) / _STEP_NS
        extra = self._extra[cell] + (at - cell * _STEP_NS) * rate
        return at + np.rint(extra).astype(np.int64) + self.offset_ns

    def true_from_device(self, device_ns: ArrayLike) -> NDArray[np.int64]:
        """True time at device times; the inverse to a nanosecond."""
        wanted = np.asarray(device_ns, np.int64)
        at = wanted - self.offset_ns
        for _ in range(4):  # each round gains the factor of the frequency error, 1e-2 at the very worst
            at = at + (wanted - self.device_from_true(at))
        return at

    def _reach(self, true_ns: int) -> None:
        need = true_ns // _STEP_NS + 2 - len(self._extra)
        if need <= 0:
            return
        need = max(need, 600)  # the draws do not depend on how far is looked at a time: one stream, in order
        ramp = self.ramp_ppm_per_min * 1e-6 / 60 * _STEP_NS / NS
        kicks = ramp + self.walk * np.sqrt(_STEP_NS / NS) * self._rng.standard_normal(need)
        rates = np.clip(self._rate + np.concatenate([[0.0], np.cumsum(kicks)]), -0.01, 0.01)
        self._extra = np.concatenate([self._extra, self._extra[-1] + np.cumsum(rates[:-1]) * _STEP_NS])
        self._rate = float(rates[-1])
