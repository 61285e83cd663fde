"""The bridge's bytes: commands and config as four open drivers have them, errors, profiles, the emulated bus."""

import dataclasses
import errno
import tomllib
from array import array

import pytest
import usb.core
from vidar_bench import K20, MID, MS, camera

from spikerig.dataset.errors import DataError, DeviceError, UsageError
from spikerig.dataset.wire import WireProfile
from spikerig.rigctl import ft60x
from spikerig.rigctl.ft60x import Fault, command, fault_of, parse_config, parse_version
from spikerig.rigctl.profiles import PROFILES, check_link, profile_named, read_profile
from spikerig.rigctl.sim.emulate.spike_bench import bridge_of
from spikerig.rigctl.sim.emulate.usb import EmulatedUsb, usb_error
from spikerig.rigctl.sim.emulate.virtual import VirtualHost


def test_commands_are_the_twenty_bytes_of_the_open_drivers():
    # one-command stream of ft60x-rs, session of LimeSuite's size, flush of all pipes
    assert command(ft60x.STREAM, 0x82, 0x4000_0000).hex(" ") == "00 00 00 00 82 02 00 00 00 00 00 40" + " 00" * 8
    assert command(ft60x.SESSION, 0x82, 4096, index=7).hex(" ") == "07 00 00 00 82 01 00 00 00 10 00 00" + " 00" * 8
    assert command(ft60x.FLUSH, 0).hex(" ") == "00 00 00 00 00 03 00 00" + " 00" * 12
    assert [len(c) for c in (*ft60x.start_commands(), *ft60x.stop_commands())] == [20] * 5
    assert [c[5] for c in ft60x.stop_commands()] == [0, 0, 3]


def test_the_version_and_the_config_block_are_read():
    assert parse_version(b"\x09\x01\x00\x00") == "1.09"
    _, bus, _ = camera(serial="K10-0042")
    device = usb.core.find(backend=bus)
    block = bytes(device.ctrl_transfer(0xC0, 0xCF, 1, 0, 152))
    assert len(block) == 152
    assert block[:4] == b"\x03\x04\x1f\x60"
    assert block[137:140] == b"\x00\x00\x02"
    assert block[144:148] == b"\x00\x08\x01\x00"
    config = parse_config(block)
    assert (config.vendor, config.product, config.serial) == (0x0403, 0x601F, "K10-0042")
    assert (config.clock_mhz, config.mode_600, config.channels, config.bus_bytes_s) == (100, False, "one", 400e6)
    for spoiled in (block[:-1], block[:4] + b"\x07" + block[5:], block[:137] + b"\x04" + block[138:], b"\xff" * 152):
        with pytest.raises(DeviceError):
            parse_config(spoiled)
    with pytest.raises(DeviceError):
        parse_version(b"\x09")


@pytest.mark.parametrize(
    ("number", "fault"),
    [
        (errno.ETIMEDOUT, Fault.TIMEOUT),
        (errno.EPIPE, Fault.STALL),
        (errno.EOVERFLOW, Fault.OVERFLOW),
        (errno.ENODEV, Fault.GONE),
        (errno.EBUSY, Fault.BUSY),
        (errno.EACCES, Fault.DENIED),
        (errno.EINTR, Fault.AGAIN),
        (errno.EIO, Fault.BROKEN),
    ],
)
def test_every_error_of_pyusb_has_a_meaning(number, fault):
    error = usb_error(number)
    assert fault_of(error) is fault
    assert isinstance(error, usb.core.USBTimeoutError) == (number == errno.ETIMEDOUT)
    assert error.backend_error_code < 0
    assert fault_of(OSError("without a number")) is Fault.BROKEN


def test_the_emulated_bridge_obeys_sessions():
    host, bus, _ = camera(MID)
    device = usb.core.find(backend=bus)
    buffer = array("B", bytes(262_144))
    with pytest.raises(usb.core.USBTimeoutError):  # nobody asked for a session: nothing comes
        device.read(0x82, buffer, 50)
    device.write(0x01, command(ft60x.SESSION, 0x82, 100_000))
    assert device.read(0x82, buffer, 1000) == 100_000
    with pytest.raises(usb.core.USBTimeoutError):
        device.read(0x82, buffer, 50)
    device.write(0x01, command(ft60x.STREAM, 0x82, 0x4000_0000))
    began = host.now_ns()
    assert device.read(0x82, buffer, 1000) == 262_144
    took = host.now_ns() - began
    assert abs(took - (262_144 - 16_384) / MID.bytes_s * 1e9) < MS  # 16 KiB had waited in the chip
    device.write(0x01, command(ft60x.ABORT))
    with pytest.raises(usb.core.USBTimeoutError):
        device.read(0x82, buffer, 50)
    for bad in (b"\0" * 19, b"\0" * 5 + b"\x09" + b"\0" * 14, command(2, 0x55)):
        with pytest.raises(usb.core.USBError) as told:
            device.write(0x01, bad)
        assert told.value.errno == errno.EPIPE
    with pytest.raises(usb.core.USBError):
        device.ctrl_transfer(0xC0, 0x77, 0, 0, 4)


def test_two_programs_cannot_hold_one_bridge():
    _, bus, _ = camera()
    one, two = usb.core.find(backend=bus), usb.core.find(backend=bus)
    usb.util.claim_interface(one, 1)
    with pytest.raises(usb.core.USBError) as told:
        usb.util.claim_interface(two, 1)
    assert told.value.errno == errno.EBUSY
    usb.util.dispose_resources(one)
    usb.util.claim_interface(two, 1)


def test_a_link_that_is_too_slow_loses_all_the_time_and_says_so():
    fast = dataclasses.replace(MID, rate_hz=20_000.0, link_bytes_s=20e6)
    host, bus, bridge = camera(fast, ppm=0.0)
    device = usb.core.find(backend=bus)
    device.write(0x01, command(ft60x.STREAM, 0x82, 0x4000_0000))
    buffer, got = array("B", bytes(262_144)), 0
    began = host.now_ns()
    while host.now_ns() < began + 500 * MS:
        got += device.read(0x82, buffer, 1000)
    lost = sum(x["stop"] - x["start"] for x in bridge.truth(0)["lost"] if x["why"] == "overflow")
    took = (host.now_ns() - began) / 1e9
    assert abs(got / took - 20e6) < 0.01 * 20e6
    assert abs(lost / took - 5.6e6) < 0.02 * 5.6e6


def test_the_emulated_bus_says_overflow_only_when_told_to():
    for says in (False, True):
        host, bus, _ = camera(MID, overflow_error=says)
        device = usb.core.find(backend=bus)
        device.write(0x01, command(ft60x.STREAM, 0x82, 0x4000_0000))
        buffer = array("B", bytes(16_384))
        device.read(0x82, buffer, 1000)
        host.sleep_until(host.now_ns() + 10 * MS)
        if says:
            with pytest.raises(usb.core.USBError) as told:
                device.read(0x82, buffer, 1000)
            assert told.value.errno == errno.EOVERFLOW
        assert device.read(0x82, buffer, 1000) == 16_384


def test_profiles_are_as_published_and_say_how_sure_they_are():
    assert {p.tick_bytes for p in PROFILES.values()} == {12_500, 13_000, 128_000}
    assert [p.bytes_s / 1e6 for p in PROFILES.values()] == [250, 260, 500, 520, 2560]
    names = {f.name for f in dataclasses.fields(WireProfile)} - {"name", "sure"}
    for p in PROFILES.values():
        assert set(p.sure) == names
        assert "verified" not in p.sure.values()  # no hardware was seen
        assert p.packet_bytes == 262_144


def test_a_plan_beyond_the_link_is_refused_with_the_numbers():
    assert check_link(PROFILES["vidar-400x250-20k"]) is None
    assert check_link(PROFILES["vidar-400x250-20k-416"]) is None
    assert check_link(PROFILES["m1k40-1000x1000-20k"]) is None  # over PCIe
    for name, need in (("vidar-400x250-40k", "500 MB/s"), ("vidar-400x250-40k-416", "520 MB/s")):
        told = str(check_link(PROFILES[name]))
        assert need in told
        assert "360 MB/s" in told
        assert "400 MB/s" in told
    assert "27,692" in str(check_link(PROFILES["vidar-400x250-40k-416"]))  # 360e6 / 13000


def test_a_users_profile_from_toml(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('like = "vidar-400x250-20k"\nrow_bits = 416\nrate_hz = 19998\nsure = { rate_hz = "verified" }\n')
    mine = profile_named(str(path))
    assert (mine.row_bits, mine.rate_hz, mine.width) == (416, 19_998.0, 400)
    assert mine.sure["rate_hz"] == "verified"
    assert "row_bits" not in mine.sure  # the table's claim is not the user's
    path.write_text('name = "tiny"\nwidth = 64\nheight = 40\nrow_bits = 64\nrate_hz = 20000\nbottom_up = false\n')
    assert read_profile(path).tick_bytes == 320
    for text, words in (
        ("name = 3\nwidth = 64.5\nspeed = 1\n", ["name = 3", "width = 64.5", "speed = 1", "rate_hz is missing"]),
        ('like = "nothing"\n', ["nothing"]),
        ("rate_hz =\n", ["TOML"]),
        ('like = "vidar-400x250-20k"\nbottom_up = 1\n', ["bottom_up = 1"]),
        ('like = "vidar-400x250-20k"\nsure = { speed = "verified" }\n', ["sure"]),
    ):
        path.write_text(text)
        with pytest.raises(DataError) as told:
            read_profile(path)
        assert all(w in str(told.value) for w in words)
    with pytest.raises(UsageError, match="no such wire profile"):
        profile_named("vidar")
    with pytest.raises(UsageError, match="cannot be read"):
        profile_named(str(tmp_path / "none.toml"))
    path.write_text('like = "vidar-400x250-20k"\nrow_bits = 300\n')
    with pytest.raises(UsageError, match="row_bits >= width"):
        read_profile(path)


def test_an_emulated_camera_from_a_table():
    table = tomllib.loads("""
        profile = "vidar-400x250-20k"
        serial = "E1"
        ppm = 40.0
        faults = [{kind = "drop", at_s = 1.0, bytes = 4000}]
        turn = {floor_us = 5.0}
        picture = "noise"
    """)
    bridge = bridge_of(table, start_ns=10**9)
    device = usb.core.find(backend=EmulatedUsb(VirtualHost(10**9), [bridge]))
    assert device.serial_number == "E1"
    assert abs(bridge.wire.made(2 * 10**9) - bridge.wire.made(10**9) - 250e6 * (1 + 40e-6)) < 2
    assert bridge.wire.made(10**9) % K20.tick_bytes  # a stream is entered in the middle of a tick
    for wrong in ({"speed": 1}, {"faults": [{"kind": "fire"}]}, {"faults": [{"when": 1}]}, {"picture": "cat"}):
        with pytest.raises(UsageError):
            bridge_of(wrong)
