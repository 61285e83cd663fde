"""The contact sheet of a completed scene: pictures of every view, cameras, and how far things are off.

One HTML file without scripts or anything outside it; what comes from the scene file is escaped.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.agree import edge_agreement
from spikerig.calib.aligned_scene import WORST_PX
from spikerig.calib.arms import Arms, arms_of
from spikerig.calib.overlay import overlay
from spikerig.calib.plots import STYLE as PLOT_STYLE
from spikerig.calib.plots import Spot, bars, camera_plots, histogram, spot_of
from spikerig.dataset.check_look import SceneLook, Undecided, ViewLook
from spikerig.dataset.errors import RigError
from spikerig.dataset.images import srgb8_from_linear
from spikerig.dataset.outfile import refuse_existing, whole_file
from spikerig.dataset.store import open_scene

Pixels = NDArray[np.uint8]
BYTES = 9_000_000  # of the whole file, about; pictures are made smaller to fit
LEAST_PX = 48  # width below which a picture is not made smaller
CAMERAS = "Filled: to train on; hollow: held out; red: the path over an exposure, magnified; grey dots: points."
WINDOW = 32  # ticks of the TFP shown
STYLE = (
    "body{font:14px sans-serif;margin:2em;max-width:120em}table{border-collapse:collapse}td,th{padding:.2em .6em;"
    "text-align:left;vertical-align:top}.views img{width:20em;image-rendering:auto}.plots svg{margin:.3em}" + PLOT_STYLE
)


def write_sheet(
    scene: Path, out: Path, *, force: bool = False, done: Callable[[], object] = lambda: None, limit: int = BYTES
) -> dict[str, Any]:
    """Write the contact sheet of a scene file.

    Args:
        scene: the file.
        out: the .html to write, whole or not at all.
        force: replace `out`.
        done: called after each view.
        limit: bytes, about; pictures are made smaller until they fit.

    Returns:
        What was made, JSON-ready: out, bytes, views, how many could not be compared and why.

    Cost:
        0.2 s a view at 400x250; holds one view and the pictures made.
    """
    refuse_existing(out, force)
    with open_scene(scene) as file:
        look = SceneLook(file)
        budget = limit // max(len(look.names), 1)
        rows, spots, edges, amiss = [], [], {}, {}
        for name in look.names:
            view = ViewLook(look, name)
            pictures, apart, why = _pictures(view)
            rows.append(_row(view, _fitted(pictures, budget), apart, why))
            spots.append(spot_of(view.view))
            if np.isfinite(apart):
                edges[name] = apart
            if why:
                amiss[name] = why
            done()
        text = page(look, rows, spots, edges)
    with whole_file(out, force=force) as part:
        part.write_text(text, encoding="utf-8")
    return {"out": str(out), "bytes": out.stat().st_size, "views": len(rows), "not_compared": amiss}


def _pictures(look: ViewLook) -> tuple[dict[str, Pixels], float, str]:
    """The pictures of a view by label, how far its edges lie apart (NaN: not known), and why spikes are not shown."""
    pictures = {"RGB": np.array(look.frame.pixels8)}
    try:
        arms = arms_of(look)
    except (Undecided, RigError) as why:
        return pictures, float("nan"), why.what if isinstance(why, RigError) else str(why)
    both = arms.aligned(look.view.valid)
    apart = edge_agreement(both.texture.light, both.light.mean(2), both.valid & both.texture.known).rms_px
    pictures |= _textures(arms)
    pictures |= {"overlay: RGB red, spikes cyan": overlay(both, "red-cyan"), "overlay: tiles": overlay(both, "mix")}
    return pictures, apart, ""


def _textures(arms: Arms) -> dict[str, Pixels]:
    made = {f"TFP, {WINDOW} ticks": arms.tfp(WINDOW), "TFI": arms.tfi()}
    return {label: _gray(np.where(t.known, t.light, 0)) for label, t in made.items()}


def _gray(light: NDArray[np.float32]) -> Pixels:
    top = float(np.percentile(light, 99))
    return srgb8_from_linear(np.clip(light / (top or 1.0), 0, 1))


def _fitted(pictures: Mapping[str, Pixels], budget: int) -> dict[str, bytes]:
    """PNG data of some pictures, made smaller until their base64 text fits a number of bytes."""
    import cv2

    share = 1.0
    while True:
        data = {}
        for label, pixels in pictures.items():
            height, width = pixels.shape[:2]
            size = (max(1, round(width * share)), max(1, round(height * share)))
            small = pixels if share == 1 else cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
            turned = np.ascontiguousarray(small[..., ::-1] if small.ndim == 3 else small)
            data[label] = cv2.imencode(".png", turned, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()
        total = sum(len(d) for d in data.values()) * 4 / 3 + 1000
        widest = max(p.shape[1] for p in pictures.values())
        if total <= budget or widest * share <= LEAST_PX:
            return data
        share = max(share * min(0.95, 0.97 * (budget / total) ** 0.5), LEAST_PX / widest * 0.999)


def _row(look: ViewLook, pictures: Mapping[str, bytes], apart: float, why: str) -> str:
    record = _table(look.scene.info.get("poses"))
    told = [look.view.split, f"exposed {look.frame.exposure_ns / 1e6:.3g} ms"]
    told += [f"edges {apart:.2f} px apart"] if np.isfinite(apart) else []
    told += [f"residual {v:.2f} px" for v in _numbers(record.get("residual_px"), look.name)]
    told += [f"{v:.0f} observations" for v in _numbers(record.get("observations"), look.name)]
    told += [f"no textures: {why}"] if why else []
    cells = "".join(
        f'<td>{html.escape(label)}<br><img alt="" src="data:image/png;base64,{base64.b64encode(data).decode()}"></td>'
        for label, data in pictures.items()
    )
    return f"<tr><th>{html.escape(look.name)}<br>{'<br>'.join(html.escape(t) for t in told)}</th>{cells}</tr>"


def page(look: SceneLook, rows: list[str], spots: list[Spot], edges: Mapping[str, float]) -> str:
    """The page, of rows already made.

    Args:
        look: the scene.
        rows: HTML of its views.
        spots: its cameras.
        edges: how far both arms' edges lie apart, px, by view.
    """
    record = _table(look.info.get("poses"))
    facts = "".join(f"<tr><th>{html.escape(k)}</th><td>{html.escape(v)}</td></tr>" for k, v in _facts(look).items())
    residual = {n: v for n in look.names for v in _numbers(record.get("residual_px"), n)}
    seen = {n: v for n in look.names for v in _numbers(record.get("observations"), n)}
    points = look.points
    plots = [
        f"<h2>Cameras</h2><p>{CAMERAS}</p>",
        camera_plots(spots, None if points is None else points.xyz),
        "<h2>Residuals</h2>",
        histogram(list(edges.values()), "edges of both arms apart, px, by view", bound=WORST_PX),
        histogram(list(residual.values()), "mean reprojection error, px, by view"),
        _binned(record.get("point_residuals")),
        bars(residual, "mean reprojection error, px, view by view"),
        bars(seen, "observations in the map, view by view", high_is_bad=False),
    ]
    title = html.escape(f"{look.file.name}: views and cameras")
    head = f"<!doctype html><meta charset=utf-8><title>{title}</title><style>{STYLE}</style>"
    body = [f"<h1>{title}</h1><table>{facts}</table>", f"<div class=plots>{''.join(plots)}</div>", "<h2>Views</h2>"]
    return "\n".join([head, *body, "<table class=views>", *rows, "</table>"]) + "\n"


def _facts(look: SceneLook) -> dict[str, str]:
    align, poses = (_table(look.info.get(key)) for key in ("align", "poses"))
    facts = {
        "size": f"{look.camera.width}x{look.camera.height}",
        "views": f"{len(look.train)} to train on, {len(look.test)} held out",
        "points": "none" if look.points is None else f"{len(look.points.xyz)}, {look.points.source}",
        "aligned by": str(align.get("calibration", "not aligned, or made aligned"))[:16] + _forced(align),
        "poses": _posed(poses) if poses else "as given",
        "textures mapped": _short(poses.get("kinds")) if poses else "",
        "made with": _short(poses.get("versions")) if poses else "",
    }
    return {k: v for k, v in facts.items() if v}


def _posed(record: Mapping[str, Any]) -> str:
    placed = f"{_short(record.get('registered'))} of {_short(record.get('images'))} placed"
    return f"{placed}, mean residual {_short(record.get('error_px'))} px{_forced(record)}"


def _forced(record: Mapping[str, Any]) -> str:
    return ", REFUSED AND FORCED" if record.get("forced") else ""


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, dict):
        return ", ".join(f"{k} {v}" for k, v in list(value.items())[:8])[:200]
    return (", ".join(map(str, value[:8])) if isinstance(value, list) else str(value))[:200]


def _table(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _numbers(table: Any, name: str) -> list[float]:
    """The number of a view in a record that somebody else may have written; empty where there is none."""
    value = _table(table).get(name)
    return [float(value)] if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e9 else []


def _binned(record: Any) -> str:
    """Residuals of the map's points, from percentiles kept in the record."""
    values = record if isinstance(record, list) else []
    clean = [float(v) for v in values[:2000] if isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < 1e9]
    return histogram(clean, "residuals of the map's points, px (200 quantiles)") if clean else ""
