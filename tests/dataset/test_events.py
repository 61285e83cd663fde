"""Events in memory and in the scene file: windows, sums, exact round trips, files made to do harm."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hard_store import H, W, events, full_scene, same, view
from spoil_events import EVENTS, HOSTILE, UNREADABLE

from spikerig.dataset.cli import run
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.events import EventStream, no_events
from spikerig.dataset.scene import Scene
from spikerig.dataset.store import SceneWriter, open_scene, verify_scene, write_scene
from spikerig.dataset.store_seal import seal

T0 = 2**60


def stream(t: list[int], x: list[int], y: list[int], p: list[int], **more: Any) -> EventStream:
    columns = (np.array(c, d) for c, d in ((t, np.int64), (x, np.uint16), (y, np.uint16), (p, np.int8)))
    return EventStream(*columns, **({"height": 3, "width": 5, "t0_ns": 0, "t1_ns": 100} | more))


def brute(s: EventStream, t0: int, t1: int) -> np.ndarray:
    """The signed sum, event by event."""
    out = np.zeros((s.height, s.width), np.int32)
    for t, x, y, p in zip(s.t_ns, s.x, s.y, s.polarity, strict=True):
        if t0 <= t < t1:
            out[y, x] += p
    return out


def test_sums_over_windows_are_those_of_a_loop() -> None:
    s = events(3000, 1)
    edges = np.array([T0, T0 + 5, T0 + 5, T0 + 7_000_001, T0 + 19_999_999, T0 + 20_000_000])
    found = s.bins(edges)
    assert (found.dtype, found.shape) == (np.int32, (5, H, W))
    for k in range(5):
        assert np.array_equal(found[k], brute(s, edges[k], edges[k + 1])), k
        assert np.array_equal(found[k], s.accumulate(edges[k], edges[k + 1]))
    assert not found[1].any(), "an empty window"
    assert np.array_equal(found.sum(0), s.accumulate())
    assert np.abs(s.accumulate()).sum() > 100


def test_windows_are_half_open() -> None:
    s = stream([10, 10, 20, 30], [0, 1, 2, 3], [0, 0, 1, 2], [1, -1, 1, 1])
    assert s.slice(10, 20).t_ns.tolist() == [10, 10]
    assert s.slice(11, 30).t_ns.tolist() == [20]
    assert s.slice(30, 31).x.tolist() == [3]
    assert len(s.slice(10, 10)) == 0
    assert s.accumulate(10, 30).sum() == 1


def test_a_slice_knows_what_was_watched() -> None:
    s = stream([10, 90], [0, 0], [0, 0], [1, 1], t0_ns=5, t1_ns=95, clock="dvs")
    for window, span in (
        ((0, 50), (5, 50)), ((50, 200), (50, 95)), ((-9, -3), (5, 5)), ((200, 300), (95, 95)), ((7, 7), (7, 7)),
    ):  # fmt: skip
        part = s.slice(*window)
        assert (part.t0_ns, part.t1_ns) == span, window
        assert (part.clock, part.height, part.width) == ("dvs", 3, 5)
    assert np.shares_memory(s.slice(0, 50).x, s.x)


def test_arrays_are_read_only_and_the_callers_stay_writable() -> None:
    t = np.array([1, 2])
    s = EventStream(t, np.array([0, 1]), np.array([0, 1]), np.array([1, -1]), 2, 2, 0, 3)
    assert [getattr(s, n).dtype for n in ("t_ns", "x", "y", "polarity")] == [np.int64, np.uint16, np.uint16, np.int8]
    with pytest.raises(ValueError, match="read-only"):
        s.t_ns[0] = 5
    t[0] = 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"t": [5, 4]}, "event 1 is before event 0"),
        ({"t": [-1, 4]}, "outside the span"),
        ({"t": [1, 100]}, "outside the span"),
        ({"x": [0, 5]}, "outside the picture"),
        ({"y": [3, 0]}, "outside the picture"),
        ({"p": [1, 0]}, "+1 or -1"),
        ({"p": [1, -128]}, "+1 or -1"),
        ({"x": [0]}, "equally many"),
        ({"t1_ns": -1}, "ends no sooner"),
        ({"height": 0}, "1 to 65536"),
        ({"width": 65537}, "1 to 65536"),
    ],
)
def test_what_is_no_event_is_refused(change: dict[str, Any], words: str) -> None:
    good: dict[str, Any] = {"t": [5, 5], "x": [0, 4], "y": [2, 0], "p": [1, -1]}
    stream(**good)
    with pytest.raises(DataError) as told:
        stream(**good | change)
    assert words in str(told.value)


def test_numbers_that_a_type_cannot_hold_are_refused_not_wrapped() -> None:
    good = [np.array([5]), np.array([0]), np.array([0]), np.array([1])]
    for k, bad in ((1, 65536), (1, -1), (2, 1 << 40), (3, 257)):
        columns = list(good)
        columns[k] = np.array([bad])
        with pytest.raises(DataError, match="out of range"):
            EventStream(*columns, 3, 5, 0, 100)
    for bad in (np.array([0.5]), np.array([[5]]), np.array([True])):
        with pytest.raises(DataError, match="whole numbers"):
            EventStream(bad, *good[1:], 3, 5, 0, 100)


@pytest.mark.parametrize("edges", [[3], [], [3, 2], [1.5, 2.5], [[1, 2]]])
def test_edges_that_are_none(edges: Any) -> None:
    with pytest.raises(UsageError, match="edges"):
        events(5).bins(edges)


def test_a_window_that_ends_before_it_starts() -> None:
    with pytest.raises(UsageError, match="no sooner"):
        events(5).slice(T0 + 5, T0)


def test_the_largest_sensor() -> None:
    s = stream([1], [65535], [65535], [1], height=65536, width=65536)
    assert int(s.x[0]) + int(s.y[0]) == 131070


# ---- in the scene file


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    file = tmp_path / "scene.h5"
    write_scene(file, full_scene())
    return file


def test_events_round_trip_and_views_without_say_so(scene: Path) -> None:
    with open_scene(scene) as file:
        for name, seen in full_scene().events.items():
            same(seen, file.events(name))
        assert [file.has_events(name) for name in file.names] == [False, True, False, True]
        assert file.describe()["events"] == {"v-01.x": 777, "Z9": 0}
        with pytest.raises(UsageError, match="no events"):
            file.events("a")
        with pytest.raises(UsageError, match="no such view"):
            file.events("who")
        with pytest.raises(UsageError, match="no sooner"):
            file.events("v-01.x", 5, 4)
    assert verify_scene(scene) == []


def test_a_window_of_the_file_is_that_slice(tmp_path: Path) -> None:
    """Over several chunks, with many events at one time."""
    many = events(200_000, 3, span_ns=3000)
    with SceneWriter(tmp_path / "s.h5", "s", full_scene().camera) as out:
        out.add(view(0), events=many)
    with h5py.File(tmp_path / "s.h5") as raw:
        assert raw["/views/a/events/t_ns"].chunks == (65536,)
    with open_scene(tmp_path / "s.h5") as file:
        for t0, t1 in ((0, 3000), (-50, 10), (1499, 1500), (1500, 1500), (2999, 9999), (8000, 9000), (7, 2345)):
            same(many.slice(T0 + t0, T0 + t1), file.events("a", T0 + t0, T0 + t1))
        same(many.slice(T0 + 1000, many.t1_ns), file.events("a", T0 + 1000))
        same(many.slice(many.t0_ns, T0 + 1000), file.events("a", None, T0 + 1000))
    assert verify_scene(tmp_path / "s.h5") == []


def test_disorder_between_blocks_is_found(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Events are checked some millions at a time; here, 100."""
    from spikerig.dataset import store_events

    monkeypatch.setattr(store_events, "BLOCK", 100)
    with open_scene(scene) as file:
        file.check_events("v-01.x")
    with h5py.File(scene, "r+") as raw:
        times = raw[f"{EVENTS}/t_ns"]
        times[:100] = np.sort(times[:100] + 15_000_000)  # each block is in order, still
    with open_scene(scene) as file, pytest.raises(DataError, match="order of their times"):
        file.check_events("v-01.x")


def test_events_that_pack_too_well_are_stored_plain(tmp_path: Path) -> None:
    """A reader must take 70 MB in 0.1 MB for a bomb: the writer does not make one."""
    n = 9_000_000
    zeros = np.zeros(n, np.uint16)
    same_all = EventStream(np.zeros(n, np.int64), zeros, zeros, np.ones(n, np.int8), 1, 1, 0, 1)
    with SceneWriter(tmp_path / "s.h5", "s", full_scene().camera) as out:
        out.add(view(0), events=same_all)
    with h5py.File(tmp_path / "s.h5") as raw:
        assert raw["/views/a/events/t_ns"].chunks is None
        assert raw["/views/a/events/x"].chunks is not None
    assert verify_scene(tmp_path / "s.h5") == []
    with open_scene(tmp_path / "s.h5") as file:
        assert len(file.events("a")) == n


def test_a_scene_without_events_has_no_trace_of_them(tmp_path: Path) -> None:
    write_scene(tmp_path / "s.h5", replace(full_scene(), events={}))
    with h5py.File(tmp_path / "s.h5") as file:
        file.visit(lambda name: pytest.fail(name) if "event" in name else None)
        assert file.attrs["version"] == b"1.0"


def test_events_of_views_that_are_not_there_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="events of views"):
        write_scene(tmp_path / "s.h5", replace(full_scene(), events={"who": no_events(1, 1, 0, 0)}))


def spoiled(scene: Path, harm: Callable[[Path], None], sealed: bool = False) -> Path:
    harm(scene)
    if sealed:
        with h5py.File(scene, "r+") as file:
            things = [file]
            file.visititems(lambda name, thing: things.append(thing))
            for thing in things:
                thing.attrs.pop("sha256", None)
            seal(file)
    return scene


def read_all(path: Path) -> Scene:
    with open_scene(path) as file:
        return file.read()


@pytest.mark.parametrize("case", UNREADABLE)
def test_hostile_events_make_a_file_unreadable(scene: Path, case: str) -> None:
    harm, words = UNREADABLE[case]
    spoiled(scene, harm)
    for call in (read_all, verify_scene):
        with pytest.raises(DataError) as told:
            call(scene)
        assert words in str(told.value)
        assert scene.name in str(told.value)


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_events_end_in_one_error_and_a_finding(scene: Path, case: str) -> None:
    """The checksums are made to fit the harm, so that only the looks at the numbers themselves can find it."""
    harm, words = HOSTILE[case]
    spoiled(scene, harm, sealed=True)
    with pytest.raises(DataError) as told:
        read_all(scene)
    assert words in str(told.value)
    assert scene.name in str(told.value)
    found = [f for f in verify_scene(scene) if f.importance == "error"]
    assert any(words in f.message and f.where.startswith("/views/v-01.x") for f in found), found


@pytest.mark.parametrize("column", ["t_ns", "x", "y", "polarity"])
def test_a_changed_column_is_found_by_its_checksum(scene: Path, column: str) -> None:
    def harm(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            values = file[f"{EVENTS}/{column}"]
            values[5] = -values[5] if column == "polarity" else values[4 if values[4] != values[5] else 6]

    spoiled(scene, harm)
    assert ("checksum", f"{EVENTS}/{column}") in {(f.check, f.where) for f in verify_scene(scene)}


def test_info_tells_of_events(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["data", "info", str(scene)]) == 0
    shown = capsys.readouterr().err
    assert "events       777" in shown
    assert "event_views  2" in shown
