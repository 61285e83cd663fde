"""Vignetting: less light reaches the corners."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import UsageError
from spikerig.rigctl.sim.arms import ARMS, on_arm
from spikerig.rigctl.sim.effects import Floats, Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits


@dataclass(frozen=True, slots=True)
class Vignetting:
    """Light is multiplied by cos(angle)^power (1 + k2 r^2 + k4 r^4), r from the centre (0) to the corner (1).

    Args:
        arm: spike, rgb or both.
        power: of the cosine of the angle off the axis: 4 is a simple lens's natural fall-off, 0 none.
        k2, k4: of what the lens's barrel cuts off, or its maker has put right.
    """

    arm: str = limits("both", unit="arm", choices=ARMS)
    power: float = limits(4.0, 0, 16, "exponent")
    k2: float = limits(0.0, -10, 10, "in the corner")
    k4: float = limits(0.0, -10, 10, "in the corner")

    name: ClassVar[str] = "vignetting"
    stage: ClassVar[Stage] = Stage.OPTICS
    per: ClassVar[str] = "knot"
    source: ClassVar[str] = "the cos^4 law; an even polynomial of the radius (Goldman and Chen, ICCV 2005)"
    vanishes: ClassVar[str] = "power = k2 = k4 = 0"
    cost_ns: ClassVar[float] = 0.5

    def gain(self, radius: Floats, tangent: Floats) -> NDArray[np.float64]:
        """Factor of the light at a radius (1 in the corner) and a tangent of the angle off the axis; not below 0."""
        barrel = 1 + self.k2 * radius**2 + self.k4 * radius**4
        return np.maximum((1 + np.asarray(tangent, np.float64) ** 2) ** (-self.power / 2) * barrel, 0)

    def begin(self, site: Site) -> Hooks:
        """The same for every view.

        Raises:
            UsageError: a power of the angle, and no camera is known.
        """
        if not (self.power or self.k2 or self.k4):
            return Hooks()
        if site.camera is None and self.power:
            raise UsageError("vignetting needs the camera: how wide its angles are", expected="power = 0 without one")
        y, x = np.mgrid[: site.height, : site.width] + 0.5
        y, x = y - site.height / 2, x - site.width / 2
        r = np.hypot(y, x)
        tangent = np.zeros_like(r)
        if site.camera is not None:
            K = site.camera.K
            tangent = np.hypot((x + site.width / 2 - K[0, 2]) / K[0, 0], (y + site.height / 2 - K[1, 2]) / K[1, 1])
        gain = self.gain(r / (np.hypot(site.height, site.width) / 2), tangent).astype(np.float32)[..., None]
        return on_arm(self.arm, lambda pictures: pictures * gain)

    def magnitude(self, facts: Facts) -> Bound:
        """(1 - factor) light, at each pixel's radius."""
        corner = np.hypot(*facts.size) / 2 / facts.focal_px
        gain = self.gain(facts.radius, facts.radius * corner)
        spikes = facts.spikes(lambda light: light * gain) if self.arm != "rgb" else 0.0
        dn = facts.dn(lambda light: light * gain[:, None]) if self.arm != "spike" else 0.0
        least = float(self.gain(np.array(1.0), np.array(corner)))
        return Bound(spikes, dn, f"light x (1 - {least:.3g}) in the corner")
