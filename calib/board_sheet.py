"""A calibration at a glance: where the corners lay, how the boards tilted, what hangs on each view, how sure it is."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spikerig.calib.bundle import Sight
from spikerig.calib.measure import Measured
from spikerig.dataset.errors import UsageError
from spikerig.dataset.outfile import whole_file

WIDE = 300  # px of a panel
RINGS = (20, 40, 60)  # degrees
STYLE = (
    "body{font:14px sans-serif;margin:2em;max-width:70em}table{border-collapse:collapse;margin-right:3em;float:left}"
    "td,th{padding:.1em .8em;text-align:left}td{text-align:right}"
)


def write_sheet(path: Path, measured: Measured, document: Mapping[str, Any], *, force: bool = False) -> None:
    """Write the maps of a calibration, and as HTML its parameters too.

    Args:
        path: ends in .html or .svg.
        measured: what came of it.
        document: its report.
        force: replace an existing file.
    """
    kind = path.suffix.lower()
    if kind not in (".html", ".svg"):
        raise UsageError("a sheet is written as .html or .svg", value=path)
    picture = maps(measured, document)
    with whole_file(path, force=force) as part:
        part.write_text(picture if kind == ".svg" else page(picture, document), encoding="utf-8")


def maps(measured: Measured, document: Mapping[str, Any]) -> str:
    """Coverage of both arms, tilts, and how far the crop moves without each view, side by side as one SVG."""
    shown = [_coverage("spike", measured.seen.spike), _coverage("RGB", measured.seen.rgb), _tilts(document["views"]),
             _stability(document["views"])]  # fmt: skip
    parts = [f"<g transform='translate({k * (WIDE + 30) + 10},25)'>{part}</g>" for k, part in enumerate(shown)]
    return (
        f"<svg xmlns='http://www.w3.org/2000/svg' width='{len(shown) * (WIDE + 30)}' height='{WIDE + 40}' "
        f"font-family='sans-serif' font-size='11'><rect width='100%' height='100%' fill='white'/>"
        f"{''.join(parts)}</svg>\n"
    )


def _coverage(label: str, sight: Sight, across: int = 5, down: int = 4) -> str:
    """The arm's picture in parts, darker where more corners lay; corners as dots."""
    from spikerig.calib.verdict import coverage

    counts, scale = coverage(sight, across, down), WIDE / max(sight.width, sight.height)
    w, h = sight.width * scale / across, sight.height * scale / down
    top = max(int(counts.max()), 1)
    cells = "".join(
        f"<rect x='{i * w:.1f}' y='{j * h:.1f}' width='{w:.1f}' height='{h:.1f}' stroke='#999' fill='#47a' "
        f"fill-opacity='{0.8 * counts[j, i] / top:.2f}'/>"
        f"<text x='{i * w + 3:.1f}' y='{j * h + 11:.1f}'>{counts[j, i]}</text>"
        for j in range(down) for i in range(across)
    )  # fmt: skip
    dots = "".join(f"<circle cx='{x:.1f}' cy='{y:.1f}' r='0.9' fill='#a33'/>" for x, y in sight.px[sight.seen] * scale)
    return f"<text y='-8'>corners in the {label} picture</text>{cells}{dots}"


def _tilts(views: Sequence[Mapping[str, Any]]) -> str:
    """Where each board's normal leaned, as seen from the spike arm."""
    middle, per = WIDE / 2, WIDE / 2 / RINGS[-1]
    rings = "".join(
        f"<circle cx='{middle}' cy='{middle}' r='{d * per:.1f}' fill='none' stroke='#bbb'/>"
        f"<text x='{middle + 2}' y='{middle - d * per + 11:.1f}' fill='#777'>{d} deg</text>"
        for d in RINGS
    )
    dots = "".join(
        f"<circle cx='{middle + x * per:.1f}' cy='{middle + y * per:.1f}' r='4' fill='{_colour(v)}'>"
        f"<title>{html.escape(v['name'])}</title></circle>"
        for v in views if v.get("tilt_deg") is not None for x, y in [np.clip(v["tilt_deg"], -RINGS[-1], RINGS[-1])]
    )  # fmt: skip
    return f"<text y='-8'>tilt of each board, right and down</text>{rings}{dots}"


def _stability(views: Sequence[Mapping[str, Any]]) -> str:
    """A bar a view: how far the crop moves without it."""
    rows = [(v, (v.get("without_it") or {}).get("crop_moves_px")) for v in views]
    moves = [float(m) for _, m in rows if m is not None and np.isfinite(m)]
    top, high = max([*moves, 1e-9]), WIDE / max(len(rows), 1)
    bars = "".join(
        f"<rect y='{k * high:.1f}' width='{WIDE * float(m) / top:.1f}' height='{0.8 * high:.1f}' fill='{_colour(v)}' "
        f"fill-opacity='.5'/><text x='3' y='{(k + 0.6) * high:.1f}'>{html.escape(v['name'])}: {float(m):.3f} px</text>"
        for k, (v, m) in enumerate(rows) if m is not None and np.isfinite(m)
    )  # fmt: skip
    return f"<text y='-8'>how far the crop moves without the view</text>{bars}"


def _colour(view: Mapping[str, Any]) -> str:
    return "#47a" if view["used"] else "#a33"


def page(picture: str, document: Mapping[str, Any]) -> str:
    """The whole sheet as HTML: verdict, maps, parameters with both standard deviations."""
    rms = document["rms_px"]
    facts = {
        "verdict": "accepted" if document["accepted"] else "refused: " + ", ".join(document["reason_codes"]),
        "views used": f"{document['views_used']} of {document['views_given']}",
        "model": f"{document['model']}, mirrored: {document['mirrored']} ({(document['mirror'] or {}).get('arm')})",
        **{f"residual {k}, px": _number(v) for k, v in rms.items()},
        "baseline, mm": _number(document["baseline_mm"]),
    }
    said = "".join(f"<p>{html.escape(text)}</p>" for text in (*document["reasons"], *document["warnings"]))
    table = "".join(f"<tr><th>{html.escape(k)}</th><td>{html.escape(str(v))}</td></tr>" for k, v in facts.items())
    sd, scatter = document.get("sd") or {}, document.get("sd_leaving_views_out") or {}
    rows = "".join(
        f"<tr><th>{html.escape(k)}</th><td>{_number(v)}</td><td>{_number(scatter.get(k))}</td></tr>"
        for k, v in sd.items()
    )
    return (
        f"<!doctype html><meta charset=utf-8><title>Calibration</title><style>{STYLE}</style><h1>Calibration</h1>{said}"
        f"{picture}<p></p><table>{table}</table><table><tr><th>standard deviation</th><th>by residuals</th>"
        f"<th>leaving views out</th></tr>{rows}</table>\n"
    )


def _number(value: Any) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{float(value):.4g}"
