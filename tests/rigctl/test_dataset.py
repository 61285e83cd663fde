"""A dataset of built-in scenes: the same bytes from one worker, two, a cluster, and after a kill."""

import json
import os
import signal
import subprocess
import sys
import time
from collections import namedtuple
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spikerig.dataset.cli import run
from spikerig.dataset.errors import DataError, HostError, UsageError
from spikerig.dataset.images import read_image
from spikerig.dataset.store import open_scene, verify_scene
from spikerig.rigctl.sim import dataset, farm, shelf
from spikerig.rigctl.sim.capture import take_view
from spikerig.rigctl.sim.dataset import Order, make, spec_of
from spikerig.rigctl.sim.shelf import Shelf, alone, fingerprint

ORDER = Order(("glossy",), views=4, test_every=2, seed=7, size=(32, 20))
WORDS = ["--scenes", "glossy", "--views", "4", "--test-every", "2", "--seed", "7", "--size", "32x20"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset, made at one go by one worker."""
    folder = tmp_path_factory.mktemp("whole")
    make(folder, ORDER)
    return folder


def sums(folder: Path) -> tuple[str, str]:
    """The digest of the folder's manifest, and of the scene's bytes."""
    return dataset.read_manifest(folder)["sha256"], dataset.sha256_of(folder / "glossy.h5")


def test_what_is_made(whole: Path) -> None:
    assert sorted(p.name for p in whole.iterdir()) == ["glossy.h5", "glossy.png", "manifest.json", "overview.png"]
    manifest = dataset.read_manifest(whole)
    row = manifest["scenes"]["glossy"]
    assert manifest["status"] == "complete"
    assert row["sha256"] == dataset.sha256_of(whole / "glossy.h5")
    assert row["bytes"] == (whole / "glossy.h5").stat().st_size
    assert (row["train_views"], row["test_views"], row["seed"], row["size"]) == (2, 2, 7, [32, 20])
    assert manifest["command"] == "spikerig sim dataset --out DIR " + " ".join(WORDS)
    assert verify_scene(whole / "glossy.h5") == []
    with open_scene(whole / "glossy.h5") as file:
        scene = file.read()
    assert scene.truth is not None
    assert [v.split for v in scene.views] == ["train", "test", "train", "test"]
    assert scene.info["made_by"] == "spikerig sim dataset"
    assert scene.info["scene_file"]["shake"]["path_px"] == [12 * 32 / 400, 22 * 32 / 400]
    sheet = read_image(whole / "glossy.png")
    assert sheet.shape == (60, 64, 3)
    assert np.array_equal(sheet[:20, :32], scene.views[0].frame.pixels)
    assert sheet[20:40].std() > 10
    small_one = read_image(whole / "overview.png")
    assert small_one.shape == (10, 96, 3)
    assert abs(float(small_one[:, :16].mean()) - float(sheet[:20, 32:].mean())) < 0.5
    assert not small_one[:, 48:].any()


def test_half_and_half_as_in_the_paper() -> None:
    spec = spec_of(Order(views=200, test_every=2), "leaves")
    assert len(spec.orbit.held_out()) == 100
    assert spec_of(Order(), "round").orbit.views == 30


@pytest.mark.parametrize(
    ("order", "words"),
    [
        (Order(("leafs",)), "did you mean 'leaves'"),
        (replace(ORDER, views=0), "views"),
        (replace(ORDER, size=(0, 20)), "size is out of range"),
        (replace(ORDER, seed=-1), "a seed"),
        (replace(ORDER, test_every=-1), "test views"),
        (replace(ORDER, test_every=1), "leaves no view to train on"),
    ],
)
def test_orders_that_make_no_sense(order: Order, words: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError) as caught:
        make(tmp_path / "out", order)
    assert words in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_two_workers_give_the_same_bytes(whole: Path, tmp_path: Path) -> None:
    make(tmp_path / "two", ORDER, workers=2)
    assert sums(tmp_path / "two") == sums(whole)


KILLED = """
import os, signal, sys
from spikerig.rigctl.sim import farm
take_view = farm.take_view
def dies(spec, number):
    if number:
        os.kill(os.getpid(), signal.SIGKILL)
    return take_view(spec, number)
farm.take_view = dies
from spikerig.dataset import cli
sys.exit(cli.run(sys.argv[1:]))
"""


def test_a_killed_run_goes_on(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """kill -9 after the first view; the same command makes only the others, and the bytes are the same."""
    out = tmp_path / "killed"
    words = [sys.executable, "-c", KILLED, "sim", "dataset", "--out", str(out), *WORDS, "--workers", "1"]
    child = subprocess.run(words, capture_output=True, timeout=120, check=False)
    assert child.returncode == -signal.SIGKILL, child.stderr.decode()
    assert not (out / "glossy.h5").exists()
    assert [p.name for p in out.glob("glossy.views/0*.npz")] == ["000000.npz"]
    made = []
    monkeypatch.setattr(farm, "take_view", lambda spec, number: made.append(number) or take_view(spec, number))
    told = make(out, ORDER)
    assert made == [1, 2, 3]
    assert told["kept"] == []
    assert sums(out) == sums(whole)
    assert sorted(p.name for p in out.iterdir()) == ["glossy.h5", "glossy.png", "manifest.json", "overview.png"]
    made.clear()
    assert make(out, ORDER)["kept"] == ["glossy"]
    assert made == []


def children(pid: int) -> list[int]:
    """Processes that a process started and that still run."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, parent = stat.read_text().rpartition(")")[2].split()[:2]
        except OSError:
            continue  # it ended just now
        if int(parent) == pid and state != "Z":
            found.append(int(stat.parent.name))
    return found


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_workers_end_with_a_killed_run(tmp_path: Path) -> None:
    out = tmp_path / "killed"
    words = [sys.executable, "-m", "spikerig.dataset", "sim", "dataset", "--out", str(out), *WORDS, "--workers", "2"]
    child = subprocess.Popen([*words, "--views", "60"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 120
        while not list(out.glob("glossy.views/0*.npz")):
            assert child.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.02)
        started = children(child.pid)
    finally:
        child.send_signal(signal.SIGKILL)
        child.wait()
    assert len(started) >= 2
    deadline = time.monotonic() + 60
    while any(alive(pid) for pid in started):
        assert time.monotonic() < deadline, started
        time.sleep(0.05)


def test_a_damaged_view_and_a_damaged_scene_are_made_again(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    spec = spec_of(ORDER, "glossy")

    def stop(name: str, views: int, kept: int) -> Any:
        def after_one() -> None:
            raise KeyboardInterrupt

        return after_one

    with pytest.raises(KeyboardInterrupt):
        make(out, ORDER, begin=stop)
    part = out / "glossy.views" / "000000.npz"
    part.write_bytes(part.read_bytes()[:-100])
    (out / "glossy.views" / ".000001.npz.99").write_bytes(b"half")
    make(out, ORDER)
    assert sums(out) == sums(whole)
    with (out / "glossy.h5").open("r+b") as file:
        file.truncate(1000)
    assert make(out, ORDER)["kept"] == []
    assert sums(out) == sums(whole)
    assert spec.name == "glossy"


def test_other_settings_are_refused_by_name(whole: Path, tmp_path: Path) -> None:
    before = sums(whole)
    for order, words in (
        (replace(ORDER, views=5), "order.views: 4 there, 5 here"),
        (replace(ORDER, seed=None), "order.seed: 7 there, null here"),
        (replace(ORDER, scenes=("glossy", "round")), 'order.scenes: ["glossy"] there, ["glossy", "round"] here'),
    ):
        with pytest.raises(UsageError) as caught:
            make(whole, order)
        assert words in str(caught.value)
        assert "--force" in str(caught.value)
    assert sums(whole) == before
    out = tmp_path / "out"
    make(out, replace(ORDER, size=(16, 10)))
    make(out, ORDER, force=True)
    assert sums(out) == before


def test_other_code_is_refused(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset, "fingerprint", lambda: {**fingerprint(), "numpy": "9.9"})
    with pytest.raises(UsageError, match="other settings") as caught:
        make(whole, ORDER)
    assert 'made_with.numpy: "' in str(caught.value)


def test_what_is_not_ours_stays(tmp_path: Path) -> None:
    (tmp_path / "glossy.h5").write_text("something of the user's")
    with pytest.raises(UsageError, match="no manifest names"):
        make(tmp_path, ORDER)
    assert (tmp_path / "glossy.h5").read_text() == "something of the user's"
    (tmp_path / "manifest.json").write_text("{}")
    with pytest.raises(DataError, match="not the manifest"):
        make(tmp_path, ORDER)


def test_one_run_at_a_time(tmp_path: Path) -> None:
    with alone(tmp_path / "out"), pytest.raises(UsageError, match="another run"):
        make(tmp_path / "out", ORDER)
    assert not (tmp_path / "out").exists()


def test_room_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(dataset.shutil, "disk_usage", lambda path: usage(10**12, 10**12, 10**9))
    with pytest.raises(HostError, match="not enough room") as caught:
        make(tmp_path / "out", Order(views=200))
    assert "1.0 GB free" in str(caught.value)


def test_view_bytes_are_about_right(whole: Path) -> None:
    train, test = dataset.view_bytes(spec_of(ORDER, "glossy"))
    size = (whole / "glossy.h5").stat().st_size
    assert size == pytest.approx(2 * train + 2 * test, rel=0.2)


def test_the_command(whole: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = ["sim", "dataset", "--out", str(tmp_path / "out"), *WORDS, "--workers", "1", "--json"]
    assert run(words) == 0
    told = json.loads(capfd.readouterr().out)
    assert told["schema"] == "spikerig.sim.dataset/1"
    assert told["sha256"] == sums(whole)[0]
    assert run([*words, "--views", "5"]) == 2
    assert "order.views" in json.loads(capfd.readouterr().out)["error"]["value"]
    assert run([*words[:3], str(tmp_path / "b"), "--size", "12"]) == 2
    assert run([*words[:3], str(tmp_path / "b"), "--scheduler", "somewhere"]) == 2


class FakeClient:
    """What a Dask client says of its workers."""

    def __init__(self, kinds: dict[str, dict[str, str]]) -> None:
        self.kinds = kinds

    def wait_for_workers(self, n: int, timeout: float) -> None:
        if len(self.kinds) < n:
            raise TimeoutError

    def run(self, function: Any) -> dict[str, dict[str, str]]:
        return self.kinds


def chosen(kinds: dict[str, dict[str, str]]) -> tuple[dict[str, str], list[str]]:
    cluster: Any = farm.Cluster.__new__(farm.Cluster)
    cluster._client = FakeClient(kinds)
    return cluster._choose("tcp://x:1"), cluster.workers


def test_workers_of_one_kind_are_used(capfd: pytest.CaptureFixture[str]) -> None:
    here = fingerprint()
    other, third = {**here, "cpu": "X86_V2"}, {**here, "numpy": "9"}
    assert chosen({"a": other, "b": here, "c": other}) == (here, ["b"])
    assert "2 workers with another CPU or NumPy are left out" in capfd.readouterr().err
    assert chosen({"a": other, "b": third, "c": other}) == (other, ["a", "c"])
    assert "bytes will be those of the workers" in capfd.readouterr().err
    assert chosen({"a": here, "b": here}) == (here, ["a", "b"])
    assert capfd.readouterr().err == ""
    with pytest.raises(HostError, match="another spikerig"):
        chosen({"a": here, "b": {**here, "code": "0"}})
    with pytest.raises(HostError, match="no workers"):
        chosen({})


def test_without_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    words = ["sim", "dataset", "--out", str(tmp_path / "out"), *WORDS, "--scheduler", "tcp://127.0.0.1:1"]
    assert run(words) == 6
    assert "spikerig[cluster]" in capfd.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """A cluster of two processes on this machine."""
    distributed = pytest.importorskip("distributed", reason="needs the extra `cluster`")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", host="127.0.0.1"
    ) as cluster:
        yield cluster.scheduler_address


def test_a_cluster_gives_the_same_bytes(whole: Path, tmp_path: Path, scheduler: str) -> None:
    make(tmp_path / "out", ORDER, scheduler=scheduler)
    assert sums(tmp_path / "out") == sums(whole)
    assert dataset.read_manifest(tmp_path / "out")["runs"][0]["workers"] == 2


def test_a_fault_on_the_cluster_is_told(tmp_path: Path, scheduler: str) -> None:
    """An error of ours comes back as itself, another as one that says what to do; what is finished stays."""
    spec = spec_of(ORDER, "glossy")
    broken = replace(spec, orbit=replace(spec.orbit, views=4, target="nowhere"))
    one = Shelf(tmp_path / "views", {})
    with farm.Cluster(scheduler) as cluster, pytest.raises(HostError, match="the Dask cluster failed"):
        cluster.fill(broken, one, lambda: None)


def test_nobody_answers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    monkeypatch.setattr(farm, "PATIENCE_S", 1)
    began = time.monotonic()
    with pytest.raises(HostError, match="does not answer"):
        make(tmp_path / "out", ORDER, scheduler="tcp://127.0.0.1:1")
    assert time.monotonic() - began < 60
    assert os.listdir(tmp_path) == []
    assert shelf.RECORDS
