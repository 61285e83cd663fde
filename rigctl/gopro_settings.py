"""Settings of a HERO9: names for people, numbers for the wire, and the order that is not refused."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from spikerig.dataset.errors import UsageError


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting.

    Args:
        name: as in a plan.
        number: its id on the wire.
        options: value in a plan -> value on the wire.
        documented: in GoPro's own table for the HERO9; else known from its firmware only: tried, and checked in
            the file.
    """

    name: str
    number: int
    options: Mapping[str, int]
    documented: bool = True


_ISO = {"6400": 0, "3200": 3, "1600": 1, "800": 4, "400": 2, "200": 7, "100": 8}
# In the order of setting: what a later one may choose depends on the earlier ones (403 otherwise).
SETTINGS: tuple[Setting, ...] = (
    Setting("hindsight", 167, {"off": 4, "15": 2, "30": 3}),  # when on, the camera always encodes and refuses the rest
    Setting("auto_off", 59, {"never": 0, "5": 4, "15": 6, "30": 7}),
    Setting("max_lens", 162, {"off": 0, "on": 1}),
    Setting("anti_flicker", 134, {"60": 2, "50": 3}),
    Setting("lens", 121, {
        "wide": 0, "linear": 4, "narrow": 2, "superview": 3, "max_superview": 7, "linear_horizon": 8}),
    Setting("resolution", 2, {"1080": 9, "1440": 7, "2.7k": 4, "2.7k43": 6, "4k": 1, "4k43": 18, "5k": 24}),
    Setting("fps", 3, {"240": 0, "200": 13, "120": 1, "100": 2, "60": 5, "50": 6, "30": 8, "25": 9, "24": 10}),
    Setting("hypersmooth", 135, {"off": 0, "on": 1, "high": 2, "boost": 3}),
    Setting("gps", 83, {"off": 0, "on": 1}),
    Setting("protune", 114, {"off": 0, "on": 1}, False),
    Setting("shutter", 145, {
        "auto": 0, "1/120": 13, "1/240": 18, "1/480": 22, "1/960": 23, "1/1920": 24, "1/3840": 31}, False),
    Setting("iso_max", 13, _ISO, False),
    Setting("iso_min", 102, _ISO, False),
    Setting("white_balance", 115, {"auto": 0, "native": 4, "5500": 2, "6500": 3, "5000": 12}, False),
    Setting("colour", 116, {"gopro": 0, "flat": 1}, False),
    Setting("sharpness", 117, {"high": 0, "medium": 1, "low": 2}, False),
    Setting("ev", 118, {"0": 4}, False),
    Setting("bit_rate", 124, {"standard": 0, "high": 1}, False),
    Setting("codec", 106, {"avc": 0, "hevc": 1}, False),
)  # fmt: skip
BY_NAME = {s.name: s for s in SETTINGS}
BY_NUMBER = {s.number: s for s in SETTINGS}

#: What the rig records with: no in-camera dewarp or stabilisation (undistortion is ours), nothing left to the camera.
DEFAULTS: dict[str, str] = {
    "hindsight": "off", "auto_off": "never", "max_lens": "off", "anti_flicker": "60", "lens": "wide",
    "resolution": "1080", "fps": "120", "hypersmooth": "off", "gps": "off", "protune": "on", "shutter": "1/480",
    "iso_max": "400", "iso_min": "400", "white_balance": "5500", "colour": "flat", "sharpness": "low", "ev": "0",
    "bit_rate": "high", "codec": "avc",
}  # fmt: skip


def in_order(wanted: Mapping[str, Any]) -> list[tuple[Setting, str, int]]:
    """(setting, option, its number) for all that is wanted, in the order of setting.

    Raises:
        UsageError: unknown names or options, all at once.
    """
    wrong = [f"no setting {name!r}" for name in wanted if name not in BY_NAME]
    chosen = []
    for setting in SETTINGS:
        if setting.name not in wanted:
            continue
        option = str(wanted[setting.name]).strip().lower()
        if option not in setting.options:
            wrong.append(f"{setting.name} = {option!r}: one of {', '.join(setting.options)}")
        else:
            chosen.append((setting, option, setting.options[option]))
    if wrong:
        raise UsageError("the camera has no such settings", value="; ".join(wrong), expected=", ".join(BY_NAME))
    return chosen


def option_name(number: int, value: int) -> str:
    """The name of an option of a setting by their numbers; the bare number where it has none."""
    setting = BY_NUMBER.get(number)
    names = {v: k for k, v in setting.options.items()} if setting else {}
    return names.get(value, str(value))
