"""Results in the layout of nerfbaselines 1.2.12, so that its readers and tables take them.

    DIR/predictions/color/NAME.png      renders        DIR/predictions/gt-color/NAME.png   what they are held against
    DIR/predictions/info.json           what was run   DIR/results.json                    metrics and hashes

The hashes are nerfbaselines' own: SHA-256 over the bytes of the PNG files in the order of their names, and over the
metrics' values. `evaluate_version` and `nb_version` name spikerig, because nerfbaselines itself did not run.
"""

from __future__ import annotations

import base64
import hashlib
import struct
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import UsageError
from spikerig.train import metrics
from spikerig.train.judges import Judge

LAYOUT = "nerfbaselines 1.2.12, results.json"
DIGITS = 5  # of the averaged metrics
Picture = tuple[str, NDArray[np.uint8], NDArray[np.uint8]]  # name, prediction, truth


def encode(values: Sequence[float]) -> str:
    """float32 little endian, base64: one metric's values in the order of the pictures' names."""
    return base64.b64encode(struct.pack(f"<{len(values)}f", *values)).decode("ascii")


def metrics_hash(values: Mapping[str, Sequence[float]]) -> str:
    """nerfbaselines' hash: over names in order, and each one's values sorted."""
    digest = hashlib.sha256()
    for name in sorted(values):
        digest.update(name.lower().encode() + encode(sorted(values[name])).encode() + b"\n")
    return digest.hexdigest()


def files_hash(folder: Path) -> str:
    """SHA-256 over the bytes of a folder's files in the order of their paths."""
    digest = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def measure(prediction: NDArray[np.uint8], truth: NDArray[np.uint8], lpips: Judge | None) -> dict[str, float]:
    """Its metrics of one picture: PSNR, SSIM (dm_pix's), MAE, MSE, and LPIPS where weights are given."""
    x, y = metrics.as_float(prediction), metrics.as_float(truth)
    found = {
        "psnr": metrics.psnr(prediction, truth),
        "ssim": metrics.ssim(prediction, truth, "tf"),
        "mae": float(np.mean(np.abs(x - y))),
        "mse": float(np.mean((x - y) ** 2)),
    }
    if lpips is not None:
        found["lpips_vgg" if "VGG" in lpips.about["network"] else "lpips"] = lpips(prediction, truth)
    return found


def write_results(out: Path, pictures: Sequence[Picture], about: Mapping[str, Any], lpips: Judge | None) -> Path:
    """Write predictions and results.json.

    Args:
        out: a folder without either.
        pictures: of the held-out views.
        about: method, scene, dataset, steps, seconds, seed, checkpoint_sha256, background (three of 0..255), config.
        lpips: a judge, or None: then the key is absent, as it is for readers of nerfbaselines.

    Returns:
        The path of results.json.

    Raises:
        UsageError: there are results already.
    """
    from spikerig.dataset.images import write_image
    from spikerig.train.record import write_json

    predictions = out / "predictions"
    if predictions.exists() or (out / "results.json").exists():
        raise UsageError("there are results already", value=out, next="give another folder")
    pictures = sorted(pictures, key=lambda p: f"{p[0]}.png")  # as files sort
    lists: dict[str, list[float]] = {}
    for name, prediction, truth in pictures:
        for kind, codes in (("color", prediction), ("gt-color", truth)):
            (predictions / kind).mkdir(parents=True, exist_ok=True)
            write_image(predictions / kind / f"{name}.png", codes)
        for key, value in measure(prediction, truth, lpips).items():
            lists.setdefault(key, []).append(value)
    info = _info(about)
    write_json(predictions / "info.json", info)
    write_json(out / "results.json", _results(predictions, info, lists))
    return out / "results.json"


def _version() -> str:
    return f"spikerig {metadata.version('spikerig')}"


def _now() -> str:
    return datetime.now(UTC).replace(tzinfo=None).isoformat(timespec="seconds")


def _info(about: Mapping[str, Any]) -> dict[str, Any]:
    scene = {
        "id": about["dataset"],
        "scene": about["scene"],
        "color_space": "srgb",
        "background_color": about["background"],
        "evaluation_protocol": "default",
        "type": None,
    }
    return {
        "method": about["method"],
        "nb_version": _version(),
        "num_iterations": about["steps"],
        "total_train_time": about["seconds"],
        "resources_utilization": {},
        "config_overrides": about["config"],
        "dataset_metadata": scene,
        "evaluation_protocol": "default",
        "checkpoint_sha256": about["checkpoint_sha256"],
        "render_version": _version(),
        "render_datetime": _now(),
        "render_dataset_metadata": scene,
    }


def _results(predictions: Path, info: dict[str, Any], lists: Mapping[str, Sequence[float]]) -> dict[str, Any]:
    inner = dict(info)
    render = {key: inner.pop(key) for key in ("render_datetime", "render_version", "render_dataset_metadata")}
    return {
        **render,
        "nb_info": inner,
        "evaluate_datetime": _now(),
        "evaluate_version": _version(),
        "metrics": {k: round(float(np.mean(v)), DIGITS) for k, v in lists.items()},
        "metrics_raw": {k: encode(v) for k, v in lists.items()},
        "metrics_sha256": metrics_hash(lists),
        "predictions_sha256": files_hash(predictions / "color"),
        "ground_truth_sha256": files_hash(predictions / "gt-color"),
        "evaluation_protocol": "default",
        "layout": LAYOUT,
    }
