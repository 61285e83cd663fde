"""The scene file: exact round trips, honest status, checksums, versions, windows of spikes."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from hard_store import full_scene, path, same, view

from spikerig.dataset.cli import run
from spikerig.dataset.clocktime import ns_from_tick
from spikerig.dataset.errors import DataError, HostError, NumericsError, UsageError
from spikerig.dataset.scene import Camera, Scene
from spikerig.dataset.store import ROWS, SceneWriter, open_scene, schema_markdown, verify_scene, write_scene

PAGE = Path(__file__).resolve().parents[2] / "docs" / "format.md"


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    file = tmp_path / "scene.h5"
    write_scene(file, full_scene())
    return file


def writer(file: Path, **more: object) -> SceneWriter:
    whole = full_scene()
    keys = ("light_gain", "info", "points", "clock", "calibration", "truth")
    return SceneWriter(file, whole.name, whole.camera, **{k: getattr(whole, k) for k in keys} | more)


def test_everything_round_trips_to_the_last_bit(scene: Path) -> None:
    with open_scene(scene) as file:
        same(full_scene(), file.read())
        assert (file.names, file.train, file.test) == (
            ("a", "v-01.x", "_b", "Z9"),
            ("a", "v-01.x", "_b"),
            ("Z9",),
        )
        assert (file.status, file.has_truth, file.truth_label) == ("complete", True, "first")


def test_a_frame_of_more_than_eight_bits_round_trips(tmp_path: Path) -> None:
    whole, first = full_scene(), view(0)
    deep = np.random.default_rng(0).integers(0, 65536, first.frame.pixels.shape, np.uint16)
    first = replace(first, frame=replace(first.frame, pixels=deep))
    write_scene(tmp_path / "deep.h5", replace(whole, views=(first, *whole.views[1:])))
    with open_scene(tmp_path / "deep.h5") as file:
        frame = file.view("a").frame
    assert (frame.pixels.dtype, frame.full) == (np.uint16, 65535)
    assert np.array_equal(frame.pixels, deep)
    assert frame.pixels8.dtype == np.uint8
    assert np.abs(frame.pixels8 - deep / 257).max() <= 0.5
    assert not verify_scene(tmp_path / "deep.h5")


def test_the_least_scene_round_trips(tmp_path: Path) -> None:
    least = Scene("s", Camera.pinhole(21, 13, 40.0), (replace(view(1), spikes=None),))
    write_scene(tmp_path / "s.h5", least)
    with open_scene(tmp_path / "s.h5") as file:
        same(least, file.read())
        assert not file.has_truth
        with pytest.raises(UsageError, match="no true light"):
            file.truth_light("v-01.x")
        with pytest.raises(UsageError, match="no spikes"):
            file.spikes("v-01.x")
        with pytest.raises(UsageError, match="no such view"):
            file.view("v-02")
    assert verify_scene(tmp_path / "s.h5") == []


def test_the_file_holds_what_the_schema_says_and_nothing_else(scene: Path) -> None:
    """The full scene uses every row and every attribute of the table."""
    met: set[str] = set()
    with h5py.File(scene) as file:

        def note(name: str, thing: h5py.Group | h5py.Dataset) -> None:
            parts = f"/{name}".split("/")
            at = 2 + (parts[1] == "truth")
            if len(parts) > at and parts[at - 1] == "views":
                parts[at] = "{view}"
            row = ROWS["/".join(parts)]
            met.update([row.path, *(f"{row.path}@{a}" for a in thing.attrs)])
            assert set(thing.attrs) <= set(row.attrs) | {"sha256"}, name
            assert isinstance(thing, h5py.Group) == (row.dtype == "group"), name
            assert "sha256" in thing.attrs

        file.visititems(note)
        met.update(["/", *(f"/@{a}" for a in file.attrs)])
    wanted = {p for row in ROWS.values() for p in (row.path, *(f"{row.path}@{a}" for a in row.attrs))}
    assert wanted <= met, wanted - met


def test_a_window_of_spikes_is_that_slice_in_time(scene: Path) -> None:
    whole = full_scene().view("v-01.x").spikes
    assert whole is not None
    with open_scene(scene) as file:
        part = file.spikes("v-01.x", 5, 21)
        assert part.bits.tobytes() == whole.bits[5:21].tobytes()
        assert part.t0_ns == int(ns_from_tick(5, 40_000.1, whole.t0_ns))
        assert part.lost.tolist() == [[0, 4], [15, 16]], "lost [3, 9) and [20, 21), counted from tick 5"
        assert (part.rate_hz, part.clock, part.width) == (whole.rate_hz, whole.clock, whole.width)
        assert file.spikes("v-01.x", 7, 7).ticks == 0
        assert file.spikes("_b", 5).t0_ns == whole.t0_ns, "no rate: no time to move"
        for t0, t1 in ((-1, 3), (3, 2), (0, 41)):
            with pytest.raises(UsageError, match="no such ticks"):
                file.spikes("v-01.x", t0, t1)


def test_a_writer_taking_one_view_at_a_time_makes_the_same_content(scene: Path, tmp_path: Path) -> None:
    whole = full_scene()
    assert whole.truth is not None
    bare = replace(whole.truth, light={}, at_ns={}, trajectories={})
    with writer(tmp_path / "w.h5", truth=bare, light_gain=None, info={}, points=None) as out:
        for one in whole.views:
            truth = whole.truth
            out.add(
                one,
                light=truth.light.get(one.name),
                at_ns=truth.at_ns.get(one.name),
                trajectory=truth.trajectories.get(one.name),
                events=whole.events.get(one.name),
            )
        out.light_gain, out.info, out.points = whole.light_gain, dict(whole.info), whole.points
    with open_scene(scene) as a, open_scene(tmp_path / "w.h5") as b:
        same(a.read(), b.read())
        assert a.describe()["sha256"] == b.describe()["sha256"], "the root's checksum names the content"
        assert len(a.describe()["sha256"]) == 64


def test_nothing_is_overwritten_unasked(scene: Path, tmp_path: Path) -> None:
    before = scene.read_bytes()
    with pytest.raises(UsageError, match="exists already"):
        write_scene(scene, full_scene())
    assert scene.read_bytes() == before
    write_scene(scene, replace(full_scene(), name="new"), force=True)
    with open_scene(scene) as file:
        assert file.name == "new"
    with pytest.raises(HostError):
        write_scene(tmp_path / "nowhere" / "s.h5", full_scene())
    with pytest.raises(UsageError):
        write_scene(tmp_path, full_scene(), force=True)


def test_a_failed_write_leaves_the_old_file_and_nothing_else(scene: Path) -> None:
    before = scene.read_bytes()
    doubled = replace(full_scene(), views=(view(0), view(0)), truth=None, events={})
    with pytest.raises(UsageError, match="taken"):
        write_scene(scene, doubled, force=True)
    assert scene.read_bytes() == before
    assert os.listdir(scene.parent) == [scene.name]


def fail_after(out: SceneWriter, views: int) -> None:
    with out:
        for i in range(views):
            out.add(view(i))
        raise ZeroDivisionError


def test_an_exception_leaves_an_aborted_part_that_says_so(tmp_path: Path) -> None:
    file = tmp_path / "s.h5"
    out = writer(file)
    with pytest.raises(ZeroDivisionError):
        fail_after(out, 1)
    assert os.listdir(tmp_path) == ["s.h5.partial"]
    with pytest.raises(DataError, match="not finished") as told:
        open_scene(out.part)
    assert "aborted" in str(told.value)
    assert [f.message for f in verify_scene(out.part) if f.check == "status"] == [
        "status aborted: its writer did not finish"
    ]
    with pytest.raises(UsageError, match="unfinished scene lies in the way"):
        writer(file)
    with writer(file, force=True) as again:
        again.add(view(0))
    assert os.listdir(tmp_path) == ["s.h5"]


def test_an_exception_before_any_view_leaves_nothing(tmp_path: Path) -> None:
    out = writer(tmp_path / "s.h5")
    with pytest.raises(ZeroDivisionError):
        fail_after(out, 0)
    assert os.listdir(tmp_path) == []


KILLED = """
import os, signal, sys
sys.path.insert(0, sys.argv[2])
from hard_store import full_scene, view
from spikerig.dataset.store import SceneWriter
out = SceneWriter(sys.argv[1], "s", full_scene().camera)
out.add(view(0)); out.add(view(1))
out._views.create_group("half").create_dataset("pixels", data=[1])
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_kill_leaves_a_recording_part_whose_whole_views_can_be_read(tmp_path: Path) -> None:
    file, tests = tmp_path / "s.h5", Path(__file__).resolve().parents[1]
    done = subprocess.run([sys.executable, "-c", KILLED, str(file), str(tests)], capture_output=True, timeout=120)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert os.listdir(tmp_path) == ["s.h5.partial"]
    part = tmp_path / "s.h5.partial"
    with pytest.raises(DataError, match="not finished") as told:
        open_scene(part)
    assert "recording" in str(told.value)
    assert "partial=True" in str(told.value)
    with open_scene(part, partial=True) as found:
        assert found.names == ("a", "v-01.x")
        same(view(1), found.view("v-01.x"))


@pytest.mark.parametrize("name", ["", ".", "..", ".hidden", "../x", "a/b", "a b", "ü", "a\n", "x" * 128])
def test_a_view_name_is_never_a_path(tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError, match="not a name"), writer(tmp_path / "s.h5") as out:
        out.add(replace(view(0), name=name))
    assert os.listdir(tmp_path) == []


def test_what_cannot_be_stored_is_refused(tmp_path: Path) -> None:
    whole = full_scene()
    assert whole.truth is not None
    light = np.zeros((13, 21, 3), np.float32)
    light[0, 0, 0] = np.nan
    with pytest.raises(NumericsError, match="finite"), writer(tmp_path / "s.h5") as out:
        out.add(view(0), light=light)
    with pytest.raises(UsageError, match="camera's size"), writer(tmp_path / "s.h5") as out:
        out.add(view(0), light=light[1:])
    with pytest.raises(UsageError, match="camera's size"):
        write_scene(tmp_path / "s.h5", replace(whole, camera=Camera.pinhole(20, 13, 40.0)))
    with pytest.raises(UsageError, match="without truth"), writer(tmp_path / "s.h5", truth=None) as out:
        out.add(view(0), at_ns=3)
    with pytest.raises(UsageError, match="does not have"):
        write_scene(tmp_path / "s.h5", replace(whole, truth=replace(whole.truth, at_ns={"who": 1})))
    with pytest.raises(UsageError, match="64 bits"):
        write_scene(tmp_path / "s.h5", replace(whole, truth=replace(whole.truth, seed=2**64)))
    with pytest.raises(UsageError, match="NUL"):
        write_scene(tmp_path / "s.h5", replace(whole, name="a\0b"))
    assert os.listdir(tmp_path) == []


def datasets(file: Path) -> list[tuple[str, int, int]]:
    found: list[tuple[str, int, int]] = []
    with h5py.File(file) as opened:

        def note(name: str, thing: object) -> None:
            if isinstance(thing, h5py.Dataset) and thing.size and thing.chunks is None:
                found.append((f"/{name}", thing.id.get_offset(), thing.nbytes))

        opened.visititems(note)
    return found


def test_a_flipped_bit_in_any_dataset_is_found_and_named(scene: Path) -> None:
    """One bit is flipped in every dataset at once: as many findings as datasets, each naming its own."""
    assert verify_scene(scene) == []
    spoiled = bytearray(scene.read_bytes())
    places = datasets(scene)
    assert len(places) > 30
    for k, (_, offset, size) in enumerate(places):
        spoiled[offset + (k * 7919) % size] ^= 1 << (k % 8)
    scene.write_bytes(spoiled)
    found = verify_scene(scene)
    assert {f.where for f in found if f.check == "checksum"} == {name for name, _, _ in places}
    assert {f.importance for f in found if f.check == "checksum"} == {"error"}


@pytest.mark.parametrize("where", ["/", "/camera", "/views/a", "/views/a/pixels", "/truth"])
def test_a_changed_attribute_is_found(scene: Path, where: str) -> None:
    with h5py.File(scene, "r+") as file:
        name = sorted(set(file[where].attrs) - {"sha256", "format", "version", "status"})[0]
        old = file[where].attrs[name]
        file[where].attrs.modify(name, old + 1 if isinstance(old, np.number) else np.bytes_(old[:-1] + b"?"))
    assert ("checksum", where) in {(f.check, f.where) for f in verify_scene(scene)}


def test_a_newer_minor_version_is_read_with_a_note(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with h5py.File(scene, "r+") as file:
        file.attrs["version"] = np.bytes_(b"1.7")
        file["views/a/novelty"] = np.arange(3)
    with open_scene(scene) as found:
        same(full_scene(), found.read())
    assert "RS-3D 1.7 is newer than this reader (1.0)" in capsys.readouterr().err
    assert ("schema", "note", "/views/a/novelty") in {(f.check, f.importance, f.where) for f in verify_scene(scene)}


def test_a_newer_major_version_is_refused_with_what_to_do(scene: Path) -> None:
    with h5py.File(scene, "r+") as file:
        file.attrs["version"] = np.bytes_(b"2.0")
    with pytest.raises(DataError) as told:
        open_scene(scene)
    assert "RS-3D 2.0" in str(told.value)
    assert "this reader knows 1.0" in str(told.value)
    assert "pip install --upgrade spikerig" in str(told.value)


def test_compressed_by_a_release_reads_the_same(scene: Path, tmp_path: Path) -> None:
    """The filters of the allow-list, in chunks, give the same records."""
    packed = tmp_path / "packed.h5"
    with h5py.File(scene) as a, h5py.File(packed, "w") as b:
        for name in a.attrs:
            b.attrs[name] = a.attrs[name]

        def copy(name: str, thing: h5py.Group | h5py.Dataset) -> None:
            if isinstance(thing, h5py.Group):
                made = b.create_group(name)
            else:
                packing = {"compression": "gzip", "shuffle": True, "fletcher32": True, "chunks": True}
                made = b.create_dataset(name, data=thing[()], **(packing if thing.size else {}))
            for key in thing.attrs:
                made.attrs[key] = thing.attrs[key]

        a.visititems(copy)
    with open_scene(packed) as file:
        same(full_scene(), file.read())
    assert verify_scene(packed) == []


def test_a_scene_file_may_be_closed_twice_and_is_then_closed(scene: Path) -> None:
    file = open_scene(scene)
    file.close()
    file.close()
    with pytest.raises(DataError):
        file.view("a")


FULL = """
import resource, signal, sys
sys.path.insert(0, sys.argv[2])
from hard_store import full_scene
from spikerig.dataset.errors import HostError
from spikerig.dataset.store import write_scene
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (30000, 30000))
try:
    write_scene(sys.argv[1], full_scene())
except HostError as error:
    print("told:", error)
"""


def test_a_full_disk_is_one_clear_error(tmp_path: Path) -> None:
    """A limit on the size of files stands in for the disk."""
    file, tests = tmp_path / "s.h5", Path(__file__).resolve().parents[1]
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(file), str(tests)], capture_output=True, text=True, timeout=120
    )
    assert done.stdout.startswith("told: the scene cannot be written"), done.stderr
    assert not file.exists()


def test_the_page_of_the_format_is_made_from_the_table() -> None:
    assert schema_markdown() in PAGE.read_text(encoding="utf-8"), (
        "python -m spikerig.dataset.store prints it: paste it into docs/format.md"
    )


def test_the_cost_of_a_scene_is_measured(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["cost", "scene", "--views", "1", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["bytes"] > 812 * 250 * 50
    assert {"write", "open", "41 ticks of a view"} < found["rows"].keys()
    assert all(row["wall_ms"] > 0 for row in found["rows"].values())


def test_paths_given_as_text(tmp_path: Path) -> None:
    write_scene(str(tmp_path / "s.h5"), full_scene())
    with open_scene(str(tmp_path / "s.h5")) as file:
        assert file.truth_trajectory("a").at_ns.tolist() == path(9, False).at_ns.tolist()
    with pytest.raises(UsageError, match="no such file"):
        open_scene(tmp_path / "other.h5")
