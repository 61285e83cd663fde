"""One run of COLMAP over a set of pictures: a job goes to a child process, a map comes back or a clear error does."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import HostError, UsageError
from spikerig.dataset.images import write_image
from spikerig.dataset.scene import Camera

CHILD = ("-m", "spikerig.calib.colmap_child")
PATIENCE_S = 3600
EXHAUSTIVE = 80  # pictures up to which every pair is matched


@dataclass(frozen=True, slots=True)
class Options:
    """How pictures are matched and mapped.

    Args:
        peak_threshold: of SIFT; half of COLMAP's default, spike textures are low in contrast.
        max_features: a picture.
        max_ratio: of the distances to the best and second-best match.
        max_error_px: of a match, and of an observation of a point.
        pairs: `exhaustive`, `sequential`, or `auto` by the number of pictures.
        overlap: neighbours on each side for `sequential`.
        mapper: `incremental` or `global`.
        max_image_size: longer sides are made smaller; -1 keeps all.
        tries: at mapping the same matches; the largest map is kept.
        seed: of RANSAC and of the mapper.
        threads: of features and matching; 0 is one a core. The mapper runs on one. Same seed and threads, same bits;
            another number of threads numbers the matches differently, and gives a nearby answer.
    """

    peak_threshold: float = 0.0033
    max_features: int = 4096
    max_ratio: float = 0.8
    max_error_px: float = 1.5
    pairs: str = "auto"
    overlap: int = 10
    mapper: str = "incremental"
    max_image_size: int = -1
    tries: int = 2
    seed: int = 1
    threads: int = 0

    def __post_init__(self) -> None:
        if self.pairs not in ("auto", "exhaustive", "sequential"):
            raise UsageError("unknown pairs", value=self.pairs, expected="auto, exhaustive or sequential")
        if self.mapper not in ("incremental", "global"):
            raise UsageError("unknown mapper", value=self.mapper, expected="incremental or global")


@dataclass(frozen=True, slots=True)
class Placed:
    """A picture placed in a map: cam_from_world float64[3,4], its inliers, covariance [6,6] of the twist it is off by
    (rotation, translation; on its left), and the mean residual of its features in pixels."""

    pose: NDArray[np.float64]
    inliers: int
    cov: NDArray[np.float64] | None = None
    error_px: float | None = None


@dataclass(frozen=True, slots=True)
class Map:
    """What COLMAP made of the pictures.

    Args:
        poses: by picture, of the largest model.
        placed: further pictures, localised against it.
        xyz, rgb, error: its points, their colours, their mean residuals in pixels.
        error_px: mean residual of all observations.
        models: pictures in each model, largest first.
        seconds: of each step.
        versions: of what made it.
        cameras: as estimated or given.
        focal: of a known camera, were it free: `ratio` to the one given, and the share of the residual `saved` by it.
        link: how few points hold two parts of it together; None where nobody counted. `hanging`: the smaller part.
    """

    poses: Mapping[str, Placed] = field(default_factory=dict)
    placed: Mapping[str, Placed] = field(default_factory=dict)
    xyz: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    rgb: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    error: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    error_px: float = float("nan")
    models: tuple[int, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)
    version: str = ""
    cameras: Mapping[str, Any] = field(default_factory=dict)
    focal: Mapping[str, float] = field(default_factory=dict)
    link: int | None = None
    hanging: tuple[str, ...] = ()


def build_map(
    pictures: Mapping[str, NDArray[np.uint8] | Path],
    camera: Camera | None,
    options: Options,
    *,
    further: Mapping[str, tuple[str, NDArray[np.uint8]]] | None = None,
    rig: Sequence[Mapping[str, Any]] | None = None,
    separate_cameras: bool = False,
    keep: Path | None = None,
    done: Callable[[str], None] = lambda step: None,
) -> Map:
    """Features, matches and a map of pictures, in a child process.

    Args:
        pictures: by name (letters, digits, `-`, `_`, `.`, `/`); arrays uint8[H,W] or [H,W,3], or files.
        camera: known intrinsics, kept as they are; None lets COLMAP estimate them.
        options: how.
        further: name -> (picture it belongs to, array): localised against the map, not mapped; not matched with the
            picture they belong to.
        rig: COLMAP's rig configuration, for pictures in folders of the arms' names.
        separate_cameras: an own unknown camera for every picture.
        keep: folder that takes COLMAP's database and model; else they are thrown away.
        done: called after each step.

    Raises:
        HostError: pycolmap is missing, or the child died.
        UsageError: fewer than three pictures.

    Cost:
        40 pictures of 400x250: about 15 s for features and exhaustive matches, 3 s for the map, on two cores.
    """
    if len(pictures) < 3:
        raise UsageError("too few pictures for a map", value=len(pictures), expected="3 at least")
    with tempfile.TemporaryDirectory(prefix="spikerig-poses-") as scratch:
        root = Path(scratch)
        names = _lay_out(root, pictures, further or {})
        pairs = options.pairs
        if pairs == "auto":
            pairs = "exhaustive" if len(pictures) <= EXHAUSTIVE else "sequential"
        job = {
            "map": [names[n] for n in pictures],
            "place": [names[n] for n in further or {}],
            "own": {names[n]: names[own] for n, (own, _) in (further or {}).items()},
            "pairs": pairs,
            "camera": None if camera is None else colmap_camera(camera),
            "separate_cameras": separate_cameras,
            "rig": list(rig) if rig else None,
            "doubt_focal": rig is None,
            **{k: getattr(options, k) for k in Options.__slots__ if k not in ("pairs", "threads")},
            "threads": options.threads or len(os.sched_getaffinity(0)),
        }
        (root / "job.json").write_text(json.dumps(job), encoding="utf-8")
        run_child(root / "job.json", done)
        told = json.loads((root / "result.json").read_text(encoding="utf-8"))
        if keep is not None:
            _keep(root, keep)
        return _map_of(told, root, {v: k for k, v in names.items()})


def colmap_camera(camera: Camera) -> dict[str, Any]:
    """COLMAP's camera of ours: pixel centres are at +0.5 in both."""
    K, d = camera.K, np.asarray(camera.distortion, np.float64)
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    if not np.any(d):
        return {"model": "PINHOLE", "params": params}
    if len(d) == 4:
        return {"model": "OPENCV", "params": [*params, *d]}
    return {"model": "FULL_OPENCV", "params": [*params, *d, *([0.0] * (8 - len(d)))]}


def run_child(job: Path, done: Callable[[str], None] = lambda step: None) -> None:
    """Run COLMAP's child process on a job file; its death is an error of ours, with the end of what it said."""
    env = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, *CHILD, str(job)]
    log = job.with_name("stderr.txt")
    with log.open("wb") as errors:
        child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, stdin=subprocess.DEVNULL, env=env)
        try:
            for line in child.stdout or ():
                if line.startswith(b'{"done"'):
                    done(json.loads(line)["done"])
            code = child.wait(PATIENCE_S)
        finally:
            if child.poll() is None:  # interrupted, or out of patience
                child.kill()
                child.wait()
            if child.stdout:
                child.stdout.close()
    if code == 0:
        return
    said = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    last = said[-1][:300] if said else "nothing"
    if "No module named 'pycolmap'" in last:
        raise HostError("pycolmap is not installed", next='pip install "pycolmap>=4.0.4,<4.3"')
    how = signal.Signals(-code).name if code < 0 else f"exit {code}"
    raise HostError("COLMAP's process died", value=f"{how}; it said: {last}", cause="a fault of its own, or no memory")


def _lay_out(root: Path, pictures: Mapping[str, Any], further: Mapping[str, tuple[str, Any]]) -> dict[str, str]:
    """Write pictures where the child looks for them; file names by name."""
    names = {}
    for name, picture in [*pictures.items(), *((n, p) for n, (_, p) in further.items())]:
        suffix = picture.suffix.lower() if isinstance(picture, Path) else ".png"
        names[name] = f"{name}{suffix}"
        path = root / "images" / names[name]
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(picture, Path):
            path.symlink_to(picture.resolve())
        else:
            write_image(path, picture if picture.ndim == 3 else np.repeat(picture[:, :, None], 3, 2))
    return names


def _keep(root: Path, keep: Path) -> None:
    """COLMAP's own files, for whoever wants to look."""
    import shutil

    keep.mkdir(parents=True, exist_ok=True)
    shutil.copy(root / "database.db", keep / "database.db")
    if (root / "sparse").is_dir():
        shutil.copytree(root / "sparse", keep / "sparse" / "0", dirs_exist_ok=True)


def _map_of(told: dict[str, Any], root: Path, names: Mapping[str, str]) -> Map:
    if not told.get("images"):
        return Map(models=tuple(told["models"]), seconds=told["seconds"], version=told["version"])
    poses = {names[n]: Placed(np.array(r["pose"]), r["points"], None, r["error_px"]) for n, r in told["images"].items()}
    placed = {
        names[n]: Placed(np.array(r["pose"]), r["inliers"], np.array(r["cov"]))
        for n, r in told.get("placed", {}).items()
    }
    xyz, rgb, error = (np.load(root / f"{key}.npy", allow_pickle=False) for key in ("xyz", "rgb", "error"))
    more = (
        told["error_px"],
        tuple(told["models"]),
        told["seconds"],
        told["version"],
        told["cameras"],
        told.get("focal", {}),
        told["link"]["points"],
        tuple(names[n] for n in told["link"]["views"]),
    )
    return Map(poses, placed, xyz, rgb, error, *more)
