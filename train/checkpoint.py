"""The state of a fit on disk: one safetensors file, tensors beside a JSON record, replaced in one step."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import torch

from spikerig.dataset.errors import DataError, HostError
from spikerig.dataset.terminal import jsonable

FORMAT = "spikerig-checkpoint/1"


def save(path: Path, tensors: dict[str, torch.Tensor], record: dict[str, Any]) -> None:
    """Write tensors and record as one file; a crash leaves the old file or the new one, never half of one.

    Raises:
        HostError: the disk is full or the folder cannot be written.
    """
    from safetensors.torch import save_file

    part = path.with_name(path.name + ".partial")
    text = json.dumps({"format": FORMAT, **jsonable(record)}, allow_nan=False)
    try:
        save_file({k: v.detach().contiguous() for k, v in tensors.items()}, part, metadata={"spikerig": text})
        part.chmod(0o644)  # safetensors makes it private
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        raise HostError("a checkpoint could not be written", value=path, cause=str(error)) from error


def load(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Tensors and record of a checkpoint.

    Raises:
        DataError: missing, damaged, or not a checkpoint of ours.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            record = json.loads((file.metadata() or {}).get("spikerig", "null"))
            # clones, because torch's sums have other last bits where memory is not aligned
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118 (not a dict)
    except FileNotFoundError as error:
        raise DataError("there is no checkpoint", value=path, next="spikerig train fit SCENE.h5 -o RUN") from error
    except (OSError, SafetensorError, ValueError) as error:
        raise DataError("a checkpoint cannot be read", value=path, cause=str(error)) from error
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise DataError("not a checkpoint of spikerig", value=path, expected=FORMAT)
    return tensors, record
