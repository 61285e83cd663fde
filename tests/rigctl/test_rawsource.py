"""Raw dumps as spike sources, and the slot of a vendor's library."""

from contextlib import ExitStack, closing
from itertools import pairwise

import numpy as np
import pytest
from vidar_bench import MID, MS, S

from spikerig.dataset.errors import DataError, DeviceError, HostError, UsageError
from spikerig.rigctl.rawsource import RawSource, VendorSource
from spikerig.rigctl.sim.emulate.virtual import VirtualHost


@pytest.fixture
def dump(tmp_path):
    path = tmp_path / "dump.raw"
    words = np.arange(MID.tick_bytes * 1000 // 4, dtype="<u4")
    path.write_bytes(words.tobytes())
    return path, words


@pytest.fixture
def opened():
    with ExitStack() as stack:
        yield lambda path, host, **more: stack.enter_context(closing(RawSource(path, MID, host, **more)))


def play(source, host, until_s, wait=100 * MS):
    blocks = []
    while host.now_ns() < until_s * S:
        block = source.read(wait)
        if block is not None:
            blocks.append((block, block.data.copy()))
    return blocks


def test_a_dump_comes_at_the_sensors_speed(dump, opened):
    path, words = dump
    host = VirtualHost()
    source = opened(path, host)
    source.start()
    blocks = play(source, host, 0.05)
    got = np.concatenate([d for _, d in blocks]).view("<u4")
    assert np.array_equal(got, words)  # 1000 ticks at 20 kHz are these 50 ms
    assert host.now_ns() == 50 * MS
    assert [b.byte_index for b, _ in blocks] == [0, 524_288, 1_048_576]
    with pytest.raises(DeviceError, match="is over"):
        source.read(MS)


def test_a_timeout_brings_what_is_there(dump, opened):
    path, words = dump
    host = VirtualHost()
    source = opened(path, host)
    source.start()
    blocks = play(source, host, 0.02, wait=3 * MS)
    assert {len(d) for _, d in blocks} == {76_800}
    assert np.array_equal(np.concatenate([d for _, d in blocks]).view("<u4"), words[: 7 * 19_200])


def test_a_loop_of_whole_ticks_is_one_epoch_and_of_others_many(dump, opened):
    path, words = dump
    host = VirtualHost()
    source = opened(path, host, loop=True)
    source.start()
    assert {b.epoch for b, _ in play(source, host, 0.2)} == {0}
    path.write_bytes(words.tobytes()[:-4])
    source = opened(path, host, loop=True)
    source.start()
    blocks = play(source, host, 0.39)
    assert {b.epoch for b, _ in blocks} == {0, 1, 2, 3}
    assert all(b.byte_index == 0 for (a, _), (b, _) in pairwise(blocks) if a.epoch != b.epoch)


def test_a_late_reader_loses_only_where_the_memory_is_finite(dump, opened):
    for memory in (0, 100_000):
        host = VirtualHost()
        source = opened(dump[0], host, block_bytes=40_000, memory_bytes=memory)
        source.start()
        first = source.read(S).data.copy()
        host.sleep_until(host.now_ns() + 10 * MS)
        block = source.read(S)
        if memory == 0:
            assert (block.epoch, block.lost_bytes) == (0, 0)
            assert block.data.view("<u4")[0] == first.view("<u4")[-1] + 1
        else:
            assert (block.epoch, block.byte_index, block.lost_why) == (1, 0, "overflow")
            assert block.lost_bytes == 256_000 - 100_000
            assert block.data.view("<u4")[0] == 10_000 + (256_000 - 100_000) // 4


def test_what_is_no_dump_is_told(tmp_path, dump):
    with pytest.raises(UsageError, match="cannot be read"):
        RawSource(tmp_path / "none", MID, VirtualHost())
    (tmp_path / "short").write_bytes(b"123")
    with pytest.raises(DataError, match="less than a tick"):
        RawSource(tmp_path / "short", MID, VirtualHost())
    source = RawSource(dump[0], MID, VirtualHost())
    with pytest.raises(UsageError, match="not started"):
        source.read(MS)
    source.start()
    with pytest.raises(UsageError, match="already"):
        source.start()
    dump[0].write_bytes(b"")
    with pytest.raises(DataError, match="shrank"):
        source.read(S)
    source.close()
    source.close()
    with pytest.raises(DeviceError, match="closed"):
        source.start()


class Library:
    """A vendor's library as a lab's ctypes binding would show it."""

    def __init__(self, host, missing=(), silent=()):
        self.host, self.calls, self.pts = host, [], -1
        self.missing, self.silent = missing, silent

    def open(self, **how):
        self.calls.append(how)

    def start(self):
        self.calls.append("start")

    def take(self, into, timeout_ms):
        self.pts += 1
        if self.pts in self.silent:
            return 0, -1
        made = self.pts * len(into)
        self.host.sleep_until(round((self.pts + 1) * len(into) / MID.bytes_s * S))
        into.view(np.uint32)[:] = np.arange(made // 4, (made + len(into)) // 4, dtype=np.uint32)
        if self.pts in self.missing:
            return self.take(into, timeout_ms)
        return len(into), self.pts

    def stop(self):
        self.calls.append("stop")

    def close(self):
        self.calls.append("close")


def test_the_vendors_slot_streams_and_tells_jumps_of_its_counter():
    host = VirtualHost()
    library = Library(host, missing=(7, 8))
    source = VendorSource(library, MID, host, serial="X1")
    assert library.calls == [
        {"interface": 0x21, "mode": 0x1000, "serial": "X1", "packet_bytes": 262_144, "queue": 16, "cusum": 50}
    ]
    source.start()
    blocks = [source.read(S) for _ in range(12)]
    assert [b.epoch for b in blocks] == [0] * 7 + [1] * 5
    assert (blocks[7].lost_bytes, blocks[7].lost_why) == (2 * 64_000, "counter")
    assert [b.byte_index for b in blocks[5:10]] == [5 * 64_000, 6 * 64_000, 0, 64_000, 128_000]
    source.stop()
    source.stop()
    source.close()
    source.close()
    assert library.calls[1:] == ["start", "stop", "close"]
    with pytest.raises(UsageError, match="closed"):
        source.start()


def test_the_vendors_slot_sees_what_the_counter_hides():
    host = VirtualHost()
    library = Library(host)
    source = VendorSource(library, MID, host)
    source.start()
    for _ in range(200):
        source.read(S)
    kept = library.pts

    class Hides:  # the library drops data and counts on without a gap
        def take(self, into, timeout_ms):
            count, pts = Library.take(library, into, timeout_ms)
            return count, pts - 3

        def __getattr__(self, name):
            return getattr(library, name)

    for _ in range(3):
        library.take(np.zeros(64_000, np.uint8), 1)
    source._link = Hides()
    told = [source.read(S) for _ in range(60)]
    assert library.pts > kept + 3
    (new,) = [b for b in told if b.lost_why]
    assert (new.lost_why, new.epoch) == ("rate", 1)
    assert abs(new.lost_bytes - 3 * 64_000) < 1000


def test_a_library_that_does_not_open_is_this_machines_fault():
    class Broken(Library):
        def open(self, **how):
            raise OSError("libspikelinkapi.so: cannot open shared object file")

    with pytest.raises(HostError, match="vendor's library") as told:
        VendorSource(Broken(VirtualHost()), MID, VirtualHost())
    assert told.value.exit_code == 6
