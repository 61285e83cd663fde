"""A contact sheet of an alignment: every view at a glance, in one HTML file without anything outside it."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.agree import Agreement
from spikerig.calib.align import Aligned, Warp, rows_of_spike_px, warp_texture
from spikerig.calib.aligned_scene import WORST_PX
from spikerig.calib.overlay import overlay
from spikerig.calib.plots import STYLE as PLOT_STYLE
from spikerig.calib.plots import Spot, camera_plots, histogram
from spikerig.calib.rig import RigCalibration
from spikerig.calib.rolling import tfp_rows
from spikerig.dataset.images import srgb8_from_linear
from spikerig.dataset.scene import View
from spikerig.dataset.texture import tfi

Floats = NDArray[np.float64]
STYLE = (
    "body{font:14px sans-serif;margin:2em;max-width:110em}table{border-collapse:collapse}td,th{padding:.2em .6em;"
    "text-align:left;vertical-align:top}img{image-rendering:pixelated;width:22em}" + PLOT_STYLE
)


@dataclass(frozen=True, slots=True)
class Row:
    """One view on the sheet: pictures as PNG data, and how far its edges lie apart."""

    name: str
    pictures: dict[str, bytes]
    agreement: Agreement


def row_of(name: str, aligned: Aligned, agreement: Agreement, sharp: dict[str, NDArray[np.float32]]) -> Row:
    """Encode a view's pictures at once, so that a sheet of many views holds no arrays; `sharp`: textures by name."""
    pictures = {"RGB": _png(srgb8_from_linear(aligned.light))}
    pictures |= {label: _png(_gray(light)) for label, light in {"exposure": aligned.texture.light, **sharp}.items()}
    pictures |= {kind: _png(overlay(aligned, kind)) for kind in ("mix", "red-cyan")}
    return Row(name, pictures, agreement)


def sharp_textures(view: View, calibration: RigCalibration, warp: Warp) -> dict[str, NDArray[np.float32]]:
    """TFP and TFI at mid-exposure on the aligned camera: what an operator looks at for sharpness."""
    if view.spikes is None:
        return {}
    rows = rows_of_spike_px(calibration)
    at = float(np.clip(view.spikes.tick_at(view.mid_ns), 0, view.spikes.ticks))
    made = {"TFP, 32 ticks": tfp_rows(view.spikes, view.frame, rows, 0.5, 32), "TFI": tfi(view.spikes, at)}
    return {name: warp_texture(warp, texture).light for name, texture in made.items()}


def _gray(light: NDArray[np.float32]) -> NDArray[np.uint8]:
    top = float(np.percentile(light, 99))
    return np.repeat(srgb8_from_linear(np.clip(light / (top or 1.0), 0, 1))[..., None], 3, 2)


def _png(pixels: NDArray[np.uint8]) -> bytes:
    import cv2

    return cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]))[1].tobytes()


def page(title: str, calibration: RigCalibration, rows: Sequence[Row], spots: Sequence[Spot]) -> str:
    """The page.

    Args:
        title: of the scene; escaped here.
        calibration: of its rig.
        rows: views.
        spots: the cameras of all views.
    """
    said = [r.agreement.rms_px for r in rows if np.isfinite(r.agreement.rms_px)]
    facts = {
        "calibration": calibration.id[:16],
        "model": calibration.model + (f", {calibration.mirrored} arm mirrored" if calibration.mirrored else ""),
        "baseline": f"{calibration.baseline_mm:.3f} mm",
        "board residual": f"{calibration.residual_px:.3f} px",
        "crop known to": f"{calibration.sd.get('crop_px', float('nan')):.3f} px",
        "edges apart, median of views": f"{np.median(said):.3f} px" if said else "no edges",
        "forced": ", ".join(calibration.forced) or "no",
    }
    table = "".join(f"<tr><th>{html.escape(k)}</th><td>{html.escape(v)}</td></tr>" for k, v in facts.items())
    parts = [
        f"<!doctype html><meta charset=utf-8><title>{html.escape(title)}</title><style>{STYLE}</style>",
        f"<h1>{html.escape(title)}</h1><table>{table}</table>",
        f"<h2>Edges apart</h2>{histogram(said, 'px, by view', bound=WORST_PX)}",
        f"<h2>Cameras</h2>{camera_plots(spots)}<h2>Views</h2><table>",
    ]
    for r in rows:
        cells = "".join(
            f"<td>{html.escape(label)}<br><img src='data:image/png;base64,{base64.b64encode(data).decode()}'></td>"
            for label, data in r.pictures.items()
        )
        parts.append(f"<tr><th>{html.escape(r.name)}<br>{r.agreement.rms_px:.2f} px</th>{cells}</tr>")
    return "\n".join([*parts, "</table>"]) + "\n"
