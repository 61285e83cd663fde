"""`spikerig cost pose-study`: poses from blurry pictures against poses from spikes, on simulated scenes with truth.

Three ways, with the same options: one map of the blurry pictures, one map of spike textures, and what `calib poses`
does: three kinds of texture are mapped, and a result on which they do not agree is refused (and is no success).
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.terminal import Progress, emit, jsonable, note

if TYPE_CHECKING:
    from spikerig.calib.mapping import Map
    from spikerig.rigctl.sim.spec import SceneSpec

SCENES = "demo,chroma,leaves,parts,glossy,mesh,fabric,round"
SIZE = (200, 125)
ARC_DEG = 120.0  # at most
ARMS = {"rgb": "blurry RGB", "spike": "spikes, one map", "maps": "spikes, three maps"}
WITHIN_DEG, WITHIN_SHARE = 1.0, 0.02  # of a success; the share is of the extent of the true camera centres


@dataclass(frozen=True, slots=True)
class Row:
    """One map: a scene, a blur, an arm.

    Args:
        scene, blur_px, arm: which; the blur is the image centre's path over the exposure; arm is one of `ARMS`.
        kind: of texture, the best where there are several; empty for `rgb`.
        views, registered, within: how many there were, were placed, and were placed within 1 degree and 2 %.
        deg, share: median errors of the placed ones; None where fewer than three were.
        error_px: mean residual.
        map_seconds: wall, of features, matches and the map.
        reasons: why the result is refused; only `maps` can be.
    """

    scene: str
    blur_px: float
    arm: str
    kind: str
    views: int
    registered: int
    within: int
    deg: float | None
    share: float | None
    error_px: float | None
    map_seconds: float
    reasons: tuple[str, ...] = ()

    @property
    def good(self) -> int:
        """Views that succeed: none where the result is refused."""
        return 0 if self.reasons else self.within


def spec_of(scene: str, blur_px: float, views: int) -> SceneSpec:
    """A built-in scene, small: 200x125, at most 120 degrees, a given blur, no view held out."""
    from spikerig.rigctl.sim.spec import load_scene_toml

    spec = load_scene_toml(scene)
    arc = min(abs(spec.orbit.arc_deg), ARC_DEG)
    return replace(
        spec,
        lens=replace(spec.lens, width=SIZE[0], height=SIZE[1]),
        orbit=replace(spec.orbit, views=views, arc_deg=arc, test_every=0, test=()),
        shake=replace(spec.shake, path_px=(blur_px, blur_px)),
    )


def measure(scene: str, blur_px: float, views: int, seed: int) -> list[Row]:
    """One scene at one blur, every arm: the same options, no second try for the single maps."""
    from spikerig.calib.mapping import Options, build_map
    from spikerig.calib.pictures import frame_picture
    from spikerig.calib.poses import Wanted, best_kind, estimate_poses, gain_of, look_at
    from spikerig.dataset.store import open_scene
    from spikerig.rigctl.sim.capture import capture

    with tempfile.TemporaryDirectory(prefix="spikerig-study-") as scratch:
        path = Path(scratch) / "scene.h5"
        capture(spec_of(scene, blur_px, views), path, workers=1)
        with open_scene(path) as opened:
            seen, camera = [opened.view(n) for n in opened.names], opened.camera
    truth = {v.name: v.pose.cam_from_world for v in seen}
    gain, options = gain_of(seen), Options(seed=seed)
    kind = best_kind(seen, gain)
    pictures = {
        "rgb": {v.name: frame_picture(v.frame) for v in seen},
        "spike": {v.name: look_at(v, 0.5, kind, gain) for v in seen},
    }
    rows = []
    for arm, shown in pictures.items():
        began = time.monotonic()
        found = build_map(shown, camera, options)
        poses = {n: p.pose for n, p in found.poses.items()}
        row = Row(scene, blur_px, arm, kind if arm == "spike" else "", *errors(poses, truth), finite(found), 0.0)
        rows.append(replace(row, map_seconds=time.monotonic() - began))
    began = time.monotonic()
    several = estimate_poses(seen, camera, Wanted(instants=1), options)
    spent, best = time.monotonic() - began, several.best
    found = errors(several.poses, truth)
    return [*rows, Row(scene, blur_px, "maps", several.kinds[0], *found, finite(best), spent, several.reasons)]


def finite(found: Map) -> float | None:
    """The mean residual, where there is one."""
    return None if found.error_px != found.error_px else found.error_px


def errors(poses: Mapping[str, Any], truth: Mapping[str, Any]) -> tuple[int, int, int, float | None, float | None]:
    """Views, how many were placed, how many of them well, median degrees and share of the extent of all of truth."""
    import numpy as np

    from spikerig.calib.gauge import centres, degrees_apart, extent, similarity

    names = sorted(poses)
    none = len(truth), len(names), 0, None, None
    if len(names) < 3:
        return none
    here, there = np.stack([poses[n] for n in names]), np.stack([truth[n] for n in names])
    try:
        at = similarity(here, there).poses(here)
    except DataError:  # all at one place
        return none
    turned = degrees_apart(at, there)
    moved = np.linalg.norm(centres(at) - centres(there), axis=1) / extent(np.stack(list(truth.values())))
    within = int(np.sum((turned <= WITHIN_DEG) & (moved <= WITHIN_SHARE)))
    return len(truth), len(names), within, float(np.median(turned)), float(np.median(moved))


def table(rows: Sequence[Row]) -> str:
    """The rows as Markdown: a line a scene and blur, and the sums."""

    def cell(row: Row) -> str:
        if row.reasons:
            return f"refused ({row.within} of {row.views} right)"
        error = "" if row.deg is None or row.share is None else f": {row.deg:.2f} deg, {100 * row.share:.2f} %"
        return f"{row.within} of {row.registered} placed{error}"

    by = {(r.blur_px, r.scene, r.arm): r for r in rows}
    lines = [f"| blur px | scene | {' | '.join(ARMS.values())} |", "|---|---|" + "---|" * len(ARMS)]
    for blur, scene in dict.fromkeys((r.blur_px, r.scene) for r in rows):
        lines.append(f"| {blur:g} | {scene} | {' | '.join(cell(by[blur, scene, arm]) for arm in ARMS)} |")
    for blur in dict.fromkeys(r.blur_px for r in rows):
        cells = []
        for arm in ARMS:
            some = [r for r in rows if r.blur_px == blur and r.arm == arm]
            good, views = sum(r.good for r in some), sum(r.views for r in some)
            cells.append(f"**{good} of {views} views ({good / max(views, 1):.0%})**")
        lines.append(f"| {blur:g} | all | {' | '.join(cells)} |")
    return "\n".join(lines)


def plot(rows: Sequence[Row], path: Path) -> None:
    """Share of views that succeed by scene and arm, a panel a blur; silent without matplotlib."""
    try:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt
    except ImportError:
        return
    matplotlib.rcParams["svg.hashsalt"] = "pose-study"
    blurs = sorted({r.blur_px for r in rows})
    scenes = list(dict.fromkeys(r.scene for r in rows))
    figure, panels = plt.subplots(
        1, len(blurs), figsize=(3.6 * len(blurs), 3.2), layout="constrained", sharey=True, squeeze=False
    )
    for axes, blur in zip(panels[0], blurs, strict=True):
        for (arm, label), shift in zip(ARMS.items(), (-0.27, 0.0, 0.27), strict=True):
            share = {r.scene: r.good / r.views for r in rows if r.blur_px == blur and r.arm == arm}
            places = [k + shift for k, s in enumerate(scenes) if s in share]
            axes.bar(places, [share[s] for s in scenes if s in share], 0.27, label=label)
        axes.set_xticks(range(len(scenes)), scenes, rotation=60)
        axes.set(title=f"blur {blur:g} px of {SIZE[0]}", ylim=(0, 1.02))
    panels[0][0].set_ylabel("views within 1 degree and 2 %")
    panels[0][-1].legend(fontsize=7)
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)
    plt.close(figure)


def pose_study(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for pose_study.json and .svg; goes on there.")],
    scenes: Annotated[str, typer.Option(help="Built-in scenes.")] = SCENES,
    blur: Annotated[str, typer.Option(help="Pixels the image centre moves over an exposure.")] = "8,16",
    views: Annotated[int, typer.Option(help="Of each scene.")] = 20,
    seed: Annotated[int, typer.Option(help="Of RANSAC and of the mapper; the scenes keep their own.")] = 1,
    force: Annotated[bool, typer.Option("--force", help="Start over.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Map simulated scenes from blurry RGB and from spike textures, and count the views that are placed well.

    Rows are saved as they come; the same command goes on where an earlier one stopped.
    """
    from spikerig.dataset import machine

    names = [s for s in scenes.split(",") if s]
    try:
        blurs = [float(b) for b in blur.split(",") if b]
    except ValueError as error:
        raise UsageError("blur is numbers of pixels", value=blur, expected="e.g. 8,16") from error
    if not names or not blurs or not 3 <= views <= 200:
        raise UsageError("a study needs scenes, blurs and 3 to 200 views", value=(scenes, blur, views))
    path, asked = out / "pose_study.json", {"views": views, "seed": seed, "size": list(SIZE), "arc_deg": ARC_DEG}
    rows = [] if force else _earlier(path, asked)
    out.mkdir(parents=True, exist_ok=True)
    bar = Progress("pose study", len(names) * len(blurs), "scenes")
    for level in blurs:
        for scene in names:
            if not any((r.scene, r.blur_px) == (scene, level) for r in rows):
                rows += measure(scene, level, views, seed)
                told = {**asked, "rows": [asdict(r) for r in rows], "machine": machine.describe()}
                told["command"] = machine.command()
                part = path.with_suffix(".json.partial")
                part.write_text(json.dumps(jsonable(told), indent=1, allow_nan=False) + "\n", encoding="utf-8")
                os.replace(part, path)
            bar.step(1, f"{scene}, {level:g} px")
    plot(rows, out / "pose_study.svg")
    if as_json:
        emit("spikerig.cost.pose_study/1", {**asked, "rows": [asdict(r) for r in rows]})
    else:
        note(table(rows))


def _earlier(path: Path, asked: dict[str, Any]) -> list[Row]:
    """Rows of an earlier run of the same study."""
    if not path.exists():
        return []
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        rows = [Row(**{**r, "reasons": tuple(r["reasons"])}) for r in told["rows"]]
        other = {k: told[k] for k in asked if told[k] != asked[k]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError("not an earlier study", value=path, cause=str(error), next="add --force") from error
    if other:
        raise UsageError("an earlier study had other settings", value=other, next="add --force, or another folder")
    return rows
