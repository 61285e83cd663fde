"""What a fit is trained on: per view its frame, and at instants of its exposure the pose, textures, ratio targets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from spikerig.calib.straight import Straight, straight_of
from spikerig.dataset.bayer import bayer_of
from spikerig.dataset.clocktime import ClockModel
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.scene import Floats, View
from spikerig.dataset.spikes import SpikeStream
from spikerig.dataset.terminal import Progress
from spikerig.train.arms import align
from spikerig.train.config import FitConfig
from spikerig.train.gauge import Gauge
from spikerig.train.gray import Gray, Pairs, solve
from spikerig.train.losses import mean_weights, ratio_target, srgb_from_linear
from spikerig.train.parts import parts_of
from spikerig.train.trajectory import phases, pose_at, sub_pose

if TYPE_CHECKING:
    from spikerig.dataset.store import SceneFile
    from spikerig.dataset.texture import Texture

NEEDS_TRUTH = "a simulated scene (spikerig sim capture); real scenes have no sharp truth"


@dataclass(frozen=True, slots=True, eq=False)
class Instant:
    """An instant of a view's exposure: pose float32[3,4] in the gauge, TfS targets, colour target.

    `textures` are pairs (texture [H,W] as tfs_domain wants it, mean weights [H,W]); `ratio` is float16[H,W,3] codes
    (rounding below 1/16 of an 8-bit step), empty where no step uses it.
    """

    pose: torch.Tensor
    textures: tuple[tuple[torch.Tensor, torch.Tensor], ...]
    ratio: torch.Tensor


@dataclass(frozen=True, slots=True, eq=False)
class TrainView:
    """A training view: colour target float32[H,W,3] codes, valid bool[H,W] or None for all, instants by phase.

    `which` int64[1] is the view's number among the training views; `beside` holds what parts read of it, [H,W,...].

    Or B pixels of some views, as pictures of B rows and one column: then `pixels` int64[B] says which (row * width +
    column), `which` is int64[B], and an instant's pose is [B,3,4].
    """

    name: str
    frame: torch.Tensor
    valid: torch.Tensor | None
    instants: dict[float, Instant]
    pixels: torch.Tensor | None = None
    which: torch.Tensor = field(default_factory=lambda: torch.zeros(1, dtype=torch.int64))
    beside: dict[str, torch.Tensor] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Targets:
    """All training views, the instants each term uses (fractions of the exposure), the converter, remarks.

    `also`: further instants that parts ask for.
    """

    views: tuple[TrainView, ...]
    colour: tuple[float, ...]
    tfs: tuple[float, ...]
    ratio: tuple[float, ...]
    gray: Gray | None
    remarks: tuple[str, ...] = field(default=())
    also: tuple[float, ...] = field(default=())


def views_of_step(targets: Targets, seed: int, step: int, count: int = 1) -> list[TrainView]:
    """The `count` views of a step; every view comes once in each epoch, in an order drawn by seed and epoch."""
    n = len(targets.views)
    turns = range(step * count, (step + 1) * count)
    orders = {epoch: np.random.default_rng((seed, 3, epoch)).permutation(n) for epoch in {k // n for k in turns}}
    return [targets.views[orders[k // n][k % n]] for k in turns]


def spikes_of(view: View) -> SpikeStream:
    """The spikes of a view that must have them."""
    if view.spikes is None:
        raise DataError(
            f"view '{view.name}' has no spikes, and this method trains on them",
            next="--method plain or average needs none",
        )
    return view.spikes


def truth_pose(scene: SceneFile, view: View) -> Floats:
    """The camera [3,4] at the instant of a view's sharp truth; its mid-exposure pose where no instant is given."""
    if view.trajectory is None or len(view.trajectory.at_ns) < 2:
        return view.pose.cam_from_world
    try:
        return pose_at(view.trajectory, float(scene.truth_at_ns(view.name)))
    except UsageError:  # no instant given
        return view.pose.cam_from_world


def spike_tick(view: View, at_ns: float, clock: ClockModel | None) -> float:
    """The (fractional) tick of a view's spikes at an instant of its frame's clock.

    Raises:
        DataError: the spikes are on another clock and the scene has no map to it.
    """
    stream = spikes_of(view)
    if stream.clock == view.frame.clock:
        return stream.tick_at(round(at_ns))
    if clock is None:
        raise DataError(
            f"the frame and spikes of view '{view.name}' are on different clocks",
            value=f"{view.frame.clock} and {stream.clock}",
            expected="one clock, or the scene's map between them",
        )
    return stream.tick_at(int(clock.device_from_rig(np.int64(round(at_ns)))))


def windowed_tfi(stream: SpikeStream, tick: float, window: int) -> Texture:
    """TFI over the most intervals (1, 3 or 9: as many before as after) that fit into a window of ticks.

    One interval where even three are longer. Bright pixels get the low noise of a window, dark ones no zero counts:
    on the demo scene its error is half that of TFP over 32 ticks.
    """
    from spikerig.dataset.texture import Texture, tfi

    first = tfi(stream, tick)
    light, known = first.light.copy(), first.known
    for k in (3, 9):
        longer = tfi(stream, tick, intervals=k)
        fits = longer.known & (k <= window * longer.light)
        light[fits] = longer.light[fits]
    return Texture(light, known, tick, f"tfi-window-{window}")


def textures_at(stream: Any, tick: float, kind: str, window: int) -> list[Texture]:
    """The textures of an instant by kind: tfp, tfi, both of them, tfi-window, or raw (the one tick's spikes)."""
    from spikerig.dataset.texture import tfi, tfp

    made: dict[str, Callable[[], list[Texture]]] = {
        "tfp": lambda: [tfp(stream, tick, window)],
        "tfi": lambda: [tfi(stream, tick)],
        "both": lambda: [tfp(stream, tick, window), tfi(stream, tick)],
        "tfi-window": lambda: [windowed_tfi(stream, tick, window)],
        "raw": lambda: [tfp(stream, tick, 1)],
    }
    return made[kind]()


def average_texture(found: list[Texture]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Mean over the textures known at each pixel: (light [H,W], known where any is)."""
    known = np.stack([t.known for t in found])
    light = np.where(known, np.stack([t.light for t in found]), 0).sum(0)
    return (light / np.maximum(known.sum(0), 1)).astype(np.float32), np.asarray(known.any(0), np.bool_)


def exposure_mean(view: View, clock: ClockModel | None) -> Texture:
    """Spikes a tick over the whole exposure, of the raw spikes."""
    from spikerig.dataset.texture import Texture, window_sum

    stream = spikes_of(view)
    t0, t1 = (round(spike_tick(view, view.instant_ns(phase), clock)) for phase in (0.0, 1.0))
    if not (0 <= t0 < t1 <= stream.ticks):
        raise DataError(
            f"the spikes of view '{view.name}' do not cover its exposure",
            value=f"exposure ticks {t0}..{t1}, stream 0..{stream.ticks}",
            expected="spikes from before its start to after its end",
            next="spikerig data verify FILE",
        )
    lost = any(a < t1 and b > t0 for a, b in stream.lost)
    light = np.asarray(window_sum(stream, t0, t1), np.float32) / np.float32(t1 - t0)
    return Texture(light, np.full(light.shape, not lost), (t0 + t1) / 2, "exposure")


def load_targets(scene: SceneFile, config: FitConfig, gauge: Gauge) -> Targets:
    """Read the training views of a scene and prepare everything a step needs.

    Args:
        scene: open scene file.
        config: of the fit.
        gauge: poses are given in it.

    Raises:
        DataError: no training views, no spikes, no trajectory or no truth where the method needs it; a colour spike
            camera.
        UsageError: single spikes are asked for, and the spike arm's lens bends.
    Cost: a texture takes milliseconds; memory 12 bytes a pixel and view, +4 a texture, +6 a ratio instant.
    """
    if not scene.train:
        raise DataError("this scene has no training views", value=scene.name, next="spikerig data info FILE")
    if config.colour_target == "truth" and not scene.has_truth:
        raise DataError("this method trains on the sharp truth", value=scene.name, expected=NEEDS_TRUTH)
    if config.needs_spikes and bayer_of(scene.info) is not None:
        raise DataError(
            "the spikes of this scene see colours, and the losses on spikes compare gray",
            value=scene.name,
            expected="a scene of a gray spike camera, or a method without spikes",
        )
    straight = straight_of(scene) if config.needs_spikes else Straight()
    if config.textures == "raw" and straight.resamples:
        raise UsageError(
            "single spikes cannot be brought to the scene's camera: its spike lens bends, and they would be blended",
            value="textures=raw",
            expected="a texture: tfp, tfi, both or tfi-window",
            next="--set textures=tfp --set texture_window=8",
        )
    colour = phases(config.poses_per_view, config.instants_rule, config.pose_label)
    tfs = phases(config.textures_per_view, config.instants_rule, config.pose_label) if config.tfs_weight > 0 else ()
    ratio = phases(config.ratio_instants, "midpoints", config.pose_label) if config.ratio_until > 0 else ()
    if config.ratio_until >= 1:
        colour, tfs = ratio, (ratio if tfs else ())
    if config.restore_instants > 0:
        colour = ()  # the part has a colour term of its own
    parts = parts_of(config)
    also = tuple(dict.fromkeys(p for part in parts if part.instants is not None for p in part.instants(config)))
    pairs, raw, bar = Pairs(), [], Progress("preparing views", len(scene.train), "views")
    for name in scene.train:
        raw.append(_read(scene, name, config, (colour, tfs, ratio, also), pairs, straight))
        bar.step()
    gray = solve(pairs, config.gray, scene.light_gain) if config.needs_spikes else None
    remarks = _remarks(raw)
    if gray is not None and config.align_arms != "off":
        motion = align(raw, np.array([*gray.weights, gray.bias]), gray.white, config.align_arms)
        pairs = Pairs()
        for each in raw:
            pairs.add(each["codes"], each["light"], each["mean"], each["mean_known"] & each["valid"])
        gray = solve(pairs, config.gray, scene.light_gain)
        x, y = motion.shift_px
        remarks += (
            f"frames were moved by {x:+.2f}, {y:+.2f} px to meet the spikes ({config.align_arms}; rms of the grays' "
            f"difference {motion.rms_before:.4f} -> {motion.rms_after:.4f} of white)",
        )
    views = tuple(_finish(each, k, config, gauge, gray, (colour, tfs, ratio)) for k, each in enumerate(raw))
    return Targets(views, colour, tfs, ratio, gray, remarks, also)


def _remarks(raw: list[dict[str, Any]]) -> tuple[str, ...]:
    rolling = sum(1 for each in raw if each["row_ns"])
    if not rolling:
        return ()
    return (
        f"{rolling} frames have a rolling shutter: every row is treated as read when the middle one was "
        "(poses, textures), so fast shake skews",
    )


def _read(
    scene: SceneFile,
    name: str,
    config: FitConfig,
    instants: tuple[tuple[float, ...], ...],
    pairs: Pairs,
    straight: Straight,
) -> dict[str, Any]:
    from spikerig.dataset.images import linear_from_srgb

    colour, tfs, ratio, also = instants
    view = scene.view(name, spikes=config.needs_spikes)
    decode = np.arange(view.frame.full + 1) / view.frame.full
    if view.frame.transfer == "srgb":
        decode = linear_from_srgb(decode)
    light = np.asarray(decode, np.float32)[view.frame.pixels]
    made: dict[str, Any] = {
        "name": name,
        "light": light,
        "valid": np.array(view.valid),
        "row_ns": view.frame.row_ns,
        "pose": {phase: sub_pose(view, phase) for phase in dict.fromkeys((*colour, *tfs, *ratio, *also))},
        "beside": {n: t for part in parts_of(config) if part.read for n, t in part.read(scene, view, config).items()},
        "textures": {},
    }
    if config.colour_target == "truth":
        made["light"] = np.array(scene.truth_light(name), np.float32)
        made["pose"] = dict.fromkeys(made["pose"], truth_pose(scene, view))
    if config.needs_spikes:
        clock = scene.clock
        mean = straight.texture(exposure_mean(view, clock))
        pairs.add(view.frame.pixels8, light, mean.light, mean.known & view.valid)
        made["mean"], made["mean_known"], made["codes"] = mean.light, mean.known, view.frame.pixels8
        for phase in dict.fromkeys((*tfs, *ratio)):
            tick = spike_tick(view, view.instant_ns(phase), clock)
            found = textures_at(view.spikes, tick, config.textures, config.texture_window)
            made["textures"][phase] = [straight.texture(t) for t in found]
    return made


def _finish(
    raw: dict[str, Any],
    number: int,
    config: FitConfig,
    gauge: Gauge,
    gray: Gray | None,
    instants: tuple[tuple[float, ...], ...],
) -> TrainView:
    _, tfs, ratio = instants
    light, valid = torch.from_numpy(raw["light"]), raw["valid"]
    clipped = light.clamp(0, None if config.highlights == "keep" else 1)  # a truth may be brighter than white
    made: dict[float, Instant] = {}
    for phase, pose in raw["pose"].items():
        textures, target = (), torch.zeros(0, dtype=torch.half)
        if gray is not None and phase in raw["textures"]:
            found = raw["textures"][phase]
            averaged = average_texture(found)
            if phase in tfs or (ratio and config.tfs_weight > 0):
                each = [averaged] if config.tfs_combine == "average" else [(t.light, t.known) for t in found]
                textures = tuple(_tfs_target(a, k & valid, gray.white, config) for a, k in each)
            if phase in ratio:
                target = ratio_target(
                    clipped,
                    torch.from_numpy(averaged[0] / np.float32(gray.white)),
                    torch.from_numpy(raw["mean"] / np.float32(gray.white)),
                    torch.from_numpy(averaged[1] & raw["mean_known"]),
                    eps=config.ratio_eps,
                    low=config.ratio_min,
                    high=config.ratio_max,
                ).half()
        made[phase] = Instant(torch.from_numpy(gauge.pose(pose)), textures, target)
    everywhere = None if valid.all() else torch.from_numpy(valid)
    which = torch.tensor([number])
    return TrainView(raw["name"], srgb_from_linear(clipped).contiguous(), everywhere, made, None, which, raw["beside"])


def _tfs_target(
    light: NDArray, known: NDArray[np.bool_], white: float, config: FitConfig
) -> tuple[torch.Tensor, torch.Tensor]:
    texture = torch.from_numpy(np.ascontiguousarray(light / np.float32(white), np.float32))
    if config.highlights == "clip":
        texture = texture.clamp(max=1.0)
    if config.tfs_domain in ("encoded", "luma"):
        texture = srgb_from_linear(texture)
    return texture.contiguous(), mean_weights(torch.from_numpy(known))
