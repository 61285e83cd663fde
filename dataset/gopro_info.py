"""What a GoPro clip is, JSON-ready: the body of `spikerig data info FILE.MP4`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from spikerig.dataset.gopro_chapter import Samples
from spikerig.dataset.gopro_file import GoProClip, chapters, open_gopro
from spikerig.dataset.hdf5_guard import printable

SETTINGS = (
    "VRES",
    "VFPS",
    "VFOV",
    "EISE",
    "EISA",
    "PRTN",
    "PTWB",
    "PTCL",
    "PTSH",
    "PTEV",
    "EXPT",
    "PIMX",
    "PIMN",
    "BITR",
)


def describe_clip(path: Path) -> dict[str, Any]:
    """One file of a clip; `chapters` names those that lie beside it."""
    clip = open_gopro(path)
    return {
        "format": "gopro" if clip.model or clip.streams else "mp4",
        "model": printable(clip.model) or None,
        "firmware": printable(clip.firmware) or None,
        "serial": printable(clip.serial) or None,
        "width": clip.width,
        "height": clip.height,
        "codec": printable(clip.codec),
        "fps": clip.fps,
        "frames": clip.frames,
        "duration_s": clip.duration_s,
        "srot_ms": clip.srot_ms,
        "row_us": None if clip.row_ns is None else clip.row_ns / 1e3,
        "exposure_s": _exposure(clip),
        "iso": None if clip.iso is None else [float(clip.iso.min()), float(clip.iso.max())],
        "first_frame_s": float(clip.start_ns[0]) / 1e9,
        "time_source": clip.time_source,
        "skipped": int(np.abs(clip.skipped).sum()),
        "settings": {k: _plain(clip.settings[k]) for k in SETTINGS if k in clip.settings},
        "streams": {printable(key): _stream(samples) for key, samples in clip.streams.items()},
        "chapters": [printable(p.name) for p in chapters(path)],
        "remarks": [printable(r) for r in clip.remarks],
    }


def _exposure(clip: GoProClip) -> dict[str, float] | None:
    if clip.exposure_ns is None:
        return None
    seconds = clip.exposure_ns / 1e9
    return {"min": float(seconds.min()), "median": float(np.median(seconds)), "max": float(seconds.max())}


def _stream(samples: Samples) -> dict[str, Any]:
    lasting = int(samples.at_ns[-1] - samples.at_ns[0]) if len(samples.at_ns) > 1 else 0
    return {
        "name": printable(samples.name),
        "unit": printable(samples.unit),
        "samples": len(samples.values),
        "columns": samples.values.shape[1],
        "rate_hz": (len(samples.at_ns) - 1) * 1e9 / lasting if lasting > 0 else None,
    }


def _plain(value: Any) -> Any:
    return printable(value) if isinstance(value, str) else value
