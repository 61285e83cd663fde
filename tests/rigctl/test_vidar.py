"""The Vidar driver on an emulated bus: every way a stream can break, driven through pyusb, and no loss unseen."""

import errno
from itertools import pairwise

import numpy as np
import pytest
from vidar_bench import K20, MID, MS, SMALL, S, camera, gaps, opened, record

from spikerig.dataset.errors import DeviceError, HostError, UsageError
from spikerig.rigctl import usbport
from spikerig.rigctl.sim.emulate.latency import Latency
from spikerig.rigctl.sim.emulate.virtual import VirtualHost
from spikerig.rigctl.vidar import VidarSource, find

LOST = ("overflow", "drop", "stall", "io", "interrupted", "unplug")


def losses(bridge):
    """Bytes lost while it streamed, by cause."""
    told = {}
    for x in bridge.truth(0)["lost"]:
        told[x["why"]] = told.get(x["why"], 0) + x["stop"] - x["start"]
    return told


def thrown_away(bridge, blocks):
    """Bytes that came over the link since the first block, and were not handed on."""
    first = int(blocks[0][1].view(np.uint32)[0]) * 4
    sent = sum(max(0, b - max(a, first)) for a, b in bridge.truth(0)["sent"])
    return sent - sum(len(d) for _, d in blocks)


def read_on(source):
    """Read until it raises."""
    while True:
        source.read(100 * MS)


def epochs(blocks):
    """The first block of each epoch after the first."""
    return [b for (a, _), (b, _) in pairwise(blocks) if b.epoch != a.epoch]


def test_a_still_bus_gives_every_byte_in_one_epoch():
    host, bus, bridge, source = opened()
    blocks = record(host, source, 1.5)
    assert {b.epoch for b, _ in blocks} == {0}
    assert gaps(blocks) == ([], [], [])
    assert all(b.before_ns < b.after_ns for b, _ in blocks)
    assert all(len(d) >= 524_288 for _, d in blocks)
    rate = source.measured_rate()
    assert abs(rate.ppm - 30.0) < 0.1
    assert rate.sigma_bytes_s < 100
    assert abs(rate.bytes_s - MID.bytes_s * (1 + 30e-6)) < 4 * rate.sigma_bytes_s + 1
    assert source.doubtful_bytes == 0
    assert not [c for c in bus.calls if "halt" in c or "reset" in c]  # no reflex
    source.close()
    assert bridge.owner is None
    assert not bridge.streaming


def test_what_lay_in_the_camera_before_the_start_is_thrown_away():
    host, bus, bridge = camera(ram_bytes=800_000)
    host.sleep_until(S)
    source = VidarSource(MID, host, bus)
    source.start()
    began = host.now_ns()
    block = source.read(100 * MS)
    first = int(block.data.view(np.uint32)[0]) * 4
    assert 0 <= bridge.wire.made(began) - first <= 65_536  # fresh, not a second old
    assert bridge.truth(0)["sent"][0][0] < first
    source.close()


@pytest.mark.parametrize("kind", ["stall", "overflow", "io", "interrupted"])
def test_an_error_in_a_transfer_ends_the_epoch(kind):
    host, bus, bridge, source = opened(faults=[{"kind": kind, "at_s": 1.0}])
    blocks = record(host, source, 1.3)
    (new,) = epochs(blocks)
    assert new.lost_why == {"stall": "stall", "io": "io"}.get(kind, kind)
    inside, suspect, between = gaps(blocks)
    assert (inside, suspect) == ([], [])
    lost = sum(losses(bridge).get(k, 0) for k in LOST)
    assert lost > 0
    assert between == [lost + thrown_away(bridge, blocks)]  # what waited meanwhile is thrown away with it
    assert abs(new.lost_bytes - between[0]) < 200
    assert bus.calls.count("clear_halt 0x82") == (1 if kind == "stall" else 0)


def test_a_timeout_with_data_is_a_short_read_and_no_loss():
    host, _, _, source = opened(SMALL, faults=[{"kind": "short", "at_s": 0.5}])
    blocks = record(host, source, 0.2, wait_ns=7 * MS)
    assert all(0 < len(d) < 64_000 and len(d) % 4 == 0 for _, d in blocks)  # 512 KiB would take 82 ms
    blocks += record(host, source, 1.0)
    assert {b.epoch for b, _ in blocks} == {0}
    assert gaps(blocks) == ([], [], [])
    assert sum(100_000 < len(d) < 500_000 for _, d in blocks) == 1  # the short one


def test_a_silent_loss_is_seen_from_the_time_and_its_place_is_bounded():
    host, _, bridge, source = opened(K20, faults=[{"kind": "drop", "at_s": 1.0, "bytes": 5000}])
    blocks = record(host, source, 1.2)
    (new,) = epochs(blocks)
    assert new.lost_why == "rate"
    assert abs(new.lost_bytes - 5000) < 200
    assert gaps(blocks) == ([], [5000], [0])
    assert losses(bridge)["drop"] == 5000
    assert new.suspect_bytes <= 0.13 * K20.bytes_s


def test_a_late_host_without_memory_in_the_camera_loses_and_knows():
    host, _, bridge, source = opened()
    blocks = record(host, source, 1.4, pauses=[(1.0, 0.01)])
    (new,) = epochs(blocks)
    lost = losses(bridge)["overflow"]
    assert abs(lost - (256_000 - 16_384)) < 100
    assert gaps(blocks) == ([], [lost], [0])
    assert abs(new.lost_bytes - lost) < 200


def test_memory_in_the_camera_bridges_a_late_host():
    host, _, bridge, source = opened(ram_bytes=3_200_000)
    blocks = record(host, source, 2.0, pauses=[(1.0, 0.1)])
    assert gaps(blocks) == ([], [], [])
    assert epochs(blocks) == []
    assert "overflow" not in losses(bridge)
    assert source.doubtful_bytes == 0


class BusyHost(VirtualHost):
    """A host that wakes late: by some hundred microseconds, and now and then by tens of milliseconds."""

    def __init__(self, seed, share=0.05):
        super().__init__()
        self.rng, self.share = np.random.default_rng(seed), share

    def sleep_until(self, at_ns):
        late = self.rng.exponential(2e5) + (self.rng.random() < self.share) * self.rng.exponential(2e7)
        super().sleep_until(at_ns + round(late))


@pytest.mark.parametrize("seed", range(4))
def test_a_busy_host_sees_no_loss_where_there_is_none(seed):
    host, _, bridge, source = opened(host=BusyHost(seed), ram_bytes=16_000_000)
    blocks = record(host, source, 8.0)
    assert "overflow" not in losses(bridge)
    assert epochs(blocks) == []
    assert abs(source.measured_rate().ppm - 30.0) < 5 * max(1, source.measured_rate().sigma_bytes_s / MID.bytes_s * 1e6)


def test_a_host_that_is_often_behind_reads_its_backlog_off_and_sees_no_loss():
    for seed in range(4):
        host, _, bridge, source = opened(host=BusyHost(seed, 0.3), ram_bytes=32_000_000)
        blocks = record(host, source, 8.0)
        assert "overflow" not in losses(bridge)
        assert epochs(blocks) == []


@pytest.mark.parametrize("seed", range(4))
def test_a_busy_host_misses_no_loss_of_some_milliseconds(seed):
    faults = [{"kind": "drop", "at_s": 2.0 + k, "bytes": 200_000} for k in range(6)]
    host, _, _, source = opened(host=BusyHost(seed), ram_bytes=16_000_000, faults=faults)
    blocks = record(host, source, 8.5)
    inside, suspect, _ = gaps(blocks, tail=source.doubtful_bytes)
    assert inside == []
    assert suspect == [200_000] * 6
    assert {b.lost_why for b in epochs(blocks)} == {"rate"}
    assert 6 <= len(epochs(blocks)) <= 8  # a loss may be told in two parts
    assert abs(sum(b.lost_bytes for b in epochs(blocks)) - 1_200_000) < 100_000


def test_a_loss_in_the_last_blocks_is_doubted_at_the_end():
    host, _, _, source = opened()
    blocks = record(host, source, 1.0)
    host.sleep_until(host.now_ns() + 2 * MS)
    last = source.read(100 * MS)
    source.stop()
    assert source.doubtful_bytes == len(last.data)
    inside, suspect, _ = gaps([*blocks, (last, last.data)], tail=source.doubtful_bytes)
    assert inside == []
    assert len(suspect) == 1


def test_a_loss_that_no_block_tells_any_more_is_doubted_at_the_end():
    host, _, _, source = opened(faults=[{"kind": "drop", "at_s": 1.0, "bytes": 5000}])
    blocks = record(host, source, 0.9)
    while source.epoch == 0:
        block = source.read(100 * MS)
        blocks.append((block, block.data.copy()))
    source.stop()
    assert gaps(blocks, tail=source.doubtful_bytes) == ([], [5000], [])


@pytest.mark.parametrize("seed", range(12))
def test_no_loss_is_unseen(seed):
    rng = np.random.default_rng(seed)
    kinds = ["drop", "drop", "stall", "io", "overflow", "short", "interrupted", "unplug", "hang"]
    faults = [
        {"kind": str(rng.choice(kinds)), "at_s": float(t), "bytes": int(rng.integers(1000, 40_000)), "for_s": 0.13}
        for t in 0.7 + np.cumsum(rng.uniform(0.15, 0.4, 6))
    ]
    pauses = [(float(t), float(10 ** rng.uniform(-3.3, -1.0))) for t in rng.uniform(0.7, 2.8, 5)]
    host, _, bridge, source = opened(
        faults=faults, ram_bytes=int(rng.choice([0, 100_000])), ppm=float(rng.uniform(-60, 60)),
        turn=Latency(5.0, 3.0), seed=seed,
    )  # fmt: skip
    blocks = record(host, source, 3.6, pauses)
    source.stop()
    inside, suspect, between = gaps(blocks, tail=source.doubtful_bytes)
    assert all(g < 128 for g in inside)  # 5 us: below what host stamps can tell; the framing tells (test_framing.py)
    truth = bridge.truth(host.now_ns())
    first, end = int(blocks[0][1].view(np.uint32)[0]) * 4, int(blocks[-1][1].view(np.uint32)[-1]) * 4 + 4
    lost = sum(max(0, min(x["stop"], end) - max(x["start"], first)) for x in truth["lost"])
    drained = sum(max(0, min(b, end) - max(a, first)) for a, b in truth["sent"]) - sum(len(d) for _, d in blocks)
    assert sum(len(d) for _, d in blocks) + lost + drained == end - first  # bytes made
    assert sum(inside) + sum(suspect) + sum(between) == lost + drained
    assert lost > 0
    assert len(epochs(blocks)) >= 3


def test_unplugged_and_back_under_the_same_serial():
    host, bus, bridge, source = opened(faults=[{"kind": "unplug", "at_s": 1.0, "for_s": 2.0}], serial="K10-0007")
    before = source.facts
    blocks = record(host, source, 3.5)
    (new,) = epochs(blocks)
    assert new.lost_why == "unplugged"
    inside, suspect, between = gaps(blocks)
    assert (inside, suspect) == ([], [])
    assert between[0] > 2 * MID.bytes_s
    assert abs(new.lost_bytes - between[0]) < 16_384 + 4096
    assert (source.facts.serial, source.facts.address) == ("K10-0007", before.address)
    assert bus.calls == ["claim 0", "claim 1"] * 2
    assert bridge.streaming


def test_another_camera_is_not_taken_for_the_lost_one():
    host, bus, _ = camera(faults=[{"kind": "unplug", "at_s": 0.5}], serial="A")
    _, other, _ = camera(host=host, serial="B", port=2)
    bus.bridges += other.bridges
    source = VidarSource(MID, host, bus, serial="A", patience_ns=3 * S)
    source.start()
    with pytest.raises(DeviceError, match="did not come back") as told:
        read_on(source)
    assert "A" in str(told.value)
    assert 3.4 * S < host.now_ns() < 5 * S
    source.close()


def test_back_but_not_yet_permitted_is_waited_for():
    faults = [
        {"kind": "unplug", "at_s": 0.5, "for_s": 0.5},
        {"kind": "denied", "at_s": 0.9, "for_s": 0.6},  # udev comes after the plug
    ]
    host, _, _, source = opened(faults=faults)
    blocks = record(host, source, 2.5)
    (new,) = epochs(blocks)
    assert 0.9 * MID.bytes_s < new.lost_bytes < 1.7 * MID.bytes_s


def test_silence_begins_the_stream_again_and_in_the_end_gives_up():
    host, _, _, source = opened(faults=[{"kind": "hang", "at_s": 0.5, "for_s": 2.0}])
    blocks = record(host, source, 3.5)
    assert [b.lost_why for b in epochs(blocks)] == ["silence"]
    host, bus, _ = camera(faults=[{"kind": "hang", "at_s": 0.5}])
    source = VidarSource(MID, host, bus, patience_ns=3 * S)
    source.start()
    with pytest.raises(DeviceError, match="says nothing"):
        read_on(source)


def test_busy_names_the_kernel_module():
    host, bus, _ = camera(faults=[{"kind": "busy"}])
    with pytest.raises(DeviceError, match="ft60x") as told:
        VidarSource(MID, host, bus)
    assert told.value.exit_code == 3


def test_no_permission_prints_the_rule():
    host, bus, _ = camera(faults=[{"kind": "denied"}])
    with pytest.raises(HostError) as told:
        VidarSource(MID, host, bus)
    assert told.value.exit_code == 6
    assert usbport.udev_rule(0x0403, 0x601F) in told.value.next
    assert '"601f"' in told.value.next


def test_no_libusb_names_both_cures():
    with pytest.raises(HostError, match="libusb") as told:
        usbport.libusb(lambda: None)
    assert told.value.exit_code == 6
    assert "libusb-package" in told.value.next
    assert "libusb-1.0-0" in told.value.next


def test_damaged_strings_and_settings_are_lived_with():
    host, bus, _ = camera(faults=[{"kind": "strings"}, {"kind": "config"}])
    source = VidarSource(MID, host, bus)
    assert source.facts.serial == ""
    assert "152" in source.facts.more["config"] or "damaged" in source.facts.more["config"]
    source.start()
    assert source.read(100 * MS) is not None
    source.close()


def test_two_alike_are_told_apart_by_where_they_are_plugged_in():
    host, bus, _ = camera()
    _, other, _ = camera(host=host, port=2)
    bus.bridges += other.bridges
    with pytest.raises(DeviceError, match="more than one") as told:
        VidarSource(MID, host, bus)
    assert "usb:2-1" in str(told.value)
    assert "usb:2-2" in str(told.value)
    source = VidarSource(MID, host, bus, serial="usb:2-2")
    assert source.facts.address == "usb:2-2"
    found, failed = find(host, bus)
    assert sorted(f.address for f in found) == ["usb:2-1", "usb:2-2"] or failed
    source.close()


def test_nothing_plugged_in_is_told():
    host, bus, _ = camera()
    bus.bridges.clear()
    with pytest.raises(DeviceError, match="no spike camera was found"):
        VidarSource(MID, host, bus)
    assert find(host, bus) == ([], [])


def test_misuse_is_told_and_closing_twice_is_fine():
    host, bus, _ = camera()
    source = VidarSource(MID, host, bus)
    with pytest.raises(UsageError, match="not started"):
        source.read(MS)
    source.start()
    with pytest.raises(UsageError, match="runs already"):
        source.start()
    source.stop()
    source.stop()
    source.start()  # and again: a new epoch
    assert source.read(100 * MS).epoch == 1
    source.close()
    source.close()
    with pytest.raises(DeviceError, match="closed"):
        source.start()


def test_a_stalled_endpoint_that_stays_so_is_reopened_not_hammered():
    host, _, bridge, source = opened()
    record(host, source, 0.7)
    tries = []

    def stuck(now_ns, size, until_ns, plugged, read=bridge.read):
        tries.append(now_ns)
        plan = read(now_ns, size, until_ns, plugged)
        plan.error = errno.EPIPE
        return plan

    bridge.read = stuck
    with pytest.raises(DeviceError):
        read_on(source)
    assert len(tries) < 500
