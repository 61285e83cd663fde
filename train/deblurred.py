"""Training pictures that were deblurred first: by events (EDI), or by a restorer that the user gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.terminal import Progress
from spikerig.train.config import FitConfig

if TYPE_CHECKING:
    from spikerig.dataset.scene import View
    from spikerig.dataset.store import SceneFile


@dataclass(frozen=True, slots=True)
class Deblurred:
    """Linear light float32[H,W,3] of each training view by name, and how it was made, for run.json."""

    light: dict[str, NDArray[np.float32]]
    about: dict[str, Any]


def frame_light(view: View) -> NDArray[np.float32]:
    """Linear light [H,W,3] of a view's frame, full scale 1."""
    from spikerig.dataset.images import linear_from_srgb

    decode = np.arange(view.frame.full + 1) / view.frame.full
    if view.frame.transfer == "srgb":
        decode = linear_from_srgb(decode)
    return np.asarray(decode, np.float32)[view.frame.pixels]


def deblurred(scene: SceneFile, config: FitConfig) -> Deblurred | None:
    """The deblurred training pictures that a config asks for; None where it trains on frames as they are.

    Raises:
        DataError: no events, or a restorer that gives no pictures.
        UsageError: no restorer, or none that may run.
    """
    if config.colour_target == "edi":
        return _by_events(scene, config)
    if config.colour_target == "restored":
        return _by_restorer(scene, config)
    return None


def _by_events(scene: SceneFile, config: FitConfig) -> Deblurred:
    from spikerig.train import edi
    from spikerig.train.eventview import require_events, thresholds_of

    require_events(scene)

    def blurry(name: str) -> NDArray[np.float32]:
        return frame_light(scene.view(name, spikes=False))

    thresholds = thresholds_of(scene, config) or edi.searched(scene, config, blurry)
    made, bar = {}, Progress("deblurring by events", len(scene.train), "views")
    for name in scene.train:
        ratio = edi.view_ratio(scene, scene.view(name, spikes=False), config, thresholds)
        made[name] = edi.sharpened(blurry(name), ratio, thresholds.eps)
        bar.step()
    return Deblurred(made, {"how": f"EDI, {config.edi_form}", "thresholds": thresholds.as_json()})


def _by_restorer(scene: SceneFile, config: FitConfig) -> Deblurred:
    from spikerig.dataset.images import linear_from_srgb, srgb_from_linear
    from spikerig.train.eventview import event_sums, require_events
    from spikerig.train.restorer import restore

    views = [scene.view(name, spikes=False) for name in scene.train]
    codes = np.stack([srgb_from_linear(np.clip(frame_light(view), 0, 1)) for view in views]).astype(np.float32)
    sums = None
    if config.restorer_bins > 0:
        require_events(scene)
        sums = np.stack([event_sums(scene, view, config.restorer_bins) for view in views]).astype(np.float32)
    found, about = restore(codes, sums, config)
    light = linear_from_srgb(found).astype(np.float32)
    return Deblurred(dict(zip(scene.train, light, strict=True)), about)
