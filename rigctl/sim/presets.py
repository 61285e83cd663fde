"""Sensor presets: effects and settings from published numbers, by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from spikerig.dataset.errors import UsageError
from spikerig.rigctl.sim.effects import Effect, read_effects
from spikerig.rigctl.sim.limits import Faults


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


# v2s.py of SCSim (Acnext/SCSim, of the group that measured the sensor; arXiv 2304.03129) works in volts and farads of
# its own: a pixel gains 0.05 (I_dark + 20 C0 S x) a tick from light x (1 = full scale) and fires at C (S + V + n),
# where C0 = 4.348, S = 3.3 V - 2.2 V - 0.0076 V = 1.0924 V. A threshold is therefore C0 S = 4.7497, and
#   light         0.05 x 20 C0 S x / (C0 S) = x thresholds a tick: gain 1 spike a tick at full scale
#   dark current  0.05 x N(0.4442, 0.1731) / 4.7497 = 0.004676, sd 0.001822 thresholds a tick
#   threshold     V: sd 0.0497 / 1.0924 = 4.55 %; C: sd 0.0128 / 4.348 = 0.29 %; together 4.56 %
#   PRNU          alpha N(1.0128, 0.0584) / 1.0128: sd 5.77 %
#   comparator    n: sd 0.00636 / 1.0924 = 0.58 % of the threshold at each look (thermal: 9.6e-9 V, left out)
#   reset loss    x 0.998 in the tick after a spike: 0.002
#   shot noise    light x is scaled by Poisson(5e4 x) / (5e4 x): 50,000 electrons a threshold
# Where v2s.py differs from what is built here: its Poisson means are cut to whole numbers, it draws shot noise of the
# light alone, and it takes off the noisy threshold. The comparator is given as 6.36e-3 / 4.75 in places: the code
# multiplies it by C, as it does V.
SCSIM: tuple[Mapping[str, Any], ...] = (
    {"name": "shot_noise", "threshold_e": 5e4},
    {"name": "prnu", "sd": 0.0577},
    {"name": "dark_current", "rate": 0.004676, "sd": 0.001822},
    {"name": "threshold_fpn", "sd": 0.0456},
    {"name": "reset_loss", "loss": 0.002},
    {"name": "comparator_noise", "sd": 0.00582},
)

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
    "vidar-scsim": Preset("spike", "SCSim (arXiv 2304.03129), v2s.py, a 250x400 Vidar at 20 kHz", SCSIM),
    "vidar-map": Preset("spike", "the sensor's own maps, named by sensor.map"),
}


def preset_names(arm: str) -> tuple[str, ...]:
    """Names of the presets of an arm, after the empty name of none."""
    return ("", *(name for name, preset in PRESETS.items() if preset.arm == arm))


def preset_effects(*names: str, map: str = "") -> list[Mapping[str, Any]]:
    """The effect tables of presets, in order; empty names give none. `map`: the file of `vidar-map`."""
    tables = [table for name in names if name for table in PRESETS[name].effects]
    return tables + ([{"name": "sensor_map", "file": map}] if map and "vidar-map" in names else [])


def sensor_effects(name: str) -> list[Effect]:
    """The effects of a spike camera's preset, and the random phase that any has.

    Raises:
        UsageError: no such preset, or one that needs a map.
    """
    if name not in preset_names("spike")[1:] or name == "vidar-map":
        known = [n for n in preset_names("spike")[1:] if n != "vidar-map"]
        raise UsageError("no such sensor preset", value=name, expected=", ".join(known))
    faults = Faults(f"preset {name}")
    found = read_effects([*PRESETS[name].effects, "initial_phase"], faults)
    faults.raise_any()
    return list(found.values())
