"""A clock followed as marks come in: the same state as the smoother's, forwards only; steps are told, not absorbed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from spikerig.calib.clock_track import Floats, Wander, transition
from spikerig.dataset.clocktime import NS

Verdict = Literal["used", "far", "step"]
FAR = 6.0  # standard deviations from where a mark is not believed
CONFIRM = 4  # marks in a row that agree with each other and not with the clock make a step


@dataclass
class Follower:
    """Offset, skew and drift of y against x, after the marks so far.

    Args:
        wander: what the clocks may do.
        least_ns: no smaller disagreement is a step (a path whose asymmetry changes moves the offset too).
    """

    wander: Wander = field(default_factory=Wander)
    least_ns: float = 50_000.0
    marks: int = 0
    last_ns: int = 0  # on x, of the last mark used
    origin: tuple[int, int] = (0, 0)
    stepped_ns: float = 0.0  # size of the last step
    state: Floats = field(default_factory=lambda: np.zeros(3))
    cov: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    far: list[tuple[int, int, float]] = field(default_factory=list)

    def add(self, x_ns: int, y_ns: int, sd_ns: float) -> Verdict:
        """Take a mark: used; left out as too far away; or, after several that agree, a step to where they are.

        Marks come in the order of x; one that lies before the last is taken at the last's time.
        """
        if self.marks <= 0:
            fresh = self.marks == 0
            self._begin(x_ns, y_ns, sd_ns, None if fresh else (self.state[1:].copy(), self.cov[1:, 1:].copy()))
            return "used"
        told_ns, sigma = self.predict(x_ns)
        off = float(y_ns - told_ns)
        limit = max(self.least_ns, FAR * float(np.hypot(sigma, sd_ns)))
        if abs(off) > limit:
            self.far.append((x_ns, y_ns, sd_ns))
            return self._judged()
        if self.far:
            x, y, _ = self.far[-1]
            if abs(off - (y - self.predict(x)[0])) <= limit:
                return "far"  # too poor to tell the old course from the new one
        self.far.clear()
        self._update(x_ns, off, sd_ns)
        return "used"

    def predict(self, x_ns: int) -> tuple[int, float]:
        """y at x and its standard deviation (noise and wander, no bias)."""
        state, cov = self._at(x_ns)
        ahead = float(state[0])
        return self.origin[1] + (int(x_ns) - self.origin[0]) + round(ahead), float(np.sqrt(cov[0, 0]))

    def again(self) -> None:
        """The clock began anew: the next mark sets the offset; the crystal, and so the skew, stays."""
        if self.marks:
            self.marks = -1
            self.far.clear()

    def stood(self, by_ns: int, sd_ns: float) -> None:
        """x stood still while y went on for `by_ns`, known to `sd_ns`: the crystals had that time to wander."""
        if self.marks <= 0:
            return
        step, noise = transition(by_ns / NS, self.wander)
        self.state, self.cov = step @ self.state, step @ self.cov @ step.T + noise
        self.state[0] += by_ns
        self.cov[0, 0] += sd_ns**2
        self.far.clear()

    @property
    def skew_ppm(self) -> float:
        """Of y against x at the last mark."""
        return float(self.state[1]) * 1e-3

    @property
    def skew_sd_ppm(self) -> float:
        """Its standard deviation."""
        return float(np.sqrt(self.cov[1, 1])) * 1e-3

    def _begin(self, x_ns: int, y_ns: int, sd_ns: float, crystal: tuple[Floats, Floats] | None = None) -> None:
        self.origin, self.last_ns, self.marks = (int(x_ns), int(y_ns)), int(x_ns), 1
        self.state = np.zeros(3)
        self.cov = np.diag([sd_ns, self.wander.ppm * 1e3, self.wander.drift * NS]) ** 2
        if crystal is not None:
            self.state[1:], self.cov[1:, 1:] = crystal
        self.far.clear()

    def _at(self, x_ns: int) -> tuple[Floats, Floats]:
        step, noise = transition(max(int(x_ns) - self.last_ns, 0) / NS, self.wander)
        return step @ self.state, step @ self.cov @ step.T + noise

    def _update(self, x_ns: int, off: float, sd_ns: float) -> None:
        state, cov = self._at(x_ns)
        gain = cov[:, 0] / (cov[0, 0] + sd_ns**2)
        self.state = state + gain * off
        kept = np.eye(3)
        kept[:, 0] -= gain  # Joseph's form: stays positive whatever the rounding
        self.cov = kept @ cov @ kept.T + np.outer(gain, gain) * sd_ns**2
        self.last_ns, self.marks = max(self.last_ns, int(x_ns)), self.marks + 1

    def _judged(self) -> Verdict:
        if len(self.far) < CONFIRM:
            return "far"
        recent = self.far[-CONFIRM:]
        offs = np.array([y - self.predict(x)[0] for x, y, _ in recent], np.float64)
        sd = max(s for *_, s in recent)
        if float(np.ptp(offs)) > max(self.least_ns, FAR * sd):
            return "far"
        self.stepped_ns = float(np.median(offs))
        x, y, _ = recent[-1]
        # A step of the count leaves the crystal as it was.
        self._begin(x, y, sd, (self.state[1:].copy(), self.cov[1:, 1:].copy()))
        return "step"
