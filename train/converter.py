"""The gray converter while it is trained: free, held to weights that cannot raise contrast, or with a response curve.

The paper learns a layer from 3 numbers to 1. Free, it cheats beside a blurry colour term (gray.py says how).
`constrained` keeps what a camera may do: positive weights whose sum, like the bias, stays what it was at the start.
`response` adds a monotone curve from black to white, for a spike arm that is not linear.
"""

from __future__ import annotations

import torch
from torch import Tensor

SEGMENTS = 8  # of the response curve, equally long between black and white
LEARNED = ("learned", "constrained", "response")


def start_converter(kind: str, frozen: Tensor) -> Tensor:
    """What is trained, at step 0: the converter is the frozen one [4] (weights below 1e-3 are raised to that).

    Returns:
        learned: [4]; constrained: [3] logits; response: [3 + SEGMENTS], logits and the logarithms of the curve's steps.
    """
    if kind == "learned":
        return frozen.clone()
    logits = torch.log(frozen[:3].clamp(min=1e-3))
    return torch.cat([logits, logits.new_zeros(SEGMENTS if kind == "response" else 0)])


def converter(kind: str, raw: Tensor, frozen: Tensor) -> tuple[Tensor, Tensor | None]:
    """Weights and bias [4], and the heights of the response curve at its knots [SEGMENTS + 1], or None.

    Args:
        kind: one of LEARNED.
        raw: what is trained.
        frozen: [4], where it started: sum of weights and bias stay for all but `learned`.

    Edges: weights stay positive and the curve monotone from 0 to 1 for any finite `raw`.
    """
    if kind == "learned":
        return raw, None
    weights = frozen[:3].sum() * torch.softmax(raw[:3], 0)
    gray = torch.cat([weights, frozen[3:]])
    if kind == "constrained":
        return gray, None
    steps = torch.softmax(raw[3:], 0)
    return gray, torch.cat([steps.new_zeros(1), torch.cumsum(steps, 0)])


def respond(gray: Tensor, heights: Tensor) -> Tensor:
    """The curve through equally spaced knots at gray values; beyond 0 and 1 its end pieces go on straight."""
    count = len(heights) - 1
    at = gray * count
    piece = at.detach().floor().clamp(0, count - 1).long()
    return heights[piece] + (at - piece) * (heights[piece + 1] - heights[piece])
