"""Two arms behind one beam splitter: which of them an effect acts on, and what it changes there."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from spikerig.rigctl.sim.effects import Floats, Hooks
from spikerig.rigctl.sim.facts import SLACK, Bound, Facts

ARMS = ("spike", "rgb", "both")


def on_arm(arm: str, change: Callable[[Floats], Floats]) -> Hooks:
    """Hooks of a change of pictures [n,H,W,C] on one arm, or both."""
    return Hooks(
        spike_optics=change if arm in ("spike", "both") else None,
        rgb_optics=change if arm in ("rgb", "both") else None,
    )


def moved(
    facts: Facts, arm: str, change: Callable[[Floats], Floats] | Sequence[Callable[[Floats], Floats]]
) -> tuple[float, float]:
    """How much a change of the optics moves counts and RGB values of the surveyed views, at 95 % of the pixels.

    Exact for these views: optics are linear and the same at all times, so that they act on the exposure's mean.

    Args:
        facts: of the scene.
        arm: the arm, or both.
        change: of pictures float32[n,H,W,C]; of several, the largest change counts.
    """
    changes = [change] if callable(change) else change
    spikes = dn = 0.0
    for redrawn in changes:
        if arm != "rgb":
            pairs = [(light, _after(redrawn, light[..., None])[..., 0]) for light, _ in facts.means]
            spikes = max(spikes, facts.spikes_between(*np.stack(pairs, 1)))
        if arm != "spike":
            dn = max(dn, facts.dn_between(*np.stack([(rgb, _after(redrawn, rgb)) for _, rgb in facts.means], 1)))
    return spikes, dn


def _after(change: Callable[[Floats], Floats], mean: Floats) -> Floats:
    return change(mean[None].astype(np.float32))[0]


def looked_at(facts: Facts, arm: str, change: Callable[[Floats], Floats], words: str) -> Bound:
    """The bound of a change of the optics, as `moved` finds it."""
    spikes, dn = moved(facts, arm, change)
    return Bound(spikes, dn, f"{words}; {in_views(facts)}")


def in_views(facts: Facts) -> str:
    """Where a bound was read off, in words."""
    return f"{SLACK:g} x the change in {len(facts.means)} surveyed views"
