"""`ours`: targets that restore every instant of an exposure, luma from its spikes, colour from the model's own blur.

For an instant t of a view let R be the render (linear light), A the mean of the renders of all instants, B the frame.
Had the field the right colours, A would be B; what is missing is a factor, so the colour that t should have is
R B / A (Richardson and Lucy's step, with the blur kernel replaced by the camera's own path). Its gray is then held
against the spikes: an interval [a, b] between spikes of a pixel says that the gray, averaged over a..b, is k / (b - a).
Where light is scarce an interval outlasts an instant, so it is compared with the mean of the renders it covers, and
the correction is weighted by how much the interval is worth against what the model knows already (Kalman's gain).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spikerig.calib.straight import Straight, straight_of
from spikerig.dataset.errors import DataError
from spikerig.dataset.texture import Texture
from spikerig.train.config import FitConfig
from spikerig.train.field import Step, Tensors
from spikerig.train.gray import BRIGHTEST
from spikerig.train.losses import light_of, srgb_from_linear
from spikerig.train.trajectory import phases

if TYPE_CHECKING:
    from spikerig.dataset.scene import View
    from spikerig.dataset.spikes import SpikeStream
    from spikerig.dataset.store import SceneFile
    from spikerig.train.targets import TrainView

DIM = 1e-3  # linear light added to both sides of a ratio: about three 8-bit steps of black
MOST = 6.0  # a correction is at most so large, or 1 / so small
ROUNDING = 1 / 6  # variance, ticks^2, of an interval between two instants that are each rounded up to a tick
ELECTRONS = 1000.0  # a threshold: shot noise of the order that published sensors have
LEAST_DOUBT = 1e-4  # relative variance that a model's gray keeps: 1 %


def instants(config: FitConfig) -> tuple[float, ...]:
    """The instants that are restored."""
    return phases(config.restore_instants, "midpoints", config.pose_label)


@dataclass(frozen=True, slots=True, eq=False)
class Interval:
    """What spikes say around an instant: gray light [H,W] (spikes a tick; 0: nothing known), its relative variance, and
    the ticks first..last [H,W] that it is the mean of."""

    light: NDArray[np.float32]
    variance: NDArray[np.float32]
    first: NDArray[np.float32]
    last: NDArray[np.float32]


def intervals_at(stream: SpikeStream, tick: float, window: int, straight: Straight) -> Interval:
    """The most intervals (1, 3 or 9) that fit into a window of ticks around an instant; one where none fits.

    Edges: not known where the stream ends or was lost before the needed spikes. A lens that bends blends ends of
    intervals as it blends light.
    """
    from spikerig.dataset import kernels

    shape = (stream.height, stream.width)
    light, first, last, count = (np.zeros(shape) for _ in range(4))
    lost = stream.lost_before()
    for k in (1, 3, 9):
        a, b = kernels.tfi_at(stream.bits, stream.width, int(np.floor(tick)), before=k // 2 + 1, after=(k + 1) // 2)
        fits = (a >= 0) & (b >= 0) & ((b - a <= window) | (k == 1))
        fits &= lost[np.maximum(b, 0)] == lost[np.minimum(a + 1, stream.ticks)]
        light[fits], count[fits] = k / (b - a)[fits], k
        first[fits], last[fits] = a[fits] + 1, b[fits] + 1
    known = count > 0
    span = np.maximum(last - first, 1)
    variance = ROUNDING / span**2 + 1 / (ELECTRONS * np.maximum(count, 1))
    made = (np.asarray(m, np.float32) for m in (light, variance, first, last))
    maps = [straight.texture(Texture(m, known, tick, "intervals")) for m in made]
    return Interval(*(np.where(m.known, m.light, np.float32(0)) for m in maps))


def read(scene: SceneFile, view: View, config: FitConfig) -> dict[str, Tensor]:
    """Of a view: the exposure's mean of the spikes [H,W], and by instant the interval there (light, relative variance,
    first and last as fractions of the exposure) as `instant J` [H,W,4].

    Raises:
        DataError: a rolling shutter under a field of rays.
    """
    from spikerig.train.spikelight import exposures, light_at, spike_tick, spikes_of

    if view.frame.row_ns and config.field != "splat":
        raise DataError(
            "fields of rays follow a rolling shutter's rows, and restored instants do not",
            value=f"view '{view.name}', {view.frame.row_ns} ns a row",
            expected="field splat, or a method of which every row has its own instant",
            next="--field splat, or --method spike-ratio",
        )
    straight, stream = straight_of(scene), spikes_of(view)
    begin, end = (spike_tick(view, view.instant_ns(phase), scene.clock) for phase in (0.0, 1.0))
    (mean,) = light_at(view, 0.5, None, scene.clock, straight, exposures(view, scene.clock))
    made = {"mean": torch.from_numpy(np.where(mean.known, mean.light, np.float32(0)))}
    for j, phase in enumerate(instants(config)):
        tick = spike_tick(view, view.instant_ns(phase), scene.clock)
        found = intervals_at(stream, tick, config.texture_window, straight)
        ends = [(t - begin) / (end - begin) for t in (found.first, found.last)]
        stacked = np.stack([found.light, found.variance, *ends], -1)
        made[f"instant {j}"] = torch.from_numpy(np.ascontiguousarray(stacked, np.float32))
    return made


def start(task: Any) -> Tensors:
    """`flat` [H,W]: each pixel's sensitivity (fixed pattern), from all training views: spikes over the frame's gray.

    It is not trained: no gradient reaches it. Pixels that clip in every view have 1.
    """
    weights, white = task.gray, task.targets.gray.white
    height, width = task.camera.height, task.camera.width
    spikes, gray = torch.full((height, width), DIM), torch.full((height, width), DIM)
    for view in task.targets.views:
        good = (view.beside["mean"] > 0) & ~clipped_in(view).any(-1)
        if view.valid is not None:
            good &= view.valid
        spikes += torch.where(good, view.beside["mean"] / white, 0.0)
        gray += torch.where(good, gray_light(light_of(view.frame), weights), 0.0)
    return {"flat": (spikes / gray).clamp(1 / MOST, MOST)}


def clipped_in(view: TrainView) -> Tensor:
    """bool[H,W,3]: channels of the frame at, or next to, their end."""
    return view.frame > BRIGHTEST / 255


def gray_light(light: Tensor, weights: Tensor) -> Tensor:
    """What the spike camera would see, in units of white: [H,W] of linear light [H,W,3] and gray[4]."""
    gray = light[..., 0] * weights[0] + light[..., 1] * weights[1] + light[..., 2] * weights[2] + weights[3]
    return gray.clamp(min=DIM)


def loss(state: Any, task: Any, view: TrainView, pictures: dict[float, Tensor], step: Step) -> list[Tensor]:
    """The colour term of each rendered instant against its restored target; their mean."""
    from spikerig.train.fit import colour_loss

    config, order = task.config, instants(task.config)
    drawn = [p for p in order if p in pictures]
    if not drawn:
        return []
    kept = [light_of(pictures[p]) if p in pictures else state.memory[view.name, p].float() for p in order]
    lights = [light.clamp(min=0) for light in kept]
    flat = state.params["restore:flat"].detach()
    flat = flat if view.pixels is None else flat.reshape(-1)[view.pixels][:, None]
    early = step.fraction < config.restore_from or config.restore_colour == "frame"
    terms = [
        colour_loss(pictures[p], restored(view, order.index(p), lights, flat, task, early), view.valid, config)
        for p in drawn
    ]
    return [sum(terms[1:], terms[0]) / len(terms)]


def restored(view: TrainView, j: int, lights: list[Tensor], flat: Tensor, task: Any, early: bool) -> Tensor:
    """The target of instant j, sRGB codes [H,W,3].

    Args:
        view: with what `read` found.
        j: number of the instant.
        lights: linear light of the renders of all instants.
        flat: sensitivity [H,W].
        task: of the fit.
        early: the colour is still the frame's.
    """
    config, gray, white = task.config, task.gray, task.targets.gray.white
    frame, clipped, keep = light_of(view.frame), clipped_in(view), config.highlights == "keep"
    if early:
        colour, grays = frame, []
    else:
        factor = missing(frame, clipped if keep else None, lights)
        colour = lights[j] * factor
        grays = [gray_light(light * factor, gray) for light in lights] if config.restore_light == "interval" else []
    found, variance, first, last = view.beside[f"instant {j}"].unbind(-1)
    own = gray_light(colour, gray)
    predicted = covered(grays, first, last) if grays else own
    measured = found / white / flat
    if config.restore_white == "ratio":  # the frame's own gray says what the exposure's spikes mean
        exact = (view.beside["mean"] > 0) & ~clipped.any(-1)
        ratio = gray_light(frame, gray) / view.beside["mean"].clamp(min=1e-6)
        measured = torch.where(exact, found * ratio, measured)
    known = found > 0
    innovation = torch.where(known, (measured / predicted - 1).clamp(1 / MOST - 1, MOST - 1), 0.0)
    if config.restore_gain == "bayes" and not early:
        innovation = innovation * kalman(innovation, variance, known)
    bias = float(gray[3])
    light = (own * (1 + innovation) - bias).clamp(min=0) / (own - bias).clamp(min=DIM)
    target = colour * light.clamp(1 / MOST, MOST)[..., None]
    return srgb_from_linear(target if keep else target.clamp(0.0, 1.0))


def missing(frame: Tensor, clipped: Tensor | None, lights: list[Tensor]) -> Tensor:
    """What the mean of renders lacks to be the frame, as a factor [H,W,3]: Richardson and Lucy's B / A.

    `clipped` bool[H,W,3]: channels that only say that there was at least so much light; their factor is at least 1.
    """
    mean = sum(lights[1:], lights[0]) / len(lights)
    factor = ((frame + DIM) / (mean + DIM)).clamp(1 / MOST, MOST)
    return factor if clipped is None else torch.where(clipped, factor.clamp(min=1.0), factor)


def covered(grays: list[Tensor], first: Tensor, last: Tensor) -> Tensor:
    """The mean of n grays over first..last (fractions of the exposure, in n equal slots; the outer ones go on)."""
    n, total, span = len(grays), torch.zeros_like(first), (last - first).clamp(min=1e-6)
    for j, gray in enumerate(grays):
        low = first if j == 0 else first.clamp(min=j / n)
        high = last if j == n - 1 else last.clamp(max=(j + 1) / n)
        total += gray * (high - low).clamp(min=0)
    return torch.where(last > first, total / span, grays[n // 2])


def kalman(innovation: Tensor, variance: Tensor, known: Tensor) -> Tensor:
    """Share of an innovation to believe: the model's variance over the sum of the model's and the spikes' own.

    The model's is what the innovations of the picture have beyond the spikes' (all relative).
    """
    count = known.sum().clamp(min=1)
    beyond = torch.where(known, innovation * innovation - variance, 0.0).sum() / count
    doubt = beyond.clamp(min=LEAST_DOUBT)
    return doubt / (doubt + variance)
