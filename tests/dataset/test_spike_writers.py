"""Every format written and read back exactly, and what writing refuses."""

import numpy as np
import pytest
from spike_bytes import bits_to_bytes, random_pixels, vidar

from spikerig.dataset import oracles
from spikerig.dataset.errors import DataError, HostError, UsageError
from spikerig.dataset.spikes import SpikeStream, open_spikes, write_spikes


def same(a, b):
    """Whether two streams are equal in everything."""
    return (
        np.array_equal(a.bits, b.bits)
        and (a.width, a.rate_hz, a.t0_ns, a.clock) == (b.width, b.rate_hz, b.t0_ns, b.clock)
        and np.array_equal(a.lost, b.lost)
    )


def read(path, **layout):
    with open_spikes(path, **layout) as file:
        return file.read()


# ---- there and back -------------------------------------------------------------------------------------------------


def made(ticks, height, width, *, bare=False):
    bits = oracles.pack(random_pixels(ticks, height, width, seed=ticks))
    if bare:
        return SpikeStream(bits, width)
    lost = np.array([[0, 1], [ticks - 2, ticks]]) if ticks > 4 else np.zeros((0, 2), np.int64)
    return SpikeStream(bits, width, 19_999.25, -(2**40), "spike Kamera", lost)


SIZES = [(1, 1, 1), (7, 3, 13), (300, 2, 400), (5, 9, 1001), (40, 6, 8)]


@pytest.mark.parametrize("size", [*SIZES, (0, 4, 9)])
@pytest.mark.parametrize("ending", [".npz", ".h5"])
@pytest.mark.parametrize("bare", [False, True])
def test_round_trip_of_our_own_formats(tmp_path, size, ending, bare):
    s = made(*size, bare=bare)
    write_spikes(tmp_path / ("a" + ending), s)
    with open_spikes(tmp_path / ("a" + ending)) as file:
        assert same(file.read(), s)
        if size[0] > 5:
            assert same(file.read(2, 6), s.slice(2, 6))
        blocks = list(file.blocks(3))
    assert sum(b.ticks for b in blocks) == s.ticks
    assert np.array_equal(np.concatenate([s.bits[:0], *[b.bits for b in blocks]]), s.bits)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("extra", [0, 3, 16])
def test_round_trip_of_rasters(tmp_path, size, extra):
    s = made(*size, bare=True)
    write_spikes(tmp_path / "a.dat", s, row_bits=size[2] + extra)
    assert same(read(tmp_path / "a.dat", height=size[1], width=size[2], row_bits=size[2] + extra), s)


def test_round_trip_of_m1k40(tmp_path):
    s = made(35, 1000, 1000, bare=True)
    write_spikes(tmp_path / "a.bin", s)
    assert (tmp_path / "a.bin").stat().st_size == 35 * 128_000
    assert same(read(tmp_path / "a.bin"), s)


def test_our_writers_write_the_bytes_of_the_formats(tmp_path):
    pixels = random_pixels(2, 4, 13)
    write_spikes(tmp_path / "a.dat", SpikeStream.from_pixels(pixels), row_bits=29)
    assert (tmp_path / "a.dat").read_bytes() == vidar(pixels, 29, trailer=0)
    pixels = random_pixels(1, 1000, 1000)
    write_spikes(tmp_path / "a.bin", SpikeStream.from_pixels(pixels))
    blocks = np.frombuffer((tmp_path / "a.bin").read_bytes(), np.uint8).reshape(2000, 64)
    words = blocks[:, 62].astype(int) | blocks[:, 63].astype(int) << 8
    channel, line = words >> 14, words >> 4 & 1023
    assert sorted(zip(channel.tolist(), line.tolist(), strict=True)) == [
        (c, n) for c in range(4) for n in range(1, 501)
    ]
    assert (channel[0], line[0], channel[-1], line[-1]) == (0, 500, 3, 500)
    tag = int(words[1] >> 4)
    second = bits_to_bytes([*pixels[0, 0, 500:], *(tag >> k & 1 for k in range(12))], 64)
    assert blocks[1].tobytes() == second


def test_writing_is_refused_where_something_would_be_lost(tmp_path):
    s = made(9, 2, 9)
    for name in ("a.dat", "a.bin"):
        with pytest.raises(UsageError, match="lost"):
            write_spikes(tmp_path / name, s)
    with pytest.raises(UsageError, match="1000x1000"):
        write_spikes(tmp_path / "a.bin", made(9, 2, 9, bare=True))
    for call in (
        lambda: write_spikes(tmp_path / "a.xyz", s),
        lambda: write_spikes(tmp_path / "a.h5", s, format="avi"),
        lambda: write_spikes(tmp_path / "a.h5", s, row_bits=16),
        lambda: write_spikes(tmp_path / "a.dat", made(9, 2, 9, bare=True), row_bits=8),
        lambda: write_spikes(tmp_path / "none" / "a.h5", s),
    ):
        with pytest.raises(UsageError):
            call()
    assert list(tmp_path.iterdir()) == []  # nothing half written


def test_nothing_is_replaced_unasked(tmp_path):
    path = tmp_path / "a.h5"
    path.write_bytes(b"precious")
    with pytest.raises(UsageError, match="exists"):
        write_spikes(path, made(3, 2, 9))
    assert path.read_bytes() == b"precious"
    write_spikes(path, made(3, 2, 9), force=True)
    assert same(read(path), made(3, 2, 9))


def test_files_that_are_none(tmp_path):
    with pytest.raises(UsageError, match="no such file"):
        open_spikes(tmp_path / "a.dat")
    with pytest.raises(UsageError, match="folder"):
        open_spikes(tmp_path)
    (tmp_path / "empty.dat").write_bytes(b"")
    with pytest.raises(DataError, match="empty"):
        open_spikes(tmp_path / "empty.dat")
    for ending in ("h5", "npz"):
        path = tmp_path / f"a.{ending}"
        write_spikes(path, made(9, 3, 9))
        with pytest.raises(UsageError):
            open_spikes(path, height=3, width=9)
    with pytest.raises(UsageError, match="rate"):
        open_spikes(path, rate_hz=float("nan"))
    with open_spikes(path, rate_hz=100) as file:
        assert file.read().rate_hz == 100


def test_a_full_disk_is_told(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("spikerig.dataset.vidar_dat.write_raster", full)
    with pytest.raises(HostError, match="cannot be written"):
        write_spikes(tmp_path / "a.dat", made(3, 2, 9, bare=True))
