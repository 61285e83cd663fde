"""What the settings of the baselines must hold to; their meanings are in FitConfig's docstring."""

from __future__ import annotations

from typing import Any

NUMBERS = ("event_weight", "event_shift", "event_hinge", "event_pos", "event_neg", "kernel_align")


def baseline_faults(config: Any) -> list[tuple[bool, str]]:
    """Pairs of (it does not hold, what to say) for a FitConfig."""
    frames = config.restorer_frames
    return [
        *((not 0 <= getattr(config, n) < 1e3, f"{n} must be 0 to 1000") for n in NUMBERS),
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


def _event_faults(config: Any) -> list[tuple[bool, str]]:
    return [
        (config.poses_per_view < 2, "events tie two sub-poses: poses_per_view must be 2 or more"),
        (config.instants_rule != "endpoints", "events lie between the ends of bins: instants_rule must be endpoints"),
        (config.fresh_poses == 1, "events tie two renders of a step: fresh_poses must not be 1"),
    ]
