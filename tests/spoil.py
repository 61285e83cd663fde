"""Scene files made to do harm: each function takes the path of a good scene (hard_store.full_scene) and spoils it."""

import os
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np


def _swap(path: Path, name: str, make: Callable[[h5py.Group, str], Any]) -> None:
    with h5py.File(path, "r+") as file:
        parent, last = file[name].parent, name.rsplit("/", 1)[1]
        del parent[last]
        make(parent, last)


def external_link(path: Path) -> None:
    """To a pose that is perfectly good, in another file."""
    other = path.with_name("other.h5")
    shutil.copy(path, other)
    _swap(path, "/views/a/pose", lambda g, n: g.__setitem__(n, h5py.ExternalLink(str(other), "/views/a/pose")))


def soft_link(path: Path) -> None:
    """To a pose that is perfectly good, in the same file."""
    _swap(path, "/views/a/pose", lambda g, n: g.__setitem__(n, h5py.SoftLink("/views/v-01.x/pose")))


def soft_link_to_itself(path: Path) -> None:
    _swap(path, "/views/a", lambda g, n: g.__setitem__(n, h5py.SoftLink("/views/a")))


def hard_link_cycle(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["/views/a/again"] = file["/views"]


def virtual_dataset(path: Path) -> None:
    """Of a pose that is perfectly good, in another file."""
    other = path.with_name("other.h5")
    shutil.copy(path, other)
    layout = h5py.VirtualLayout((3, 4), "<f8")
    layout[:] = h5py.VirtualSource(str(other), "/views/a/pose", (3, 4))
    _swap(path, "/views/a/pose", lambda g, n: g.create_virtual_dataset(n, layout))


def external_storage(path: Path) -> None:
    """A pose that is perfectly good, in a raw file beside."""
    raw = path.with_name("raw.bin")
    raw.write_bytes(np.eye(4)[:3].tobytes())

    def make(group: h5py.Group, name: str) -> None:
        group.create_dataset(name, (3, 4), "<f8", external=[(str(raw), 0, 96)])

    _swap(path, "/views/a/pose", make)


def huge_empty_chunks(path: Path) -> None:
    """40 TB claimed, nothing stored."""
    _swap(path, "/views/a/spikes", lambda g, n: g.create_dataset(n, (1 << 40, 13, 3), "|u1", chunks=(1 << 10, 13, 3)))


def chunks_never_written(path: Path) -> None:
    _swap(path, "/views/a/spikes", lambda g, n: g.create_dataset(n, (4000, 13, 3), "|u1", chunks=(1000, 13, 3)))


def huge_contiguous(path: Path) -> None:
    """40 TB claimed in one piece that was never written."""
    _swap(path, "/views/a/spikes", lambda g, n: g.create_dataset(n, (1 << 40, 13, 3), "|u1"))


def deflate_bomb(path: Path) -> None:
    """2 GB of zeros in 2 MB, every chunk honestly there."""
    zeros = zlib.compress(bytes(1 << 24), 9)

    def make(group: h5py.Group, name: str) -> None:
        made = group.create_dataset(name, (1, 1 << 19, 1 << 12), "|u1", chunks=(1, 1 << 12, 1 << 12), compression=9)
        for k in range(0, 1 << 19, 1 << 12):
            made.id.write_direct_chunk((0, k, 0), zeros)

    _swap(path, "/views/a/spikes", make)


def wrong_dtype(path: Path) -> None:
    _swap(path, "/views/a/pose", lambda g, n: g.create_dataset(n, data=np.eye(4, dtype="<f4")[:3]))


def text_for_numbers(path: Path) -> None:
    _swap(path, "/views/a/pose", lambda g, n: g.create_dataset(n, data=["a", "b"], dtype=h5py.string_dtype()))


def reference_type(path: Path) -> None:
    _swap(path, "/views/a/pose", lambda g, n: g.create_dataset(n, (1,), h5py.ref_dtype))


def scalar_for_array(path: Path) -> None:
    _swap(path, "/views/a/pose", lambda g, n: g.create_dataset(n, data=1.0))


def group_for_dataset(path: Path) -> None:
    _swap(path, "/views/a/pose", lambda g, n: g.create_group(n))


def unknown_filter(path: Path) -> None:
    def make(group: h5py.Group, name: str) -> None:
        group.create_dataset(name, data=np.eye(4)[:3], chunks=(3, 4), compression="lzf")

    _swap(path, "/views/a/pose", make)


def missing_dataset(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["/views/a/pose"]


def missing_camera(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["/camera"]


def missing_attribute(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["/views/a/pixels"].attrs["start_ns"]


def text_attribute_for_number(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["/views/a/pixels"].attrs["start_ns"] = np.bytes_(b"soon")


def endless_text_attribute(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file.attrs["name"] = "n" * 200_000


def array_attribute(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["/views/a"].attrs["order"] = np.zeros(5000, np.int64)


def camera_of_another_size(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["camera"].attrs["width"] = np.int64(1 << 40)


def mirrored_pose(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["/views/a/pose"][...] = np.diag([1, 1, -1, 1])[:3]


def pose_of_nan(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["/views/a/pose"][...] = np.nan


def lost_beyond_the_end(path: Path) -> None:
    _swap(path, "/views/v-01.x/lost", lambda g, n: g.create_dataset(n, data=np.array([[0, 1 << 60]])))


def lost_backwards(path: Path) -> None:
    _swap(path, "/views/v-01.x/lost", lambda g, n: g.create_dataset(n, data=np.array([[9, 3]])))


def padding_bits(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["/views/v-01.x/spikes"][5, 5, -1] = 0xFF


def width_beyond_the_row(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["/views/v-01.x/spikes"].attrs["width"] = np.int64(4000)


def info_not_json(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["info"][0] = 0xFF


def info_nested_deep(path: Path) -> None:
    text = b'{"a":' + b"[" * 200_000
    _swap(path, "/info", lambda g, n: g.create_dataset(n, data=np.frombuffer(text, np.uint8)))


def name_with_dots(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["/views"].move("a", "...")


def name_that_climbs(path: Path) -> None:
    """A member called "../../xy": HDF5 refuses to make it, so it is patched into a file without checksums."""
    with h5py.File(path) as good, h5py.File(path.with_suffix(".old"), "w", libver="earliest") as old:
        old.create_group("views")  # of the old kind: its members' names lie in a plain heap
        for name in [*(n for n in good if n != "views"), *(f"views/{n}" for n in good["views"])]:
            good.copy(name, old, name)
        for name in good.attrs:
            old.attrs[name] = good.attrs[name]
        old["views"].move("v-01.x", "QQQQQQQQ")
    data = path.with_suffix(".old").read_bytes()
    assert data.count(b"QQQQQQQQ") == 1
    path.write_bytes(data.replace(b"QQQQQQQQ", b"../../xy"))


def name_of_the_parent(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["/views"].move("a", "..")


def name_of_a_device(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["/views"].move("a", "con\n<script>")


def future_major(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file.attrs["version"] = np.bytes_(b"2.0")


def version_of_nonsense(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file.attrs["version"] = np.bytes_(b"1.0; rm -rf /")


def another_format(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file.attrs["format"] = np.bytes_(b"RS-4D")


def not_hdf5(path: Path) -> None:
    path.write_bytes(b"\x93NUMPY" + bytes(5000))


def empty(path: Path) -> None:
    path.write_bytes(b"")


def only_the_signature(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:8])


def folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


# `spikerig data verify` exits 4 (unreadable) or 1 (findings), and these words stand in its error or in a finding.
# Opening and reading everything is one DataError either way, of the same words where verifying is.
HOSTILE: dict[Callable[[Path], None], tuple[int, str]] = {
    external_link: (4, "only hard links are followed"),
    soft_link: (4, "only hard links are followed"),
    soft_link_to_itself: (4, "only hard links are followed"),
    hard_link_cycle: (4, "one object under two names"),
    virtual_dataset: (4, "its data lie in other files"),
    external_storage: (4, "its data lie in other files"),
    huge_empty_chunks: (4, "claims 42880953483264 bytes"),
    chunks_never_written: (4, "0 of 4 chunks are there"),
    huge_contiguous: (4, "claims 42880953483264 bytes"),
    deflate_bomb: (4, "claims 2147483648 bytes"),
    text_for_numbers: (4, "only integers and floats are read"),
    reference_type: (4, "only integers and floats are read"),
    scalar_for_array: (4, "a scalar or null dataspace"),
    unknown_filter: (4, "allowed are ['deflate', 'fletcher32', 'shuffle']"),
    endless_text_attribute: (4, "not one number or short text"),
    array_attribute: (4, "not one number or short text"),
    name_that_climbs: (4, "not a plain one: '../../xy'"),
    name_of_the_parent: (4, "not a plain one: '..'"),
    future_major: (4, "RS-3D 2.0"),
    version_of_nonsense: (4, "version '1.0; rm -rf /'"),
    another_format: (4, "an HDF5 file of another kind"),
    not_hdf5: (4, "does not begin as HDF5 does"),
    empty: (4, "it is empty"),
    only_the_signature: (4, "HDF5:"),
    folder: (4, "not a file"),
    pipe: (4, "not a file"),
    wrong_dtype: (1, "not what the schema says"),
    group_for_dataset: (1, "not the f8 that belongs there"),
    missing_dataset: (1, "pose is missing"),
    missing_camera: (1, "camera is missing"),
    missing_attribute: (1, "start_ns is missing"),
    text_attribute_for_number: (1, "where int belongs"),
    camera_of_another_size: (1, "not those that were written"),
    mirrored_pose: (1, "not those that were written"),
    pose_of_nan: (1, "not finite"),
    lost_beyond_the_end: (1, "not those that were written"),
    lost_backwards: (1, "not those that were written"),
    padding_bits: (1, "not those that were written"),
    width_beyond_the_row: (1, "not those that were written"),
    info_not_json: (1, "not those that were written"),
    info_nested_deep: (1, "not those that were written"),
    name_with_dots: (1, "not those that were written"),
    name_of_a_device: (1, "not those that were written"),
}
