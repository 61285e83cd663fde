"""Built-in scenes played into a folder: one scene file each, contact sheets, a manifest. Resumable, reproducible."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from spikerig.dataset import machine
from spikerig.dataset.errors import DataError, HostError, UsageError
from spikerig.dataset.terminal import jsonable
from spikerig.rigctl.sim.capture import provenance, rig_of, settled
from spikerig.rigctl.sim.farm import Cluster, fill, finished
from spikerig.rigctl.sim.judge.plan import Plan
from spikerig.rigctl.sim.limits import nearest
from spikerig.rigctl.sim.sheet import contact_sheet, overview
from spikerig.rigctl.sim.shelf import Shelf, alone, differences, fingerprint, write_whole
from spikerig.rigctl.sim.spec import SceneSpec, builtin_names, load_scene_toml, with_changes
from spikerig.rigctl.sim.take import pack

SCHEMA = "spikerig.sim.dataset/1"
SIX = ("leaves", "parts", "glossy", "mesh", "fabric", "round")
MANIFEST, OVERVIEW = "manifest.json", "overview.png"
SPARE_BYTES = 1 << 28  # of disk that is left free


@dataclass(frozen=True, slots=True)
class Order:
    """What to make.

    Args:
        scenes: built-in names.
        views: viewpoints a scene; None for the scene's own.
        test_every: every n-th view is for testing, 0 for none; None for the scene's own.
        seed: of shake, noise and points, in place of the scenes'.
        size: width and height in pixels; the shake grows with the width. None for the scene's own.
    """

    scenes: tuple[str, ...] = SIX
    views: int | None = None
    test_every: int | None = None
    seed: int | None = None
    size: tuple[int, int] | None = None


def spec_of(order: Order, name: str) -> SceneSpec:
    """A built-in scene as ordered.

    Raises:
        UsageError: no such scene, or a number out of range.
    """
    if name not in builtin_names():
        raise UsageError("there is no such built-in scene", value=name, cause=nearest(name, builtin_names()))
    spec = load_scene_toml(name)
    if order.test_every is not None:
        if order.test_every < 0:
            raise UsageError("test views are every n-th, n from 0 (none)", value=order.test_every)
        spec = replace(spec, orbit=replace(spec.orbit, test_every=order.test_every, test=()))
    if order.size is not None:
        width, height = order.size
        if not (1 <= width <= 8192 and 1 <= height <= 8192):
            raise UsageError("a size is out of range", value=f"{width}x{height}", expected="1x1 to 8192x8192")
        scale = width / spec.lens.width
        path = (spec.shake.path_px[0] * scale, spec.shake.path_px[1] * scale)
        spec = replace(spec, lens=replace(spec.lens, width=width, height=height))
        spec = replace(spec, shake=replace(spec.shake, path_px=path))
    views = spec.orbit.views if order.views is None else order.views
    return with_changes(spec, seed=order.seed, views=views)


def make(
    folder: str | Path,
    order: Order,
    *,
    workers: int = 1,
    scheduler: str = "",
    force: bool = False,
    begin: Callable[[str, int, int], Callable[[], None]] = lambda name, views, kept: lambda: None,
) -> dict[str, Any]:
    """Make a dataset, or go on with one that was left half made.

    Args:
        folder: where; it is made. Only files that the manifest names are ever replaced.
        order: what.
        workers: processes; the bytes do not depend on it.
        scheduler: address of a Dask scheduler to work for us; "" for processes here.
        force: start anew where the folder holds a dataset made with other settings.
        begin: called as a scene begins, with its name, its views and how many of them are finished; gives what is
            called after each view.

    Returns:
        The manifest, and `kept`: scenes that were there already.

    Raises:
        UsageError: the folder holds something else, or another run is at work in it.
        HostError: no space, no cluster, a dead worker.
    """
    folder = Path(folder)
    specs = {name: spec_of(order, name) for name in dict.fromkeys(order.scenes)}
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise HostError("the folder cannot be made", value=f"{folder}: {error.strerror}") from error
    with ExitStack() as stack:
        stack.enter_context(alone(folder))
        cluster = stack.enter_context(Cluster(scheduler)) if scheduler else None
        made = {"order": asdict(order), "made_with": cluster.made_by if cluster else fingerprint()}
        document = _opened(folder, made, specs, force)
        kept = sorted(document["scenes"])
        _check_space(folder, [spec for name, spec in specs.items() if name not in kept])
        for name, spec in specs.items():
            if name in kept:
                continue
            started = time.monotonic(), _cpu_seconds()
            spec, judged = settled(spec)
            shelf = Shelf(folder / f"{name}.views", made, force)
            lacking = len(shelf.missing(spec.orbit.views))
            done = begin(name, spec.orbit.views, spec.orbit.views - lacking)
            if cluster:
                cluster.fill(spec, shelf, done)
            else:
                fill(spec, shelf, workers, done)
            document["scenes"][name] = _seal(folder, spec, shelf, judged)
            document["runs"].append(
                {
                    "scene": name,
                    "views": lacking,
                    "seconds": time.monotonic() - started[0],
                    "cpu_seconds": None if cluster else _cpu_seconds() - started[1],
                    "workers": len(cluster.workers) if cluster else workers,
                    "cluster": scheduler or None,
                }
            )
            _write(folder, document)
            shelf.clear()
        overview(folder / OVERVIEW, [folder / row["file"] for row in document["scenes"].values()])
        document["status"] = "complete"
        _write(folder, document)
    return document | {"kept": kept}


def _opened(folder: Path, made: Mapping[str, Any], specs: Mapping[str, SceneSpec], force: bool) -> dict[str, Any]:
    """The manifest of a folder, begun or gone on with; scenes whose files are not as it says are taken off it."""
    path = folder / MANIFEST
    fresh: dict[str, Any] = {
        "schema": SCHEMA,
        "status": "recording",
        "command": canonical(made["order"]),
        **jsonable(dict(made)),
        "scenes": {},
        "runs": [],
        "machine": machine.describe(),
    }
    if path.exists():
        there = read_manifest(folder)
        told = differences({k: there.get(k) for k in made}, jsonable(dict(made)))
        if not told:
            for name in [name for name, row in there["scenes"].items() if _changed(folder, row)]:
                del there["scenes"][name]
            return there
        if not force:
            raise UsageError(
                "the folder holds a dataset made with other settings",
                value="\n            ".join([str(folder), *told]),
                next="give another --out, or --force to make it anew",
            )
        for name in {*specs, *builtin_names()}:
            shutil.rmtree(folder / f"{name}.views", ignore_errors=True)
        for row in there["scenes"].values():
            for key in ("file", "sheet"):
                (folder / Path(str(row.get(key))).name).unlink(missing_ok=True)
    strangers = [name for name in specs if (folder / f"{name}.h5").exists() and not force]
    if strangers and not path.exists():
        raise UsageError(
            "scene files lie in the way that no manifest names",
            value=", ".join(f"{folder / name}.h5" for name in strangers),
            next="give another --out, or --force to replace them",
        )
    _write(folder, fresh)
    return fresh


def read_manifest(folder: Path) -> dict[str, Any]:
    """A folder's manifest.

    Raises:
        DataError: it is not one.
    """
    path = folder / MANIFEST
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if document["schema"] != SCHEMA or not isinstance(document["scenes"], dict):
            raise ValueError(document["schema"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            "not the manifest of a dataset", value=f"{path}: {error}", next="give another --out, or move it away"
        ) from None
    return document


def _write(folder: Path, document: dict[str, Any]) -> None:
    document["sha256"] = digest(document)
    write_whole(folder / MANIFEST, (json.dumps(jsonable(document), indent=1) + "\n").encode())


def digest(document: Mapping[str, Any]) -> str:
    """SHA-256 of what a manifest says was made: order, code and scenes; not when, where and how fast."""
    keys = ("schema", "command", "order", "made_with", "scenes")
    return hashlib.sha256(json.dumps(jsonable({k: document[k] for k in keys}), sort_keys=True).encode()).hexdigest()


def canonical(order: Mapping[str, Any]) -> str:
    """The command that makes the same dataset, but for the folder."""
    words = ["spikerig sim dataset --out DIR --scenes", ",".join(order["scenes"])]
    for key, flag in (("views", "--views"), ("test_every", "--test-every"), ("seed", "--seed")):
        words += [flag, str(order[key])] if order[key] is not None else []
    words += ["--size", "x".join(str(n) for n in order["size"])] if order["size"] is not None else []
    return " ".join(words)


def _cpu_seconds() -> float:
    """CPU time of this process and of those that it started and that ended."""
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system


def _changed(folder: Path, row: Mapping[str, Any]) -> bool:
    path = folder / Path(str(row["file"])).name
    return not path.is_file() or path.stat().st_size != row["bytes"] or sha256_of(path) != row["sha256"]


def sha256_of(path: Path) -> str:
    """SHA-256 of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def view_bytes(spec: SceneSpec) -> tuple[int, int]:
    """About how many bytes a view for training and one for testing take in a scene file."""
    pixels = spec.lens.width * spec.lens.height
    row = (spec.lens.width + 7) // 8
    ticks = spec.exposure.ticks + 2 * spec.exposure.margin_ticks
    picture = pixels * (3 + 12 + 4 + 1) + 20_000
    return picture + ticks * spec.lens.height * row, picture


def _check_space(folder: Path, specs: Sequence[SceneSpec]) -> None:
    """All scenes to make, and the views of the largest beside it, must fit on the disk."""
    sizes = [0]
    for spec in specs:
        train, test = view_bytes(spec)
        held_out = len(spec.orbit.held_out())
        sizes.append(train * (spec.orbit.views - held_out) + test * held_out)
    needed = sum(sizes) + max(sizes) + SPARE_BYTES
    free = shutil.disk_usage(folder).free
    if len(sizes) > 1 and free < needed:
        raise HostError(
            "there is not enough room on the disk",
            value=f"{folder}: {free / 1e9:.1f} GB free",
            expected=f"{needed / 1e9:.1f} GB",
            next="give another --out, fewer --views or a smaller --size",
        )


def _seal(folder: Path, spec: SceneSpec, shelf: Shelf, judged: Plan | None) -> dict[str, Any]:
    """Gather the finished views of a scene in its file, beside it a contact sheet; its row of the manifest."""
    path = folder / f"{spec.name}.h5"
    info = {**provenance(spec, judged), "made_by": "spikerig sim dataset"}
    told = pack(path, rig_of(spec), finished(spec, shelf), info=info, views=spec.orbit.views, force=True)
    sheet = folder / f"{spec.name}.png"
    contact_sheet(sheet, path)
    keys = ("train_views", "test_views", "size", "ticks", "spikes_mean", "spikes_max", "blurry_psnr_db", "points")
    return {
        "file": path.name,
        "sha256": sha256_of(path),
        "bytes": path.stat().st_size,
        "seed": told["seed"],
        "sheet": sheet.name,
        **{key: told[key] for key in keys},
    }
