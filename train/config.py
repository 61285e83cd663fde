"""One flat, frozen config of a fit (presets and methods, which return or adjust one, are in methods.py).

Every ambiguity of the paper is a named switch here, with its default. "w" always ends as a mean-equivalent weight:
all loss terms are means over pixels, textures in [0,1] where 1 is display white.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any

from spikerig.dataset.errors import UsageError

CHOICES: dict[str, tuple[str, ...]] = {
    "field": ("splat", "nerf", "nerf-fast"),
    "init": ("points", "random"),
    "background": ("black", "white", "random"),
    "densify": ("off", "mcmc", "default"),
    "densify_by": ("all", "colour", "tfs"),
    "exposure": ("off", "affine", "bilateral"),
    "colour_loss": ("l1ssim", "l2"),
    "colour_target": ("frame", "truth", "edi", "restored"),
    "average_domain": ("linear", "encoded"),
    "event_light": ("linear", "encoded"),
    "edi_form": ("continuous", "binned"),
    "pose_label": ("mid", "first"),
    "instants_rule": ("midpoints", "endpoints"),
    "textures": ("both", "tfp", "tfi", "tfi-window", "raw"),
    "tfs_combine": ("average", "sum"),
    "tfs_domain": ("encoded", "linear", "luma", "naive"),
    "highlights": ("clip", "keep"),
    "gray": ("calibrated", "rec601", "learned", "constrained", "response"),
    "trajectory": ("given", "linear", "cubic"),
    "knots_at": ("even", "spikes"),
    "path_from": ("given", "mid"),
    "anchor": ("mean", "mid", "none"),
    "align_arms": ("off", "shift", "affine"),
    "restore_colour": ("model", "frame"),
    "restore_light": ("interval", "instant"),
    "restore_gain": ("bayes", "full"),
    "restore_white": ("flat", "ratio"),
    "weight_reading": ("mean", "sum-batch", "sum-image", "u8"),
    "device": ("cpu", "cuda"),
}
PAPER_BATCH = 1024
SPLAT_ONLY = {
    "splats", "init_opacity", "init_scale", "antialias", "densify", "densify_every", "densify_until", "noise",
    "densify_from", "densify_by", "densify_grad", "densify_size", "densify_share", "splats_most", "huge", "absgrad",
    "opacity_reset",
    "opacity_reg", "scale_reg", "sh_warmup", "ssim_weight", "fresh_poses", "lr_means", "lr_scales", "lr_quats",
    "lr_opacities", "lr_colours",
}  # fmt: skip
FAST_ONLY = {"grid_levels", "coarsest", "finest", "table_log2", "occupancy", "probes", "contract", "lr_grid"}
RAYS_ONLY = {"rays", "views_per_step", "coarse", "fine", "width", "lr_net", *FAST_ONLY}


@dataclass(frozen=True, slots=True)
class FitConfig:
    """All knobs of a fit; units in the names or beside them.

    Model: `splats` is the number to start with (points are thinned or duplicated to it), `splats_most` the cap of
    densification (0: `splats` itself for mcmc, four times it for default);
    learning rates are per step at the start of the run and fall exponentially to `lr_end` times that, by the fraction
    of steps done, or of seconds spent where `seconds` > 0. `lr_means` is in units of the normalised scene ([-1, 1]).

    Densification, every `densify_every` steps between the fractions `densify_from` (default only) and `densify_until`
    of the run. mcmc: `noise`. default (train/grow.py): splats whose mean screen gradient is above `densify_grad` (loss
    per half picture; 0: 2e-4, or 8e-4 with `absgrad`, which sums its absolute values over pixels) are cloned, or split
    where larger than `densify_size`, at most `densify_share` of all in a round; those fainter than 0.005 are dropped,
    and after the first of the opacity resets every `opacity_reset` steps (0: none) those larger than `huge` (gauge
    units). `densify_by`: the gradient of the whole loss, or of the colour or the TfS term alone.

    Rays (fields nerf and nerf-fast): a step draws `rays` pixels, from `views_per_step` views in equal shares. `coarse`
    and `fine` are samples a ray: of the two networks of nerf; for nerf-fast the places looked up in the occupancy grid,
    and those the networks are trained at; with `probes` > 0 the density of so many places, looked up without gradient,
    says where those are. nerf-fast starts from the scene's points, or with `init` random from nothing. `width` is that
    of the hidden layers; `grid_levels` levels of a hash grid go from `coarsest` to `finest` cells along an axis with at
    most 2^`table_log2` rows each; `occupancy` cells along an axis. `contract`: the space beyond
    the unit ball is drawn in to radius 2 and looked at out to infinity; without, a box around all points and cameras.

    Camera: a blurry frame is explained by `poses_per_view` sub-poses of its exposure, averaged in linear light. One
    sub-pose is the instant of `pose_label` (the paper does not say which). More lie at (j+1/2)/n of the exposure
    (`instants_rule` midpoints) or at j/(n-1) (endpoints). With `fresh_poses` k > 0 a step renders only k of them, drawn
    at random, and remembers the last renders of the others (the gradient is scaled by n/k): the average at the cost
    of k renders a step instead of n.

    Paths: `trajectory` given trains no camera. With linear or cubic, every training camera's pose is that given times
    an SE(3) spline in its frame that is optimised with the scene: screws between `knots` knots (0: 2), or a cumulative
    cubic B-spline of as many control poses (0: 4). Knots lie evenly over the exposure (`knots_at` even), or the pieces
    of the spline end at the instants of the textures (spikes; `knots` is 0 then). `path_from` given starts at the
    scene's trajectory, or at the mid-exposure pose, which then stands for all instants, where it has none; mid always
    does the latter. `anchor` mean: what all cameras do in common (a motion, a scale) is projected out; mid:
    mid-exposure poses hold, only the motion around them is learned; none. Rates `lr_poses` (radians and the normalised
    scene's units) fall to `lr_poses_end` times that. For studies, `pose_noise_deg` degrees and `pose_noise_share` of
    half the scene's size about each axis (standard deviations, drawn by seed and view) are put onto the poses given; at
    the exposure's ends as much again, halved, in opposite directions.

    `colour_weight` scales the colour term; 0 leaves the frames out: textures are all there is (colour spikes).

    TfS: `tfs_weight` in the reading `weight_reading` of Eq. TfS (`effective_weight` maps it); textures at
    `textures_per_view` instants, of kind `textures` (`both` = TFP and TFI, averaged to one residual by `tfs_combine`
    average, or two losses by sum; `tfi-window` = TFI over as many intervals as fit into `texture_window` ticks, the
    least noisy; `raw` = the spike bit itself). `tfs_domain`: encoded = sRGB of texture against sRGB
    of the gray of the linearised render; linear = both linear; luma = gray of the encoded render against the encoded
    texture; naive = gray of the encoded render against the linear texture (wrong, for the ablation). `highlights`:
    clip textures to display white, where RGB ends too, or keep them. `gray`: how RGB becomes what a spike sees:
    calibrated before training and frozen; rec601; learned (the paper's, free); constrained (learned, positive weights
    of fixed sum); response (constrained, then a learned monotone curve). Learned ones start from Rec.601.
    `tfs_from`: fraction of the run where TfS begins.

    Exposure (train/exposure.py): frames of different gain or white balance, as real captures have them. affine: a
    colour matrix and offset a view, in linear light; bilateral: a grid of them a view, smoothed by `exposure_tv`.

    Ratio: until `ratio_until` of the run the colour target is the frame times the ratio of the texture at one of
    `ratio_instants` instants (a random one a step) to the exposure's mean.

    Ours (train/restore.py): with `restore_instants` n > 0 each of n instants has a target made of the model's own
    renders, in place of the colour term; fields of rays render all n a step. `restore_colour`: the target's colour is
    the frame's, or from `restore_from` of the run on the model's, times what its own blur lacks to be the frame.
    `restore_light`: an interval between spikes is compared with the renders it covers, or with its instant's.
    `restore_gain`: spikes correct the gray fully, or by what they are worth against what the model knows (bayes).
    `restore_white`: what a spike means comes from the frame's own gray (ratio), or from a flat field that all views
    give. `texture_window` bounds the intervals; with `highlights` keep, light above white is trained from spikes, and
    channels that clip only say "at least". `align_arms` (any method with spikes, train/arms.py): frames are first moved
    onto the spikes by the shift or affine motion that all views together show.

    Baselines (docs/baselines.md): `colour_target` frame, truth, edi (frames deblurred by events: `edi_form` continuous,
    or binned in `edi_bins`) or restored (by the network `restorer`, which runs only with `trust`; it sees
    `restorer_frames` views and `restorer_bins` event sums of each, sides padded to multiples of `restorer_pad`, and has
    `restorer_limit_s` for all). `average_domain`: sub-poses and kernels are averaged as linear light or as encoded
    codes. `event_weight` of E2NeRF's loss (renders at bin ends against events); `event_light` is what it takes the log
    of; `event_pos` and `event_neg` are thresholds (0: those recorded); `event_shift` is added to counts, `event_hinge`
    weighs pixels without events. `kernel_points` of Deblur-NeRF's kernel, from `kernel_start` of the run on, its first
    point held by `kernel_align`.
    """

    field: str = "splat"
    method: str = "plain"
    preset: str = "standard"
    seed: int = 0
    device: str = "cpu"
    steps: int = 3000
    seconds: float = 0.0
    # model
    splats: int = 12_000
    sh_degree: int = 0
    sh_warmup: float = 0.25
    init: str = "points"
    init_opacity: float = 0.5
    init_scale: float = 0.6
    antialias: bool = False
    background: str = "black"
    densify: str = "off"
    densify_every: int = 100
    densify_until: float = 0.7
    densify_from: float = 0.05
    densify_by: str = "all"
    densify_grad: float = 0.0
    densify_size: float = 0.01
    densify_share: float = 1.0
    splats_most: int = 0
    huge: float = 0.1
    absgrad: bool = False
    opacity_reset: int = 3000
    noise: float = 5e4
    opacity_reg: float = 0.0
    scale_reg: float = 0.0
    # rays
    rays: int = 1024
    views_per_step: int = 1
    coarse: int = 64
    fine: int = 128
    width: int = 256
    grid_levels: int = 12
    coarsest: int = 16
    finest: int = 512
    table_log2: int = 16
    occupancy: int = 64
    probes: int = 32
    contract: bool = False
    # rates
    lr_means: float = 4e-4
    lr_scales: float = 3e-2
    lr_quats: float = 6e-3
    lr_opacities: float = 3e-2
    lr_colours: float = 1e-2
    lr_gray: float = 1e-3
    lr_exposure: float = 2e-3
    lr_net: float = 5e-4
    lr_grid: float = 1e-2
    lr_end: float = 0.3
    # colour term and camera
    colour_target: str = "frame"
    colour_loss: str = "l1ssim"
    colour_weight: float = 1.0
    ssim_weight: float = 0.2
    poses_per_view: int = 1
    fresh_poses: int = 0
    pose_label: str = "mid"
    instants_rule: str = "midpoints"
    exposure: str = "off"
    exposure_tv: float = 10.0
    # paths
    trajectory: str = "given"
    knots: int = 0
    knots_at: str = "even"
    path_from: str = "given"
    anchor: str = "mean"
    lr_poses: float = 2e-3
    lr_poses_end: float = 0.01
    pose_noise_deg: float = 0.0
    pose_noise_share: float = 0.0
    # TfS
    tfs_weight: float = 0.0
    tfs_from: float = 0.0
    weight_reading: str = "mean"
    textures_per_view: int = 1
    textures: str = "both"
    tfs_combine: str = "average"
    tfs_domain: str = "encoded"
    texture_window: int = 32
    highlights: str = "clip"
    gray: str = "calibrated"
    # ratio
    ratio_until: float = 0.0
    ratio_instants: int = 5
    ratio_eps: float = 0.01
    ratio_min: float = 0.15
    ratio_max: float = 6.0
    # baselines
    average_domain: str = "linear"
    event_weight: float = 0.0
    event_light: str = "linear"
    event_pos: float = 0.0
    event_neg: float = 0.0
    event_shift: float = 0.5
    event_hinge: float = 0.0
    edi_form: str = "continuous"
    edi_bins: int = 4
    kernel_points: int = 0
    kernel_start: float = 0.02
    kernel_align: float = 0.01
    lr_kernel: float = 1e-2
    restorer: str = ""
    trust: bool = False
    restorer_frames: int = 1
    restorer_bins: int = 0
    restorer_pad: int = 8
    restorer_limit_s: float = 600.0
    # ours
    align_arms: str = "off"
    restore_instants: int = 0
    restore_colour: str = "model"
    restore_from: float = 0.1
    restore_light: str = "interval"
    restore_gain: str = "bayes"
    restore_white: str = "flat"

    def __post_init__(self) -> None:
        from spikerig.train.faults import faults_of

        faults = [
            f"{name} is '{getattr(self, name)}', not one of {', '.join(choices)}"
            for name, choices in CHOICES.items()
            if getattr(self, name) not in choices
        ]
        faults += faults_of(self)
        if faults:
            raise UsageError("the settings of this fit do not hold together", value="; ".join(faults))

    @property
    def moves_cameras(self) -> bool:
        """Whether training cameras are not those of the scene."""
        return self.trajectory != "given" or self.pose_noise_deg > 0 or self.pose_noise_share > 0

    @property
    def needs_spikes(self) -> bool:
        """Whether any term reads spikes."""
        return self.tfs_weight > 0 or self.ratio_until > 0 or self.restore_instants > 0

    @property
    def needs_trajectory(self) -> bool:
        """Whether any instant but mid-exposure is rendered, from a pose that must be given."""
        if self.trajectory != "given":
            return False
        many = self.poses_per_view > 1 and self.ratio_until < 1
        textures = self.tfs_weight > 0 and self.textures_per_view > 1
        ratio = self.ratio_until > 0 and self.ratio_instants > 1
        return many or textures or ratio or self.restore_instants > 1 or self.pose_label == "first"

    def as_json(self) -> dict[str, Any]:
        """A JSON-ready record of every setting."""
        return asdict(self)


def from_json(record: dict[str, Any]) -> FitConfig:
    """The config of a stored record; unknown names are an error (a newer spikerig wrote it)."""
    known = {f.name for f in fields(FitConfig)}
    if strange := sorted(set(record) - known):
        raise UsageError(
            "settings this version does not know",
            value=", ".join(strange),
            expected="settings of this version",
            cause="the run was written by a newer spikerig",
            next="pip install --upgrade spikerig",
        )
    return FitConfig(**record)


def parse_setting(text: str) -> tuple[str, Any]:
    """`name=value` from a command line as (name, typed value)."""
    name, equals, value = text.partition("=")
    types = {f.name: str(f.type) for f in fields(FitConfig)}
    if not equals or name not in types:
        raise UsageError("a setting is name=value", value=text, expected="one of: " + ", ".join(sorted(types)))
    try:
        if types[name] == "bool":
            return name, {"true": True, "false": False}[value.lower()]
        return name, {"int": int, "float": float, "str": str}[types[name]](value)
    except (ValueError, KeyError):
        raise UsageError(f"'{name}' takes a value of type {types[name]}", value=value) from None


def effective_weight(weight: float, reading: str, pixels: int) -> float:
    """The mean-equivalent weight of the paper's w under a reading of Eq. TfS.

    Args:
        weight: w as given.
        reading: mean = both terms are means over pixels, textures in [0,1]; sum-batch = TfS is a sum over a batch of
            1024 rays, colour a mean; sum-image = TfS is a sum over a whole image; u8 = textures in 0..255, colour in
            [0,1].
        pixels: of one image.

    Source: paper, Eq. TfS; facts on which reading makes 1e-4 do anything (only u8, 6.5, and sum-image).
    """
    scale = {"mean": 1.0, "sum-batch": float(PAPER_BATCH), "sum-image": float(pixels), "u8": 255.0**2}
    if reading not in scale:
        raise UsageError("no such reading of w", value=reading, expected=", ".join(scale))
    return weight * scale[reading]
