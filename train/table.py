"""A table as a plan: which cells it has, what each is made from, and the hash by which a finished one is known again.

A cell is one method under one pose label on one scene with one seed. Nothing here imports torch: the cells are child
processes, and what this process holds would be counted as theirs (a child's peak memory is never below its parent's).
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as default
from functools import cache
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

from spikerig.dataset.errors import RigError, UsageError
from spikerig.train.config import FitConfig, parse_setting
from spikerig.train.methods import METHODS, configure

LABELS = ("mid", "first")
# The paper's rows in its order, by our names; then ours, then the ceiling.
PAPER = {
    "plain": "NeRF",
    "deblur": "Deblur-NeRF",
    "d2net": "D2Net-NeRF",
    "edi": "EDI-NeRF",
    "mpr": "MPR-NeRF",
    "e2-5x": "E2NeRF 5x",
    "e2-2x": "E2NeRF 2x",
    "spikenerf-5x": "SpikeNeRF 5x",
    "spikenerf": "SpikeNeRF",
}
EVERY = "all"
ASKING = ("mpr", "d2net")  # methods that run only with a file of the user's: not among the default rows
OWN_FLAGS = ("-o", "--out", "--method", "--field", "--preset", "--steps", "--seconds", "--seed", "--pose-label",
             "--threads", "--resume", "--force", "--json", "--score-on")  # fmt: skip
CHECKPOINT_S = 15.0  # of a fit that is killed, at most so much is lost


@dataclass(frozen=True, slots=True)
class Row:
    """A line of the table: a method, and the pose its blurry views are labelled with ("" where that does not enter)."""

    method: str
    label: str

    @property
    def name(self) -> str:
        """`plain@first`, or `average`."""
        return f"{self.method}@{self.label}" if self.label else self.method


@dataclass(frozen=True, slots=True)
class Place:
    """A scene of the table: its file, what it holds, and a file on whose held-out views it is scored beside its own."""

    name: str
    path: Path
    sha256: str
    size: tuple[int, int]
    train_views: int
    test_views: int
    other: Path | None = None
    other_sha256: str = ""


@dataclass(frozen=True, slots=True)
class Order:
    """What is asked for.

    Args:
        scenes: files.
        methods: names, each as METHOD or METHOD@LABEL; "all", or none: all that need no file of the user's.
        labels: pose labels of methods that name none.
        field, preset: of every fit; ONE field, so that costs compare.
        steps, seconds: length of every fit; both None: the preset's steps.
        seeds: of every fit.
        settings: `[SCOPE:]name=value`, the scope a scene's or a method's name.
        extra: METHOD -> further words of its `train fit`.
        score_on: scene name -> file whose held-out views are scored too.
        ssim, lpips, trust: of every score.
        nerfbaselines: write each cell's results for nerfbaselines.
    """

    scenes: tuple[Path, ...]
    methods: tuple[str, ...] = ()
    labels: tuple[str, ...] = ("mid",)
    field: str = "splat"
    preset: str = "draft"
    steps: int | None = None
    seconds: float | None = None
    seeds: tuple[int, ...] = (0,)
    settings: tuple[str, ...] = ()
    extra: Mapping[str, tuple[str, ...]] = default(default_factory=dict)
    score_on: Mapping[str, Path] = default(default_factory=dict)
    ssim: str = "torchmetrics"
    lpips: Path | None = None
    trust: bool = False
    nerfbaselines: bool = False


@dataclass(frozen=True, slots=True)
class Cell:
    """One fit and its scores; `sha256` is over all that its numbers depend on."""

    scene: str
    row: Row
    seed: int
    fit: tuple[str, ...]
    scores: tuple[tuple[str, tuple[str, ...]], ...]
    identity: Mapping[str, Any]
    sha256: str

    @property
    def name(self) -> str:
        """Its folder below `cells/`, and its name in messages."""
        return f"{self.scene}-{self.row.method}{'-' + self.row.label if self.row.label else ''}-{self.seed}"


@dataclass(frozen=True, slots=True)
class Plan:
    """All of a table: its scenes, rows and cells, in the order in which they are shown and run."""

    order: Order
    scenes: tuple[Place, ...]
    rows: tuple[Row, ...]
    cells: tuple[Cell, ...]


def plan(order: Order) -> Plan:
    """Look at everything an order names and lay out its cells.

    Raises:
        UsageError, DataError: what is wrong with it, all at once where several things are.
    """
    _check_numbers(order)
    scenes = _places(order)
    every = [m for m in sorted_methods(METHODS) if m not in ASKING or m in order.extra]
    wanted = [every if text == EVERY else [text] for text in order.methods or (EVERY,)]
    methods = tuple(dict.fromkeys(name for names in wanted for name in names))
    names = {s.name for s in scenes}
    faults = [f"--score-on: no scene '{name}'" for name in order.score_on if name not in names]
    faults += _scope_faults(order, names, {m.partition("@")[0] for m in methods})
    rows: dict[Row, None] = {}
    made: dict[tuple[str, Row, int], FitConfig] = {}
    for text in methods:
        method, at, label = text.partition("@")
        for wanted in (label,) if at else order.labels:
            try:
                row, configs = _configs(order, scenes, method, wanted)
            except RigError as error:
                faults.append(f"{text}: {error.what}" + ("" if error.value is None else f" ({error.value})"))
                break
            rows[row] = None
            made |= {(scene, row, seed): config for (scene, seed), config in configs.items()}
    if faults:
        raise UsageError("this table cannot be made", value="; ".join(dict.fromkeys(faults)), expected=_expected())
    cells = [
        _cell(order, s, row, seed, made[s.name, row, seed]) for s in scenes for seed in order.seeds for row in rows
    ]
    return Plan(order, scenes, tuple(rows), tuple(cells))


def sorted_methods(methods: Sequence[str] | Mapping[str, Any]) -> list[str]:
    """Methods in the order in which they are shown: the paper's rows, then others, the oracle last."""
    paper = list(PAPER)
    rank = {name: paper.index(name) for name in methods if name in PAPER} | {"oracle": 1000}
    return sorted(methods, key=lambda name: rank.get(name, 100))


def _expected() -> str:
    return (
        f"METHOD or METHOD@LABEL of {', '.join(METHODS)}; labels {', '.join(LABELS)}; --set [SCENE|METHOD:]NAME=VALUE"
    )


def _check_numbers(order: Order) -> None:
    if not order.scenes or not order.seeds or not order.labels:
        raise UsageError("a table needs scenes, seeds and labels", value=(order.scenes, order.seeds, order.labels))
    if order.steps is not None and order.seconds is not None:
        raise UsageError("fits end by --steps or by --seconds, not both", value=f"{order.steps}, {order.seconds} s")
    if strange := [label for label in order.labels if label not in LABELS]:
        raise UsageError("no such pose label", value=", ".join(strange), expected=", ".join(LABELS))
    if any(seed < 0 for seed in order.seeds) or len(set(order.seeds)) < len(order.seeds):
        raise UsageError("seeds are different numbers from 0", value=", ".join(map(str, order.seeds)))


def _places(order: Order) -> tuple[Place, ...]:
    """Every scene, looked at; all that are missing are told at once."""
    files = [*order.scenes, *order.score_on.values(), *([order.lpips] if order.lpips else [])]
    if missing := [str(path) for path in files if not path.is_file()]:
        raise UsageError(
            "these files are not there", value=", ".join(missing), next="spikerig sim capture NAME -o FILE"
        )
    names = [re.sub(r"[^A-Za-z0-9_.-]", "_", path.stem) for path in order.scenes]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise UsageError("two scenes have the same file name", value=", ".join(twice), next="rename one of them")
    return tuple(_place(path, name, order.score_on.get(name)) for path, name in zip(order.scenes, names, strict=True))


def _place(path: Path, name: str, other: Path | None) -> Place:
    from spikerig.dataset.store import open_scene

    with open_scene(path) as file:
        size = (file.camera.width, file.camera.height)
        counts = len(file.train), len(file.test)
    if other is not None:
        with open_scene(other) as file:
            theirs = (file.camera.width, file.camera.height)
        if theirs != size:
            raise UsageError(
                f"the scene to score '{name}' on has another size",
                value=f"{other}: {theirs[0]}x{theirs[1]}",
                expected=f"{size[0]}x{size[1]}",
            )
    return Place(name, path, file_hash(path), size, *counts, other, "" if other is None else file_hash(other))


def _scope_faults(order: Order, scenes: set[str], methods: set[str]) -> list[str]:
    faults = [f"--extra: no row '{method}'" for method in order.extra if method not in methods]
    for method, words in order.extra.items():
        if own := [word for word in words if word.partition("=")[0] in OWN_FLAGS]:
            faults.append(f"--extra {method}: {', '.join(own)} is the table's to say")
    for text in order.settings:
        scope, colon, _ = text.partition("=")[0].partition(":")
        if colon and scope not in scenes | methods:
            faults.append(f"--set {text}: no scene or row '{scope}'")
    return faults


def _configs(
    order: Order, scenes: Sequence[Place], method: str, label: str
) -> tuple[Row, dict[tuple[str, int], FitConfig]]:
    """A row and its configs by (scene, seed); the label is left out where no instant depends on it."""
    if label not in LABELS:
        raise UsageError("no such pose label", value=label)
    found, enters = {}, False
    for scene in scenes:
        changes = settings_of(order, scene.name, method)
        config = configure(method, order.preset, field=order.field, **changes)
        if "pose_label" in changes:
            raise UsageError("the pose label is the row's", value=f"pose_label={changes['pose_label']}")
        enters = enters or label_enters(config)
        for seed in order.seeds:
            more = {"seed": seed, **({"pose_label": label} if label_enters(config) else {})}
            found[scene.name, seed] = configure(method, order.preset, field=order.field, **(changes | more))
    return Row(method, label if enters else ""), found


def settings_of(order: Order, scene: str, method: str) -> dict[str, Any]:
    """What `--steps`, `--seconds` and, over them, `--set` change of a method's config on a scene."""
    changes: dict[str, Any] = {} if order.steps is None else {"steps": order.steps}
    changes |= {} if order.seconds is None else {"seconds": order.seconds}
    for text in order.settings:
        scope, colon, _ = text.partition("=")[0].partition(":")
        if not colon:
            changes |= dict([parse_setting(text)])
        elif scope in (scene, method):
            changes |= dict([parse_setting(text.partition(":")[2])])
    return changes


def label_enters(config: FitConfig) -> bool:
    """Whether the pose label changes what is trained: some term looks at one instant alone."""
    if config.colour_target == "truth" or config.restore_instants > 0:  # these are about mid-exposure
        return False
    ratio = config.ratio_until > 0 and config.ratio_instants == 1
    colour = config.ratio_until < 1 and config.poses_per_view == 1
    tfs = config.ratio_until < 1 and config.tfs_weight > 0 and config.textures_per_view == 1
    return ratio or colour or tfs


def _cell(order: Order, scene: Place, row: Row, seed: int, config: FitConfig) -> Cell:
    extra = order.extra.get(row.method, ())
    changes = settings_of(order, scene.name, row.method)
    fit = ["train", "fit", str(scene.path), "--method", row.method, "--field", order.field, "--preset", order.preset]
    fit += ["--seed", str(seed), *(["--pose-label", config.pose_label] if config.pose_label != "mid" else [])]
    fit += ["--checkpoint-every", f"{CHECKPOINT_S:g}"]
    for name, value in changes.items():
        flag = [f"--{name}", f"{value:g}"] if name in ("steps", "seconds") else ["--set", f"{name}={_text(value)}"]
        fit += flag
    judged = ["--ssim", order.ssim, *(["--lpips", str(order.lpips)] if order.lpips else [])]
    judged += ["--trust"] if order.trust else []
    scores = [("own", (str(scene.path), *judged))]
    scores += [("other", (str(scene.other), *judged))] if scene.other else []
    identity = {
        "scene": scene.sha256,
        "other": scene.other_sha256,
        "config": config.as_json(),
        "extra": list(extra),
        "files": {word: file_hash(Path(word)) for word in extra if _is_file(word)},
        "ssim": order.ssim,
        "lpips": file_hash(order.lpips) if order.lpips else "",
        "version": metadata.version("spikerig"),
        "code": code_hash(),
    }
    digest = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()
    return Cell(scene.name, row, seed, (*fit, *extra), tuple(scores), identity, digest)


def _is_file(word: str) -> bool:
    try:
        return Path(word).is_file()
    except OSError:  # too long for a name
        return False


def _text(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def file_hash(path: Path) -> str:
    """SHA-256 of a file, hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@cache
def code_hash() -> str:
    """SHA-256 over the code a cell's numbers come from: dataset, calib, train (but for tables, sweeps), kernels."""
    digest = hashlib.sha256()
    for package in ("spikerig.dataset", "spikerig.calib", "spikerig.train"):
        folder = Path(next(iter(import_module(package).__path__)))
        for path in sorted(folder.rglob("*.py")):
            if not path.name.startswith(("table", "claims", "cost", "bench")):
                digest.update(path.name.encode() + b"\0" + path.read_bytes())
    digest.update(Path(str(import_module("spikerig._native").__file__)).read_bytes())
    return digest.hexdigest()
