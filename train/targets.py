"""What a fit is trained on: per view its frame, and at instants of its exposure the pose, textures, ratio targets."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from spikerig.calib.straight import Straight, straight_of
from spikerig.dataset.bayer import bayer_of
from spikerig.dataset.errors import DataError, NumericsError, UsageError
from spikerig.dataset.scene import Floats, View
from spikerig.dataset.terminal import Progress
from spikerig.train import rolling
from spikerig.train.arms import align
from spikerig.train.config import FitConfig
from spikerig.train.deblurred import Deblurred, deblurred, frame_light
from spikerig.train.filters import Filters, check_colour, solve_filters
from spikerig.train.gauge import Gauge
from spikerig.train.gray import Gray, Pairs, solve
from spikerig.train.losses import mean_weights, ratio_target, srgb_from_linear
from spikerig.train.parts import parts_of
from spikerig.train.spikelight import average_texture, exposures, light_at, textures_at
from spikerig.train.trajectory import PATH_PHASES, given_pose, phases, pose_at

if TYPE_CHECKING:
    from spikerig.dataset.store import SceneFile

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

    `late` (rolling shutter, fields of rays): how many exposures after the middle row a pixel was exposed, float32[H,W];
    an instant's pose is then [K,3,4], of the first pixel read to the last. Of a batch: [B,1].
    """

    name: str
    frame: torch.Tensor
    valid: torch.Tensor | None
    instants: dict[float, Instant]
    pixels: torch.Tensor | None = None
    which: torch.Tensor = field(default_factory=lambda: torch.zeros(1, dtype=torch.int64))
    beside: dict[str, torch.Tensor] = field(default_factory=dict)
    late: torch.Tensor | None = None


@dataclass(frozen=True, slots=True)
class Targets:
    """All training views, the instants each term uses (fractions of the exposure), the converter, remarks.

    `also`: further instants that parts ask for. `given`: where cameras move, the poses [N,5,3,4] of the world that the
    fit was given at PATH_PHASES. `deblurred`: how pictures were deblurred first, for run.json. `filters`: of
    colour spikes, in place of `gray`.
    """

    views: tuple[TrainView, ...]
    colour: tuple[float, ...]
    tfs: tuple[float, ...]
    ratio: tuple[float, ...]
    gray: Gray | None
    remarks: tuple[str, ...] = field(default=())
    also: tuple[float, ...] = field(default=())
    given: Floats = field(default_factory=lambda: np.zeros((0, len(PATH_PHASES), 3, 4)))
    deblurred: dict[str, Any] | None = None
    filters: Filters | None = None


def views_of_step(targets: Targets, seed: int, step: int, count: int = 1) -> list[TrainView]:
    """The `count` views of a step; every view comes once in each epoch, in an order drawn by seed and epoch."""
    n = len(targets.views)
    turns = range(step * count, (step + 1) * count)
    orders = {epoch: np.random.default_rng((seed, 3, epoch)).permutation(n) for epoch in {k // n for k in turns}}
    return [targets.views[orders[k // n][k % n]] for k in turns]


def truth_pose(scene: SceneFile, view: View) -> Floats:
    """The camera [3,4] at the instant of a view's sharp truth; its mid-exposure pose where no instant is given."""
    if view.trajectory is None or len(view.trajectory.at_ns) < 2:
        return view.pose.cam_from_world
    try:
        return pose_at(view.trajectory, float(scene.truth_at_ns(view.name)))
    except UsageError:  # no instant given
        return view.pose.cam_from_world


def load_targets(scene: SceneFile, config: FitConfig, gauge: Gauge) -> Targets:
    """Read the training views of a scene and prepare everything a step needs.

    Args:
        scene: open scene file.
        config: of the fit.
        gauge: poses are given in it.

    Raises:
        DataError: no training views, nothing valid in them, no spikes, no trajectory or no truth where the method
            needs it.
        NumericsError: true light that is not finite.
        UsageError: single spikes are asked for, and the spike arm's lens bends; settings that colour spikes do not go
            with; a restorer that is not there or may not run.
    Cost: a texture takes milliseconds; memory 12 bytes a pixel and view, +4 a texture, +6 a ratio instant.
    """
    if not scene.train:
        raise DataError("this scene has no training views", value=scene.name, next="spikerig data info FILE")
    if config.colour_target == "truth" and not scene.has_truth:
        raise DataError("this method trains on the sharp truth", value=scene.name, expected=NEEDS_TRUTH)
    straight = straight_of(scene) if config.needs_spikes else Straight()
    bayer = bayer_of(scene.info) if config.needs_spikes else None
    if bayer is not None:
        check_colour(config, straight)
    elif config.colour_weight == 0:
        raise DataError(
            "spikes of a gray camera do not say what colour things have",
            value=scene.name,
            expected="a scene of a colour spike camera ([sensor] bayer), or frames beside the spikes",
            next="--method spikenerf",
        )
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
    if config.restore_instants > 0 or config.colour_weight == 0:
        colour = ()  # the part has a colour term of its own, or there is none
    parts = parts_of(config)
    also = tuple(dict.fromkeys(p for part in parts if part.instants is not None for p in part.instants(config)))
    sharper = deblurred(scene, config)
    pairs, raw, bar = Pairs(), [], Progress("preparing views", len(scene.train), "views")
    for number, name in enumerate(scene.train):
        raw.append(_read(scene, name, number, config, gauge, (colour, tfs, ratio, also), pairs, straight, sharper))
        bar.step()
    if not any(each["valid"].any() for each in raw):
        raise DataError(
            "no pixel of any training view is valid",
            value=scene.name,
            expected="views whose two arms see something in common",
            cause="an alignment that missed, or masks that are inverted",
            next="spikerig data check FILE",
        )
    gray = solve(pairs, config.gray, scene.light_gain) if config.needs_spikes and bayer is None else None
    filters = None if bayer is None else solve_filters(raw, bayer, config.gray, scene.light_gain)
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
    seen = gray if filters is None else filters
    views = tuple(_finish(each, k, config, gauge, seen, (colour, tfs, ratio)) for k, each in enumerate(raw))
    given = [each["given"] for each in raw] if config.moves_cameras else np.zeros((0, len(PATH_PHASES), 3, 4))
    about = None if sharper is None else sharper.about
    return Targets(views, colour, tfs, ratio, gray, remarks, also, np.array(given), about, filters)


def _remarks(raw: list[dict[str, Any]]) -> tuple[str, ...]:
    rolled = [each for each in raw if each["row_ns"]]
    if not rolled:
        return ()
    told = f"{len(rolled)} frames have a rolling shutter: "
    if all(each["late"] is not None for each in rolled):
        return (told + "every row has its own instant (poses, textures)",)
    return (
        told + "every row is treated as read when the middle one was (poses, textures), so fast shake skews; fields "
        "nerf and nerf-fast follow the rows where poses over the whole read-out are known",
    )


def _read(
    scene: SceneFile,
    name: str,
    number: int,
    config: FitConfig,
    gauge: Gauge,
    instants: tuple[tuple[float, ...], ...],
    pairs: Pairs,
    straight: Straight,
    sharper: Deblurred | None,
) -> dict[str, Any]:
    colour, tfs, ratio, also = instants
    view = scene.view(name, spikes=config.needs_spikes)
    light = frame_light(view)
    late = None
    if config.field != "splat" and config.colour_target != "truth" and not config.moves_cameras:
        late = rolling.late_of(view)

    def given(phase: float) -> Floats:
        return given_pose(view, number, phase, config, gauge.scale)

    made: dict[str, Any] = {
        "name": name,
        "late": late,
        "light": light if sharper is None else sharper.light[name],
        "valid": np.array(view.valid),
        "row_ns": view.frame.row_ns,
        "pose": {
            phase: given(phase) if late is None else rolling.row_poses(view, phase, late)
            for phase in dict.fromkeys((*colour, *tfs, *ratio, *also))
        },
        "beside": {n: t for part in parts_of(config) if part.read for n, t in part.read(scene, view, config).items()},
        "textures": {},
    }
    if config.colour_target == "truth":
        made["light"] = _finite(np.array(scene.truth_light(name), np.float32), name, scene)
        made["pose"] = dict.fromkeys(made["pose"], truth_pose(scene, view))
    if config.moves_cameras:
        made["given"] = [given(phase) for phase in PATH_PHASES]
    if config.needs_spikes:
        (mean,) = light_at(view, 0.5, late, scene.clock, straight, exposures(view, scene.clock))
        pairs.add(view.frame.pixels8, light, mean.light, mean.known & view.valid)
        made["mean"], made["mean_known"], made["codes"] = mean.light, mean.known, view.frame.pixels8
        for phase in dict.fromkeys((*tfs, *ratio)):
            make = partial(textures_at, kind=config.textures, window=config.texture_window)
            made["textures"][phase] = light_at(view, phase, late, scene.clock, straight, make)
    return made


def _finite(light: NDArray[np.float32], name: str, scene: SceneFile) -> NDArray[np.float32]:
    """True light as it is, if all of it is finite (a file that was changed since it was written may hold anything)."""
    bad = np.argwhere(~np.isfinite(light))
    if len(bad):
        raise NumericsError(
            f"the true light of view '{name}' is not finite",
            value=f"{light[tuple(bad[0])]} at index {bad[0].tolist()}, {len(bad)} in all",
            expected="finite numbers",
            cause="a damaged file",
            next=f"spikerig data verify {scene.path}",
        )
    return light


def _finish(
    raw: dict[str, Any],
    number: int,
    config: FitConfig,
    gauge: Gauge,
    seen: Gray | Filters | None,
    instants: tuple[tuple[float, ...], ...],
) -> TrainView:
    _, tfs, ratio = instants
    light, valid = torch.from_numpy(raw["light"]), raw["valid"]
    clipped = light.clamp(0, None if config.highlights == "keep" else 1)  # a truth may be brighter than white
    made: dict[float, Instant] = {}
    for phase, pose in raw["pose"].items():
        textures, target = (), torch.zeros(0, dtype=torch.half)
        if seen is not None and phase in raw["textures"]:
            found = raw["textures"][phase]
            averaged = average_texture(found)
            if phase in tfs or (ratio and config.tfs_weight > 0):
                each = [averaged] if config.tfs_combine == "average" else [(t.light, t.known) for t in found]
                textures = tuple(_tfs_target(a, k & valid, seen.white, config) for a, k in each)
            if phase in ratio:
                now = averaged[0] / np.float32(seen.white), averaged[1]
                mean = raw["mean"] / np.float32(seen.white), raw["mean_known"]
                if isinstance(seen, Filters):
                    now, mean = seen.colours(*now), seen.colours(*mean)
                target = ratio_target(
                    clipped,
                    torch.from_numpy(now[0]),
                    torch.from_numpy(mean[0]),
                    torch.from_numpy(now[1] & mean[1]),
                    eps=config.ratio_eps,
                    low=config.ratio_min,
                    high=config.ratio_max,
                ).half()
        poses = gauge.pose(pose) if pose.ndim == 2 else np.stack([gauge.pose(each) for each in pose])
        made[phase] = Instant(torch.from_numpy(poses), textures, target)
    everywhere = None if valid.all() else torch.from_numpy(valid)
    which = torch.tensor([number])
    late = None if raw["late"] is None else torch.from_numpy(raw["late"])
    frame = srgb_from_linear(clipped).contiguous()
    beside = raw["beside"] | ({"site": torch.from_numpy(seen.site)} if isinstance(seen, Filters) else {})
    return TrainView(raw["name"], frame, everywhere, made, None, which, beside, late)


def _tfs_target(
    light: NDArray, known: NDArray[np.bool_], white: float | NDArray[np.float32], config: FitConfig
) -> tuple[torch.Tensor, torch.Tensor]:
    texture = torch.from_numpy(np.ascontiguousarray(light / np.float32(white), np.float32))
    if config.highlights == "clip":
        texture = texture.clamp(max=1.0)
    if config.tfs_domain in ("encoded", "luma"):
        texture = srgb_from_linear(texture)
    return texture.contiguous(), mean_weights(torch.from_numpy(known))
