"""Colour spikes as training input: each pixel of the spike camera sees the render through the filter in front of it.

Nothing is demosaiced for the TfS term: a red pixel is compared with what a red pixel would see of the render. Only the
ratio target, a whole colour picture, needs all three colours everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spikerig.dataset.bayer import Bayer, demosaic
from spikerig.dataset.errors import UsageError
from spikerig.dataset.texture import Texture
from spikerig.train.config import FitConfig
from spikerig.train.gray import Gray, Pairs, solve
from spikerig.train.losses import tfs_loss

if TYPE_CHECKING:
    from spikerig.calib.straight import Straight

OWN = np.eye(3)  # a pure filter: its own colour and nothing else


@dataclass(frozen=True, slots=True, eq=False)
class Filters:
    """What the three kinds of pixels see.

    Args:
        site: uint8[H,W], which of the three a pixel is: 0 red, 1 green, 2 blue.
        gray: their converters: from linear RGB to the light behind the filter, white at 1.
        bayer: the pattern.
    """

    site: NDArray[np.uint8]
    gray: tuple[Gray, Gray, Gray]
    bayer: Bayer

    @property
    def white(self) -> NDArray[np.float32]:
        """Texture value of display white at each pixel, [H,W]."""
        return np.asarray([g.white for g in self.gray], np.float32)[self.site]

    @property
    def weights(self) -> Tensor:
        """Weights and bias of each kind, [3,4]."""
        return torch.tensor([[*g.weights, g.bias] for g in self.gray])

    def colours(self, light: NDArray[np.float32], known: NDArray[np.bool_]) -> tuple[NDArray, NDArray[np.bool_]]:
        """Light [H,W] in units of white with all colours everywhere: ([H,W,3], known [H,W])."""
        found = demosaic(Texture(light, known, 0.0, "colour spikes"), Bayer(self.bayer.pattern))
        return np.array(found.light), np.asarray(found.known.all(-1), np.bool_)

    def as_json(self) -> list[dict[str, Any]]:
        """A JSON-ready record of the three."""
        return [g.as_json() for g in self.gray]


def check_colour(config: FitConfig, straight: Straight) -> None:
    """Refuse what cannot be done with colour spikes."""
    if straight.resamples:
        raise UsageError(
            "the spike arm's lens bends, and its colour pixels cannot be blended straight",
            value="a colour spike camera",
            expected="a scene whose spike arm is a pinhole, or a method without spikes",
        )
    refused = [
        (config.restore_instants > 0, f"method {config.method} (restored instants)"),
        (config.align_arms != "off", "align_arms"),
        (config.gray not in ("calibrated", "rec601"), f"gray {config.gray}"),
        (config.tfs_domain in ("luma", "naive"), f"tfs_domain {config.tfs_domain}"),
    ]
    if wrong := [text for is_wrong, text in refused if is_wrong]:
        raise UsageError(
            "colour spikes do not go with these settings",
            value="; ".join(wrong),
            expected="TfS and ratio targets; gray calibrated, or rec601 for pure filters",
            next="--method colour-spikes",
        )


def solve_filters(raw: list[dict[str, Any]], bayer: Bayer, how: str, light_gain: float | None) -> Filters:
    """The three converters, from the exposures of all training views.

    Args:
        raw: views, each with codes uint8[H,W,3], light [H,W,3], mean and mean_known [H,W], valid [H,W].
        bayer: pattern and gains.
        how: calibrated (by least squares, cross-talk of the filters included), or rec601: pure filters.
        light_gain: texture value of white before the filters' gains, where it is known.

    Raises:
        DataError: too few good pixels of a colour, or spikes that do not grow with light.
    """
    height, width = raw[0]["mean"].shape
    site = bayer.channels(height, width).astype(np.uint8)
    found = []
    for c in range(3):
        white = None if light_gain is None else light_gain * bayer.gain[c]
        if how == "rec601" and white is not None:
            r, g, b = OWN[c]
            found.append(Gray((r, g, b), 0.0, white, "pure filter"))
            continue
        pairs = Pairs()
        for each in raw:
            good = each["mean_known"] & each["valid"] & (site == c)
            pairs.add(each["codes"], each["light"], each["mean"], good)
        found.append(solve(pairs, "calibrated", white))
    return Filters(site, (found[0], found[1], found[2]), bayer)


def tfs_through(image: Tensor, texture: Tensor, weight: Tensor, site: Tensor, weights: Tensor, domain: str) -> Tensor:
    """The TfS term of a render against a texture of colour pixels; arguments as `tfs_loss`, `weights` [3,4]."""
    parts = [tfs_loss(image, texture, weight * (site == c), weights[c], domain) for c in range(3)]
    return parts[0] + parts[1] + parts[2]
