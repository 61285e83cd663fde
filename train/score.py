"""How good a run is: held-out sharp views, and sharp truth at the training views' mid-exposure.

Scores at the poses as given and scores after moving each camera onto its picture (`train.realign`) are kept apart.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.scene import Floats
from spikerig.dataset.terminal import note
from spikerig.train import metrics
from spikerig.train.bridge import Bridge, Cameras, bridge, estimated_poses, stored_cameras, true_pose
from spikerig.train.field import Model
from spikerig.train.metrics import SSIM_VARIANTS, rounded
from spikerig.train.model import BACKGROUNDS, SplatModel
from spikerig.train.parts import parts_of
from spikerig.train.quality import Judges, compare, judge_alone, means
from spikerig.train.realign import STEPS, realign
from spikerig.train.targets import truth_pose
from spikerig.train.trajectory import pose_at

if TYPE_CHECKING:
    from spikerig.dataset.store import SceneFile

SHARP, STORED = "sharp truth of the simulator", "the held-out frames as stored"
AGAINST_TRUTH = ("psnr", "ssim", "luma_psnr", "chroma_psnr", "lpips")
Keep = Callable[[str, NDArray[np.uint8]], None]


@dataclass(frozen=True, slots=True)
class Exam:
    """A picture to be met: the pose [3,4] of the world, and uint8[H,W,3] sRGB codes."""

    name: str
    pose: Floats
    picture: NDArray[np.uint8]


def novel_views(scene: SceneFile) -> tuple[list[Exam], str]:
    """Held-out views and what they are scored on: sharp truth where the scene has it, else the stored frames."""
    sharp = [_exam(scene, name) for name in scene.test]
    if sharp and all(e is not None for e in sharp):
        return [e for e in sharp if e is not None], SHARP
    stored = [scene.view(name, spikes=False) for name in scene.test]
    return [Exam(v.name, v.pose.cam_from_world, _codes(v.frame.pixels8, v.frame.transfer)) for v in stored], STORED


def blur_views(scene: SceneFile) -> list[Exam]:
    """Sharp truth at the training views; empty without truth."""
    return [exam for name in scene.train if (exam := _exam(scene, name)) is not None]


def _exam(scene: SceneFile, name: str) -> Exam | None:
    from spikerig.dataset.images import srgb_from_linear

    if not scene.has_truth:
        return None
    try:
        light = scene.truth_light(name)
    except UsageError:  # this view has no truth
        return None
    view = scene.view(name, spikes=False)
    return Exam(name, truth_pose(scene, view), rounded(srgb_from_linear(np.clip(light, 0, 1))))


def bring_over(
    scene: SceneFile, novel: Sequence[Exam], blurred: Sequence[Exam], trained: Cameras | None, estimated: bool
) -> tuple[list[Exam], list[Exam], dict[str, Any] | None]:
    """Exams of a scene in the world the run was trained in, and how they came there.

    Args:
        scene: that is scored on.
        novel, blurred: its exams.
        trained: the run's training cameras; None: not known, and then poses stay as they are.
        estimated: the poses that the run was trained with are estimates.

    Returns:
        Held-out exams: at their true poses brought over, where the scene knows them. Training views: at the cameras
        that the run was trained with, where worlds differ. And a JSON-ready record, None where `trained` is.
    """
    if trained is None:
        return list(novel), list(blurred), None
    estimated = estimated or estimated_poses(scene)
    found = bridge({n: true_pose(scene, n) for n in scene.train}, trained, estimated=estimated)
    if estimated:
        novel = [replace(e, pose=_true_exam_pose(scene, e)) for e in novel]
    over = [replace(e, pose=found.pose(e.pose)) for e in novel]
    if found.to_run is not None:
        blurred = [replace(e, pose=_trained_pose(scene, e, trained, found)) for e in blurred]
    return over, list(blurred), found.as_json()


def _true_exam_pose(scene: SceneFile, exam: Exam) -> Floats:
    if not scene.has_true(exam.name, "trajectory"):
        return exam.pose
    if not scene.has_true(exam.name, "at_ns"):
        return true_pose(scene, exam.name)
    return pose_at(scene.truth_trajectory(exam.name), float(scene.truth_at_ns(exam.name)))


def _trained_pose(scene: SceneFile, exam: Exam, trained: Cameras, found: Bridge) -> Floats:
    stored, given = scene.view(exam.name, spikes=False).pose.cam_from_world, trained.get(exam.name)
    if given is None:
        return found.pose(true_pose(scene, exam.name))
    return exam.pose if np.array_equal(stored, given) else given  # the exam's goes by the stored path, to its instant


def _codes(pixels: NDArray[np.uint8], transfer: str) -> NDArray[np.uint8]:
    from spikerig.dataset.images import srgb_from_linear

    return pixels if transfer == "srgb" else rounded(srgb_from_linear(pixels / 255.0))


def grade(
    model: Model,
    exams: Sequence[Exam],
    *,
    ssim: str = "torchmetrics",
    judges: Judges | None = None,
    keep: Keep = lambda name, picture: None,
) -> dict[str, Any]:
    """Score a model: PSNR, SSIM, luma and chroma PSNR, LPIPS, each per view and then averaged over views.

    Args:
        model: to draw with.
        exams: what it should look like.
        ssim: variant, by name.
        judges: LPIPS among them, or it is null.
        keep: called with every rounded render, e.g. to write it.

    Returns:
        A JSON-ready record; `predictions_sha256` and `truth_sha256` cover names and 8-bit pixels in order. A mean is
        over the views that have a number; an infinite PSNR makes it infinite.
    """
    views, hashes = [], (hashlib.sha256(), hashlib.sha256())
    for exam in exams:
        picture = rounded(model.picture(exam.pose))
        keep(exam.name, picture)
        for digest, pixels in zip(hashes, (picture, exam.picture), strict=True):
            digest.update(exam.name.encode() + b"\0" + repr(pixels.shape).encode() + pixels.tobytes())
        row, remarks = compare(picture, exam.picture, judges or Judges(), ssim)
        views.append({"name": exam.name, **row, **({"remarks": remarks} if remarks else {})})
    return {
        **{key: _mean(v[key] for v in views) for key in AGAINST_TRUTH},
        "predictions_sha256": hashes[0].hexdigest(),
        "truth_sha256": hashes[1].hexdigest(),
        "views": views,
    }


def _mean(values: Iterable[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def grade_aligned(
    model: SplatModel, exams: Sequence[Exam], steps: int, *, ssim: str = "torchmetrics", judges: Judges | None = None
) -> dict[str, Any]:
    """The same after each camera was moved onto the picture it is scored on, and how far each moved."""
    found = [realign(model, exam.pose, exam.picture, steps) for exam in exams]
    moved = [replace(exam, pose=each.pose) for exam, each in zip(exams, found, strict=True)]
    graded = grade(model, moved, ssim=ssim, judges=judges)
    for row, each in zip(graded["views"], found, strict=True):
        row |= {"moved_deg": each.deg, "moved_px": each.px}
    how = f"each camera moved onto its own held-out picture in {steps} steps; not comparable with raw scores"
    return {**graded, "moved_px_median": float(np.median([a.px for a in found])), "how": how}


def grade_alone(model: Model, poses: Mapping[str, Floats], judges: Judges, of: str) -> dict[str, Any]:
    """What renders at poses of the model's world say of themselves: sharpness, BRISQUE, RankIQA; no truth needed."""
    views = []
    for name, pose in poses.items():
        row, remarks = judge_alone(rounded(model.picture(pose)), judges)
        views.append({"name": name, **row, "remarks": remarks})
    return {"of": of, "mean": means(views), "judges": judges.about(), "views": views}


def mean_psnr(model: Model, exams: Sequence[Exam]) -> float:
    """Held-out PSNR alone, for curves during training."""
    return float(np.mean([metrics.psnr(rounded(model.picture(e.pose)), e.picture) for e in exams]))


def score_run(
    model: Model,
    scene: SceneFile,
    *,
    ssim: str = "torchmetrics",
    judges: Judges | None = None,
    trained: Cameras | None = None,
    estimated: bool = False,
    align_steps: int | None = None,
    quality: bool = False,
    keep: Keep = lambda name, picture: None,
) -> dict[str, Any]:
    """All scores of a run, with everything named that a number depends on.

    Args:
        model: of the run.
        scene: to score on.
        ssim: variant, by name.
        judges: trained ones at hand.
        trained: the run's training cameras, [3,4] at mid-exposure by name.
        estimated: those are estimates.
        align_steps: of test-time alignment; 0: none; None: 60 where poses are estimates, else none.
        quality: measure the renders without a reference too; always done where there is no sharp truth.
        keep: called with every rounded held-out render.

    Raises:
        DataError: the scene has nothing to score against (and quality alone is not asked for).
    """
    if ssim not in SSIM_VARIANTS:
        raise UsageError("no such SSIM", value=ssim, expected=", ".join(SSIM_VARIANTS))
    check_size(model, scene)
    judges = judges or Judges()
    novel, against = novel_views(scene)
    blurred = blur_views(scene)
    if not novel and not blurred and not quality:
        raise DataError(
            "this scene has nothing to score against",
            value=scene.name,
            expected="held-out views (split test), or the sharp truth of a simulated scene",
            next="--quality measures the renders alone; or spikerig data build with held-out views",
        )
    novel, blurred, gauge = bring_over(scene, novel, blurred, trained, estimated)
    if align_steps is None:
        align_steps = STEPS if estimated or (gauge is not None and not gauge["same_world"]) else 0
    if align_steps and not isinstance(model, SplatModel):
        note(f"cameras are not aligned: the field '{model.config.field}' gives no gradient of a pose")
        align_steps = 0
    graded = grade(model, novel, ssim=ssim, judges=judges, keep=keep) if novel else None
    aligned = None
    if novel and align_steps and isinstance(model, SplatModel):
        aligned = grade_aligned(model, novel, align_steps, ssim=ssim, judges=judges)
    alone = None
    if quality or (against == STORED and not blurred):
        poses = {e.name: e.pose for e in novel} or (trained or stored_cameras(scene))
        of = "renders of the held-out views" if novel else "renders of the training views"
        alone = grade_alone(model, poses, judges, of)
    return {
        **({k: graded[k] for k in AGAINST_TRUTH} if graded else {}),
        "novel_view": {**graded, "against": against} if graded else None,
        "novel_view_aligned": {**aligned, "against": against} if aligned else None,
        "blur_view": {**grade(model, blurred, ssim=ssim, judges=judges), "against": SHARP} if blurred else None,
        "quality": alone,
        "worlds": gauge,
        "pose_label": model.config.pose_label,
        "ssim_variant": f"{ssim}: {SSIM_VARIANTS[ssim][0]}",
        "lpips_variant": judges.about()["lpips"],
        "rounding": metrics.ROUNDING,
        "background": list(BACKGROUNDS[model.config.background]),
        "remarks": [part.remark for part in parts_of(model.config) if part.remark],
        "method": model.config.method,
        "preset": model.config.preset,
        "field": model.config.field,
    }


def check_size(model: Model, scene: SceneFile) -> None:
    """Raise a DataError where a scene's pictures have another size than the run's."""
    if (scene.camera.width, scene.camera.height) != (model.camera.width, model.camera.height):
        raise DataError(
            "the scene's pictures have another size than the run's",
            value=f"{scene.camera.width}x{scene.camera.height}",
            expected=f"{model.camera.width}x{model.camera.height}",
        )
