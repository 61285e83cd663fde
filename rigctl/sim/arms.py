"""Two arms behind one beam splitter: which of them an effect acts on, and what it changes there."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from spikerig.rigctl.sim.effects import Floats, Hooks
from spikerig.rigctl.sim.judge.facts import SLACK, Bound, Facts
from spikerig.rigctl.sim.rgb import window_weights

NEAR = 0.8  # light that optics may raise beyond one threshold a tick
ARMS = ("spike", "rgb", "both")
PLACING = ("misalignment", "mirror_flip", "distortion")  # effects that say where a pixel looks


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
            pairs = [_rates(facts, k, redrawn) for k in range(len(facts.means))]
            spikes = max(spikes, facts.spikes_between(*np.stack(pairs, 1)))
        if arm != "spike":
            dn = max(dn, facts.dn_between(*np.stack([(rgb, _after(redrawn, rgb)) for _, rgb in facts.means], 1)))
    return spikes, dn


def _rates(facts: Facts, k: int, redrawn: Callable[[Floats], Floats]) -> tuple[Floats, Floats]:
    """Spikes a tick of a look before and after; instant by instant where some of it is clipped."""
    light, look = facts.means[k][0], facts.looks[k]
    weights = window_weights(look, np.array([float(look.exposure[0])]))[0]
    inside = np.flatnonzero(weights)
    seen = look.rgb[inside] @ np.array(facts.response, np.float32)
    if seen.max(initial=0) < NEAR:
        return light, _after(redrawn, light[..., None])[..., 0]
    after = redrawn(seen[..., None])[..., 0]
    before, after = (np.tensordot(weights[inside], np.clip(a, 0, 1), 1) for a in (seen, after))
    return before, after


def _after(change: Callable[[Floats], Floats], mean: Floats) -> Floats:
    return change(mean[None].astype(np.float32))[0]


def looked_at(facts: Facts, arm: str, change: Callable[[Floats], Floats], words: str) -> Bound:
    """The bound of a change of the optics, as `moved` finds it."""
    spikes, dn = moved(facts, arm, change)
    return Bound(spikes, dn, f"{words}; {in_views(facts)}")


def in_views(facts: Facts) -> str:
    """Where a bound was read off, in words."""
    return f"{SLACK:g} x the change in {len(facts.means)} surveyed views"
