"""The folder of a run: run.json (what was done), checkpoint.safetensors (the state), history.json (dB over seconds)."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spikerig.dataset import machine
from spikerig.dataset.errors import DataError, HostError, UsageError
from spikerig.dataset.scene import Camera
from spikerig.dataset.terminal import jsonable
from spikerig.train import checkpoint
from spikerig.train.config import FitConfig, from_json
from spikerig.train.field import Model
from spikerig.train.fields import field_of
from spikerig.train.gauge import Gauge

DIVERGED = "diverged.safetensors"  # the state before a step that left something not finite
CHECKPOINT, RECORD, HISTORY, PATHS = "checkpoint.safetensors", "run.json", "history.json", "paths.json"


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A run as stored: the model, its config, and run.json."""

    folder: Path
    model: Model
    config: FitConfig
    record: dict[str, Any]

    @property
    def scene(self) -> Path:
        """The scene file it was trained on, as it was named."""
        return Path(self.record["scene"]["path"])


def write_json(path: Path, value: Any) -> None:
    """Replace a JSON file in one step."""
    part = path.with_name(path.name + ".partial")
    try:
        part.write_text(json.dumps(jsonable(value), indent=1, allow_nan=False) + "\n", encoding="utf-8")
        os.replace(part, path)
    except OSError as error:
        raise HostError("a file of the run could not be written", value=path, cause=str(error)) from error


def read_json(path: Path) -> Any:
    """A JSON file of a run."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError("a file of the run cannot be read", value=path, cause=str(error)) from error


def prepare_folder(out: Path, *, force: bool, resume: bool) -> None:
    """Make the folder of a run; an earlier run there is continued, replaced or refused.

    Raises:
        UsageError: it holds a run and neither is wanted, or things that are no run.
    """
    files = [out / name for name in (CHECKPOINT, RECORD, HISTORY, PATHS)]
    if out.exists() and not out.is_dir():
        raise UsageError("the run's folder is a file", value=out)
    if out.is_dir() and any(out.iterdir()):
        if not any(f.exists() for f in files):
            raise UsageError("this folder holds something that is no run", value=out, next="give -o another folder")
        if not force and not resume:
            raise UsageError("there is a run already", value=out, next="--resume goes on with it, --force replaces it")
    if force and not resume:
        for file in files:
            file.unlink(missing_ok=True)
    (out / DIVERGED).unlink(missing_ok=True)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise HostError("the run's folder cannot be made", value=out, cause=str(error)) from error


def scene_hash(path: Path) -> str:
    """SHA-256 of a file, hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def camera_record(camera: Camera) -> dict[str, Any]:
    """A pinhole camera as JSON."""
    return {"K": camera.K.tolist(), "width": camera.width, "height": camera.height}


def new_record(config: FitConfig, scene: dict[str, Any], camera: Camera, gauge: Gauge) -> dict[str, Any]:
    """What is known about a run before its first step."""
    return {
        "schema": "spikerig.run/1",
        "status": "running",
        "config": config.as_json(),
        "scene": scene,
        "camera": camera_record(camera),
        "gauge": gauge.as_json(),
        "pose_label": config.pose_label,
        "machine": machine.describe(),
        "command": machine.command(),
    }


def open_run(folder: Path) -> Run:
    """The latest stored state of a run, ready to draw.

    Raises:
        DataError: no run there, or it is damaged.
    """
    if not (folder / RECORD).exists():
        raise DataError("there is no run here", value=folder, next="spikerig train fit SCENE.h5 -o RUN")
    record = read_json(folder / RECORD)
    tensors, state = checkpoint.load(folder / CHECKPOINT)
    record |= {"steps": state.get("step"), "train_seconds": state.get("seconds")}
    try:
        config = from_json(record["config"])
        camera = Camera(record["camera"]["K"], np.zeros(0), record["camera"]["width"], record["camera"]["height"])
        centre = record["gauge"]["centre"]
        gauge = Gauge((float(centre[0]), float(centre[1]), float(centre[2])), float(record["gauge"]["scale"]))
        params, grids = (
            {k.removeprefix(kind): v for k, v in tensors.items() if k.startswith(kind)} for kind in ("param/", "grid/")
        )
        model = field_of(config).model(params, grids, gauge, camera, config)
    except (KeyError, TypeError, IndexError, ValueError) as error:
        raise DataError("the run's record or checkpoint is damaged", value=folder, cause=repr(error)) from error
    return Run(folder, model, config, record)
