"""Small drawings as inline SVG, without scripts or links: histograms, bars by name, cameras from two sides."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.scene import View

Floats = NDArray[np.float64]
SIDE, RIM = 420, 26  # px of a camera plot, and free rim
DOTS = 500  # points drawn
PATH = 24.0  # px that the usual path over an exposure is drawn long
STYLE = (
    "svg{background:#fafafa;border:1px solid #ddd}svg text{font:11px sans-serif;fill:#333}"
    ".train{fill:#2a6fb0;stroke:#2a6fb0}.test{fill:#fff;stroke:#d07000}.way{fill:none;stroke:#bbb}"
    ".dot{fill:#999;fill-opacity:.5}.sub{fill:none;stroke:#c22;stroke-width:2}.bar{fill:#47a}.bad{fill:#c22}"
)


@dataclass(frozen=True, slots=True)
class Spot:
    """A camera on a plot: its name, cam_from_world [3,4], "train" or "test", centres of its path [K,3] or None."""

    name: str
    pose: Floats
    split: str
    path: Floats | None = None

    @property
    def centre(self) -> Floats:
        """Where it stands."""
        return -self.pose[:, :3].T @ self.pose[:, 3]


def spot_of(view: View) -> Spot:
    """A view's camera."""
    path = view.trajectory
    centres = None if path is None else np.stack([-m[:, :3].T @ m[:, 3] for m in path.poses])
    return Spot(view.name, view.pose.cam_from_world, view.split, centres)


def histogram(values: Sequence[float], label: str, *, bound: float | None = None, bins: int = 24) -> str:
    """How often values occur, from 0 to what holds 98 % of them (the last bar has the others).

    Args:
        values: finite ones are counted.
        label: under the axis, with the unit.
        bound: drawn as a line, e.g. where a result is refused.
        bins: bars.
    """
    at = np.array([v for v in values if np.isfinite(v)], np.float64)
    if not at.size:
        return f"<p>{html.escape(label)}: none.</p>"
    top = max(float(np.percentile(at, 98)) * 1.05, 1.15 * (bound or 0.0), 1e-9)
    counts, edges = np.histogram(np.clip(at, 0, top), bins, (0, top))
    most, width, height = max(int(counts.max()), 1), 16, 100
    parts = []
    for k, n in enumerate(counts):
        tall = height * n / most
        kind = "bad" if bound is not None and edges[k] >= bound else "bar"
        parts.append(_rect(kind, RIM + k * width, 10 + height - tall, width - 2, tall, f"{n} of {at.size}"))
    wide, base = RIM + bins * width, 10 + height
    if bound is not None:
        x = RIM + bins * width * bound / top
        parts.append(f'<line x1="{x:.1f}" y1="6" x2="{x:.1f}" y2="{base}" stroke="#c22" stroke-dasharray="4 3"/>')
    parts += [_text(RIM, base + 14, "0"), _text(wide - 34, base + 14, f"{top:.3g}"),
              _text(RIM + 40, base + 30, f"{label}; median {np.median(at):.3g}, most {at.max():.3g}"),
              _text(2, 18, str(most))]  # fmt: skip
    return _svg(wide + RIM, base + 38, parts)


def bars(values: Mapping[str, float], label: str, *, most: int = 120, high_is_bad: bool = True) -> str:
    """A bar for each name, in the order given; a name shows when the mouse rests on its bar.

    Values over twice the median are red where `high_is_bad`, else those under half of it.

    Edges:
        Of more than `most` names the first are drawn, and the label says so.
    """
    shown = [(n, v) for n, v in values.items() if np.isfinite(v)][:most]
    if not shown:
        return f"<p>{html.escape(label)}: none.</p>"
    top = max(max(v for _, v in shown), 1e-9)
    width, height = max(4, min(16, 600 // len(shown))), 100
    usual = float(np.median([v for _, v in shown]))
    parts = []
    for k, (name, v) in enumerate(shown):
        tall = height * max(v, 0.0) / top
        kind = "bad" if (v > 2 * usual if high_is_bad else v < usual / 2) else "bar"
        parts.append(_rect(kind, RIM + k * width, 10 + height - tall, width - 1, tall, f"{name}: {v:.3g}"))
    more = "" if len(shown) == len(values) else f"; {len(shown)} of {len(values)} shown"
    parts += [_text(2, 18, f"{top:.3g}"), _text(RIM, 126, f"{label}; median {usual:.3g}{more}")]
    return _svg(max(RIM + len(shown) * width, 330) + RIM, 134, parts)


def camera_plots(spots: Sequence[Spot], points: Floats | None = None) -> str:
    """Cameras from above and from the side, to one scale: where they look, the way from one to the next, their paths.

    Args:
        spots: cameras in the order of the scene.
        points: float64[N,3] of its surface; some are drawn as dots.
    """
    if not spots:
        return "<p>No cameras.</p>"
    across, ahead, up = axes_of(np.stack([s.pose for s in spots]))
    above = _plot(spots, points, np.stack([across, ahead]), "from above")
    return above + _plot(spots, points, np.stack([across, -up]), "from the side")


def axes_of(poses: Floats) -> tuple[Floats, Floats, Floats]:
    """A frame to draw poses [N,3,4] in: (across, ahead, up) float64[3] each.

    Up is the normal of the plane that the cameras stand in, where they stand in one and it is near their mean upward;
    else that itself; of cameras that roll, the axis along which they spread least.
    """
    upward = -poses[:, 1, :3].mean(0)
    centres = np.stack([-p[:, :3].T @ p[:, 3] for p in poses])
    _, spread, axes = np.linalg.svd(centres - centres.mean(0), full_matrices=True)
    normal = axes[2] * (1 if axes[2] @ upward >= 0 else -1)
    rolls = np.linalg.norm(upward) < 0.3
    flat = len(spread) == 3 and spread[2] < 0.2 * spread[1] and normal @ upward > 0.7 * np.linalg.norm(upward)
    up = normal if rolls or flat else upward / np.linalg.norm(upward)
    forward = poses[:, 2, :3].mean(0)
    for sideways in (np.cross(forward, up), np.cross([1.0, 0, 0], up), np.cross([0, 1.0, 0], up)):
        if np.linalg.norm(sideways) > 0.1:
            break
    across = sideways / np.linalg.norm(sideways)
    return across, np.asarray(np.cross(up, across), np.float64), up


def _plot(spots: Sequence[Spot], points: Floats | None, plane: Floats, label: str) -> str:
    at = np.stack([s.centre for s in spots]) @ plane.T
    dots = _some(points) @ plane.T if points is not None and len(points) else np.zeros((0, 2))
    low, high = at.min(0), at.max(0)
    if len(dots):
        low, high = np.minimum(low, np.percentile(dots, 3, 0)), np.maximum(high, np.percentile(dots, 97, 0))
    size = max(float((high - low).max()), 1e-9)
    scale = (SIDE - 2 * RIM) / size
    middle = (low + high) / 2

    def px(p: Floats) -> Floats:
        q = (p - middle) * scale
        return np.stack(
            [SIDE / 2 + q[..., 0], SIDE / 2 - q[..., 1] if label == "from above" else SIDE / 2 + q[..., 1]], -1
        )

    larger = _larger(spots, scale)
    parts = [f'<circle class="dot" cx="{x:.1f}" cy="{y:.1f}" r="1.3"/>' for x, y in px(dots)
             if 0 < x < SIDE and 0 < y < SIDE]  # fmt: skip
    parts.append(_line("way", px(at)))
    flip = np.array([1, -1.0]) if label == "from above" else np.array([1, 1.0])
    for spot, (x, y) in zip(spots, px(at), strict=True):
        look = plane @ spot.pose[2, :3] * flip
        side = np.array([-look[1], look[0]]) * 0.35
        tip = np.array([x, y])
        wedge = " ".join(f"{u:.1f},{v:.1f}" for u, v in (tip, tip + 16 * (look + side), tip + 16 * (look - side)))
        if spot.path is not None:
            parts.append(_line("sub", px((spot.centre + larger * (spot.path - spot.centre)) @ plane.T)))
        parts.append(f'<g class="{_split(spot)}"><title>{html.escape(spot.name)}</title>')
        parts.append(f'<polygon points="{wedge}" fill-opacity=".15"/><circle cx="{x:.1f}" cy="{y:.1f}" r="3"/></g>')
    for k in sorted({0, len(spots) // 2, len(spots) - 1}):
        x, y = px(at[k])
        parts.append(_text(x + 5, y - 5, spots[k].name[:24]))
    shown = f"; paths {larger:.0f} times as large" if larger > 1 else ""
    parts.append(_text(8, 16, f"{label}; {size:.3g} across{shown}"))
    return _svg(SIDE, SIDE, parts)


def _larger(spots: Sequence[Spot], scale: float) -> float:
    """How much to magnify paths about their cameras so that the usual one is PATH px long; at least 1."""
    lengths = [float(np.linalg.norm(np.ptp(s.path, axis=0))) for s in spots if s.path is not None]
    usual = float(np.median(lengths)) * scale if lengths else 0.0
    return max(1.0, float(np.round(PATH / usual))) if usual > 1e-6 else 1.0


def _some(points: Floats) -> Floats:
    return points[:: max(1, len(points) // DOTS)]


def _split(spot: Spot) -> str:
    return "test" if spot.split == "test" else "train"


def _line(kind: str, at: Floats) -> str:
    return f'<polyline class="{kind}" points="{" ".join(f"{x:.1f},{y:.1f}" for x, y in at)}"/>'


def _rect(kind: str, x: float, y: float, width: float, height: float, title: str) -> str:
    return (f'<rect class="{kind}" x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}">'
            f"<title>{html.escape(title)}</title></rect>")  # fmt: skip


def _text(x: float, y: float, text: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}">{html.escape(text)}</text>'


def _svg(width: float, height: float, parts: Sequence[str]) -> str:
    return (f'<svg width="{width:.0f}" height="{height:.0f}" '
            f'viewBox="0 0 {width:.0f} {height:.0f}">' + "".join(parts) + "</svg>")  # fmt: skip
