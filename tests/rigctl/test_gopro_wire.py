"""The GoPro's Bluetooth as bytes: known messages, packets, damage, refusals, a session that goes on."""

import numpy as np
import pytest
from gopro_cameras import S, camera

from spikerig.dataset.errors import DeviceError
from spikerig.rigctl import gopro_ble as ble
from spikerig.rigctl.gopro_radio import Radio
from spikerig.rigctl.sim.emulate.gopro_air import Air


def radio_to(cam):
    air = Air(cam)
    return Radio(air.dial, cam.host), air


# ---- packets and messages -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("message", "known"),
    [
        (ble.command(ble.SHUTTER, b"\1"), "01 01 01"),
        (ble.command(2, b"\x09"), "02 01 09"),
        (ble.command(3, b"\x01"), "03 01 01"),
        (ble.command(0x79, b"\x00"), "79 01 00"),
        (ble.command(0x87, b"\x00"), "87 01 00"),
        (ble.command(ble.ALIVE, b"\x42"), "5b 01 42"),
        (ble.command(ble.SET_TIME, ble.whole_seconds((2023, 1, 31, 3, 4, 5))), "0d 07 07 e7 01 1f 03 04 05"),
        (ble.command(ble.SLEEP), "05"),
        (ble.command(ble.AP, b"\x01"), "17 01 01"),
    ],
)
def test_messages_are_those_of_the_documents(message, known):
    assert message == bytes.fromhex(known)


def test_a_message_of_50_bytes_is_cut_as_documented():
    message = bytes(range(50))
    parts = ble.packets(message)
    assert [p[:2].hex() for p in parts] == ["2032", "8012", "8125"]
    assert [len(p) for p in parts] == [20, 20, 14]


@pytest.mark.parametrize("size", [0, 1, 17, 18, 19, 37, 38, 371, 0x1FFF])
def test_packets_assemble_to_the_message(size):
    message = np.random.default_rng(size).bytes(size)
    ears = ble.Assembler()
    told = [ears.feed(p) for p in ble.packets(message)]
    assert told[-1] == message
    assert told[:-1] == [None] * (len(told) - 1)
    assert ears.broken == 0


def test_too_long_a_message_is_refused():
    with pytest.raises(ValueError, match="8192"):
        ble.packets(bytes(0x2000))


def test_the_cameras_short_and_16_bit_headers_are_read():
    ears = ble.Assembler()
    assert ears.feed(bytes.fromhex("02 01 00")) == b"\x01\x00"
    assert ears.feed(bytes.fromhex("40 00 03 aa bb cc")) == b"\xaa\xbb\xcc"


@pytest.mark.parametrize("damage", ["lost", "repeated", "swapped", "cut", "long", "empty", "odd"])
def test_damaged_packets_never_make_a_message(damage):
    message = bytes(range(100))
    parts = ble.packets(message)
    parts = {
        "lost": [parts[0], *parts[2:]],
        "repeated": [parts[0], parts[1], *parts[1:]],
        "swapped": [parts[0], parts[2], parts[1], *parts[3:]],
        "cut": parts[:-1],
        "long": [*parts[:-1], parts[-1] + b"zz"],
        "empty": [parts[0], b"", *parts[1:]],
        "odd": [b"\x60abc"],
    }[damage]
    ears = ble.Assembler()
    assert all(ears.feed(p) is None for p in parts)
    assert ears.feed(b"\x02\x01\x00") == b"\x01\x00"  # the next message is heard
    assert ears.broken > 0
    assert ears.why


def test_random_packets_never_raise():
    rng, ears = np.random.default_rng(0), ble.Assembler()
    for _ in range(5000):
        ears.feed(rng.bytes(rng.integers(0, 21)))


def test_a_captured_push_and_reply_are_read():
    assert ble.values(bytes.fromhex("08 01 01 0a 01 01")) == {8: b"\1", 10: b"\1"}
    with pytest.raises(DeviceError):
        ble.values(bytes.fromhex("08 01 01 0a 02 01"))
    with pytest.raises(DeviceError):
        ble.values(b"\x08")
    assert ble.decoded(54, (1 << 33).to_bytes(8, "big")) == 1 << 33
    assert ble.decoded(30, b"GP123\0\0") == "GP123"
    assert ble.decoded(250, bytes(9)) == "00 " * 8 + "00"


def test_hardware_info_that_runs_over_its_end():
    with pytest.raises(DeviceError):
        ble.hardware(b"\x04\0\0\0\x37\x0bHERO9")


# ---- the session ----------------------------------------------------------------------------------------------------


def test_all_statuses_come_through_with_those_nobody_documents(tmp_path):
    radio, air = radio_to(camera(tmp_path))
    told = radio.statuses()
    assert told[10] == 0
    assert told[30] == "GP25000001"
    assert told[54] == 62_500_000
    assert set(told) >= {3, 40, 90, 109}
    assert air.many == 1


@pytest.mark.parametrize("how", ["lost", "repeated", "cut"])
def test_a_damaged_reply_is_thrown_away_and_asked_for_again(tmp_path, how):
    radio, _ = radio_to(camera(tmp_path, broken_replies=(0, 1), broken_how=how))
    assert radio.statuses()[30] == "GP25000001"
    assert radio.requeries == 2


def test_a_reply_damaged_again_and_again_is_an_error(tmp_path):
    radio, _ = radio_to(camera(tmp_path, broken_replies=tuple(range(9))))
    with pytest.raises(DeviceError, match="did not come whole"):
        radio.statuses()
    assert radio.statuses([10]) == {10: 0}  # a reply of one packet still comes through


def test_connecting_takes_several_tries_and_wakes(tmp_path):
    cam = camera(tmp_path, dials_fail=3)
    cam.asleep = True
    radio, air = radio_to(cam)
    radio.connect()
    assert air.dialled == 4
    assert not cam.asleep
    assert cam.host.now_ns() > 7 * S  # 1 + 2 + 4 s between the tries


def test_a_camera_that_never_connects_is_an_error_that_names_the_fallback(tmp_path):
    radio, _ = radio_to(camera(tmp_path, dials_fail=99))
    with pytest.raises(DeviceError, match="Bluetooth") as told:
        radio.connect()
    assert "hand" in told.value.next


def test_a_lost_link_is_made_anew_where_asking_twice_does_no_harm(tmp_path):
    cam = camera(tmp_path, link_lost_s=(2.0, 5.0))
    radio, air = radio_to(cam)
    radio.statuses([10])
    cam.host.sleep_until(3 * S)
    assert radio.statuses([10]) == {10: 0}
    cam.host.sleep_until(6 * S)
    with pytest.raises(DeviceError):
        radio.do(ble.SHUTTER, b"\1", again=False)
    assert air.dialled == 2
    assert radio.statuses([10]) == {10: 0}
    assert not cam.busy  # the shutter was not pressed by the way


def test_pushes_tell_of_a_start(tmp_path):
    cam = camera(tmp_path)
    radio, _ = radio_to(cam)
    radio.register([8, 10, 13])
    radio.do(ble.SHUTTER, b"\1")
    for _ in range(8):
        cam.host.sleep_until(cam.host.now_ns() + S // 2)
        radio.statuses([70])
    assert radio.pushed[10] == 1
    assert radio.pushed[13] >= 2


def test_refusals_of_the_radio(tmp_path):
    cam = camera(tmp_path)
    radio, _ = radio_to(cam)
    assert radio.set(3, 1) == 1  # 120 fps at 50 Hz
    assert radio.set(3, 99) == 2
    assert radio.set(251, 1) == 2
    with pytest.raises(DeviceError, match="refuses"):
        radio.do(0x77)
    with pytest.raises(DeviceError, match="refuses"):
        radio.do(ble.SHUTTER, b"\0")  # nothing runs
