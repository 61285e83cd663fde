"""Bayer mosaic: each pixel sees one colour; the others come from its neighbours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from spikerig.rigctl.sim.arms import in_views
from spikerig.rigctl.sim.effects import Floats, Hooks, Site, Stage
from spikerig.rigctl.sim.judge.facts import Bound, Facts
from spikerig.rigctl.sim.limits import limits

PATTERNS = ("rggb", "bggr", "grbg", "gbrg")


@dataclass(frozen=True, slots=True)
class Bayer:
    """The mosaic is taken and filled in again in linear light, bilinearly: a missing colour is the mean of the nearest
    pixels that have it (2 or 4).

    Args:
        pattern: colours of the first two pixels of the first two rows.
    """

    pattern: str = limits("rggb", unit="order", choices=PATTERNS)

    name: ClassVar[str] = "bayer"
    stage: ClassVar[Stage] = Stage.RGB
    per: ClassVar[str] = "frame"
    source: ClassVar[str] = "Bayer, US 3971065; bilinear interpolation"
    vanishes: ClassVar[str] = "left out; light that is the same all over comes out as it went in"
    cost_ns: ClassVar[float] = 50.0
    on_noise: ClassVar[bool] = True  # its bound is taken with the noise that reaches it

    def begin(self, site: Site) -> Hooks:
        """The same for every view."""
        masks = colour_masks(self.pattern, site.height, site.width)
        return Hooks(linear=lambda light: demosaic(light, masks))

    def magnitude(self, facts: Facts) -> Bound:
        """What filling in gets wrong: light against the mean of its neighbours."""
        masks = colour_masks(self.pattern, *facts.size)
        pairs = [(rgb, demosaic(rgb.astype(np.float32), masks)) for _, rgb in facts.means]
        words = f"light is {facts.most(facts.rgb_bend):.3g} off its neighbours' mean; {in_views(facts)}"
        return Bound(0.0, facts.dn_between(*np.stack(pairs, 1)), words)


def colour_masks(pattern: str, height: int, width: int) -> Floats:
    """float32[H,W,3], 1 where a pixel sees the colour."""
    y, x = np.mgrid[:height, :width]
    colour = np.array(["rgb".index(c) for c in pattern])[(y % 2) * 2 + x % 2]
    return (colour[..., None] == np.arange(3)).astype(np.float32)


def demosaic(light: Floats, masks: Floats) -> Floats:
    """Linear light float32[H,W,3] as a mosaic sees it, filled in bilinearly; a colour with no pixel near is gray."""
    seen = light * masks
    own = seen.sum(2, keepdims=True)
    around, share = (_tent(np.pad(a, [(1, 1), (1, 1), (0, 0)], mode="reflect")) for a in (seen, masks))
    filled = np.where(share > 0, around / np.maximum(share, np.float32(1e-6)), own)
    return np.where(masks > 0, light, filled).astype(np.float32)


def _tent(wide: NDArray) -> NDArray:
    """Sums weighted 1 2 1 along both axes; two rows and columns smaller."""
    rows = wide[:-2] + 2 * wide[1:-1] + wide[2:]
    return rows[:, :-2] + 2 * rows[:, 1:-1] + rows[:, 2:]
