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
    "densify": ("off", "mcmc"),
    "colour_loss": ("l1ssim", "l2"),
    "colour_target": ("frame", "truth"),
    "pose_label": ("mid", "first"),
    "instants_rule": ("midpoints", "endpoints"),
    "textures": ("both", "tfp", "tfi", "tfi-window", "raw"),
    "tfs_combine": ("average", "sum"),
    "tfs_domain": ("encoded", "linear", "luma", "naive"),
    "highlights": ("clip", "keep"),
    "gray": ("calibrated", "rec601", "learned"),
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
    "splats", "init", "init_opacity", "init_scale", "antialias", "densify", "densify_every", "densify_until", "noise",
    "opacity_reg", "scale_reg", "sh_warmup", "ssim_weight", "fresh_poses", "lr_means", "lr_scales", "lr_quats",
    "lr_opacities", "lr_colours",
}  # fmt: skip
FAST_ONLY = {"grid_levels", "coarsest", "finest", "table_log2", "occupancy", "lr_grid"}
RAYS_ONLY = {"rays", "views_per_step", "coarse", "fine", "width", "lr_net", *FAST_ONLY}


@dataclass(frozen=True, slots=True)
class FitConfig:
    """All knobs of a fit; units in the names or beside them.

    Model: `splats` is the number to start with (points are thinned or duplicated to it) and the cap of densification;
    learning rates are per step at the start of the run and fall exponentially to `lr_end` times that, by the fraction
    of steps done, or of seconds spent where `seconds` > 0. `lr_means` is in units of the normalised scene ([-1, 1]).

    Rays (fields nerf and nerf-fast): a step draws `rays` pixels, from `views_per_step` views in equal shares. `coarse`
    and `fine` are samples a ray: of the two networks of nerf; for nerf-fast the places looked up in the occupancy grid,
    and those the network sees. `width` is that of the hidden layers; `grid_levels` levels of a hash grid go from
    `coarsest` to `finest` cells along an axis with at most 2^`table_log2` rows each; `occupancy` cells along an axis.

    Camera: a blurry frame is explained by `poses_per_view` sub-poses of its exposure, averaged in linear light. One
    sub-pose is the instant of `pose_label` (the paper does not say which). More lie at (j+1/2)/n of the exposure
    (`instants_rule` midpoints) or at j/(n-1) (endpoints). With `fresh_poses` k > 0 a step renders only k of them, drawn
    at random, and remembers the last renders of the others (the gradient is scaled by n/k): the average at the cost
    of k renders a step instead of n.

    TfS: `tfs_weight` in the reading `weight_reading` of Eq. TfS (`effective_weight` maps it); textures at
    `textures_per_view` instants, of kind `textures` (`both` = TFP and TFI, averaged to one residual by `tfs_combine`
    average, or two losses by sum; `tfi-window` = TFI over as many intervals as fit into `texture_window` ticks, the
    least noisy; `raw` = the spike bit itself). `tfs_domain`: encoded = sRGB of texture against sRGB
    of the gray of the linearised render; linear = both linear; luma = gray of the encoded render against the encoded
    texture; naive = gray of the encoded render against the linear texture (wrong, for the ablation). `highlights`:
    clip textures to display white, where RGB ends too, or keep them.

    Ratio: until `ratio_until` of the run the colour target is the frame times the ratio of the texture at one of
    `ratio_instants` instants (a random one a step) to the exposure's mean.

    Ours (train/restore.py): with `restore_instants` n > 0 each of n instants has a target made of the model's own
    renders, in place of the colour term; fields of rays render all n a step. `restore_colour`: the target's colour is
    the frame's, or from `restore_from` of the run on the model's, times what its own blur lacks to be the frame.
    `restore_light`: an interval between spikes is compared with the renders it covers, or with its instant's.
    `restore_gain`: spikes correct the gray fully, or by what they are worth against what the model knows (bayes).
    `restore_white`: what a spike means comes from the frame's own gray (ratio), or from a flat field of all views.
    `texture_window` bounds the intervals; with `highlights` keep, light above white is trained from spikes, and
    channels that clip only say "at least". `align_arms` (any method with spikes, train/arms.py): frames are first moved
    onto the spikes by the shift or affine motion that all views together show.
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
    # rates
    lr_means: float = 4e-4
    lr_scales: float = 3e-2
    lr_quats: float = 6e-3
    lr_opacities: float = 3e-2
    lr_colours: float = 1e-2
    lr_gray: float = 1e-3
    lr_net: float = 5e-4
    lr_grid: float = 1e-2
    lr_end: float = 0.3
    # colour term and camera
    colour_target: str = "frame"
    colour_loss: str = "l1ssim"
    ssim_weight: float = 0.2
    poses_per_view: int = 1
    fresh_poses: int = 0
    pose_label: str = "mid"
    instants_rule: str = "midpoints"
    # TfS
    tfs_weight: float = 0.0
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
    # ours
    align_arms: str = "off"
    restore_instants: int = 0
    restore_colour: str = "model"
    restore_from: float = 0.1
    restore_light: str = "interval"
    restore_gain: str = "bayes"
    restore_white: str = "flat"

    def __post_init__(self) -> None:
        faults = [
            f"{name} is '{getattr(self, name)}', not one of {', '.join(choices)}"
            for name, choices in CHOICES.items()
            if getattr(self, name) not in choices
        ]
        faults += [text for wrong, text in self._range_faults() if wrong]
        if faults:
            raise UsageError("the settings of this fit do not hold together", value="; ".join(faults))

    def _range_faults(self) -> list[tuple[bool, str]]:
        positive = ("steps", "splats", "densify_every", "poses_per_view", "textures_per_view", "texture_window")
        positive += ("rays", "views_per_step", "coarse", "fine", "width")
        rates = [f.name for f in fields(self) if f.name.startswith("lr_")]
        return [
            *((getattr(self, name) < 1, f"{name} must be at least 1") for name in (*positive, "ratio_instants")),
            *((not 0 <= getattr(self, name) < 1e6, f"{name} must be 0 or more") for name in rates),
            *((not 0 <= getattr(self, n) < 1e12, f"{n} must be 0 or more") for n in ("noise", "tfs_weight", "seconds")),
            (not 0 <= self.sh_degree <= 3, "sh_degree must be 0 to 3"),
            (self.fresh_poses < 0, "fresh_poses must be 0 (all) or more"),
            (not 0 < self.init_opacity < 1, "init_opacity must lie between 0 and 1"),
            (not 0 < self.init_scale < 1e3, "init_scale must be positive"),
            (not 0 <= self.ssim_weight <= 1, "ssim_weight must be 0 to 1"),
            (not 0 < self.lr_end <= 1, "lr_end must be in (0, 1]"),
            *(
                (not 0 <= getattr(self, n) <= 1, f"{n} is a fraction, 0 to 1")
                for n in ("ratio_until", "sh_warmup", "densify_until")
            ),
            *self._restore_faults(),
            (self.ratio_eps <= 0, "ratio_eps must be positive"),
            (not 0 < self.ratio_min <= 1 <= self.ratio_max, "ratio_min <= 1 <= ratio_max must hold"),
            *self._ray_faults(),
            (self.pose_label == "first" and self.colour_target == "truth", "the truth is not labelled by pose_label"),
        ]

    def _restore_faults(self) -> list[tuple[bool, str]]:
        on = self.restore_instants > 0
        return [
            (not 0 <= self.restore_instants <= 99, "restore_instants must be 0 (off) to 99"),
            (not 0 <= self.restore_from <= 1, "restore_from is a fraction, 0 to 1"),
            (on and self.ratio_until > 0, "restored instants take the ratio targets' place: ratio_until must be 0"),
            (on and self.colour_target == "truth", "the truth needs no restoring: restore_instants must be 0"),
            (on and self.pose_label == "first", "instants are restored about mid-exposure: pose_label must be mid"),
            (on and self.tfs_weight > 0 and self.textures_per_view > 1, "with restored instants TfS has one texture"),
            (self.align_arms != "off" and not self.needs_spikes, "without spikes there are no arms to align"),
        ]

    def _ray_faults(self) -> list[tuple[bool, str]]:
        if self.field == "splat":
            return []
        return [
            (self.colour_loss != "l2", "a batch of rays has no neighbours for SSIM: colour_loss must be l2"),
            (self.fresh_poses > 0, "renders of single rays are not remembered: fresh_poses must be 0"),
            (self.densify != "off", "only splats densify"),
            (self.views_per_step > self.rays, "views_per_step must not exceed rays"),
            (max(self.coarse, self.fine, self.width) > 4096, "coarse, fine and width are at most 4096"),
            (self.rays > 1 << 20, "rays is at most 2^20"),
            (not 4 <= self.occupancy <= 512, "occupancy must be 4 to 512"),
        ]

    @property
    def needs_spikes(self) -> bool:
        """Whether any term reads spikes."""
        return self.tfs_weight > 0 or self.ratio_until > 0 or self.restore_instants > 0

    @property
    def needs_trajectory(self) -> bool:
        """Whether any instant but mid-exposure is rendered."""
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
