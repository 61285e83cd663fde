"""The whole of `spikerig calib photometric`: recordings of an even field to maps, response and what to know of them."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spikerig.calib.photometric import Level, count_level, flat_field, smooth_part
from spikerig.calib.response import Response, fit_response, rgb_mean
from spikerig.calib.shots import Reading, files_in, open_reading, pair_up
from spikerig.dataset.errors import UsageError
from spikerig.dataset.flat import FlatField
from spikerig.dataset.images import SUFFIXES, linear_from_srgb, read_image

CURVE = 0.03  # a curve whose slope is off 1 by more than this is not sRGB


@dataclass(frozen=True, slots=True)
class Even:
    """What came of it: the maps, the response (None without RGB pictures), the report."""

    flat: FlatField
    response: Response | None
    report: dict[str, Any]

    @staticmethod
    def hash_of(path: Path) -> str:
        """SHA-256 (hex) of a file."""
        return hashlib.sha256(path.read_bytes()).hexdigest()


def measure_even(
    spike_dir: Path, rgb_dir: Path | None, dark: Sequence[Path], lux: Sequence[float] | None, reading: Reading
) -> Even:
    """Read the recordings and fit them.

    Args:
        spike_dir: spike files, one a level.
        rgb_dir: pictures of the same levels, or None.
        dark: spike files with the cap on.
        lux: light of the levels in natural order, where known.
        reading: layout of raw files.

    Raises:
        UsageError, DataError: as `flat_field`, `fit_response`, `pair_up`.
    """
    if rgb_dir is None:
        spikes, pictures = files_in(spike_dir), []
    else:
        pairs, _ = pair_up(spike_dir, rgb_dir)
        spikes, pictures = [p.spike for p in pairs], [p.rgb for p in pairs]
    wrong = [p.name for p in spikes if p.suffix.lower() in SUFFIXES]
    if wrong:
        raise UsageError("levels of light are spike files, not pictures", value=", ".join(wrong[:5]))
    levels = [_count(p, reading) for p in spikes]
    flat, report = flat_field(levels, [_count(p, reading) for p in dark], lux)
    warnings = _warnings(report)
    response = None
    if pictures:
        read = [read_image(p)[:, :, :3] for p in pictures]
        read = [np.repeat(p, 3, axis=2) if p.shape[2] == 1 else p for p in read]
        means = [rgb_mean(p) for p in read]
        light = np.array([row["light"] for row in report["levels"]])
        response = fit_response(np.stack([m for m, _ in means]), light, [fits for _, fits in means])
        brightest = read[int(np.argmax([m.sum() if fits else -1 for m, fits in means]))]
        luma = linear_from_srgb(brightest).mean(2, dtype=np.float64)
        smooth = smooth_part(luma / max(luma.mean(), 1e-12), np.ones(luma.shape, bool))
        h, w = luma.shape
        report["falloff_rgb"] = 1 - float(smooth[[0, 0, -1, -1], [0, -1, 0, -1]].mean() / smooth[h // 2, w // 2])
        if abs(response.curve - 1) > CURVE and not abs(response.curve - 1) < 3 * response.curve_sd:
            power = 1 / response.curve
            warnings.append(f"the RGB pictures are not sRGB: their light goes as the spikes' to the power {power:.3f}")
        if not all(response.used):
            warnings.append("left out of the response, black or clipped: " + ", ".join(
                p.name for p, used in zip(pictures, response.used, strict=True) if not used))  # fmt: skip
    report |= {
        "split_ratio": None if response is None else response.split_ratio,
        "response": None if response is None else response.response,
        "response_residual": None if response is None else response.residual,
        "curve": None if response is None else response.curve,
        "warnings": warnings,
    }
    return Even(flat, response, report)


def _count(path: Path, reading: Reading) -> Level:
    with open_reading(path, reading) as file:
        return count_level(re.sub(r"[^\w.\-]", "_", path.name), file)


def _warnings(report: dict[str, Any]) -> list[str]:
    found = []
    if not report["dark_rate"]["measured"]:
        found.append("no recording in the dark: the dark rate is what the fit leaves at no light")
    short = [row["name"] for row in report["levels"] if row["light"] * row["ticks"] < 1000]
    if short:
        found.append(f"fewer than 1000 spikes a pixel, so that counting alone scatters: {', '.join(short)}")
    full = [row["name"] for row in report["levels"] if row["saturated"] > 0.01]
    if full:
        found.append(f"partly saturated, left out there: {', '.join(full)}")
    return found
