"""Sensor presets: effects and settings from published numbers, by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True)
class Preset:
    """One camera as published.

    Args:
        arm: `spike` or `rgb`.
        source: of the numbers.
        effects: tables as in a scene file's list.
        settings: defaults of the arm's table ([sensor] or [rgb]) that differ.
    """

    arm: str
    source: str
    effects: tuple[Mapping[str, Any], ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)


PRESETS: Mapping[str, Preset] = {
    "gopro9": Preset(
        "rgb",
        "GoPro HERO9 at 1080p120. Read-out: GPMF files say it (SROT), none of a HERO9 was found; it is below a frame "
        "of 119.88 fps (8.34 ms), 7 ms is taken. Electrons: usual for pixels of 1.1 to 1.5 um, not measured. 8 bits "
        "4:2:0, H.264 or HEVC: Open GoPro's file names GH and GX. Bit rate: none published for this mode was found, 60 "
        "Mbit/s is taken",
        effects=(
            {"name": "rolling_shutter", "readout_ms": 7.0},
            {"name": "rgb_noise", "full_well_e": 6000.0, "read_e": 2.5},
            {"name": "bayer", "pattern": "rggb"},
            {"name": "video_codec", "codec": "hevc", "mbit_s": 60.0, "fps": 119.88, "full_px": 1920 * 1080},
        ),
    ),
    "vidar-ideal": Preset("spike", "the integrate-and-fire definition (SpikeNVS Eq. 5 and 6), nothing else"),
}


def preset_names(arm: str) -> tuple[str, ...]:
    """Names of the presets of an arm, after the empty name of none."""
    return ("", *(name for name, preset in PRESETS.items() if preset.arm == arm))


def preset_effects(*names: str) -> list[Mapping[str, Any]]:
    """The effect tables of presets, in order; empty names give none."""
    return [table for name in names if name for table in PRESETS[name].effects]
