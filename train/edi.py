"""EDI, the event-based double integral: the sharp picture at an instant of a blurry exposure, in closed form.

The exposure is the mean of the light: B = 1/T int L(t) dt, and events say how log light went: L(t) = L(f) exp(E(t) -
E(f)). So L(f) = B T / int exp(E(t) - E(f)) dt. Where events are of log(light + eps), it holds of light + eps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, UsageError
from spikerig.train.eventview import Thresholds, instants

if TYPE_CHECKING:
    from spikerig.dataset.events import EventStream
    from spikerig.dataset.scene import View
    from spikerig.dataset.store import SceneFile
    from spikerig.train.config import FitConfig

Floats = NDArray[np.floating]
FARTHEST = 30.0  # log light is not followed farther from that of the instant: e^30 is past any sensor's range
SEARCH = (0.02, 1.0)  # thresholds that are looked through
LOOKED = 3  # views that the search looks at, spread over the scene
GRAY = np.array([0.299, 0.587, 0.114])


def exposure_ratio(stream: EventStream, window: tuple[int, int], at_ns: int, thresholds: Thresholds) -> Floats:
    """Light at an instant over mean light of a window, float64[H,W], from events alone: the double integral, exactly.

    Args:
        stream: events that cover the window.
        window: nanoseconds [begin, end) of the exposure.
        at_ns: the instant, within it.
        thresholds: of the events; log light steps by one at an event and stays between events.

    Edges: no events at a pixel: 1. Log light more than FARTHEST from that of the instant counts as so far.
    Cost: some 0.1 s for 130,000 events at 200x125.
    Source: Pan et al., "Bringing a Blurry Frame Alive at High Frame-Rate with an Event Camera", CVPR 2019, Eq. 5-8.
    """
    begin, end = window
    if not begin <= at_ns <= end or begin >= end:
        raise UsageError("an instant within an exposure is needed", value=(window, at_ns))
    stream = stream.slice(begin, end)
    size = stream.height * stream.width
    every = np.arange(size)
    pixel = np.concatenate([every, stream.y.astype(np.int64) * stream.width + stream.x])
    step = np.concatenate([np.zeros(size), np.where(stream.polarity > 0, thresholds.up, -thresholds.down)])
    order = np.argsort(pixel, kind="stable")  # of a pixel first the start of the window, then events in time
    pixel, step = pixel[order], step[order]
    time = np.concatenate([np.full(size, begin), stream.t_ns])[order]
    first = np.searchsorted(pixel, every)
    level = np.cumsum(step)
    level -= level[first][pixel]
    here = np.bincount(pixel, time <= at_ns, size).astype(np.int64) + first - 1  # the last knot by the instant
    until = np.append(time[1:], end)
    until[np.append(first[1:], len(pixel)) - 1] = end
    relative = np.clip(level - level[here][pixel], -FARTHEST, FARTHEST)
    total = np.bincount(pixel, (until - time) * np.exp(relative), size)
    return ((end - begin) / total).reshape(stream.height, stream.width)


def binned_ratio(sums: NDArray, at: int, thresholds: Thresholds) -> Floats:
    """The same from K sums of events [K,H,W], at the end of bin `at` (0 = the exposure's start).

    Source: EDI.py of E2NeRF: L(0) = (K+1) B / (1 + sum_k exp(c E_k)), L(k) = L(0) exp(c E_k), E_k to the end of bin k.
    """
    step = np.where(sums > 0, thresholds.up, thresholds.down) * sums.astype(np.float64)
    level = np.concatenate([np.zeros((1, *sums.shape[1:])), np.cumsum(step, 0)])
    relative = np.clip(level - level[at], -FARTHEST, FARTHEST)
    return len(level) / np.exp(relative).sum(0)


def view_ratio(scene: SceneFile, view: View, config: FitConfig, thresholds: Thresholds) -> Floats:
    """Light at a view's labelled instant over its exposure's mean, float64[H,W]; DataError as `instants`."""
    stream = scene.events(view.name)
    phase = 0.5 if config.pose_label == "mid" else 0.0
    begin, at, end = instants(scene, view, (0.0, phase, 1.0), stream)
    if config.edi_form == "continuous":
        return exposure_ratio(stream, (begin, end), at, thresholds)
    if phase * config.edi_bins % 1:
        raise UsageError("mid-exposure is the end of a bin only for even edi_bins", value=config.edi_bins)
    edges = instants(scene, view, [k / config.edi_bins for k in range(config.edi_bins + 1)], stream)
    return binned_ratio(stream.bins(np.array(edges, np.int64)), round(phase * config.edi_bins), thresholds)


def sharpened(light: NDArray, ratio: Floats, eps: float) -> NDArray[np.float32]:
    """A blurry picture's light [H,W,3] at the instant of a ratio [H,W]: (light + eps) ratio - eps, not below 0."""
    return np.maximum((light + eps) * ratio[..., None] - eps, 0).astype(np.float32)


def sparsity(picture: Floats) -> float:
    """How few places a picture's gradients are gathered at: their mean length over its root mean square, 0 to 1.

    Source: Krishnan et al., "Blind Deconvolution Using a Normalized Sparsity Measure", CVPR 2011: blur raises it, and
    so do the ghosts of edges sharpened too much. EDI searches its threshold by total variation and agreement with
    edges of events, weighted by a number that is not published; this measure needs none.
    """
    length = np.hypot(np.diff(picture, axis=1)[:-1], np.diff(picture, axis=0)[:, :-1])
    root = float(np.sqrt(np.mean(length**2)))
    return float(np.mean(length)) / root if root > 0 else 1.0


def searched(scene: SceneFile, config: FitConfig, lights: Callable[[str], NDArray]) -> Thresholds:
    """One threshold for up and down, by which a few of the scene's views come out most sparse (in their gradients).

    Args:
        scene, config: as for `view_ratio`.
        lights: linear light [H,W,3] of a training view's blurry frame, by name.

    Raises:
        DataError: it is at the end of what is looked through: these events say nothing of the pictures.
    Cost: 17 pictures of each of LOOKED views.
    """
    from spikerig.dataset.images import srgb_from_linear

    views = [scene.view(name, spikes=False) for name in scene.train[:: max(1, len(scene.train) // LOOKED)][:LOOKED]]
    grays = [np.clip(lights(view.name), 0, 1) @ GRAY for view in views]

    def cost(log_c: float) -> float:
        tried = Thresholds(float(np.exp(log_c)), float(np.exp(log_c)), 0.0, "searched")
        made = (np.clip(g * view_ratio(scene, v, config, tried), 0, 1) for g, v in zip(grays, views, strict=True))
        return float(np.mean([sparsity(srgb_from_linear(light)) for light in made]))

    low, high = np.log(SEARCH)
    grid = np.linspace(low, high, 10)
    costs = [cost(c) for c in grid]
    best = int(np.argmin(costs))
    if best in (0, len(grid) - 1):
        raise DataError(
            "no event threshold makes the pictures sharp",
            value=f"the best of {SEARCH[0]} to {SEARCH[1]} is {np.exp(grid[best]):.2g}",
            cause="events of other pictures, too few of them, or pictures that are not blurred",
            next="--set event_pos=0.2 --set event_neg=0.2 gives the thresholds",
        )
    found = float(np.exp(_golden(cost, grid[best - 1], grid[best + 1], 7)))
    return Thresholds(found, found, 0.0, "searched")


def _golden(cost: Callable[[float], float], low: float, high: float, steps: int) -> float:
    """Where a function with one valley is least, by golden sections."""
    share = (np.sqrt(5) - 1) / 2
    a, b = high - share * (high - low), low + share * (high - low)
    at_a, at_b = cost(a), cost(b)
    for _ in range(steps):
        if at_a < at_b:
            high, b, at_b = b, a, at_a
            a = high - share * (high - low)
            at_a = cost(a)
        else:
            low, a, at_a = a, b, at_b
            b = low + share * (high - low)
            at_b = cost(b)
    return (low + high) / 2
