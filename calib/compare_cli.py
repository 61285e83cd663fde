"""`spikerig calib compare`: how far apart two calibrations of a rig are, in pixels and degrees."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from spikerig.dataset.errors import UsageError
from spikerig.dataset.info_cli import Json
from spikerig.dataset.terminal import emit, note

if TYPE_CHECKING:
    from spikerig.calib.rig import RigCalibration

ACROSS, DOWN = 17, 11  # points of the spike picture at which crops are compared


def compare(
    first: Annotated[Path, typer.Argument(help="A calibration (.json).")],
    second: Annotated[Path, typer.Argument(help="Another of the same rig: an earlier one, or the simulator's truth.")],
    depth_mm: Annotated[float | None, typer.Option(help="Of the scene, for a stereo rig; default the boards'.")] = None,
    as_json: Json = False,
) -> None:
    """Compare two calibrations of a rig: was it touched in between; how good is one against the truth."""
    from spikerig.calib.rig import read_calibration

    told = apart(read_calibration(first), read_calibration(second), depth_mm)
    told = {"first": str(first), "second": str(second), **told}
    if as_json:
        emit("spikerig.calib.compare/1", told)
    crop, focal, turn = told["crop_px"], told["focal_ratio"], told["turn_deg"]
    note(
        f"crops lie {crop['median']:.3f} px apart (median), {crop['max']:.3f} at most; the first focal length is "
        f"{focal['spike']:.5f} (spike) and {focal['rgb']:.5f} (rgb) times the second; arms turned by {turn:.4f} "
        f"degrees and {told['shift_mm']:.3f} mm against each other"
    )


def apart(a: RigCalibration, b: RigCalibration, depth_mm: float | None = None) -> dict[str, Any]:
    """How far apart two calibrations of a rig are, JSON-ready.

    Args:
        a, b: of the same sensors.
        depth_mm: of the crop of a stereo rig; None: b's working depth.

    Returns:
        `crop_px`: where a raw spike pixel lies in the raw RGB picture by b, brought back by a: median and largest
        distance over the spike picture. `lens_px`: the same for directions of the spike lens alone. Focal lengths of a
        over those of b, the angle between their steps, the distance of their shifts.

    Raises:
        UsageError: the sensors differ in size.
    """
    from spikerig.calib.crop import grid, rgb_px_from_spike_px, spike_px_from_rgb_px, working_depth_mm
    from spikerig.calib.lens import directions, project

    sizes = [[(c.width, c.height) for c in (r.spike, r.rgb)] for r in (a, b)]
    if sizes[0] != sizes[1]:
        raise UsageError("the calibrations are of other sensors", value=sizes)
    depth = working_depth_mm(b) if depth_mm is None else depth_mm
    here = grid(b.spike.width, b.spike.height, ACROSS, DOWN)
    back = spike_px_from_rgb_px(a, rgb_px_from_spike_px(b, here, depth), depth)
    through = project(a.spike, directions(b.spike, here))
    R = a.spike_from_rgb.cam_from_world[:, :3] @ b.spike_from_rgb.cam_from_world[:, :3].T
    sine = np.linalg.norm(R - R.T) / (2 * np.sqrt(2))
    shift = a.spike_from_rgb.cam_from_world[:, 3] - b.spike_from_rgb.cam_from_world[:, 3]
    return {
        "crop_px": _spread(back - here),
        "lens_px": _spread(through - here),
        "focal_ratio": {arm: float(a.camera(arm).K[0, 0] / b.camera(arm).K[0, 0]) for arm in ("spike", "rgb")},
        "turn_deg": float(np.degrees(np.arctan2(sine, (np.trace(R) - 1) / 2))),
        "shift_mm": float(np.linalg.norm(shift)),
        "same_mirror": a.mirrored == b.mirrored,
        "models": [a.model, b.model],
    }


def _spread(off: np.ndarray) -> dict[str, float | None]:
    """Median and largest length of vectors [...,2]; None where none is known."""
    length = np.linalg.norm(off, axis=-1)
    known = length[np.isfinite(length)]
    return (
        {"median": float(np.median(known)), "max": float(known.max())} if known.size else {"median": None, "max": None}
    )
