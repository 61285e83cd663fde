"""A deblurring network that the user gives: checked, hashed, run in a child process, its pictures looked over.

A TorchScript file, or one of torch.export (.pt2), is a program, so it runs only where `trust` is set; and it runs in a
process of its own with a time limit, so that one that crashes or hangs ends in a message. That is no sandbox: a trusted
program may do whatever you may.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, UsageError
from spikerig.train.config import FitConfig

Pictures = NDArray[np.float32]
REACH = (-0.5, 1.5)  # what a network that gives codes in [0, 1] may overshoot to; clipped then
NEXT = "--restorer FILE --trust, with a network you know (docs/baselines.md)"


def check_restorer(config: FitConfig) -> Path:
    """The file of a config's restorer.

    Raises:
        UsageError: none given, or it is not trusted.
        DataError: no such file, or neither TorchScript nor torch.export's.
    """
    if not config.restorer:
        raise UsageError(
            f"method {config.method} needs a deblurring network, and none is shipped",
            expected="TorchScript or torch.export (.pt2) of it, with its weights",
            next=NEXT,
        )
    path = Path(config.restorer)
    if not path.is_file():
        raise DataError("there is no restorer here", value=path, next=NEXT)
    with path.open("rb") as file:
        script = file.read(2) == b"PK"
    if not script:
        raise DataError(
            "not a network that can run", value=path, expected="TorchScript (.pt) or torch.export (.pt2)",
            cause="a state dict or another format: weights alone do not say what to compute",
        )  # fmt: skip
    if not config.trust:
        raise UsageError(
            "a restorer is a program: it runs, as you, only when you say so", value=path, next="--trust, if you know it"
        )
    return path


def restore(codes: Pictures, sums: Pictures | None, config: FitConfig) -> tuple[Pictures, dict[str, Any]]:
    """Blurry pictures through the restorer.

    Args:
        codes: [V,H,W,3] sRGB codes in [0, 1], in the order of the training views.
        sums: [V,K,H,W] signed sums of events in K parts of the exposure, for a network that takes them too.
        config: its restorer_ settings, trust, and device.

    Returns:
        [V,H,W,3] codes in [0, 1], and what run.json keeps: file, SHA-256, calling form, sizes.

    Raises:
        UsageError: no restorer, or not trusted.
        DataError: it does not run, takes too long, or gives something else than pictures.
    """
    from spikerig.train.record import scene_hash

    path = check_restorer(config)
    before = scene_hash(path)
    height, width = codes.shape[1:3]
    inputs = {"codes": _padded(codes.transpose(0, 3, 1, 2), config.restorer_pad)}
    if sums is not None:
        inputs["sums"] = _padded(sums, config.restorer_pad)
    found = _run(path, inputs, config)
    if before != scene_hash(path):
        raise DataError("the restorer's file changed while it ran", value=path)
    found = _checked(found, inputs["codes"].shape, path)[:, :, :height, :width]
    return np.ascontiguousarray(found.transpose(0, 2, 3, 1)), {
        "how": "restorer",
        "file": path.name,
        "sha256": before,
        "frames": config.restorer_frames,
        "event_bins": config.restorer_bins,
        "padded_to_multiples_of": config.restorer_pad,
    }


def _padded(pictures: Pictures, multiple: int) -> Pictures:
    """[V,C,H,W] grown below and on the right, by its mirror, to sides that are multiples of a number."""
    more = [-n % multiple for n in pictures.shape[2:]]
    if any(m >= n for m, n in zip(more, pictures.shape[2:], strict=True)):
        raise UsageError("pictures this small cannot be mirrored so far", value=pictures.shape[2:],
                         next="--set restorer_pad=1")  # fmt: skip
    return np.pad(pictures, ((0, 0), (0, 0), (0, more[0]), (0, more[1])), mode="reflect")


def _run(path: Path, inputs: dict[str, Pictures], config: FitConfig) -> Pictures:
    """The child's answer, whatever it is."""
    with tempfile.TemporaryDirectory(prefix="spikerig-restorer-") as name:
        folder = Path(name)
        for key, values in inputs.items():
            np.save(folder / f"{key}.npy", np.ascontiguousarray(values), allow_pickle=False)
        command = [sys.executable, "-P", "-m", "spikerig.train.restorer_child", str(path.resolve()), name]
        command += [str(config.restorer_frames), config.device]
        with (folder / "said").open("w+b") as said:
            child = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=said, stderr=said, start_new_session=True
            )
            try:
                code = child.wait(config.restorer_limit_s)
            except subprocess.TimeoutExpired:
                code = None
            finally:
                _end(child)
            said.seek(max(0, said.seek(0, os.SEEK_END) - 2000))
            last = said.read().decode(errors="replace").strip().rpartition("\n")[2][:300]
        if code is None:
            raise DataError(
                "the restorer took too long", value=path, expected=f"all pictures within {config.restorer_limit_s:g} s",
                next="--set restorer_limit_s=SECONDS gives it more",
            )  # fmt: skip
        if code != 0:
            ended = f"killed by {signal.Signals(-code).name}" if code < 0 else last
            raise DataError("the restorer does not take these pictures", value=path, cause=ended or f"exit {code}",
                            next="docs/baselines.md says how it is called")  # fmt: skip
        try:
            return np.load(folder / "out.npy", allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise DataError("the restorer left no pictures", value=path, cause=str(error)) from error


def _end(child: subprocess.Popen) -> None:
    """Kill a child and what it started."""
    try:
        os.killpg(child.pid, signal.SIGKILL)
    except ProcessLookupError:  # all are gone
        pass
    child.wait()


def _checked(found: NDArray, shape: tuple[int, ...], path: Path) -> Pictures:
    if found.shape != shape or found.dtype != np.float32:
        raise DataError(
            "the restorer gives something else than pictures of its input's size",
            value=f"{found.dtype}{list(found.shape[1:])}",
            expected=f"float32{list(shape[1:])}",
        )
    if not np.isfinite(found).all():
        raise DataError("the restorer gives values that are not finite", value=path)
    low, high = float(found.min()), float(found.max())
    if low < REACH[0] or high > REACH[1]:
        raise DataError(
            "the restorer's pictures are out of range",
            value=f"{low:.3g} to {high:.3g}",
            expected="sRGB codes in [0, 1]",
            cause="a network of [-1, 1] or 0..255; put the scaling into the file",
        )
    return np.clip(found, 0, 1)
