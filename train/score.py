"""How good a run is: held-out sharp views, and sharp truth at the training views' mid-exposure."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.scene import Floats
from spikerig.train import metrics
from spikerig.train.field import Model
from spikerig.train.metrics import SSIM_VARIANTS, rounded
from spikerig.train.model import BACKGROUNDS
from spikerig.train.targets import truth_pose

if TYPE_CHECKING:
    from spikerig.dataset.store import SceneFile

SHARP, STORED = "sharp truth of the simulator", "the held-out frames as stored"


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


def _codes(pixels: NDArray[np.uint8], transfer: str) -> NDArray[np.uint8]:
    from spikerig.dataset.images import srgb_from_linear

    return pixels if transfer == "srgb" else rounded(srgb_from_linear(pixels / 255.0))


def grade(
    model: Model,
    exams: Sequence[Exam],
    *,
    ssim: str = "torchmetrics",
    keep: Callable[[str, NDArray[np.uint8]], None] = lambda name, picture: None,
) -> dict[str, Any]:
    """Score a model: PSNR, SSIM, luma and chroma PSNR, each per view and then averaged over views.

    Args:
        model: to draw with.
        exams: what it should look like.
        ssim: variant, by name.
        keep: called with every rounded render, e.g. to write it.

    Returns:
        A JSON-ready record; `predictions_sha256` and `truth_sha256` cover names and 8-bit pixels in order.
    """
    views, hashes = [], (hashlib.sha256(), hashlib.sha256())
    for exam in exams:
        picture = rounded(model.picture(exam.pose))
        keep(exam.name, picture)
        for digest, pixels in zip(hashes, (picture, exam.picture), strict=True):
            digest.update(exam.name.encode() + b"\0" + repr(pixels.shape).encode() + pixels.tobytes())
        views.append(
            {
                "name": exam.name,
                "psnr": metrics.psnr(picture, exam.picture),
                "ssim": metrics.ssim(picture, exam.picture, ssim),
                "luma_psnr": metrics.luma_psnr(picture, exam.picture),
                "chroma_psnr": metrics.chroma_psnr(picture, exam.picture),
            }
        )
    keys = ("psnr", "ssim", "luma_psnr", "chroma_psnr")
    return {
        **{key: float(np.mean([v[key] for v in views])) for key in keys},
        "predictions_sha256": hashes[0].hexdigest(),
        "truth_sha256": hashes[1].hexdigest(),
        "views": views,
    }


def mean_psnr(model: Model, exams: Sequence[Exam]) -> float:
    """Held-out PSNR alone, for curves during training."""
    return float(np.mean([metrics.psnr(rounded(model.picture(e.pose)), e.picture) for e in exams]))


def score_run(
    model: Model,
    scene: SceneFile,
    *,
    ssim: str = "torchmetrics",
    keep: Callable[[str, NDArray[np.uint8]], None] = lambda name, picture: None,
) -> dict[str, Any]:
    """Both scores of a run, with everything named that a number depends on.

    Raises:
        DataError: the scene has nothing to score against.
    """
    if ssim not in SSIM_VARIANTS:
        raise UsageError("no such SSIM", value=ssim, expected=", ".join(SSIM_VARIANTS))
    if (scene.camera.width, scene.camera.height) != (model.camera.width, model.camera.height):
        raise DataError(
            "the scene's pictures have another size than the run's",
            value=f"{scene.camera.width}x{scene.camera.height}",
            expected=f"{model.camera.width}x{model.camera.height}",
        )
    novel, against = novel_views(scene)
    blurred = blur_views(scene)
    if not novel and not blurred:
        raise DataError(
            "this scene has nothing to score against",
            value=scene.name,
            expected="held-out views (split test), or the sharp truth of a simulated scene",
            next="spikerig data build with held-out views; spikerig train render RUN shows the result to the eye",
        )
    graded = grade(model, novel, ssim=ssim, keep=keep) if novel else None
    return {
        **({k: graded[k] for k in ("psnr", "ssim", "luma_psnr", "chroma_psnr")} if graded else {}),
        "novel_view": {**graded, "against": against} if graded else None,
        "blur_view": {**grade(model, blurred, ssim=ssim), "against": SHARP} if blurred else None,
        "pose_label": model.config.pose_label,
        "ssim_variant": f"{ssim}: {SSIM_VARIANTS[ssim][0]}",
        "rounding": metrics.ROUNDING,
        "background": list(BACKGROUNDS[model.config.background]),
        "method": model.config.method,
        "preset": model.config.preset,
        "field": model.config.field,
    }
