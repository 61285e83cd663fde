"""SpikeStream, and files of spikes: read from bytes made by hand, written and read back exactly, damaged."""

import io
import subprocess
import sys
import zipfile

import numpy as np
import pytest
from spike_bytes import m1k40, random_pixels, vidar

from spikerig.dataset import oracles
from spikerig.dataset.errors import DataError, UsageError
from spikerig.dataset.spikes import SpikeStream, open_spikes


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


# ---- the stream -----------------------------------------------------------------------------------------------------


def test_a_stream_checks_its_shape():
    for bits, width in ((np.zeros((2, 3), np.uint8), 8), (np.zeros((2, 3, 2), np.uint8), 8), (np.zeros((1, 1, 1)), 8)):
        with pytest.raises(DataError, match="packed spikes"):
            SpikeStream(bits, width)
    with pytest.raises(UsageError):
        SpikeStream.from_pixels(np.zeros((2, 3)))


def test_ticks_and_time():
    s = SpikeStream.from_pixels(random_pixels(100, 2, 9), rate_hz=40_000, t0_ns=1_000_000)
    assert s.tick_at(1_000_000) == 0
    assert s.tick_at(1_025_000) == 1
    assert s.tick_range(1_025_000, 1_050_000) == (1, 2)  # exactly one tick, not its neighbours that only touch
    assert s.tick_range(1_024_999, 1_050_001) == (0, 3)
    assert s.tick_range(0, 10) == (0, 0)
    assert s.tick_range(9_000_000, 9_100_000) == (100, 100)
    assert s.tick_range(0, 10**12) == (0, 100)
    with pytest.raises(UsageError, match="no rate"):
        SpikeStream.from_pixels(random_pixels(3, 1, 1)).tick_range(0, 1)


def test_a_slice_keeps_time_and_lost_ticks():
    s = SpikeStream(np.zeros((50, 1, 1), np.uint8), 5, 40_000.0, 7, "spike", np.array([[2, 6], [10, 20], [49, 50]]))
    part = s.slice(4, 15)
    assert part.ticks == 11
    assert part.t0_ns == 7 + 4 * 25_000
    assert part.lost.tolist() == [[0, 2], [6, 11]]
    assert s.slice(20, 20).lost.tolist() == []
    assert np.diff(s.lost_before()).nonzero()[0].tolist() == [2, 3, 4, 5, *range(10, 20), 49]
    for bad in ((-1, 3), (3, 51), (5, 4)):
        with pytest.raises(UsageError):
            s.slice(*bad)


# ---- raw rasters ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("row_bits", [400, 416])
def test_vidar_bytes(tmp_path, row_bits):
    pixels = random_pixels(3, 250, 400)
    path = tmp_path / "a.dat"
    path.write_bytes(vidar(pixels, row_bits))
    with open_spikes(path) as file:  # the size decides
        assert (file.format, file.ticks, file.height, file.width) == ("dat", 3, 250, 400)
        assert file.facts["row_bits"] == row_bits
        assert np.array_equal(oracles.unpack(file.read().bits, 400), pixels)
        assert np.array_equal(oracles.unpack(file.read(1, 2).bits, 400), pixels[1:2])
        assert file.read(2, 2).ticks == 0
        with pytest.raises(UsageError):
            file.read(2, 4)


@pytest.mark.parametrize(
    ("height", "width", "row_bits"), [(3, 13, 13), (3, 13, 16), (3, 13, 29), (2, 8, 24), (1, 1, 1), (5, 7, 11)]
)
def test_rasters_of_any_size(tmp_path, height, width, row_bits):
    pixels = random_pixels(300, height, width)  # more than one internal step of ticks
    path = tmp_path / "a.dat"
    path.write_bytes(vidar(pixels, row_bits))
    s = read(path, height=height, width=width, row_bits=row_bits)
    assert np.array_equal(oracles.unpack(s.bits, width), pixels)
    assert np.array_equal(s.bits, oracles.pack(pixels))  # trailer bits do not leak into padding


def test_a_size_that_fits_both_rows_must_be_asked(tmp_path):
    path = tmp_path / "a.dat"
    pixels = random_pixels(26, 250, 400)
    path.write_bytes(oracles.pack(pixels)[:, ::-1].tobytes())  # 26 * 12,500 = 25 * 13,000
    with pytest.raises(UsageError, match="more than one layout") as error:
        open_spikes(path)
    assert "--row-bits" in error.value.next
    assert np.array_equal(oracles.unpack(read(path, row_bits=400).bits, 400), pixels)
    assert read(path, row_bits=416).ticks == 25


def test_a_raster_that_breaks_off_says_how_many_bytes_are_over(tmp_path):
    path = tmp_path / "a.dat"
    path.write_bytes(bytes(2 * 12_500 + 777))
    with pytest.raises(DataError, match="777 left over after 2 ticks of 12500 B"):
        open_spikes(path)
    with pytest.raises(DataError, match="777 left over"):
        open_spikes(path, row_bits=400)
    with pytest.raises(UsageError, match="more than one layout"):  # either could have broken off
        open_spikes(path, drop_tail=True)
    with open_spikes(path, row_bits=400, drop_tail=True) as file:
        assert file.ticks == 2
        assert file.facts["dropped_bytes"] == 777


def test_raster_arguments_that_contradict_each_other(tmp_path):
    path = tmp_path / "a.dat"
    path.write_bytes(bytes(12_500))
    for layout in ({"height": 250}, {"width": 400}, {"row_bits": 399}, {"height": 0, "width": 5}):
        with pytest.raises(UsageError):
            open_spikes(path, **layout)


def test_a_file_that_shrinks_while_it_is_open(tmp_path):
    path = tmp_path / "a.dat"
    path.write_bytes(bytes(12_500 * 4))
    with open_spikes(path) as file:
        with path.open("r+b") as cut:
            cut.truncate(12_500 * 2)
        assert file.read(0, 2).ticks == 2
        with pytest.raises(DataError, match="ended early"):
            file.read(0, 3)


# ---- M1K40 ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def megapixel():
    """Two ticks of 1000x1000, and their bytes; columns around the seam of the two blocks are told apart."""
    pixels = random_pixels(2, 1000, 1000)
    pixels[:, :, 499], pixels[:, :, 500], pixels[0, 0, :], pixels[1, 999, :] = 1, 0, 1, 1
    return pixels, m1k40(pixels)


@pytest.mark.parametrize("skip", [0, 64, 128_000 - 64, 63_937])
def test_m1k40_starts_in_the_middle_of_a_tick(tmp_path, megapixel, skip):
    pixels, data = megapixel
    path = tmp_path / "a.bin"
    path.write_bytes((data + data + data[:5000])[skip:])
    expect = np.concatenate([pixels, pixels])[1 if skip else 0 :]
    with open_spikes(path) as file:
        assert (file.format, file.ticks, file.height, file.width) == ("m1k40", len(expect), 1000, 1000)
        assert file.facts["bytes_before_first_tick"] == (128_000 - skip if skip else 0)
        assert file.facts["bytes_after_last_tick"] == 5000
        assert np.array_equal(oracles.unpack(file.read().bits, 1000), expect)
        assert np.array_equal(oracles.unpack(file.read(1, 2).bits, 1000), expect[1:2])


def test_m1k40_is_known_without_its_ending(tmp_path, megapixel):
    path = tmp_path / "a.dat"
    path.write_bytes(megapixel[1])
    with open_spikes(path) as file:
        assert file.format == "m1k40"


def test_m1k40_pixels_that_look_like_tags_do_not_start_a_tick(tmp_path, megapixel):
    pixels = np.concatenate([megapixel[0]] * 2)
    first, last = 500, 500 | 3 << 10
    for row in pixels[0]:  # in the tick before the first whole one: pairs of false tags, as far apart as true ones
        row[4:16] = [first >> k & 1 for k in range(12)]
    for row in pixels[1]:
        row[504:516] = [last >> k & 1 for k in range(12)]
    path = tmp_path / "a.bin"
    path.write_bytes(m1k40(pixels)[640:])
    with open_spikes(path) as file:
        assert file.facts["bytes_before_first_tick"] == 128_000 - 640
        assert np.array_equal(oracles.unpack(file.read().bits, 1000), pixels[1:])


def test_m1k40_that_loses_its_frame_says_where(tmp_path, megapixel):
    path = tmp_path / "a.bin"
    data = megapixel[1] * 2
    path.write_bytes(data[: 128_000 * 2] + data[128_000 * 2 + 64 :] + bytes(64))  # a block dropped in tick 2
    with open_spikes(path) as file:
        assert file.read(0, 2).ticks == 2
        with pytest.raises(DataError, match="lost its frame") as error:
            file.read(0, 3)
        assert "tick 2" in str(error.value.value)


def test_a_bin_without_ticks(tmp_path):
    for n in (10, 127_999, 128_000, 300_000):
        path = tmp_path / "a.bin"
        path.write_bytes(bytes(n))
        with pytest.raises(DataError, match="no tick of an M1K40"):
            open_spikes(path)


# ---- archives -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.int64, np.float32])
@pytest.mark.parametrize("axes", ["THW", "HWT"])
@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_foreign_archives(tmp_path, dtype, axes, order, save):
    pixels = random_pixels(37, 5, 21)
    path = tmp_path / "a.npz"
    stored = pixels if axes == "THW" else pixels.transpose(1, 2, 0)
    save(path, spk=np.array(stored, dtype, order=order), label=np.arange(3), label_name=np.array("car"))
    with open_spikes(path, axes=axes) as file:
        assert (file.format, file.ticks, file.height, file.width) == ("npz", 37, 5, 21)
        for t0, t1 in ((0, 37), (30, 37), (3, 4), (4, 9), (5, 5)):  # also backwards
            assert np.array_equal(file.read(t0, t1).bits, oracles.pack(pixels)[t0:t1])


def test_foreign_archives_must_say_their_axes(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, spk=random_pixels(9, 9, 9))
    for axes in (None, "TWH", "thw"):
        with pytest.raises(UsageError, match="order of their axes"):
            open_spikes(path, axes=axes)


def test_archives_that_hold_no_spikes(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, a=np.zeros((2, 2)))
    with pytest.raises(DataError, match="one array of three axes"):
        open_spikes(path, axes="THW")
    np.savez(path, a=np.zeros((2, 2, 2)), b=np.zeros((2, 2, 2)))
    with pytest.raises(DataError, match="one array of three axes"):
        open_spikes(path, axes="THW")
    for bad in (2, -1, 0.5, np.nan, np.inf):
        values = np.zeros((4, 3, 5))
        values[3, 2, 4] = bad
        np.savez(path, a=values)
        with open_spikes(path, axes="THW") as file:
            assert file.read(0, 3).ticks == 3
            with pytest.raises(DataError, match="spikes are 0 or 1"):
                file.read()


class Trap:
    """Unpickling one of these would be noticed."""

    def __reduce__(self):
        return (pytest.fail, ("unpickled",))


def test_archives_are_never_unpickled(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, spk=np.full((2, 3, 4), Trap(), object))
    with pytest.raises(DataError):
        open_spikes(path, axes="THW")


def test_damaged_archives(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, spk=random_pixels(200, 30, 30))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match="damaged"):
        open_spikes(path, axes="THW")
    broken = bytearray(whole)
    broken[2000:2100] = bytes(100)
    path.write_bytes(broken)
    with open_spikes(path, axes="THW") as file, pytest.raises(DataError, match="damaged"):
        file.read()


def test_an_archive_that_claims_more_than_it_holds(tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": (10**9, 1000, 1000)})
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("spk.npy", header.getvalue() + bytes(100))
    with pytest.raises(DataError, match="claims"):
        open_spikes(path, axes="THW")


# ---- 15 GB ----------------------------------------------------------------------------------------------------------

LARGE = """
import sys
import numpy as np
from spikerig.dataset import cli
from spikerig.dataset.spikes import open_spikes
from spikerig.dataset.texture import tfp

path, out = sys.argv[1:]
with open_spikes(path, rate_hz=40_000) as file:
    assert file.ticks == 1_200_000
    end = file.read(file.ticks - 2)
    assert end.bits[1, 0, 0] == 0x81 and int(np.count_nonzero(end.bits)) == 1
    assert end.t0_ns == 29_999_950_000
    blocks = file.blocks()
    fired = sum(int(tfp(block, block.ticks // 2, block.ticks).light.sum() > 0) for block, _ in zip(blocks, range(6)))
    assert fired == 1
assert cli.run(["data", "info", path, "--json"]) == 0
assert cli.run(["data", "texture", path, "--at", "1199999", "-o", out]) == 0
status = open("/proc/self/status").read()  # ru_maxrss would begin with the parent's
print(int(status.split("VmHWM:")[1].split()[0]) // 1024)
"""


def test_15_gigabytes_in_less_than_200_megabytes(tmp_path):
    path = tmp_path / "long.dat"
    with path.open("wb") as file:  # sparse: takes no space
        file.write(b"\x01")
        file.seek(15_000_000_000 - 50)  # the last tick's top row: rows are bottom-up
        file.write(b"\x81")
        file.truncate(15_000_000_000)
    command = [sys.executable, "-c", LARGE, str(path), str(tmp_path / "t.npy")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[-1]) < 200
    assert np.load(tmp_path / "t.npy")[0, 0] == np.float32(1 / 21)
