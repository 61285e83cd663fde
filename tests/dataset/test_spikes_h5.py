"""Our own HDF5 of one stream: damaged, hostile, unfinished and future files end in one clear error."""

import h5py
import numpy as np
import pytest
from spike_bytes import random_pixels

from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.spikes import SpikeStream, open_spikes, write_spikes
from spikerig.dataset.spikes_h5 import H5Writer


@pytest.fixture
def good(tmp_path):
    path = tmp_path / "a.h5"
    s = SpikeStream.from_pixels(random_pixels(20, 4, 13), 1000.0)
    write_spikes(path, SpikeStream(s.bits, 13, 1000.0, 5, "c", np.array([[3, 5]])))
    return path


def replace(name, **how):
    def change(file):
        del file["spikes"][name]
        file["spikes"].create_dataset(name, **how)

    return change


def attr(name, value, at="spikes"):
    def change(file):
        file[at].attrs[name] = value

    return change


def link(kind):
    def change(file):
        del file["spikes/bits"]
        file["spikes/bits"] = kind

    return change


def virtual(file):
    del file["spikes/bits"]
    layout = h5py.VirtualLayout((20, 4, 2), np.uint8)
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", (20, 4, 2))
    file["spikes"].create_virtual_dataset("bits", layout)


def padding(file):
    file["spikes/bits"][7, 2, 1] |= 0x80


FAULTS = {
    "external link": link(h5py.ExternalLink("other.h5", "/x")),
    "soft link": link(h5py.SoftLink("/spikes/lost")),
    "virtual dataset": virtual,
    "wrong type": replace("bits", data=np.zeros((20, 4, 2), np.uint16)),
    "wrong axes": replace("bits", data=np.zeros((20, 8), np.uint8)),
    "wrong width": attr("width", np.int64(17)),
    "width as text": attr("width", np.bytes_("13")),
    "no width": lambda file: file["spikes"].attrs.__delitem__("width"),
    "negative rate": attr("rate_hz", np.float64(-1)),
    "rate not a number": attr("rate_hz", np.float64("nan")),
    "lost backwards": replace("lost", data=np.array([[5, 3]])),
    "lost after the end": replace("lost", data=np.array([[5, 99]])),
    "lost of another shape": replace("lost", data=np.array([5, 9])),
    "no lost": lambda file: file["spikes"].__delitem__("lost"),
    "padding bits set": padding,
    "a newer version": attr("version", np.bytes_("2.0"), at="/"),
    "unfinished": attr("status", np.bytes_("recording"), at="/"),
    "another format": attr("format", np.bytes_("RS-3D"), at="/"),
    "a claim of 10 PB": replace("bits", shape=(10**12, 1250, 2), dtype=np.uint8, chunks=(1, 1250, 2)),
    "bits is a group": lambda file: (file["spikes"].__delitem__("bits"), file.create_group("spikes/bits")),
}


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS.keys())
def test_bad_files_end_in_one_clear_error(good, fault):
    with h5py.File(good, "r+") as file:
        fault(file)
    with pytest.raises(DataError) as error, open_spikes(good) as opened:
        opened.read()
    assert len(str(error.value).splitlines()) > 1  # says more than that


def test_a_truncated_file(good):
    data = good.read_bytes()
    for n in (20, len(data) // 2, len(data) - 100):
        good.write_bytes(data[:n])
        with pytest.raises(DataError), open_spikes(good) as opened:
            opened.read()


def test_a_writer_that_fails_leaves_a_file_marked_unfinished(tmp_path):
    s = SpikeStream.from_pixels(random_pixels(20, 4, 13))
    with pytest.raises(UsageError, match="another size"), H5Writer(tmp_path / "a.h5", s) as writer:
        writer.append(SpikeStream.from_pixels(random_pixels(20, 4, 33)))
    with pytest.raises(DataError, match="never ended"):
        open_spikes(tmp_path / "a.h5")


def test_lost_ranges_that_blocks_cut_are_joined(tmp_path):
    s = SpikeStream(np.zeros((30, 2, 1), np.uint8), 5, lost=np.array([[1, 2], [8, 22]]))
    with H5Writer(tmp_path / "a.h5", s) as writer:
        for t in range(0, 30, 7):
            writer.append(s.slice(t, min(t + 7, 30)))
    with open_spikes(tmp_path / "a.h5") as file:
        assert file.read().lost.tolist() == [[1, 2], [8, 22]]
