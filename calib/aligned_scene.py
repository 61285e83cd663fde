"""A raw scene becomes an aligned one: every frame on the spike arm's pinhole camera, spikes as they were."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.agree import Agreement, ecc_refinement, edge_agreement
from spikerig.calib.align import (
    Aligned,
    Region,
    Warp,
    coded_like,
    linear_of,
    pair,
    rows_of_spike_px,
    warp_light,
    warp_of,
    without,
)
from spikerig.calib.crop import grid
from spikerig.calib.regions import blinking_regions
from spikerig.calib.rig import RigCalibration, as_json
from spikerig.calib.rolling import exposure_texture
from spikerig.dataset.errors import RefusedError, UsageError
from spikerig.dataset.flat import FlatField, flattened
from spikerig.dataset.outfile import refuse_existing, stand_in
from spikerig.dataset.scene import Truth, View
from spikerig.dataset.store import SceneFile, open_scene
from spikerig.dataset.texture import Texture

Floats = NDArray[np.float64]
WORST_PX = 0.5  # median over views of how far edges lie apart, above which an alignment is refused


@dataclass(frozen=True, slots=True)
class Wish:
    """How to align: depth and regions as in `warp_of`; `refine` takes a small common error out by ECC; `flat` evens
    the sensor out before edges are compared; `find_panel` leaves blinking lamps out, view by view."""

    depth_mm: float | None = None
    regions: tuple[Region, ...] = ()
    refine: bool = False
    flat: FlatField | None = None
    find_panel: bool = False


@dataclass(frozen=True, slots=True)
class Checked:
    """A planned alignment: the warp, how well each view's edges agree, the refinement taken (None: none), and the
    regions of each view that blink."""

    warp: Warp
    agreement: dict[str, Agreement]
    refinement: Floats | None
    panels: dict[str, tuple[Region, ...]]

    def warp_of(self, name: str) -> Warp:
        """The warp of one view, its blinking regions left out."""
        return without(self.warp, self.panels.get(name, ()))

    @property
    def median_px(self) -> float:
        """Over the views whose edges say something; NaN where none does."""
        said = [a.rms_px for a in self.agreement.values() if np.isfinite(a.rms_px)]
        return float(np.median(said)) if said else float("nan")


def check_alignment(
    scene: SceneFile,
    calibration: RigCalibration,
    wish: Wish,
    done: Callable[[View, Aligned, Warp, Agreement], object] = lambda *told: None,
) -> Checked:
    """Plan the alignment of a scene and hold both arms' edges against each other in every view with spikes.

    Args:
        scene: raw: frames as the RGB camera saw them.
        calibration: of its rig.
        wish: options.
        done: called with each view, aligned, the warp, and how its edges agree.

    Raises:
        DataError: sizes that are not the calibration's.
        RefusedError: a refinement was asked for and would move too far.
    """
    warp = warp_of(calibration, depth_mm=wish.depth_mm, regions=wish.regions)
    refinement = None
    if wish.refine:
        refinement = _refinement(scene, calibration, warp, wish)
        warp = warp_of(calibration, depth_mm=wish.depth_mm, regions=wish.regions, refinement=refinement)
    checked = Checked(warp, {}, refinement, {})
    for name in scene.names:
        view = scene.view(name)
        if view.spikes is not None:
            if wish.find_panel:
                checked.panels[name] = blinking_regions(view.spikes)
            own = checked.warp_of(name)
            told = pair(view, calibration, warp=own, texture=_texture(view, calibration, wish))
            agreement = edge_agreement(told.texture.light, told.light.mean(2), told.valid & told.texture.known)
            checked.agreement[name] = agreement
            done(view, told, own, agreement)
    return checked


def _texture(view: View, calibration: RigCalibration, wish: Wish) -> Texture:
    if view.spikes is None:
        raise UsageError("the view has no spikes to align", value=view.name)
    texture = exposure_texture(view.spikes, view.frame, rows_of_spike_px(calibration))
    return texture if wish.flat is None else flattened(texture, wish.flat)


def _refinement(scene: SceneFile, calibration: RigCalibration, warp: Warp, wish: Wish) -> Floats:
    """The median over views of where ECC puts a grid of pixels, as one homography for the rig."""
    import cv2

    at = grid(warp.camera.width, warp.camera.height, 3, 3).reshape(-1, 2)
    moved = []
    for name in scene.names:
        view = scene.view(name)
        if view.spikes is None:
            continue
        told = pair(view, calibration, warp=warp, texture=_texture(view, calibration, wish))
        try:
            H, _ = ecc_refinement(told.texture.light, told.light.mean(2), told.valid & told.texture.known)
        except RefusedError:
            continue
        p = np.concatenate([at, np.ones((len(at), 1))], 1) @ H.T
        moved.append(p[:, :2] / p[:, 2:])
    if 2 * len(moved) <= sum(scene.view(n, spikes=False).split == "train" for n in scene.names):
        raise RefusedError("too few views could be brought together for a refinement", value=len(moved))
    H, _ = cv2.findHomography(at, np.median(moved, axis=0))
    return np.asarray(H, np.float64)


def write_aligned(
    path: Path,
    calibration: RigCalibration,
    checked: Checked,
    provenance: dict[str, Any],
    *,
    out: Path | None = None,
    force: bool = False,
    done: Callable[[], object] = lambda: None,
) -> dict[str, Any]:
    """Write the aligned scene beside the raw one; it takes its place, or that of `out`, when it is whole.

    Args:
        path: of the raw scene.
        calibration, checked: as planned.
        provenance: recorded as info.align.
        out: another file; None replaces `path`.
        force: replace `out`.
        done: called after each view.

    Returns:
        What was done, JSON-ready.

    Edges:
        True light on another camera than the aligned one is left out; true paths stay.
    """
    from spikerig.dataset.store import SceneWriter

    target = out or path
    if out is not None:
        refuse_existing(out, force)
    with open_scene(path) as scene, stand_in(target, "align") as beside:
        same = same_camera(scene, checked.warp)
        truth = scene.truth
        if truth is not None and not same:
            truth = replace(truth, light={})
        with SceneWriter(
            beside, scene.name, checked.warp.camera, light_gain=calibration.split_ratio or scene.light_gain,
            info={**scene.info, "align": provenance}, points=scene.points, clock=scene.clock,
            calibration={**as_json(calibration), "id": calibration.id}, truth=truth, keep=False,
        ) as writer:  # fmt: skip
            for name in scene.names:
                warp = checked.warp_of(name)
                writer.add(_aligned_view(scene.view(name), warp), **_truth(scene, name, truth, same))
                done()
    return {"written": str(target), "true_light_kept": bool(same and scene.has_truth)}


def same_camera(scene: SceneFile, warp: Warp) -> bool:
    """Whether the scene's camera is the aligned one, so that what lies on its pixels stays there."""
    a, b = scene.camera, warp.camera
    return (
        (a.width, a.height) == (b.width, b.height) and not a.distortion.any() and bool(np.allclose(a.K, b.K, atol=1e-3))
    )


def _aligned_view(view: View, warp: Warp) -> View:
    light = np.where(warp.valid[..., None], warp_light(warp, linear_of(view.frame)), 0)
    frame = replace(view.frame, pixels=coded_like(view.frame, light))
    rows = np.where(warp.valid, warp.sensor_row, 0)
    return replace(view, frame=frame, sensor_row=rows, valid=warp.valid)


def _truth(scene: SceneFile, name: str, truth: Truth | None, same: bool) -> dict[str, Any]:
    """What is true of a view, as far as it still is."""
    told: dict[str, Any] = {}
    if truth is not None:
        reads = {"light": scene.truth_light, "at_ns": scene.truth_at_ns, "trajectory": scene.truth_trajectory}
        for key, read in reads.items():
            if scene.has_true(name, key) and (same or key != "light"):
                told[key] = read(name)
    if scene.has_events(name):
        told["events"] = scene.events(name)
    return told
