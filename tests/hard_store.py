"""Hard inputs of the scene file and the pictures; a small scene with everything in it, and an exact comparison."""

from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from spikerig.dataset.clocktime import ClockModel
from spikerig.dataset.events import EventStream, no_events
from spikerig.dataset.scene import Camera, Frame, Points, Pose, Scene, Trajectory, Truth, View
from spikerig.dataset.spikes import SpikeStream

H, W = 13, 21


def turn(angle: float, shift: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s, shift], [0, 1, 0, -shift], [-s, 0, c, 2.0]])


def path(k: int, cov: bool) -> Trajectory:
    poses = np.stack([turn(0.1 * i, 0.01 * i) for i in range(k)])
    noise = np.random.default_rng(k).random((k, 6, 6)) if cov else None
    return Trajectory(np.arange(k) * 1_000_003 - 7, poses, noise)


def stream(ticks: int, seed: int, rate_hz: float | None = 40_000.0) -> SpikeStream:
    on = np.random.default_rng(seed).random((ticks, H, W)) < 0.2
    lost = np.array([[3, 9], [20, 21]]) if ticks > 30 else np.zeros((0, 2), int)
    for a, b in lost:
        on[a:b] = False
    return SpikeStream(np.packbits(on, axis=2, bitorder="little"), W, rate_hz, -1234567, "spike-clock", lost)


def events(count: int, seed: int = 0, height: int = H, width: int = W, span_ns: int = 20_000_000) -> EventStream:
    """So many events, evenly spread over a span that starts at 2^60."""
    rng, t0 = np.random.default_rng(seed), 2**60
    t = np.sort(rng.integers(t0, t0 + span_ns, count))
    x, y = rng.integers(0, width, count, np.uint16), rng.integers(0, height, count, np.uint16)
    return EventStream(t, x, y, rng.choice(np.array([-1, 1], np.int8), count), height, width, t0, t0 + span_ns, "dvs")


def view(i: int) -> View:
    rng = np.random.default_rng(100 + i)
    shape = (H, W)
    frame = Frame(
        rng.integers(0, 256, (*shape, 3), dtype=np.uint8), ["srgb", "linear"][i % 2], 5_000 + i, 7_500_000, 21, "cam"
    )
    spikes = None if i == 3 else stream(40 if i else 0, i, None if i == 2 else 40_000.1)
    return View(
        ["a", "v-01.x", "_b", "Z9"][i],
        frame,
        spikes,
        rng.random(shape, dtype=np.float32) * 100,
        rng.random(shape) < 0.5,
        Pose(turn(0.3 * i, i)),
        None if i == 1 else path(4, cov=i == 0),
        "test" if i == 3 else "train",
    )


def full_scene() -> Scene:
    rng = np.random.default_rng(5)
    views = tuple(view(i) for i in range(4))
    clock = ClockModel(np.array([0, 10**15]), np.array([5, 10**15 + 30_000]), np.array([1.5, 2.5]), 12.5)
    truth = Truth(
        {name: rng.standard_normal((H, W, 3)).astype(np.float32) for name in ("a", "Z9")},
        {"a": 2**60 + 1, "_b": -3},
        {"a": path(9, cov=True)},
        clock,
        {"shot": {"threshold_e": 560.25}, "list": [1, None, True, "ü"]},
        2**62,
        "first",
    )
    points = Points(rng.standard_normal((17, 3)), rng.integers(0, 256, (17, 3), dtype=np.uint8), "simulator")
    camera = Camera(np.array([[30.0, 0, 10.5], [0, 31, 6.5], [0, 0, 1]]), np.array([0.1, -0.2, 0.3, 1e-17]), W, H)
    info = {"made": "üß", "n": [1, 2.5, None], "deep": {"k": True}}
    calibration = {"id": "cal-1", "mirror": {"arm": 1}}
    seen = {"v-01.x": events(777), "Z9": no_events(5, 4, -3, -3, "é")}
    return Scene("scène 1", camera, views, points, truth, 0.1 + 0.2, info, clock, calibration, seen)


def same(a: Any, b: Any, where: str = "scene") -> None:
    """Assert that two records are equal to the last bit, dtypes included."""
    assert type(a) is type(b) or (isinstance(a, dict) and isinstance(b, dict)), where
    if is_dataclass(a):
        for f in fields(a):
            same(getattr(a, f.name), getattr(b, f.name), f"{where}.{f.name}")
    elif isinstance(a, np.ndarray):
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes()), where
    elif isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            same(a[key], b[key], f"{where}[{key}]")
    elif isinstance(a, tuple):
        assert len(a) == len(b), where
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            same(x, y, f"{where}[{i}]")
    else:
        assert a == b, where


ROWS = [
    (
        "external, soft, self-referring links; a cycle of hard links",
        "open_scene, verify_scene",
        "one DataError naming the place; nothing outside the file is opened",
        "dataset/test_hostile.py::test_hostile_files_end_in_one_error",
    ),
    (
        "virtual dataset, external storage, a filter not on the list",
        "open_scene, verify_scene",
        "one DataError",
        "dataset/test_hostile.py::test_hostile_files_end_in_one_error",
    ),
    (
        "40 TB claimed and nothing stored; 2 GB of zeros deflated to 2 MB",
        "open_scene, verify_scene",
        "one DataError before memory is asked for",
        "dataset/test_hostile.py::test_hostile_files_end_in_one_error",
    ),
    (
        "wrong type, a missing dataset or attribute, text for a number, a mirrored or NaN pose",
        "open_scene, verify_scene",
        "reading: one DataError; verifying: a finding that names it",
        "dataset/test_hostile.py::test_hostile_files_end_in_one_error",
    ),
    (
        "member names `../../xy`, `..`, `...`, with a line break or markup",
        "open_scene, verify_scene",
        "one DataError; the name is shown escaped, never used as a path",
        "dataset/test_hostile.py::test_hostile_files_end_in_one_error",
    ),
    (
        "not HDF5, empty, eight bytes, a folder, a named pipe",
        "open_scene, verify_scene",
        "one DataError at once",
        "dataset/test_hostile.py::test_hostile_files_end_in_one_error",
    ),
    (
        "files of HDF5's CVE reports (some crash the library)",
        "open_scene, verify_scene",
        "one DataError; the child process may die, this one does not",
        "dataset/test_hostile.py::test_files_from_cve_reports",
    ),
    (
        "the child process crashes, hangs, answers nonsense",
        "ask_child",
        "one DataError that says which",
        "dataset/test_hostile.py::test_a_child_that_crashes_hangs_or_starves_is_a_data_error",
    ),
    (
        "cut at ten places",
        "open_scene",
        "one DataError",
        "dataset/test_hostile.py::test_truncated_anywhere",
    ),
    (
        "one bit flipped in every dataset",
        "verify_scene",
        "a critical finding for each, by name",
        "dataset/test_store.py::test_a_flipped_bit_in_any_dataset_is_found_and_named",
    ),
    (
        "one bit flipped in the file's own structure",
        "verify_scene",
        "refused, or a finding",
        "dataset/test_hostile.py::test_one_flipped_bit_of_metadata_is_found",
    ),
    (
        "an attribute changed",
        "verify_scene",
        "a checksum finding at its object",
        "dataset/test_store.py::test_a_changed_attribute_is_found",
    ),
    (
        "kill -9 while writing",
        "SceneWriter, open_scene",
        "status recording, a clear error; whole views readable when asked for",
        "dataset/test_store.py::test_a_kill_leaves_a_recording_part_whose_whole_views_can_be_read",
    ),
    (
        "an exception while writing",
        "SceneWriter",
        "status aborted, the target untouched",
        "dataset/test_store.py::test_an_exception_leaves_an_aborted_part_that_says_so",
    ),
    (
        "the disk is full",
        "write_scene",
        "one HostError, no file",
        "dataset/test_store.py::test_a_full_disk_is_one_clear_error",
    ),
    (
        "version 1.7, version 2.0",
        "open_scene",
        "read with a note; refused with what to do",
        "dataset/test_store.py::test_a_newer_major_version_is_refused_with_what_to_do",
    ),
    (
        "zero ticks, no rate, no spikes, 2^62 as a seed, 13x21 pixels, a distortion of 1e-17, nothing lost",
        "write_scene, SceneFile.read",
        "equal to the last bit",
        "dataset/test_store.py::test_everything_round_trips_to_the_last_bit",
    ),
    (
        "a window that cuts through lost ranges; no rate",
        "SceneFile.spikes",
        "lost and t0_ns counted from the window",
        "dataset/test_store.py::test_a_window_of_spikes_is_that_slice_in_time",
    ),
    (
        "light below 0, above 1, at the knee, NaN",
        "srgb_from_linear",
        "straight below, power above, NaN stays NaN",
        "dataset/test_images.py::test_the_srgb_curve_at_published_values",
    ),
    (
        "flipped, cropped, BGR, transposed, Fortran, strided, float64, half arrays",
        "write_image (EXR)",
        "the same pixels back (OpenEXR itself writes wrong ones)",
        "dataset/test_images.py::test_exr_round_trips_from_any_memory_layout",
    ),
    (
        "an EXR, PNG or JPEG that breaks off anywhere",
        "read_image",
        "one DataError",
        "dataset/test_images.py::test_a_truncated_picture_is_one_data_error",
    ),
    (
        "data window beside, inside, outside the display window",
        "read_image (EXR)",
        "on the display window, 0 where unsaid; a DataError where they do not meet",
        "dataset/test_images.py::test_exr_is_read_on_its_display_window",
    ),
    (
        "NaN and infinities in an EXR",
        "read_image",
        "NumericsError with their number",
        "dataset/test_images.py::test_exr_with_nan_or_infinities_is_refused_unless_kept",
    ),
    (
        "luminance-chroma, deep, multi-view, tiled, lone channels",
        "read_image (EXR)",
        "read or refused, as listed",
        "dataset/test_exr.py::test_awkward_exr_files_are_read_or_refused",
    ),
    (
        "a picture claiming 100,000 x 100,000",
        "read_image",
        "DataError before anything is decoded",
        "dataset/test_images.py::test_claimed_sizes_are_checked_before_anything_is_decoded",
    ),
    (
        "a texture with nothing known",
        "texture_png",
        "gain 1, all transparent",
        "dataset/test_images.py::test_the_png_of_a_texture",
    ),
    (
        "scaled, mirrored, NaN, 2x4 and float32 matrices",
        "read_transforms",
        "a rotation to the last bit, or one DataError naming the frame",
        "dataset/test_posed.py::test_float32_drift_is_taken_out_and_worse_is_refused",
    ),
    (
        "COLMAP models cut anywhere or claiming 2^62 records",
        "read_colmap",
        "one DataError",
        "dataset/test_posed.py::test_damaged_colmap_models_end_in_data_errors",
    ),
    (
        "pictures, spikes and poses that do not match",
        "build_scene",
        "all faults at once, nothing written",
        "dataset/test_build.py::test_every_fault_is_told_at_once_and_nothing_is_written",
    ),
    (
        "a forked worker with the parent's file open",
        "SceneDataset",
        "the same items",
        "train/test_scene_dataset.py::test_workers_give_the_same_items",
    ),
]
