"""Densification by screen gradients (Kerbl et al. 2023): small splats are cloned, large ones split, faint ones dropped.

What is watched goes from one round to the next in the fit's grids, so a resumed run repeats it; all draws come from the
generator that is handed in.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from spikerig.train.densify import DEAD, rotations

if TYPE_CHECKING:
    from spikerig.train.splat import Rendered

SUM, SEEN = "grow/sum", "grow/seen"  # in the grids: [N] summed gradients and how many steps saw the splat
LARGEST = 30.0  # log scales are clamped to it when drawn; beyond, places would overflow
SPLIT = 1.6  # a split splat's halves are so much smaller
RESET = 2 * DEAD  # opacity that a reset leaves at most
Moments = dict[str, tuple[Tensor, Tensor]]


@dataclass(frozen=True, slots=True)
class Rule:
    """When a splat is cloned, split or dropped.

    Args:
        gradient: mean screen gradient, loss per half picture, from which a splat is cloned or split.
        size: largest standard deviation, gauge units, of a splat that is cloned; larger ones are split.
        cap: most splats.
        share: at most so many new ones in a round, of those there are.
        huge: splats larger than this, gauge units, are dropped; inf: none.
    """

    gradient: float
    size: float
    cap: int
    share: float = 1.0
    huge: float = float("inf")


def blank(n: int) -> dict[str, Tensor]:
    """Statistics of n splats that nobody has seen."""
    return {SUM: torch.zeros(n), SEEN: torch.zeros(n)}


def watch(grids: dict[str, Tensor], drawn: list[Rendered], grads: list[Tensor]) -> None:
    """Add a step to the statistics, in place.

    Args:
        grids: with `blank`'s two.
        drawn: the pictures of the step (sub-poses of one view).
        grads: of each, d loss / d screen position, or absgrad's sums [N,2], in loss per pixel.

    Source: gsplat's DefaultStrategy: gradients in units of half the picture, so that no resolution is favoured, and a
    mean over the steps that saw the splat. Sub-poses add up first: together they are one look at the view.
    """
    height, width = drawn[0].image.shape[:2]
    total = grads[0].reshape(-1, 2).cpu().clone()
    seen = drawn[0].visible
    for picture, grad in zip(drawn[1:], grads[1:], strict=True):
        total += grad.reshape(-1, 2).cpu()
        seen = seen | picture.visible
    grids[SUM] += torch.hypot(total[:, 0] * (width / 2), total[:, 1] * (height / 2)) * seen
    grids[SEEN] += seen


def grow(
    params: dict[str, Tensor], moments: Moments, grids: dict[str, Tensor], rule: Rule, rng: np.random.Generator
) -> tuple[dict[str, Tensor], Moments]:
    """A round: clone and split where the mean gradient is large, then drop the faint and the huge.

    Args:
        params: the five tensors of Splats by name.
        moments: Adam's two a tensor; zero for what is new, kept for what stays.
        grids: `watch`'s statistics.
        rule: what to do.
        rng: draws the places of split splats.

    Returns:
        New params and moments; the inputs are left as they are. The caller starts new statistics.

    Edges: where the cap or the share leaves no room for all, those of the largest gradient win, ties by index; what
        nobody saw is left alone; where all would be dropped, none is.
    Source: Kerbl et al. 2023, section 5.2; gsplat's DefaultStrategy (the cap is ours).
    """
    n = len(params["means"])
    mean = grids[SUM] / grids[SEEN].clamp(min=1)
    largest = params["log_scales"].detach().exp().amax(1)
    chosen = _chosen(mean, rule, n)
    split = chosen[largest[chosen] > rule.size]
    out = {name: torch.cat([p.detach(), p.detach()[chosen]]) for name, p in params.items()}
    fresh: Moments = {}
    for name, pair in moments.items():
        one, two = (torch.cat([m, m.new_zeros((len(chosen), *m.shape[1:]))]) for m in pair)
        one[split], two[split] = 0, 0
        fresh[name] = one, two
    halves = torch.cat([split, n + torch.nonzero(largest[chosen] > rule.size).flatten()])
    _scatter(out, halves, rng)
    return _drop(out, fresh, rule)


def _chosen(mean: Tensor, rule: Rule, n: int) -> Tensor:
    """Which splats to copy, in the order of their index."""
    hot = torch.nonzero(mean > rule.gradient).flatten()
    room = max(0, min(rule.cap - n, int(rule.share * n)))
    if len(hot) > room:
        order = torch.sort(mean[hot], descending=True, stable=True).indices[:room]
        hot = hot[order].sort().values
    return hot


def _scatter(params: dict[str, Tensor], halves: Tensor, rng: np.random.Generator) -> None:
    """Move splats to places drawn from their own Gaussians and make them smaller, in place."""
    if len(halves) == 0:
        return
    draw = torch.from_numpy(rng.standard_normal((len(halves), 3)).astype(np.float32))
    inside = draw * params["log_scales"][halves].clamp(max=LARGEST).exp()
    params["means"][halves] += (rotations(params["quats"][halves]) * inside[:, None, :]).sum(2)
    params["log_scales"][halves] -= float(np.log(SPLIT))


def _drop(params: dict[str, Tensor], moments: Moments, rule: Rule) -> tuple[dict[str, Tensor], Moments]:
    keep = torch.sigmoid(params["logit_opacities"]) >= DEAD
    keep &= params["log_scales"].exp().amax(1) <= rule.huge
    if bool(keep.all()) or not bool(keep.any()):
        return params, moments
    return {n: p[keep] for n, p in params.items()}, {n: (a[keep], b[keep]) for n, (a, b) in moments.items()}


def fade(params: dict[str, Tensor], moments: Moments) -> None:
    """Opacities back to at most 0.01, Adam's moments of them to 0, in place: what is not needed stays faint."""
    with torch.no_grad():
        params["logit_opacities"].clamp_(max=float(np.log(RESET / (1 - RESET))))
    for moment in moments["logit_opacities"]:
        moment.zero_()
