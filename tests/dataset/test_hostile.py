"""Scene files made to do harm end in one clear error: no crash, no hang, no memory, no traceback."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hard_store import full_scene
from spoil import HOSTILE

from spikerig.dataset import hdf5_guard
from spikerig.dataset.errors import DataError
from spikerig.dataset.store import open_scene, verify_scene, write_scene


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("good") / "s.h5"
    write_scene(path, full_scene())
    return path.read_bytes()


@pytest.fixture
def scene(good: bytes, tmp_path: Path) -> Path:
    path = tmp_path / "scene.h5"
    path.write_bytes(good)
    return path


def read_all(path: Path) -> None:
    with open_scene(path) as file:
        file.read()


def one_error(path: Path, call: Callable[[Path], object]) -> DataError:
    start = time.monotonic()
    with pytest.raises(DataError) as told:
        call(path)
    assert time.monotonic() - start < 20
    assert path.name in str(told.value), "the message names the file"
    assert len(str(told.value)) < 2000
    return told.value


@pytest.mark.parametrize("spoil", HOSTILE, ids=lambda f: f.__name__)
def test_hostile_files_end_in_one_error(spoil: Callable[[Path], None], scene: Path) -> None:
    spoil(scene)
    exit_code, words = HOSTILE[spoil]
    read = one_error(scene, read_all)
    if exit_code == 4:
        assert words in str(read)
        assert words in str(one_error(scene, verify_scene))
    else:
        found = verify_scene(scene)
        assert any(words in f.message for f in found), found
        assert any(f.importance in ("error", "warning") for f in found)


def test_hostile_makers_do_spoil_a_good_scene(scene: Path) -> None:
    """The same bytes, not spoiled, are read and verified: the errors above come from the harm done."""
    read_all(scene)
    assert verify_scene(scene) == []


def test_truncated_anywhere(good: bytes, tmp_path: Path) -> None:
    path = tmp_path / "cut.h5"
    for size in (1, 8, 47, 96, 200, 1000, len(good) // 3, len(good) // 2, len(good) - 4096, len(good) - 1):
        path.write_bytes(good[:size])
        one_error(path, open_scene)


def test_one_flipped_bit_of_metadata_is_found(good: bytes, scene: Path) -> None:
    """Any of many bits outside the data is either refused by HDF5's own checksums or found by ours, or unused space."""
    rng = np.random.default_rng(0)
    heads = [at for mark in (b"OHDR", b"OCHK", b"FRHP", b"BTHD") for at in _all(good, mark)]
    assert len(heads) > 20
    for at in rng.choice(heads, 6, replace=False):
        spoiled = bytearray(good)
        spoiled[at + 9] ^= 1 << int(rng.integers(8))
        scene.write_bytes(spoiled)
        with contextlib.suppress(DataError):
            assert verify_scene(scene) != []


def _all(data: bytes, mark: bytes) -> list[int]:
    found, at = [], data.find(mark)
    while at >= 0:
        found.append(at)
        at = data.find(mark, at + 1)
    return found


def test_a_child_that_crashes_hangs_or_starves_is_a_data_error(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The limits of the child process hold, whatever kills it."""
    real = sys.executable
    for body, told in (
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "SIGSEGV"),
        ("import time; time.sleep(100)", "took more than"),
        ("print('{}', end='x')", "ended the child"),
        ("raise SystemExit(3)", "ended the child process (3)"),
    ):
        fake = scene.parent / "python"
        fake.write_text(f"#!{real}\n{body}\n")
        fake.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(fake))
        monkeypatch.setattr(hdf5_guard, "PATIENCE_S", 1)
        assert told in one_error(scene, lambda p: hdf5_guard.ask_child("probe", p)).cause


def test_the_childs_memory_is_limited() -> None:
    code = (
        "from spikerig.dataset import hdf5_guard as g\n"
        "g.limit_itself(20)\n"
        "try:\n    bytearray(8 << 30)\nexcept MemoryError:\n    print('limited')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "limited", done.stderr


def test_a_healthy_file_is_probed_once_and_again_when_it_changes(
    scene: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(hdf5_guard, "_healthy", set())
    asked: list[str] = []
    real = hdf5_guard.ask_child
    monkeypatch.setattr(hdf5_guard, "ask_child", lambda task, path: (asked.append(task), real(task, path)))
    open_scene(scene).close()
    open_scene(scene).close()
    assert asked == ["probe"]
    monkeypatch.setattr(hdf5_guard, "_healthy", set())  # another process: the cache folder knows
    open_scene(scene).close()
    assert asked == ["probe"]
    os.utime(scene, ns=(1, 1))
    open_scene(scene).close()
    assert asked == ["probe", "probe"]


def test_a_file_just_written_is_not_probed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "own.h5"
    write_scene(path, full_scene())
    monkeypatch.setattr(hdf5_guard, "ask_child", lambda *_: pytest.fail("probed its own file"))
    read_all(path)


DATA = Path(os.environ.get("SPIKERIG_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
BAD = sorted(p.name for p in (DATA / "h5_bad").glob("*") if p.name != "COPYING")


@pytest.mark.real
@pytest.mark.parametrize("name", BAD or ["cve-2016-4330.h5"])
def test_files_from_cve_reports(name: str, shared_data: Callable[[str], Path]) -> None:
    path = shared_data("h5_bad/" + name)
    one_error(path, open_scene)
    one_error(path, verify_scene)
