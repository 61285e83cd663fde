"""Whether a clip was recorded as it was asked for: its own header and telemetry judge, not the camera's yes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.gopro_file import GoProClip, open_gopro
from spikerig.dataset.hdf5_guard import printable
from spikerig.dataset.scene import Finding
from spikerig.rigctl.gopro_settings import in_order

_SIZES = {"1080": [1920, 1080], "1440": [1920, 1440], "2.7k": [2704, 1520], "2.7k43": [2704, 2028],
          "4k": [3840, 2160], "4k43": [4000, 3000], "5k": [5120, 2880]}  # fmt: skip
# setting -> key of the header, and what it says for each option
_TOLD: dict[str, tuple[str, dict[str, Any]]] = {
    "lens": ("VFOV", {"wide": "W", "linear": "L", "narrow": "N", "superview": "S"}),
    "hypersmooth": ("EISE", {"off": "N", "on": "Y", "high": "Y", "boost": "Y"}),
    "resolution": ("VRES", _SIZES),
    "protune": ("PRTN", {"on": "Y", "off": "N"}),
    "white_balance": ("PTWB", {"auto": "AUTO", "native": "NATIVE", "5500": "5500K", "6500": "6500K", "5000": "5000K"}),
    "colour": ("PTCL", {"gopro": "GOPRO", "flat": "FLAT"}),
    "sharpness": ("PTSH", {"high": "HIGH", "medium": "MED", "low": "LOW"}),
    "ev": ("PTEV", {"0": "0.0"}),
    "bit_rate": ("BITR", {"standard": "STANDARD", "high": "HIGH"}),
    "iso_max": ("PIMX", {str(n): n for n in (100, 200, 400, 800, 1600, 3200, 6400)}),
    "iso_min": ("PIMN", {str(n): n for n in (100, 200, 400, 800, 1600, 3200, 6400)}),
}
_GRAVE = {"lens", "hypersmooth", "resolution", "fps"}  # they change the geometry or the clock
_EXPOSURE, _ISO = 0.05, 0.06  # tolerated relative error


def verify_clip(settings: Mapping[str, Any], clip: GoProClip | str | Path) -> list[Finding]:
    """What of a clip is not as it was asked for.

    Args:
        settings: names and options of gopro_settings.py; those that `settle` reported, or a plan's.
        clip: as read, or the path of its first chapter.

    Returns:
        Findings, grave ones first: "critical" where geometry or timing is spoiled, "violation" where the light or the
        picture is other than asked, "suggestion" where the file does not tell. Empty: all is as asked.

    Raises:
        UsageError, DataError: as `in_order` and `open_gopro`.
    """
    read = clip if isinstance(clip, GoProClip) else open_gopro(clip)
    wanted = {setting.name: option for setting, option, _ in in_order(settings)}
    where = read.paths[0].name
    found = [Finding(check, kind, where, message, fix) for check, kind, message, fix in _all(wanted, read)]
    order = ("critical", "violation", "suggestion")
    return sorted(found, key=lambda f: order.index(f.importance))


def clip_findings(settings: Mapping[str, Any], paths: Sequence[Path]) -> list[dict[str, Any]]:
    """`verify_clip` of a recording just fetched, JSON-ready; a clip that cannot be read is a finding, too."""
    try:
        found = verify_clip(settings, open_gopro(paths))
    except (DataError, UsageError) as error:
        where = paths[0].name if paths else "clip"
        found = [Finding("read", "critical", where, f"{error.what}: {error.value}", "take the viewpoint again")]
    return [asdict(f) for f in found]


def _all(wanted: Mapping[str, str], clip: GoProClip) -> Iterator[tuple[str, str, str, str]]:
    yield from _timing(clip)
    for name, (key, words) in _TOLD.items():
        if name in wanted and wanted[name] in words:
            yield from _said(name, key, words[wanted[name]], clip)
    if "fps" in wanted and not _near(clip.fps, float(wanted["fps"]), 0.002):
        yield "fps", "critical", f"{clip.fps:.6g} frames a second, {wanted['fps']} were asked for", _again("fps")
    if wanted.get("shutter", "auto") != "auto" and clip.exposure_ns is not None:
        yield from _shutter(1 / float(wanted["shutter"].partition("/")[2]), clip)
    if clip.iso is not None and "iso_max" in wanted and "iso_min" in wanted:
        low, high = float(clip.iso.min()), float(clip.iso.max())
        if low < (1 - _ISO) * float(wanted["iso_min"]) or high > (1 + _ISO) * float(wanted["iso_max"]):
            asked = f"{wanted['iso_min']} to {wanted['iso_max']}"
            yield "iso", "violation", f"gain ran from ISO {low:g} to {high:g}, {asked} were asked for", _again("ISO")
    codec = {"avc": "avc1", "hevc": "hvc1"}.get(wanted.get("codec", ""))
    if codec and clip.codec != codec:
        yield "codec", "suggestion", f"the pictures are {printable(clip.codec)}, {codec} was asked for", ""


def _timing(clip: GoProClip) -> Iterator[tuple[str, str, str, str]]:
    if clip.time_source != "CORI":
        yield (
            "stamps",
            "critical",
            "the clip has no stamps of its frames",
            "is it the original file of a HERO8 or later?",
        )
    if clip.srot_ms is None:
        yield (
            "readout",
            "critical",
            "the clip does not tell its read-out time (SROT)",
            "solve for it with the LED panel",
        )
    elif clip.srot_ms > 1e3 / clip.fps:
        yield "readout", "critical", f"a read-out of {clip.srot_ms:.4g} ms at {clip.fps:.5g} frames a second", ""
    if clip.exposure_ns is None:
        yield "exposure", "critical", "the clip does not tell its exposures (SHUT)", ""
    if lost := int(np.abs(clip.skipped).sum()):
        at = np.flatnonzero(clip.skipped)[:5].tolist()
        yield "skipped", "violation", f"{lost} frames lost or repeated in the camera, at {at}", "a faster card"


def _said(name: str, key: str, wanted: Any, clip: GoProClip) -> Iterator[tuple[str, str, str, str]]:
    told = clip.settings.get(key)
    if isinstance(told, list) and len(told) == 1:
        told = told[0]
    if told is None:
        yield name, "suggestion", f"the file does not tell {name} ({key})", "look at the camera's screen"
    elif told != wanted:
        kind = "critical" if name in _GRAVE else "violation"
        yield name, kind, f"the file says {key} {printable(told)!r}, {name} should make it {wanted!r}", _again(name)


def _shutter(wanted_s: float, clip: GoProClip) -> Iterator[tuple[str, str, str, str]]:
    seconds = np.asarray(clip.exposure_ns) / 1e9
    low, high = float(seconds.min()), float(seconds.max())
    if low < (1 - _EXPOSURE) * wanted_s or high > (1 + _EXPOSURE) * wanted_s:
        message = f"exposures ran from 1/{1 / low:.0f} to 1/{1 / high:.0f} s, 1/{1 / wanted_s:.0f} s was asked for"
        yield "shutter", "violation", message, _again("shutter")


def _near(a: float, b: float, share: float) -> bool:
    return abs(a - b) <= share * b


def _again(name: str) -> str:
    return f"set {name} on the camera's own screen (Protune), then record again"
