"""A fit from scene file to run folder: prepare, train with checkpoints and held-out curves, record."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from spikerig.dataset.errors import DataError, NumericsError, UsageError
from spikerig.dataset.terminal import Progress, note
from spikerig.train import record as records
from spikerig.train.bridge import Cameras, bridge, true_pose
from spikerig.train.config import FitConfig
from spikerig.train.converter import converter
from spikerig.train.fields import field_of
from spikerig.train.fit import State, Task, check_finite, load_state, new_state, save_state, torch_threads, train
from spikerig.train.gauge import gauge_of
from spikerig.train.guard import Guard, copy_state, reproducer
from spikerig.train.model import SplatModel, check_pinhole
from spikerig.train.parts import parts_of
from spikerig.train.path import MIDDLE, paths
from spikerig.train.ply import export_ply
from spikerig.train.restorer import check_restorer
from spikerig.train.score import Exam, mean_psnr, novel_views
from spikerig.train.targets import load_targets
from spikerig.train.trajectory import PATH_PHASES

if TYPE_CHECKING:
    from spikerig.dataset.scene import Points
    from spikerig.dataset.store import SceneFile

MOST_EXAMS = 8  # held-out views looked at for the curve
LOOKS = (1 / 80, 1 / 40, 1 / 20, *(k / 10 for k in range(1, 10)))  # fractions of a run, closer where dB rise fast


def run_fit(
    path: Path,
    config: FitConfig,
    out: Path,
    *,
    resume: bool = False,
    force: bool = False,
    eval_every: float | None = None,
    checkpoint_every: float = 60.0,
    ply: bool = False,
    score_on: Path | None = None,
    points_of: Path | None = None,
) -> dict[str, Any]:
    """Train on a scene file and leave a run folder.

    Args:
        path: scene file.
        config: of the fit.
        out: folder of the run.
        resume: go on from its checkpoint, where there is one; the config must be the same.
        force: replace an earlier run.
        eval_every: seconds of training between held-out scores; None = at LOOKS, 0 = only at the end.
        checkpoint_every: seconds between checkpoints.
        ply: write splats.ply at the end.
        score_on: scene whose held-out views make the curve; None: those of the scene itself.
        points_of: scene whose points to start from, in the same world; None: those of the scene itself.

    Returns:
        What `train fit --json` prints.
    """
    from spikerig.dataset.store import open_scene

    field_of(config).check(config)  # a missing extra is told before minutes of preparation
    if config.colour_target == "restored":
        check_restorer(config)
    if ply and config.field != "splat":
        raise UsageError("only splats can be written as .ply", value=f"field {config.field}", next="leave out --ply")
    begin = time.monotonic()
    with open_scene(path) as scene, torch_threads():
        records.prepare_folder(out, force=force, resume=resume)
        points = scene.points if points_of is None else _points(points_of)
        task, record = prepare(scene, path, config, points)
        record["points_of"] = None if points_of is None else str(points_of)
        state = _start(out, scene, task, resume, points, record["points_of"])
        exams = _exams(scene) if score_on is None else _exams_of(score_on, scene)
        known = {name: true_pose(scene, name) for name in scene.train} if config.moves_cameras else {}
    record["prepare_seconds"] = time.monotonic() - begin
    _tell(task, record)
    watch = _Watch(out, task, record, exams, known, eval_every, checkpoint_every, Guard(copy_state(state)))
    watch.write(state)
    if state.step == 0:
        watch.look(state, 0.0)
    try:
        train(state, task, after=watch)
    except NumericsError as error:
        note("not finite: looking for the first step that broke")
        raise reproducer(out, watch.guard.kept, task, error) from error
    except KeyboardInterrupt:
        watch.save(state)
        note(f"stopped at step {state.step}; --resume goes on")
        raise
    return _finish(state, watch, record, ply)


def _points(path: Path) -> Points | None:
    from spikerig.dataset.store import open_scene

    with open_scene(path) as other:
        return other.points


def prepare(
    scene: SceneFile, path: Path, config: FitConfig, points: Points | None = None
) -> tuple[Task, dict[str, Any]]:
    """All that a fit of an open scene (from `path`) needs, from its points or others, and the record for run.json."""
    check_pinhole(scene.camera)
    poses = np.stack([scene.view(name, spikes=False).pose.cam_from_world for name in scene.names] or [np.eye(4)[:3]])
    points = scene.points if points is None else points
    gauge = gauge_of(points.xyz if points is not None and config.init == "points" else np.zeros((0, 3)), poses)
    targets = load_targets(scene, config, gauge)
    found = targets.gray
    gray = torch.zeros(4) if found is None else torch.tensor([*found.weights, found.bias])
    task = Task(config, scene.camera, gauge, targets, gray)
    about = {"path": str(path), "name": scene.name, "sha256": records.scene_hash(path)}
    record = records.new_record(config, about, scene.camera, gauge)
    record |= {
        "gray": None if found is None else found.as_json(),
        "filters": None if targets.filters is None else targets.filters.as_json(),
        "effective_tfs_weight": task.weight,
        "remarks": [*targets.remarks, *(part.remark for part in parts_of(config) if part.remark)],
        "deblurred": targets.deblurred,
        "renders_per_step": {
            "ratio": 1 if targets.ratio else 0,
            "average": len({*targets.colour, *targets.tfs, *targets.also}),
        },
    }
    return task, record


def prepare_again(record: dict[str, Any], config: FitConfig, moved: Path | None = None) -> Task:
    """The task of a stored run, from its run.json and config.

    Args:
        record: run.json.
        config: of the run.
        moved: where the scene is now; None: where it was.

    Raises:
        DataError: another scene than the run's, or none.
    """
    from spikerig.dataset.store import open_scene

    path = Path(record["scene"]["path"]) if moved is None else moved
    with open_scene(path) as scene, torch_threads():
        if record["scene"]["sha256"] != records.scene_hash(path):
            raise DataError("this is not the scene the run was made from", value=path, next="--scene FILE")
        points_of = record.get("points_of")
        return prepare(scene, path, config, _points(Path(points_of)) if points_of else None)[0]


def _start(
    out: Path, scene: SceneFile, task: Task, resume: bool, points: Points | None, points_of: str | None
) -> State:
    path = out / records.CHECKPOINT
    if not (resume and path.exists()):
        return new_state(points, task)
    state, config = load_state(path)
    now = task.config.as_json()
    if config != now:
        other = ", ".join(f"{k}: {config.get(k)} -> {now[k]}" for k in now if config.get(k) != now[k])
        raise UsageError("a run goes on with the settings it began with", value=other, next="--force starts anew")
    earlier = records.read_json(out / records.RECORD)
    if earlier["scene"]["sha256"] != records.scene_hash(scene.path):
        raise DataError("this is not the scene the run began with", value=scene.path, next="--force starts anew")
    if (earlier.get("deblurred") or {}).get("sha256") != (task.targets.deblurred or {}).get("sha256"):
        raise DataError("this is not the restorer the run began with", value=task.config.restorer)
    if earlier.get("points_of") != points_of:
        raise UsageError("a run goes on with the points it began with", value=points_of, expected=earlier["points_of"])
    if earlier["machine"]["isa"] != _isa():
        note(f"warning: begun with {earlier['machine']['isa']} kernels, going on with {_isa()}: other bits")
    note(f"going on at step {state.step}")
    return state


def _isa() -> str:
    from spikerig import _native

    return _native.isa()


def _exams(scene: SceneFile) -> list[Exam]:
    exams, _ = novel_views(scene)
    return exams[:: max(1, -(-len(exams) // MOST_EXAMS))]


def _exams_of(path: Path, trained: SceneFile) -> list[Exam]:
    from spikerig.dataset.store import open_scene

    with open_scene(path) as other:
        sizes = [f"{s.camera.width}x{s.camera.height}" for s in (other, trained)]
        if sizes[0] != sizes[1]:
            raise DataError("the scene to score on has another size", value=sizes[0], expected=sizes[1])
        return _exams(other)


def _tell(task: Task, record: dict[str, Any]) -> None:
    config = task.config
    length = f"{config.seconds:g} s" if config.seconds > 0 else f"{config.steps} steps"
    note(f"{config.method} on {record['scene']['name']}: {len(task.targets.views)} views, {length}, seed {config.seed}")
    instants = len({*task.targets.colour, *task.targets.also})
    note(f"  pose label '{config.pose_label}'; {instants} sub-pose(s) a view for colour")
    if config.tfs_weight > 0:
        note(
            f"  TfS: w = {config.tfs_weight:g} read as '{config.weight_reading}': {task.weight:g} on means; "
            f"{len(task.targets.tfs)} instant(s), {config.textures}, {config.tfs_domain}"
        )
    if (gray := task.targets.gray) is not None and config.tfs_weight > 0:
        k = ", ".join(f"{x:.3f}" for x in gray.weights)
        note(f"  gray ({gray.how}): {k}, bias {gray.bias:+.4f}, white = {gray.white:.3f} spikes a tick")
    if (sharper := task.targets.deblurred) is not None:
        note(
            f"  pictures deblurred first: {sharper['how']}, "
            + ", ".join(f"{k} {v}" for k, v in sharper.items() if k != "how")
        )
    for remark in record["remarks"]:
        note(f"  note: {remark}")


@dataclass(slots=True)
class _Watch:
    """Called after every step: progress, held-out curve, checkpoints. None of its time counts as training."""

    out: Path
    task: Task
    record: dict[str, Any]
    exams: list[Exam]
    known: Cameras  # where the world of the exams has the training cameras, where the fit moves them
    eval_every: float | None
    checkpoint_every: float
    guard: Guard
    looked: float = 0.0
    saved: float = field(default_factory=time.monotonic)
    pause: float = 0.0  # after a save that took long: it may cost a twentieth of the time, not more
    bar: Progress | None = None

    def __call__(self, state: State, fraction: float, loss: float) -> None:
        config = self.task.config
        self.guard(state)
        if self.bar is None:
            total = round(config.seconds) if config.seconds > 0 else config.steps
            self.bar = Progress("training", total, "s" if config.seconds > 0 else "steps")
            self.bar.done = int(fraction * total) if config.seconds > 0 else state.step - 1
        ahead = min(int(fraction * self.bar.total), self.bar.total) if config.seconds > 0 else state.step
        self.bar.step(ahead - self.bar.done, extra=f"loss {loss:.4f}")
        if fraction < 1 and self._due(state, fraction):
            self.look(state, fraction)
        if time.monotonic() - self.saved >= max(self.checkpoint_every, self.pause):
            self.save(state)

    def _due(self, state: State, fraction: float) -> bool:
        if self.eval_every is None:
            return any(self.looked < at <= fraction for at in LOOKS)
        last = state.history[-1]["seconds"] if state.history else 0.0
        return self.eval_every > 0 and state.seconds - last >= self.eval_every

    def look(self, state: State, fraction: float) -> None:
        """Score the held-out views and add a point to history.json."""
        self.looked = fraction
        row: dict[str, Any] = {"seconds": state.seconds, "step": state.step, "fraction": fraction, "psnr": None}
        row |= {"cpu_seconds": state.cpu, "renders": state.renders}
        if self.exams:
            row["psnr"] = mean_psnr(self.task.model(state), self._brought_over(state))
        state.history.append(row)
        records.write_json(self.out / records.HISTORY, state.history)

    def _brought_over(self, state: State) -> list[Exam]:
        """The exams in the world of the cameras as they are now, by the training cameras alone (as `train score`)."""
        if len(self.known) < 3:  # cameras stay, or are too few to tell a similarity from them
            return self.exams
        found = bridge(self.known, {n: each[MIDDLE] for n, each in paths(state, self.task).items()}, estimated=True)
        return [replace(exam, pose=found.pose(exam.pose)) for exam in self.exams]

    def write(self, state: State, done: dict[str, Any] | None = None) -> None:
        """Write run.json, and where cameras move, paths.json."""
        moved: dict[str, Any] = {}
        if self.task.config.moves_cameras:
            found = paths(state, self.task)
            moved = {"cameras": {name: each[MIDDLE].tolist() for name, each in found.items()}}
            views = {name: each.reshape(len(each), 12).tolist() for name, each in found.items()}
            record = {"schema": "spikerig.paths/1", "phases": PATH_PHASES, "cam_from_world": views}
            records.write_json(self.out / records.PATHS, record)
        done = done or {"steps": state.step, "train_seconds": state.seconds}
        records.write_json(self.out / records.RECORD, {**self.record, **moved, **done})

    def save(self, state: State) -> None:
        """Write a checkpoint; run.json beside it where cameras move, so that both tell of the same step."""
        check_finite(state)
        begin = time.monotonic()
        save_state(self.out / records.CHECKPOINT, state, self.task.config)
        if self.task.config.moves_cameras:
            self.write(state)
        self.saved = time.monotonic()
        self.pause = 20 * (self.saved - begin)


def _finish(state: State, watch: _Watch, record: dict[str, Any], ply: bool) -> dict[str, Any]:
    if not state.history or state.history[-1]["step"] != state.step:
        watch.look(state, 1.0)
    watch.save(state)
    done = {
        "status": "complete",
        "steps": state.step,
        "train_seconds": state.seconds,
        "train_cpu_seconds": state.cpu,
        "renders": state.renders,
        "renders_of": "pictures" if watch.task.config.field == "splat" else "rays",
        "parameters": sum(p.numel() for p in state.params.values()),
    }
    if "means" in state.params:
        done["splats"] = len(state.params["means"])
    if "gray" in state.params:
        gray, heights = converter(watch.task.config.gray, state.params["gray"].detach(), watch.task.gray)
        done["learned_gray"] = gray.tolist()
        done["learned_response"] = None if heights is None else heights.tolist()
    watch.write(state, done)
    model = watch.task.model(state)
    if ply and isinstance(model, SplatModel):
        export_ply(watch.out / "splats.ply", model.splats, model.gauge, force=True)
    psnr = state.history[-1]["psnr"]
    note(
        f"{watch.out}: {state.step} steps in {state.seconds:.1f} s"
        + ("" if psnr is None else f", held-out PSNR {psnr:.2f} dB (pose label '{watch.task.config.pose_label}')")
    )
    return {
        "run": str(watch.out), "method": watch.task.config.method, **done,
        "pose_label": watch.task.config.pose_label, "psnr": psnr, "seed": watch.task.config.seed,
        "effective_tfs_weight": watch.task.weight, "remarks": record["remarks"],
        "gray": record["gray"], "filters": record["filters"],
        "prepare_seconds": record["prepare_seconds"], "model_sha256": model_hash(state),
    }  # fmt: skip


def model_hash(state: State) -> str:
    """SHA-256 over the parameters, for comparing runs to the bit."""
    import hashlib

    digest = hashlib.sha256()
    for name in sorted(state.params):
        digest.update(name.encode() + state.params[name].detach().contiguous().numpy().tobytes())
    return digest.hexdigest()
