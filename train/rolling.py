"""Rolling shutters in fields of rays: every pixel's own instant, for its pose and for its textures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spikerig.dataset.scene import Floats, View
from spikerig.dataset.spikes import SpikeStream
from spikerig.dataset.texture import Texture
from spikerig.train.trajectory import sub_pose

KNOTS = 33  # poses over the read-out; straight between them, which is thousandths of a pixel off at most
SAME_TICKS = 4.0  # pixels read within so many ticks of each other share a texture


def late_of(view: View) -> NDArray[np.float32] | None:
    """How much later than the middle row each pixel was exposed, in exposures: float32[H,W], 0 where not valid.

    Edges: None where all rows are exposed at once, where no time passes (exposure 0), or where the poses do not reach
        from the first row's exposure to the last one's (up to a knot's spacing beyond their ends they are extended).
    """
    frame, path = view.frame, view.trajectory
    if frame.row_ns == 0 or frame.exposure_ns == 0 or path is None or len(path.at_ns) < 2:
        return None
    late = (view.sensor_row.astype(np.float64) - view.middle_row) * (frame.row_ns / frame.exposure_ns)
    late = np.where(view.valid, late, 0).astype(np.float32)
    times = path.at_ns.astype(np.float64)
    first, last = (view.instant_ns(phase) for phase in (float(late.min()), 1 + float(late.max())))
    reaches = first >= 2 * times[0] - times[1] and last <= 2 * times[-1] - times[-2]
    return late if reaches else None


def row_poses(view: View, phase: float, late: NDArray[np.float32]) -> Floats:
    """Poses [KNOTS,3,4] at a phase of the exposures of the first pixel read to the last, evenly in time."""
    return np.stack([sub_pose(view, phase + each) for each in np.linspace(late.min(), late.max(), KNOTS)])


def poses_at(poses: Tensor, late: Tensor | None, pixels: Tensor) -> Tensor:
    """The pose [B,3,4] of each pixel int64[B], from those of `row_poses` [K,3,4] (or [3,4] for all) and late [H,W].

    Edges: rotations between knots are blended as matrices: 1e-7 from orthonormal where a knot's step turns 1e-3 rad.
    """
    if poses.ndim == 2 or late is None:
        return poses.expand(len(pixels), 3, 4)
    low, high = late.aminmax()
    at = (late.reshape(-1)[pixels] - low) / (high - low).clamp(min=1e-12) * (len(poses) - 1)
    knot = at.long().clamp(0, len(poses) - 2)
    return torch.lerp(poses[knot], poses[knot + 1], (at - knot)[:, None, None].to(poses.dtype))


def textures_by_row(
    stream: SpikeStream,
    late: NDArray[np.float32],
    tick_of: Callable[[float], float],
    make: Callable[[SpikeStream, float], list[Texture]],
    *,
    whole: bool,
) -> list[Texture]:
    """Textures in which every pixel is of its own instant.

    Args:
        stream: of the view.
        late: of `late_of`.
        tick_of: lateness -> tick.
        make: (stream, tick) -> the textures of an instant, always as many.
        whole: hand `make` the whole stream, as it moves pixels between rows; else just the rows that are needed.

    Cost: about that of one instant where rows are read alone, of read-out / SAME_TICKS instants else.
    """
    low, span = float(late.min()), float(late.max() - late.min())
    groups = max(1, round(abs(tick_of(low + span) - tick_of(low)) / SAME_TICKS))
    group = np.rint((late - low) / max(span, 1e-12) * groups).astype(int)
    light: list[NDArray[np.float32]] = []
    known: list[NDArray[np.bool_]] = []
    names: list[str] = []
    for g in np.unique(group):
        here = group == g
        rows = np.flatnonzero(here.any(1))
        a, b = (0, len(late)) if whole else (int(rows[0]), int(rows[-1]) + 1)
        part = stream if whole else replace(stream, bits=np.ascontiguousarray(stream.bits[:, a:b]))
        found = make(part, tick_of(low + span * g / groups))
        if not names:
            names = [f"{each.method}-rows" for each in found]
            light, known = (
                [np.zeros(late.shape, np.float32) for _ in found],
                [np.zeros(late.shape, bool) for _ in found],
            )
        for k, each in enumerate(found):
            light[k][a:b][here[a:b]], known[k][a:b][here[a:b]] = each.light[here[a:b]], each.known[here[a:b]]
    return [Texture(a, b, tick_of(0.0), name) for a, b, name in zip(light, known, names, strict=True)]
