"""`spikerig cost poses`: features, picture size, instants and number of maps, against seconds and pose error."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spikerig.dataset import cost, machine
from spikerig.dataset.errors import HostError, UsageError
from spikerig.dataset.terminal import Progress
from spikerig.dataset.texture_cost import finish

if TYPE_CHECKING:
    from spikerig.calib.mapping import Map
    from spikerig.dataset.scene import Camera, View

FEATURES = (512, 1024, 2048, 4096)
PEAKS = (0.0017, 0.0033, 0.0067, 0.0133)
SIZES = (0.5, 0.75, 1.0, 2.0)
INSTANTS = (1, 3, 5, 9)
MAPS = (1, 2, 3, 4)


class Truth:
    """What a sweep runs on: views with spikes, the camera, and the true path over each exposure."""

    def __init__(self, path: Path, views: int) -> None:
        import numpy as np

        from spikerig.calib.poses import best_kind, gain_of
        from spikerig.dataset.store import open_scene

        with open_scene(path) as scene:
            if not scene.has_truth or "poses" in scene.info:
                raise UsageError(
                    "this scene has no true poses", value=path, next="spikerig sim capture demo -o demo.h5"
                )
            names = scene.train if not views else scene.train[:views]
            self.views: list[View] = [scene.view(n) for n in names]
            self.camera: Camera = scene.camera
            self.paths = {n: scene.truth_trajectory(n) for n in names}
        self.poses = {v.name: np.asarray(v.pose.cam_from_world) for v in self.views}
        self.gain = gain_of(self.views)
        self.kind = best_kind(self.views, self.gain)

    def off(self, poses: Mapping[str, Any]) -> tuple[float, str]:
        """Median degrees from the truth, and a note: share of the extent, and views that were placed."""
        import numpy as np

        from spikerig.calib.gauge import pose_errors

        names = sorted(poses)
        if len(names) < 3:
            return float("nan"), f"{len(names)} of {len(self.views)} views"
        turned, moved = pose_errors(*(np.stack([m[n] for n in names]) for m in (poses, self.poses)))
        placed = "" if len(names) == len(self.views) else f", {len(names)} of {len(self.views)} views"
        return float(np.median(turned)), f"deg, {100 * np.median(moved):.2f} %{placed}"

    def ends_off(self, estimate: Any) -> tuple[float, str]:
        """The same at the first and last instant of each exposure; the middle pose where there is no path."""
        import numpy as np

        from spikerig.calib.gauge import degrees_apart, similarity

        names = sorted(estimate.poses)
        to = similarity(*(np.stack([m[n] for n in names]) for m in (estimate.poses, self.poses)))
        found, true = [], []
        for name in names:
            view, path = next(v for v in self.views if v.name == name), self.paths[name]
            ends = np.array([-0.5, 0.5]) * view.frame.exposure_ns + view.mid_ns
            true += [path.poses[int(np.argmin(np.abs(path.at_ns - t)))] for t in ends]
            got = estimate.paths.get(name)
            found += [estimate.poses[name]] * 2 if got is None else [got.poses[0], got.poses[-1]]
        turned = degrees_apart(to.poses(np.stack(found)), np.stack(true))
        return float(np.median(turned)), f"deg, {len(estimate.paths)} paths"


def plan(truth: Truth, threads: int) -> Iterator[tuple[str, Any, Callable[[], tuple[float, str]]]]:
    """Every run of the sweep: (series, value, run), each run giving an error and a note."""
    from spikerig.calib.mapping import Options
    from spikerig.calib.poses import Wanted, estimate_poses

    base = Options(threads=threads)

    def mapped(options: Options, times: float = 1.0) -> tuple[float, str]:
        found = one_map(truth, options, times)
        return truth.off({n: p.pose for n, p in found.poses.items()})

    def whole(**more: Any) -> Any:
        return estimate_poses(truth.views, truth.camera, Wanted(**more), base)

    for n in FEATURES:
        yield f"one map, {truth.kind}: features", n, lambda n=n: mapped(replace(base, max_features=n))
    for n in PEAKS:
        yield f"one map, {truth.kind}: peak threshold", n, lambda n=n: mapped(replace(base, peak_threshold=n))
    for n in SIZES:
        yield f"one map, {truth.kind}: times the scene's size", n, lambda n=n: mapped(base, n)
    for n in MAPS:
        yield "maps that are averaged", n, lambda n=n: truth.off(whole(maps=n, instants=1).poses)
    for n in INSTANTS:
        run = partial(whole, kinds=(truth.kind,), maps=1, instants=n)
        yield "one map: instants, error at both ends", n, lambda run=run: truth.ends_off(run())


def one_map(truth: Truth, options: Any, times: float) -> Map:
    """A map of the middle instants, from pictures made larger or smaller."""
    import cv2
    import numpy as np

    from spikerig.calib.mapping import build_map
    from spikerig.calib.poses import look_at

    pictures = {v.name: look_at(v, 0.5, truth.kind, truth.gain) for v in truth.views}
    camera = truth.camera
    if times != 1:
        wide, high = round(camera.width * times), round(camera.height * times)
        how = cv2.INTER_AREA if times < 1 else cv2.INTER_CUBIC
        pictures = {
            n: np.asarray(cv2.resize(p, (wide, high), interpolation=how), np.uint8) for n, p in pictures.items()
        }
        scale = np.diag([wide / camera.width, high / camera.height, 1.0])  # our pixel centres are at +0.5
        camera = replace(camera, K=scale @ camera.K, width=wide, height=high)
    return build_map(pictures, camera, options)


def sweep(scene: Path, views: int, threads: int) -> cost.Sweep:
    """Run every setting once; CPU seconds are of COLMAP's process too.

    Args:
        scene: a scene file with truth.
        views: the first so many train views; 0: all.
        threads: of features and matches.
    """
    truth = Truth(scene, views)
    settings: Sequence[Any] = list(plan(truth, threads))
    bar = Progress("cost poses", len(settings), "runs")
    rows = []
    for series, value, run in settings:
        before, began = os.times(), time.perf_counter()
        error, told = run()
        wall, after = time.perf_counter() - began, os.times()
        cpu = max(sum(after[:4]) - sum(before[:4]), 1 / os.sysconf("SC_CLK_TCK"))  # in steps of the system's tick
        rows.append(cost.Row(series, value, error, cpu, wall, 0, told))
        bar.step(extra=f"{series} {value}")
    return cost.Sweep(
        "poses",
        f"Poses of '{scene.stem}', {len(truth.views)} views of {truth.camera.width}x{truth.camera.height}",
        "setting", "degrees, median", "the true poses, after the best similarity", 0, tuple(rows),
        machine.describe(), machine.command(), ("peak memory: COLMAP is a process of its own",),
    )  # fmt: skip


def poses(
    scene: Annotated[Path | None, typer.Argument(help="A scene file with truth; none: the demo, simulated.")] = None,
    views: Annotated[int, typer.Option(min=0, help="The first so many train views; 0: all.")] = 0,
    threads: Annotated[int, typer.Option(min=0, help="Of features and matches; 0: one a core.")] = 0,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder for poses.json and poses.svg.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier result.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Sweep features, contrast, picture size, maps and instants of pose estimation: error over seconds."""

    def run() -> cost.Sweep:
        if scene is not None:
            return sweep(scene, views, threads)
        with tempfile.TemporaryDirectory(prefix="spikerig-cost-") as folder:
            path = Path(folder) / "demo.h5"
            words = [sys.executable, "-m", "spikerig.dataset", "sim", "capture", "demo", "-o", str(path), "--json"]
            done = subprocess.run(words, stdout=subprocess.DEVNULL, check=False)
            if done.returncode:
                raise HostError("the demo scene was not made", value=f"exit {done.returncode}", cause="said above")
            return sweep(path, views, threads)

    finish("poses", run, out, force, as_json)
