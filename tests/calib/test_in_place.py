"""`calib align` and `calib poses --write` complete a scene in place: killed at any moment, the original is whole."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from calib_takes import misaligned, rig_of

from spikerig.calib.mapping import Map, Options, Placed
from spikerig.calib.pose_cli import report
from spikerig.calib.posed_scene import write_poses
from spikerig.calib.poses import Estimate
from spikerig.calib.rig import write_calibration
from spikerig.dataset import cli
from spikerig.dataset.errors import HostError
from spikerig.dataset.outfile import STALE_S, stand_in
from spikerig.dataset.provenance import file_sha256
from spikerig.dataset.store import open_scene, verify_scene

KILLED = """
import os, signal, sys
import {module} as module
real, seen = module.{function}, []
def dies(*told, **more):
    seen.append(1)
    if len(seen) == {at}:
        os.kill(os.getpid(), signal.SIGKILL)
    return real(*told, **more)
module.{function} = dies
from spikerig.dataset import cli
sys.exit(cli.run(sys.argv[1:]))
"""


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("in_place")
    misaligned(folder / "raw.h5")
    write_calibration(folder / "calib.json", rig_of(folder / "raw.h5"))
    return folder / "raw.h5"


def copy_of(raw: Path, folder: Path) -> Path:
    path = folder / "scene.h5"
    path.write_bytes(raw.read_bytes())
    return path


@pytest.mark.parametrize(
    ("module", "function", "at"),
    [
        ("spikerig.calib.aligned_scene", "_aligned_view", 3),
        ("spikerig.dataset.store_write", "_sync", 1),
        ("spikerig.dataset.store_write", "remember", 1),
    ],
)
def test_kill_9_leaves_the_original(raw: Path, tmp_path: Path, module: str, function: str, at: int) -> None:
    """Between views, before the new file is on disk, and after, before it takes its place."""
    path = copy_of(raw, tmp_path)
    words = ["calib", "align", str(path), "--with", str(raw.with_name("calib.json"))]
    code = KILLED.format(module=module, function=function, at=at)
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, timeout=120)
    assert done.returncode == -9, done.stderr.decode()
    assert path.read_bytes() == raw.read_bytes()
    assert verify_scene(path) == []
    left = [p for p in tmp_path.iterdir() if p != path]
    assert len(left) == 1
    assert left[0].name.startswith(".scene.align.")
    if function != "_aligned_view":
        return
    os.utime(left[0], (0, time.time() - 2 * STALE_S))
    assert cli.run(words) == 0
    assert [p.name for p in tmp_path.iterdir()] == ["scene.h5"]
    with open_scene(path) as scene:
        assert scene.info["align"]["accepted"] is True


def test_the_record_says_of_what_and_with_what(raw: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = copy_of(raw, tmp_path)
    (tmp_path / "regions.json").write_text('[{"arm": "rgb", "polygon_px": [[10, 10], [30, 10], [30, 20]]}]')
    words = ["calib", "align", str(path), "--with", str(raw.with_name("calib.json"))]
    assert cli.run([*words, "--regions", str(tmp_path / "regions.json"), "--depth-mm", "900", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    with open_scene(raw) as before, open_scene(path) as after:
        made = after.info["align"]
        assert made["source"] == {"name": "scene.h5", "sha256": before.sha256}
        assert after.sha256 != before.sha256
    assert made["files"] == {"calibration": {"name": "calib.json", "sha256": file_sha256(raw.with_name("calib.json"))}}
    assert set(made["versions"]) >= {"spikerig", "numpy", "opencv-contrib-python-headless", "h5py"}
    assert made["options"] == {"depth_mm": 900.0, "refine": False, "flat": False}
    assert made["regions"] == [{"arm": "rgb", "polygon_px": [[10.0, 10.0], [30.0, 10.0], [30.0, 20.0]]}]
    assert made["edges_px"]["median"] == told["edges_px"]["median"]
    assert set(made["residuals"]) == {"board_px", "crop_px"}


def test_poses_are_written_in_place_or_not_at_all(raw: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = copy_of(raw, tmp_path)
    with open_scene(path) as scene:
        known = {n: np.array(scene.view(n, spikes=False).pose.cam_from_world) for n in scene.train}
    mapped = Map({n: Placed(p, 50, None, 0.25) for n, p in known.items()}, error=np.linspace(0, 2, 900), error_px=0.25)
    estimate = Estimate(tuple(known), known, {}, mapped, ("tfp96",))
    record = report(estimate, Options())
    assert record["residual_px"] == dict.fromkeys(known, 0.25)
    assert len(record["point_residuals"]) == 200
    assert record["point_residuals"][100] == pytest.approx(1.005, abs=0.01)

    class Full(Exception):
        pass

    def full(*told: object) -> None:
        raise Full

    with pytest.raises(Full):
        write_poses(path, estimate, record, done=full)
    assert path.read_bytes() == raw.read_bytes()
    with monkeypatch.context() as broken:
        broken.setattr(os, "replace", _no_space_for(path))
        with pytest.raises(HostError, match="cannot be replaced"):
            write_poses(path, estimate, record)
    assert path.read_bytes() == raw.read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == ["scene.h5"]
    write_poses(path, estimate, record)
    assert verify_scene(path) == []


POSES = """
import spikerig.calib.poses as poses
from spikerig.calib.mapping import Map, Placed

def known(views, camera, wanted, options, **more):
    stand = {v.name: v.pose.cam_from_world.copy() for v in views}
    for k, pose in enumerate(stand.values()):
        pose[0, 3] += 0.1 * k * k  # takes of tests stand at one place
    return poses.Estimate(tuple(stand), stand, {}, Map({n: Placed(p, 50) for n, p in stand.items()}), ("tfp96",))

poses.estimate_poses = known
"""


@pytest.mark.parametrize(
    ("module", "function", "at"),
    [
        ("spikerig.calib.posed_scene", "_copy", 2),
        ("spikerig.dataset.store_write", "_sync", 1),
        ("spikerig.dataset.store_write", "remember", 1),
    ],
)
def test_kill_9_while_poses_are_written(raw: Path, tmp_path: Path, module: str, function: str, at: int) -> None:
    """The command itself, its poses given: between views, before the new file is on disk, before it takes its place."""
    path = copy_of(raw, tmp_path)
    words = ["calib", "poses", str(path), "--write"]
    code = POSES + KILLED.format(module=module, function=function, at=at)
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, timeout=120)
    assert done.returncode == -9, done.stderr.decode()
    assert path.read_bytes() == raw.read_bytes()
    assert verify_scene(path) == []
    left = [p.name for p in tmp_path.iterdir() if p != path]
    assert len(left) == 1
    assert left[0].startswith(".scene.poses.")
    if function == "_copy":
        code = POSES + KILLED.format(module=module, function=function, at=-1)
        again = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, timeout=120)
        assert again.returncode == 0, again.stderr.decode()
        with open_scene(path) as scene:
            assert scene.info["poses"]["accepted"] is True


def _no_space_for(path: Path) -> Callable[[str | Path, str | Path], None]:
    real = os.replace

    def stopped(source: str | Path, target: str | Path) -> None:
        if Path(target) == path:
            raise OSError(28, "No space left on device")
        real(source, target)

    return stopped


def test_only_what_dead_processes_left_is_swept(tmp_path: Path) -> None:
    target = tmp_path / "a.b.h5"
    old = time.time() - 2 * STALE_S
    dead = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, check=True)
    pid = int(dead.stdout)
    kept = [f".a.b.align.{os.getppid()}.h5.partial", f".a.b.poses.{pid}.h5", f".axb.align.{pid}.h5", ".a.b.align.x.h5"]
    gone = [f".a.b.align.{pid}.h5", f".a.b.align.{pid}.h5.partial"]
    for name in (*kept, *gone):
        (tmp_path / name).write_text("")
        os.utime(tmp_path / name, (old, old))
    with stand_in(target, "align") as beside:
        beside.write_text("new")
        assert not target.exists()
    assert {p.name for p in tmp_path.iterdir()} == {*kept, "a.b.h5"}
    assert target.read_text() == "new"
    fresh = tmp_path / gone[0]
    fresh.write_text("")
    with stand_in(target, "align") as beside:
        beside.write_text("newer")
    assert fresh.exists()  # written to just now: perhaps by another machine
