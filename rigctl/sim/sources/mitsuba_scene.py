"""Mitsuba scenes as light: poses and times from tables like a scene file's, pictures by a child process, a folder of
sub-frames as the joint."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import threading
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from queue import Empty, Queue
from typing import Any, TextIO, cast

import numpy as np
from numpy.typing import NDArray

from spikerig.dataset.errors import DataError, HostError, UsageError
from spikerig.rigctl.sim.capture import camera_of, view_path
from spikerig.rigctl.sim.judge.tomltext import toml_text
from spikerig.rigctl.sim.limits import Faults, limits, read_record
from spikerig.rigctl.sim.schedule import schedule
from spikerig.rigctl.sim.spec import SceneSpec, read_scene

VARIANTS = ("scalar_rgb", "scalar_spectral", "llvm_ad_rgb", "llvm_ad_spectral", "cuda_ad_rgb", "cuda_ad_spectral")
RECORD = "mitsuba.json"
SUB_POSES = 17  # of an exposure, unless said: pictures cost seconds here, so their number does not follow the motion
NOWHERE = {"solids": [{"kind": "rect", "centre": [0, 0, -1e6], "right": [1e-3, 0, 0], "up": [0, 1e-3, 0]}]}  # not empty
UP = {  # our world (z up) from the scene's
    "z": np.eye(3),
    "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "x": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
}


@dataclass(frozen=True, slots=True)
class Renderer:
    """`[mitsuba]`: how the scene is rendered.

    Args:
        spp: samples a pixel; 0 takes the square of `camera.samples`.
        variant: of Mitsuba; `scalar_rgb` always works.
        up: the scene's axis that points up; `orbit` goes around it, `orbit.target` is in the scene's own axes.
    """

    spp: int = limits(0, 0, 1 << 20, "samples a pixel")
    variant: str = limits("scalar_rgb", choices=VARIANTS)
    up: str = limits("z", choices=("x", "y", "z"))


@dataclass(frozen=True, slots=True)
class Plan:
    """Everything that will be rendered.

    Args:
        spec: the tables as read; its world is not used.
        renderer: as read.
        scene: the XML file.
        document: transforms.json.
        shots: the pictures, as `mitsuba_child` wants them.
        settings: text of capture.toml.
    """

    spec: SceneSpec
    renderer: Renderer
    scene: Path
    document: dict[str, Any]
    shots: list[dict[str, Any]]
    settings: str


def plan_scene(
    scene: str | Path,
    settings: str | Path | None = None,
    *,
    seed: int | None = None,
    spp: int | None = None,
    variant: str | None = None,
) -> Plan:
    """What to render of a Mitsuba scene.

    Args:
        scene: the XML file; its own sensors are not used, its integrator is.
        settings: TOML with the tables of a scene file but `world`, and `[mitsuba]`; None takes the one beside the
            scene (same name, .toml), or defaults.
        seed, spp, variant: in place of the settings'.

    Raises:
        UsageError: no such file, or faulty settings: all faults at once.
    """
    scene = Path(scene)
    if not scene.is_file():
        raise UsageError("there is no such scene", value=scene, expected="a Mitsuba XML file")
    path = Path(settings) if settings is not None else scene.with_suffix(".toml")
    table = _read(path) if settings is not None or path.is_file() else {}
    if "world" in table:
        raise UsageError("the world is the Mitsuba scene's", value=f"{path}: [world]", next="leave the table out")
    given = {k: v for k, v in (("spp", spp), ("variant", variant)) if v is not None}
    own = table.pop("mitsuba", {})
    if seed is not None:
        table["seed"] = seed
    table.setdefault("name", scene.stem)
    if isinstance(exposure := table.setdefault("exposure", {}), dict) and exposure.get("protocol") != "paper":
        exposure.setdefault("sub_poses", SUB_POSES)
    spec = read_scene({**table, "world": NOWHERE}, str(path))
    faults = Faults(str(path))
    renderer = read_record(Renderer, {**own, **given} if isinstance(own, dict) else own, "mitsuba", faults)
    if not spec.exposure.sub_poses:
        faults.add("exposure.sub_poses", "is 0, as many as the motion asks for: of a rendered scene say how many")
    if spec.exposure.light == "hold" and spec.exposure.margin_ticks:
        faults.add("exposure.margin_ticks", "are not for light that holds in a folder of frames: set 0")
    faults.raise_any()
    renderer = replace(renderer, spp=renderer.spp or spec.lens.samples**2)
    document, shots = _views(spec, UP[renderer.up])
    return Plan(spec, renderer, scene, document, shots, capture_toml(table))


def _read(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError("the settings cannot be read", value=f"{path}: {error}") from None


def _views(spec: SceneSpec, up: NDArray[np.float64]) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """transforms.json and the shots of every view."""
    target = tuple(float(v) for v in up @ np.array(spec.orbit.target))
    spec = replace(spec, orbit=replace(spec.orbit, target=target))  # type: ignore[arg-type]
    camera, plan, held_out = camera_of(spec), schedule(spec.exposure), spec.orbit.held_out()
    still = spec.exposure.sub_poses == 1
    phases = np.array([plan.label]) if still else plan.phases
    wanted = phases[int(np.argmin(np.abs(phases - (0.5 if spec.exposure.label == "mid" else phases[0]))))]
    views, shots = [], []
    for number in range(spec.orbit.views):
        path, name = view_path(spec, number), f"{number:03d}"
        test = number in held_out
        frames = []
        for k, phase in enumerate([plan.label] if test else phases):
            pose = _scene_pose(path.poses(phase)[0], up)
            file = f"{name}/{k:04d}.exr"
            seed = (spec.seed * 0x9E3779B1 + number * 0x10001 + k) % 2**32
            shots.append({"file": file, "kind": "light", "world_from_cam": pose.tolist(), "seed": seed})
            row = {"file": file, "transform_matrix": (pose @ np.diag([1.0, -1, -1, 1])).tolist()}
            if not test and not still and spec.exposure.light == "linear":
                row["phase"] = float(phase)
            frames.append(row)
        view: dict[str, Any] = {"name": name, "split": "test" if test else "train", "frames": frames}
        if not test:
            view["depth"] = f"{name}/depth.exr"
            pose = _scene_pose(path.poses(wanted)[0], up)
            shots.append({"file": view["depth"], "kind": "depth", "world_from_cam": pose.tolist(), "seed": 0})
        views.append(view)
    lens = {"camera_angle_x": np.radians(spec.lens.fov_deg), "w": camera.width, "h": camera.height}
    return {"name": spec.name, **lens, "views": views}, shots


def _scene_pose(cam_from_world: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """World-from-camera 4x4 in the scene's own axes."""
    R = cam_from_world[:, :3] @ up
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = R.T, -R.T @ cam_from_world[:, 3]
    return out


def capture_toml(table: Mapping[str, Any]) -> str:
    """The part of the settings that `sim frames` reads, as TOML."""
    kept = {k: v for k, v in table.items() if k not in ("camera", "orbit", "shake", "mitsuba")}
    if isinstance(kept.get("exposure"), dict):
        kept["exposure"] = {k: v for k, v in kept["exposure"].items() if k not in ("sub_poses", "margin_ticks")}
    return toml_text(kept)


def render_folder(
    plan: Plan,
    folder: Path,
    *,
    threads: int = 1,
    memory_gb: float = 16.0,
    patience_s: float = 600.0,
    force: bool = False,
    done: Callable[[str], None] = lambda file: None,
) -> None:
    """Render what a folder lacks; a folder begun with the same plan is gone on with.

    Args:
        plan: what to render.
        folder: made if need be.
        threads: Mitsuba's; the pictures of the scalar variants do not depend on it.
        memory_gb: address space the child process may use, 0 for no limit.
        patience_s: longest time for one picture.
        force: render into a folder of another plan (its pictures are replaced).
        done: called with each picture's file.

    Raises:
        UsageError: the folder holds something else. HostError: Mitsuba is missing, died or was too slow.
        DataError: Mitsuba cannot load or render the scene.
    """
    if find_spec("mitsuba") is None:
        raise HostError(
            "Mitsuba is not installed", cause="the extra 'mitsuba' was left out", next='pip install "spikerig[mitsuba]"'
        )
    _begin(plan, folder, force)
    camera = {"width": plan.spec.lens.width, "height": plan.spec.lens.height, "fov_x_deg": plan.spec.lens.fov_deg}
    job = {
        "scene": str(plan.scene.resolve()), "folder": str(folder.resolve()), "variant": plan.renderer.variant,
        "threads": max(1, threads), "memory_bytes": int(memory_gb * 2**30), "spp": plan.renderer.spp,
        "shots": plan.shots, **camera,
    }  # fmt: skip
    _watch(plan, job, patience_s, done)


def _begin(plan: Plan, folder: Path, force: bool) -> None:
    """The folder's plain files; a folder of another plan is refused, or its pictures are removed."""
    meant = {
        "scene": plan.scene.name, "sha256": hashlib.sha256(plan.scene.read_bytes()).hexdigest(),
        "spp": plan.renderer.spp, "variant": plan.renderer.variant, "document": plan.document,
        "seeds": [shot["seed"] for shot in plan.shots],
    }  # fmt: skip
    record = folder / RECORD
    found = None
    if folder.exists() and any(folder.iterdir()):
        try:
            found = json.loads(record.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            raise UsageError("the folder holds something else", value=folder, next="give another folder") from None
        if found != meant and not force:
            raise UsageError(
                "the folder was begun with another scene or other settings", value=folder,
                next="--force renders it anew; or give another folder",
            )  # fmt: skip
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for shot in plan.shots:
            (folder / shot["file"]).parent.mkdir(exist_ok=True)
            if found is not None and found != meant:
                (folder / shot["file"]).unlink(missing_ok=True)
        record.write_text(json.dumps(meant), encoding="utf-8")
        (folder / "transforms.json").write_text(json.dumps(plan.document, indent=1) + "\n", encoding="utf-8")
        (folder / "capture.toml").write_text(plan.settings, encoding="utf-8")
    except OSError as error:
        raise HostError("the frames cannot be written", value=f"{folder}: {error.strerror}") from error


def _watch(plan: Plan, job: dict[str, Any], patience_s: float, done: Callable[[str], None]) -> None:
    """Run the child and listen to it."""
    words = [sys.executable, "-m", "spikerig.rigctl.sim.sources.mitsuba_child"]
    child = subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=dict(os.environ)
    )
    lines: Queue[str | None] = Queue()
    said: list[str] = []
    threads = [
        threading.Thread(target=_pump, args=(child.stdout, lines.put), daemon=True),
        threading.Thread(target=_pump, args=(child.stderr, lambda text: said.append(text or "")), daemon=True),
    ]
    for thread in threads:
        thread.start()
    try:
        try:
            with cast(TextIO, child.stdin) as stdin:
                stdin.write(json.dumps(job))
        except BrokenPipeError:
            pass  # it died at once; its exit says more
        trouble = ""
        while (line := lines.get(timeout=patience_s)) is not None:
            message = json.loads(line)
            if "done" in message:
                done(message["done"])
            trouble = message.get("error", trouble)
        code = child.wait(timeout=60)
    except (Empty, subprocess.TimeoutExpired):
        raise HostError(
            "Mitsuba took too long for a picture", value=f"more than {patience_s:g} s",
            next="give fewer --spp, a smaller picture, or more --patience",
        ) from None  # fmt: skip
    finally:
        child.kill()
        child.wait()
        for thread in threads:
            thread.join(5)
    if trouble:
        raise DataError("Mitsuba cannot render the scene", value=plan.scene, cause=trouble)
    if code:
        raise _died(plan, code, "".join(said))


def _pump(stream: Any, put: Callable[[str | None], object]) -> None:
    for text in stream:
        put(text)
    put(None)
    stream.close()


def _died(plan: Plan, code: int, said: str) -> HostError:
    last = said.strip().splitlines()[-1:] or [""]
    cause = last[0][:500]
    if plan.renderer.variant.startswith("llvm"):
        cause = "llvm variants need LLVM 19 or later (15 and 16 end the process)" + (f"; {cause}" if cause else "")
    return HostError(
        "Mitsuba died", value=f"{plan.renderer.variant}, exit {code}", cause=cause or "out of memory, or a crash in it",
        next="--variant scalar_rgb, which always works; or set DRJIT_LIBLLVM_PATH; or more --memory-gb",
    )  # fmt: skip
