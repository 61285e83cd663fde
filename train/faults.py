"""What makes no sense in the settings of a fit, each with the words that say so."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from spikerig.train.config import FitConfig


def faults_of(config: Any) -> list[str]:
    """All faults of a FitConfig but for words that are no choice."""
    return [text for wrong, text in _range_faults(config) if wrong]


def _range_faults(config: FitConfig) -> list[tuple[bool, str]]:
    positive = ("steps", "splats", "densify_every", "poses_per_view", "textures_per_view", "texture_window")
    positive += ("rays", "views_per_step", "coarse", "fine", "width")
    rates = [f.name for f in fields(config) if f.name.startswith("lr_")]
    return [
        *((getattr(config, name) < 1, f"{name} must be at least 1") for name in (*positive, "ratio_instants")),
        *((not 0 <= getattr(config, name) < 1e6, f"{name} must be 0 or more") for name in rates),
        *(
            (not 0 <= getattr(config, n) < 1e12, f"{n} must be 0 or more")
            for n in ("noise", "tfs_weight", "seconds", "densify_grad", "exposure_tv", "colour_weight")
        ),
        (not 0 <= config.sh_degree <= 3, "sh_degree must be 0 to 3"),
        (config.fresh_poses < 0, "fresh_poses must be 0 (all) or more"),
        (not 0 < config.init_opacity < 1, "init_opacity must lie between 0 and 1"),
        (not 0 < config.init_scale < 1e3, "init_scale must be positive"),
        (not 0 <= config.ssim_weight <= 1, "ssim_weight must be 0 to 1"),
        (not 0 < config.lr_end <= 1, "lr_end must be in (0, 1]"),
        *(
            (not 0 <= getattr(config, n) <= 1, f"{n} is a fraction, 0 to 1")
            for n in ("ratio_until", "sh_warmup", "densify_until", "densify_from", "tfs_from")
        ),
        *_restore_faults(config),
        (config.ratio_eps <= 0, "ratio_eps must be positive"),
        (not 0 < config.ratio_min <= 1 <= config.ratio_max, "ratio_min <= 1 <= ratio_max must hold"),
        *_growth_faults(config),
        *_ray_faults(config),
        (
            config.exposure != "off" and config.colour_target == "truth",
            "the sharp truth has no exposure of its own to correct: exposure must be off",
        ),
        (
            config.exposure == "bilateral" and config.field != "splat",
            "a bilateral grid needs whole pictures (field splat): exposure affine corrects rays too",
        ),
        *_path_faults(config),
        *_baseline_faults(config),
        (config.colour_weight == 0 and config.tfs_weight == 0, "without frames and textures there is nothing to fit"),
        (config.colour_weight == 0 and config.ratio_until > 0, "a ratio target needs frames: colour_weight above 0"),
        (config.pose_label == "first" and config.colour_target == "truth", "the truth is not labelled by pose_label"),
    ]


def _growth_faults(config: FitConfig) -> list[tuple[bool, str]]:
    default = config.densify == "default"
    return [
        (config.absgrad and not default, "absgrad is what densify default watches"),
        (config.absgrad and config.device == "cuda", "absgrad is of the native rasteriser: device must be cpu"),
        (config.densify_by != "all" and not default, "densify_by is of densify default"),
        (config.densify_by == "tfs" and config.tfs_weight == 0, "densify_by tfs needs a TfS term"),
        (0 < config.splats_most < config.splats, "splats_most must be 0 or at least splats"),
        (not 0 < config.densify_share <= 1, "densify_share must be in (0, 1]"),
        (not (config.densify_size > 0 and config.huge > 0), "densify_size and huge must be positive"),
        (config.opacity_reset < 0, "opacity_reset must be 0 (none) or more steps"),
    ]


def _restore_faults(config: FitConfig) -> list[tuple[bool, str]]:
    on = config.restore_instants > 0
    return [
        (not 0 <= config.restore_instants <= 99, "restore_instants must be 0 (off) to 99"),
        (not 0 <= config.restore_from <= 1, "restore_from is a fraction, 0 to 1"),
        (on and config.ratio_until > 0, "restored instants take the ratio targets' place: ratio_until must be 0"),
        (
            on and config.colour_target != "frame",
            "restored instants read the blurry frame: colour_target must be frame",
        ),
        (on and config.exposure != "off", "restored instants compare with the frame as it is: exposure must be off"),
        (on and config.kernel_points > 0, "restored instants are moved by the trajectory: kernel_points must be 0"),
        (on and config.pose_label == "first", "instants are restored about mid-exposure: pose_label must be mid"),
        (on and config.tfs_weight > 0 and config.textures_per_view > 1, "with restored instants TfS has one texture"),
        (config.align_arms != "off" and not config.needs_spikes, "without spikes there are no arms to align"),
    ]


def _ray_faults(config: FitConfig) -> list[tuple[bool, str]]:
    if config.field == "splat":
        return []
    return [
        (config.colour_loss != "l2", "a batch of rays has no neighbours for SSIM: colour_loss must be l2"),
        (config.fresh_poses > 0, "renders of single rays are not remembered: fresh_poses must be 0"),
        (config.densify != "off", "only splats densify"),
        (config.views_per_step > config.rays, "views_per_step must not exceed rays"),
        (max(config.coarse, config.fine, config.width) > 4096, "coarse, fine and width are at most 4096"),
        (config.rays > 1 << 20, "rays is at most 2^20"),
        (not 0 <= config.probes <= 4096, "probes must be 0 to 4096"),
        (not 4 <= config.occupancy <= 512, "occupancy must be 4 to 512"),
    ]


def _path_faults(config: FitConfig) -> list[tuple[bool, str]]:
    least = 4 if config.trajectory == "cubic" else 2
    still = config.trajectory == "given" and (
        config.path_from == "mid" or config.knots != 0 or config.knots_at != "even"
    )
    return [
        (config.knots != 0 and not least <= config.knots <= 64, f"knots must be 0 or {least} to 64"),
        (config.knots != 0 and config.knots_at == "spikes", "the spikes say how many knots there are: knots must be 0"),
        (config.moves_cameras and config.colour_target == "truth", "the truth is seen from its true poses, which hold"),
        (still, "knots, knots_at and path_from belong to trajectory=linear or cubic"),
        (not 0 < config.lr_poses_end <= 1, "lr_poses_end must be in (0, 1]"),
        (not 0 <= config.pose_noise_deg <= 90, "pose_noise_deg must be 0 to 90"),
        (not 0 <= config.pose_noise_share <= 1, "pose_noise_share must be 0 to 1"),
    ]


def _baseline_faults(config: FitConfig) -> list[tuple[bool, str]]:
    numbers = ("event_weight", "event_shift", "event_hinge", "event_pos", "event_neg", "kernel_align")
    frames = config.restorer_frames
    return [
        *((not 0 <= getattr(config, n) < 1e3, f"{n} must be 0 to 1000") for n in numbers),
        (config.average_domain == "encoded" and config.fresh_poses > 0, "fresh_poses remembers linear light"),
        ((config.event_pos > 0) != (config.event_neg > 0), "event_pos and event_neg are given both or not at all"),
        *((config.event_weight > 0 and wrong, text) for wrong, text in _event_faults(config)),
        (not 1 <= config.edi_bins <= 1000, "edi_bins must be 1 to 1000"),
        (not 0 <= config.kernel_points <= 64, "kernel_points must be 0 (no kernel) to 64"),
        (not 0 <= config.kernel_start <= 1, "kernel_start is a fraction, 0 to 1"),
        (
            config.kernel_points > 0 and config.poses_per_view > 1,
            "a kernel stands for sub-poses: poses_per_view must be 1",
        ),
        (not 1 <= frames <= 99 or frames % 2 == 0, "restorer_frames must be odd, 1 to 99"),
        (not 0 <= config.restorer_bins <= 100, "restorer_bins must be 0 (no events) to 100"),
        (not 1 <= config.restorer_pad <= 256, "restorer_pad must be 1 to 256"),
        (not 0 < config.restorer_limit_s <= 1e6, "restorer_limit_s must be positive"),
    ]


def _event_faults(config: FitConfig) -> list[tuple[bool, str]]:
    return [
        (config.poses_per_view < 2, "events tie two sub-poses: poses_per_view must be 2 or more"),
        (config.instants_rule != "endpoints", "events lie between the ends of bins: instants_rule must be endpoints"),
        (config.fresh_poses == 1, "events tie two renders of a step: fresh_poses must not be 1"),
    ]
