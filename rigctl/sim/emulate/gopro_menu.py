"""What an emulated HERO9 lets be set: its options, which depend on each other, and what its clips then look like."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

RESOLUTION, FPS, LENS, HYPERSMOOTH, FLICKER, HINDSIGHT = 2, 3, 121, 135, 134, 167
PROTUNE, SHUTTER, ISO_MAX, ISO_MIN, WHITE, COLOUR, SHARPNESS, RATE, CODEC = 114, 145, 13, 102, 115, 116, 117, 124, 106
_SIZES = {9: (1920, 1080), 7: (1920, 1440), 4: (2704, 1520), 6: (2704, 2028), 1: (3840, 2160), 18: (4000, 3000),
          24: (5120, 2880)}  # fmt: skip
_MOST = {9: 240, 7: 120, 4: 120, 6: 60, 1: 60, 18: 30, 24: 30}  # frames a second by resolution
_RATES = {0: 240, 13: 200, 1: 120, 2: 100, 5: 60, 6: 50, 8: 30, 9: 25, 10: 24}
_BY_RATE = {v: k for k, v in _RATES.items()}
_LENSES = {0: "W", 4: "L", 2: "N", 3: "S", 7: "M", 8: "H"}
_SHUTTERS = {13: 120, 18: 240, 22: 480, 23: 960, 24: 1920, 31: 3840}
_ISO = {8: 100, 7: 200, 2: 400, 4: 800, 1: 1600, 3: 3200, 0: 6400}
_WHITE = {0: "AUTO", 4: "NATIVE", 2: "5500K", 3: "6500K", 12: "5000K"}

FACTORY: dict[int, int] = {
    RESOLUTION: 4, FPS: 8, LENS: 4, HYPERSMOOTH: 2, FLICKER: 3, HINDSIGHT: 4, 59: 4, 83: 1, 162: 0,
    PROTUNE: 0, SHUTTER: 0, ISO_MAX: 1, ISO_MIN: 8, WHITE: 0, COLOUR: 0, SHARPNESS: 1, 118: 4, RATE: 0, CODEC: 1,
}  # fmt: skip
_CHOICES: dict[int, set[int]] = {
    RESOLUTION: set(_SIZES), FPS: set(_RATES), LENS: set(_LENSES), HYPERSMOOTH: {0, 1, 2, 3}, FLICKER: {2, 3},
    HINDSIGHT: {2, 3, 4}, 59: {0, 4, 6, 7}, 83: {0, 1}, 162: {0, 1}, PROTUNE: {0, 1}, SHUTTER: {0, *_SHUTTERS},
    ISO_MAX: set(_ISO), ISO_MIN: set(_ISO), WHITE: set(_WHITE), COLOUR: {0, 1}, SHARPNESS: {0, 1, 2}, 118: {4},
    RATE: {0, 1}, CODEC: {0, 1},
}  # fmt: skip
UNDOCUMENTED = {PROTUNE, SHUTTER, ISO_MAX, ISO_MIN, WHITE, COLOUR, SHARPNESS, 118, RATE, CODEC}


@dataclass(frozen=True, slots=True)
class No:
    """A refusal: GoPro's error number of a 403, and the options that it would take."""

    error: int
    supported: tuple[int, ...] = ()


def take(settings: dict[int, int], number: int, option: int) -> No | None:
    """Set one in place, with what follows from it; or say why not. Later settings depend on earlier ones."""
    if number not in _CHOICES:
        return No(2)
    if option not in _CHOICES[number]:
        return No(4, tuple(sorted(_CHOICES[number])))
    offered = available(settings, number)
    if option not in offered:
        return No(3, tuple(sorted(offered)))
    settings[number] = option
    if number in (RESOLUTION, FLICKER):  # the camera changes the frame rate by itself where it must
        rates = sorted(_RATES[o] for o in available(settings, FPS))
        now = _RATES[settings[FPS]]
        settings[FPS] = _BY_RATE[max((r for r in rates if r <= now), default=rates[0])]
    if settings[HYPERSMOOTH] not in available(settings, HYPERSMOOTH):
        settings[HYPERSMOOTH] = 1
    return None


def available(settings: dict[int, int], number: int) -> set[int]:
    """The options of a setting that the settings before it leave."""
    if number == FPS:
        beat = {240, 120, 60, 30, 24} if settings[FLICKER] == 2 else {200, 100, 50, 25, 24}
        most = min(_MOST[settings[RESOLUTION]], 120 if settings[LENS] in (3, 7) else 240)
        return {_BY_RATE[r] for r in beat if r <= most}
    if number == HYPERSMOOTH:
        return {0, 1, 2, 3} if _RATES[settings[FPS]] <= 60 else {0, 1, 2}
    if number == RESOLUTION and settings[LENS] in (3, 7):
        return {9, 4, 1}
    return _CHOICES[number]


def rate(settings: dict[int, int]) -> Fraction:
    """Frames a second: at 60 Hz those of NTSC."""
    nominal = _RATES[settings[FPS]]
    return Fraction(nominal * 1000, 1001) if settings[FLICKER] == 2 or nominal == 24 else Fraction(nominal)


def size(settings: dict[int, int]) -> tuple[int, int]:
    """Width and height of the picture."""
    return _SIZES[settings[RESOLUTION]]


def exposure_s(settings: dict[int, int]) -> float | None:
    """The locked exposure; None: the camera chooses."""
    locked = settings[PROTUNE] and settings[SHUTTER]
    return 1 / _SHUTTERS[settings[SHUTTER]] if locked else None


def header(settings: dict[int, int]) -> dict[str, Any]:
    """What the settings look like in a clip's header."""
    protune = bool(settings[PROTUNE])
    fps = rate(settings)
    return {
        "PRTN": "Y" if protune else "N",
        "PTWB": _WHITE[settings[WHITE]] if protune else "AUTO",
        "PTCL": "FLAT" if protune and settings[COLOUR] else "GOPRO",
        "PTSH": ("HIGH", "MED", "LOW")[settings[SHARPNESS]] if protune else "MED",
        "EXPT": f"1/{_SHUTTERS[settings[SHUTTER]]}" if exposure_s(settings) else "AUTO",
        "PIMX": _ISO[settings[ISO_MAX]] if protune else 1600,
        "PIMN": _ISO[settings[ISO_MIN]] if protune else 100,
        "VFOV": _LENSES[settings[LENS]],
        "EISE": "Y" if settings[HYPERSMOOTH] else "N",
        "EISA": ("N/A", "HS Low", "HS High", "HS Boost")[settings[HYPERSMOOTH]],
        "VRES": list(size(settings)),
        "VFPS": [fps.numerator, fps.denominator],
        "BITR": "HIGH" if protune and settings[RATE] else "STANDARD",
    }
