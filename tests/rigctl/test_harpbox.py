"""The emulated box itself, by the firmware's published behaviour."""

import numpy as np
import pytest
from harp_rigs import S, box_on, rig

from spikerig.dataset.errors import DataError
from spikerig.rigctl import harp
from spikerig.rigctl.harp import Decoder, Message, encode
from spikerig.rigctl.sim.emulate.latency import Latency


def talk(firmware, *sent, wait_ns=200_000_000, **more):
    host, wire = rig(firmware, to_box=Latency(50, 0), to_host=Latency(50, 0), **more)
    port = wire.port()
    for data in sent:
        port.write(data)
    host.sleep_until(host.now_ns() + wait_ns)
    return host, wire, Decoder().feed(port.read(port.in_waiting))


def test_errors_of_the_atxmega_are_echoes():
    _, _, told = talk("atxmega", encode(harp.read(200)))
    assert [(m.type, m.address, m.payload) for m in told] == [(9, 200, b"")]
    assert told[0].stamp is not None
    for order in (
        harp.write(harp.WHO_AM_I, harp.U16, 1),
        harp.read(harp.WHO_AM_I, harp.U8),
        Message(2, 10, 1, b"\1\1"),
    ):
        assert talk("atxmega", encode(order))[2][0].refused


def test_the_pico_is_silent_where_the_atxmega_complains():
    assert talk("pico", encode(harp.read(200)))[2] == []
    assert talk("pico", encode(harp.read(harp.HEARTBEAT, harp.U16)))[2] == []
    assert talk("pico", encode(harp.write(harp.WHO_AM_I, harp.U16, 1)))[2][0].refused


def test_a_bad_checksum_is_silence_on_one_and_no_matter_on_the_other():
    bad = encode(harp.read(harp.WHO_AM_I, harp.U16))[:-1] + b"\0"
    assert talk("atxmega", bad)[2] == []
    assert talk("pico", bad)[2][0].values().tolist() == [1216]


def test_half_a_frame_is_forgotten_after_50_ms():
    host, wire = rig(to_box=Latency(50, 0), to_host=Latency(50, 0))
    port, whole = wire.port(), encode(harp.read(harp.WHO_AM_I, harp.U16))
    port.write(whole[:3])
    host.sleep_until(host.now_ns() + 60_000_000)
    port.write(whole)
    host.sleep_until(host.now_ns() + 60_000_000)
    assert [m.address for m in Decoder().feed(port.read(port.in_waiting))] == [0]


def test_a_dump_tells_all_registers():
    order = encode(harp.write(harp.OPERATION, harp.U8, harp.DUMP | 0x61))
    _, _, told = talk("atxmega", order)
    assert told[0].type == harp.WRITE
    assert told[0].payload[0] & harp.DUMP == 0
    assert {m.address for m in told[1:]} >= {0, 6, 7, 8, 9, 10, 12, 13, 14, 18, 19}
    stamps = [m.stamp_ns for m in told[1:]]
    assert np.diff(stamps).min() >= 1_900_000
    assert 18 not in {m.address for m in talk("pico", order)[2]}


def test_a_stamped_order_waits_for_its_second_or_is_dropped():
    def order(second, micro):
        return encode(Message(harp.READ, harp.WHO_AM_I, harp.U16, b"", (second, micro)))

    assert talk("atxmega", order(5, 15000))[2] == []  # later in this second
    _, _, told = talk("atxmega", order(6, 0), wait_ns=2 * S)
    assert 6 * S <= told[0].stamp_ns <= 6 * S + 2_000_000
    assert talk("atxmega", order(1, 0))[2] != []  # overdue: at once


def test_three_seconds_without_a_listener_is_standby():
    host, wire, box = box_on("atxmega")
    box.close()
    host.sleep_until(host.now_ns() + 4 * S)
    port = wire.port()
    host.sleep_until(host.now_ns() + 3 * S)
    assert port.in_waiting == 0


@pytest.mark.parametrize("start_second", [77, harp.ROLL_S - 3])
def test_the_sync_packet_of_each_second_tells_the_boxs_time(start_second):
    host, wire = rig(start_second=start_second)
    packets = wire.sync_out(host.now_ns(), host.now_ns() + 6 * S)
    assert len(packets) == 6
    for at, packet in packets:
        told = harp.parse_sync(packet)
        true = int(wire.box_ns(at))
        assert abs(harp.unwrapped_ns(told.at_ns, true) - true) <= 1
        assert harp.parse_sync(packet).second == -(-true // S) % harp.ROLL_S
    with pytest.raises(DataError):
        harp.parse_sync(packets[0][1][1:] + packets[1][1][:1])  # cut at the wrong byte
