"""BRISQUE through OpenCV's contrib module, with the model files that the user gives."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, HostError, UsageError
from spikerig.train.sharpness import flat_share, luma

FEATURES, LEAST = 36, 16  # numbers a picture; smallest side: half of it must still hold a 7x7 window
MOSTLY_FLAT = 0.5  # share of flat squares above which a score is flagged
LARGEST = 64 << 20  # bytes of a model file


@dataclass(frozen=True, slots=True)
class Score:
    """A score, None where it would mean nothing, and why."""

    value: float | None
    remark: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Brisque:
    """A loaded judge; `about` says which implementation and files."""

    judge: Any
    about: dict[str, Any]

    def __call__(self, codes: NDArray[np.uint8]) -> Score:
        """Score of uint8[H,W,3] sRGB codes, 0 good to 100 bad (OpenCV clips to that).

        Edges:
            A picture whose 8x8 squares are all flat, or with a side under 16 pixels, has no score: its statistics are
            those of rounding. More than half flat: a score and a remark. 0 and 100 themselves: clipped, remarked.
        """
        share = flat_share(luma(codes))
        if min(codes.shape[:2]) < LEAST:
            return Score(None, f"smaller than {LEAST}x{LEAST}")
        if share >= 1:
            return Score(None, "flat: BRISQUE means nothing here")
        value = float(self.judge.compute(np.ascontiguousarray(codes[:, :, ::-1]))[0])
        if not np.isfinite(value):
            return Score(None, "OpenCV gave no finite score")
        remark = f"{share:.0%} of it is flat: not to be trusted" if share > MOSTLY_FLAT else ""
        if value in (0.0, 100.0):
            remark = "; ".join(filter(None, (remark, "at the end of the scale, clipped by OpenCV")))
        return Score(value, remark)


def open_brisque(model: Path, ranges: Path) -> Brisque:
    """OpenCV's BRISQUE with a model (SVM) and the ranges of its features, as opencv_contrib's samples have them.

    Raises:
        DataError: files that are missing or not what they should be; all that is wrong with both.
        HostError: this OpenCV has no quality module.
    """
    import cv2

    from spikerig.train.record import scene_hash

    if not hasattr(cv2, "quality"):
        raise HostError("this OpenCV has no BRISQUE", next="pip install opencv-contrib-python-headless")
    faults = [f for f in (_model_fault(model), _range_fault(ranges)) if f]
    if faults:
        raise DataError(
            "BRISQUE's model files cannot be used",
            value="; ".join(faults),
            expected="brisque_model_live.yml and brisque_range_live.yml of opencv_contrib/modules/quality/samples",
        )
    try:
        judge = cv2.quality.QualityBRISQUE_create(  # pyright: ignore[reportAttributeAccessIssue]
            str(model), str(ranges)
        )
    except cv2.error as error:
        raise DataError("OpenCV refuses BRISQUE's model", value=model, cause=str(error)) from error
    hashes = {"model_sha256": scene_hash(model), "range_sha256": scene_hash(ranges)}
    return Brisque(judge, {"implementation": f"OpenCV {cv2.__version__} cv2.quality.QualityBRISQUE", **hashes})


def _open(path: Path) -> Any:
    import cv2

    if not path.is_file():
        raise UsageError("not a file")
    if path.stat().st_size > LARGEST:
        raise UsageError("too large")
    with path.open("rb") as file:
        if not file.read(5) == b"%YAML":
            raise UsageError("not OpenCV's YAML")
    return cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)


def _why(error: Exception) -> str:
    told = getattr(error, "what", None) or getattr(error, "err", None) or str(error)
    return " ".join(str(told).split())[:200]


def _model_fault(path: Path) -> str:
    import cv2

    try:
        storage = _open(path)  # its nodes live no longer than it
        node = storage.getNode("opencv_ml_svm")
        if node.empty():
            return f"{path}: holds no SVM"
        width, vectors = node.getNode("var_count").real(), node.getNode("support_vectors")
        rows = vectors.size()
        if width != FEATURES or rows < 1 or node.getNode("sv_total").real() != rows:
            return f"{path}: an SVM of {width:g} features and {rows} vectors, not of {FEATURES}"
        if any(vectors.at(k).size() != FEATURES for k in range(rows)):
            return f"{path}: a support vector is not {FEATURES} numbers"
    except (UsageError, cv2.error, OSError, SystemError) as error:
        return f"{path}: {_why(error)}"
    return ""


def _range_fault(path: Path) -> str:
    import cv2

    try:
        storage = _open(path)
        found = storage.getNode("range").mat()
    except (UsageError, cv2.error, OSError, SystemError) as error:
        return f"{path}: {_why(error)}"
    if found is None or found.shape != (2, FEATURES) or found.dtype != np.float32 or not np.isfinite(found).all():
        return f"{path}: no finite 'range' of 2 x {FEATURES} floats"
    return ""
