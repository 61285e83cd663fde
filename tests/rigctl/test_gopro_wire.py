"""The GoPro's Bluetooth and HTTP as bytes: known messages, packets, damage, refusals, downloads that go on."""

import http.client
import sys
import threading
import time
import types

import numpy as np
import pytest
from gopro_clips import pictures

from spikerig.dataset.errors import DeviceError, HostError, UsageError
from spikerig.rigctl import gopro_ble as ble
from spikerig.rigctl.gopro_bleak import SERVICE, BleakLink
from spikerig.rigctl.gopro_http import Dark, Media, Web, Wifi
from spikerig.rigctl.gopro_radio import LinkLost, Radio
from spikerig.rigctl.gopro_settings import DEFAULTS, SETTINGS, in_order
from spikerig.rigctl.host import RealHost
from spikerig.rigctl.sim.emulate import gopro_menu
from spikerig.rigctl.sim.emulate.gopro_air import Air
from spikerig.rigctl.sim.emulate.gopro_camera import Faults, GoProCamera, Nature
from spikerig.rigctl.sim.emulate.gopro_web import AirWifi, WebServer, serve
from spikerig.rigctl.sim.emulate.virtual import VirtualHost

S = 1_000_000_000


def camera(folder, **faults):
    return GoProCamera(VirtualHost(), folder, pictures(), faults=Faults(**faults), nature=Nature(stop_ms=(400, 500)))


def radio_to(cam):
    air = Air(cam)
    return Radio(air.dial, cam.host), air


def web_to(cam):
    return Web(AirWifi(WebServer(cam)), cam.host)


def record(cam, seconds=1.0):
    """A clip on the card, made by hand."""
    assert cam.shutter(True)
    for at in (cam.host.now_ns() + 2 * S, cam.host.now_ns() + 2 * S + round(seconds * S)):
        cam.host.sleep_until(at)
        cam.advance()
    assert cam.shutter(False)
    cam.host.sleep_until(cam.host.now_ns() + 3 * S)
    cam.advance()


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


# ---- HTTP -----------------------------------------------------------------------------------------------------------


def test_state_and_media_of_an_idle_camera(tmp_path):
    cam = camera(tmp_path)
    record(cam)
    web = web_to(cam)
    statuses, settings = web.state()
    assert (web.version(), statuses[10], settings[2]) == ("2.0", 0, 4)
    (media,) = web.media()  # the picture on the card is not a clip
    assert media.path == "100GOPRO/GX010001.MP4"
    assert media.size_bytes == (tmp_path / media.path).stat().st_size
    web.keep_alive()


@pytest.mark.parametrize("hangs", [False, True])
def test_http_is_dark_while_it_encodes(tmp_path, hangs):
    cam = camera(tmp_path, dark_hangs=hangs)
    web = web_to(cam)
    web.state()
    assert cam.shutter(True)
    cam.host.sleep_until(2 * S)
    cam.advance()
    with pytest.raises(Dark, match="WiFi"):
        web.state()
    assert cam.host.now_ns() >= (2 * S + 3 * S if hangs else 2 * S)
    cam.shutter(False)
    cam.host.sleep_until(cam.host.now_ns() + 5 * S)
    assert web.state()[0][10] == 0


def test_what_a_hero9_does_not_do_over_http(tmp_path):
    web = web_to(camera(tmp_path))
    with pytest.raises(DeviceError, match="500"):
        web_error(web, "/gopro/camera/shutter/start")
    with pytest.raises(DeviceError, match="404"):
        web_error(web, "/gopro/camera/control/wired_usb")


def web_error(web, path):
    try:
        web.get(path)
    except DeviceError as error:
        raise DeviceError(f"{error.value}") from error


@pytest.mark.parametrize(
    ("number", "option", "cause", "offered"),
    [
        (3, 1, "with the settings before it", "fps = 1"),
        (3, 77, "no such option", "fps = 77"),
        (251, 0, "no such setting", "setting 251"),
    ],
)
def test_a_refused_setting_says_what_would_be_taken(tmp_path, number, option, cause, offered):
    web = web_to(camera(tmp_path))
    with pytest.raises(DeviceError) as told:
        web.set(number, option)
    assert cause in told.value.cause
    assert offered in str(told.value.value)
    if cause.startswith("with"):
        assert "100" in told.value.expected.split(", ")
        assert "120" not in told.value.expected.split(", ")


def test_a_busy_camera_refuses_with_error_1(tmp_path):
    web = web_to(camera(tmp_path))
    web.set(134, 2)
    with pytest.raises(DeviceError) as told:
        web.set(2, 9)
    assert "not available as the camera is set now" in told.value.cause


def test_arguments_in_another_order_are_not_understood(tmp_path):
    with pytest.raises(DeviceError, match="refuses a request"):
        web_to(camera(tmp_path)).get("/gopro/camera/setting", {"option": 9, "setting": 2})


def test_the_order_of_settings_matters_and_ours_is_taken(tmp_path):
    def refused(order):
        settings, said = dict(gopro_menu.FACTORY), []
        for name in order:
            (setting, _, value), = in_order({name: DEFAULTS[name]})  # fmt: skip
            if gopro_menu.take(settings, setting.number, value) is not None:
                said.append(name)
        return said

    ours = [s.name for s in SETTINGS if s.name in DEFAULTS]
    assert refused(ours) == []
    assert "fps" in refused(["fps", *[n for n in ours if n != "fps"]])


@pytest.mark.parametrize(
    "body", ["[]", "{", "[" * 100_000, '{"media": 3}', '{"media": [{"d": "100GOPRO", "fs": [{}]}]}']
)
def test_answers_that_are_none(tmp_path, body):
    class Server(WebServer):
        def reply(self, request):
            yield f"HTTP/1.1 200 OK\r\nContent-Length: {len(body)}\r\n\r\n{body}".encode()

    cam = camera(tmp_path)
    web = Web(AirWifi(Server(cam)), cam.host)
    with pytest.raises(DeviceError):
        web.media()
    with pytest.raises(DeviceError):
        web.state()


def test_names_that_could_be_paths_are_left_out(tmp_path):
    body = (
        '{"media": [{"d": "..", "fs": [{"n": "GX010001.MP4", "s": "1"}]},'
        ' {"d": "100GOPRO", "fs": [{"n": "../../x", "s": "1"}, {"n": "GX010002.MP4", "s": "5"}]}]}'
    )

    class Server(WebServer):
        def reply(self, request):
            yield f"HTTP/1.1 200 OK\r\nContent-Length: {len(body)}\r\n\r\n{body}".encode()

    cam = camera(tmp_path)
    assert [m.path for m in Web(AirWifi(Server(cam)), cam.host).media()] == ["100GOPRO/GX010002.MP4"]


# ---- downloads ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "faults",
    [{}, {"downloads_break": (1000, 0, 0, 3000, 10)}, {"downloads_break": (1000, 2000), "ignores_range": True}],
)
def test_a_download_that_breaks_off_goes_on(tmp_path, faults):
    cam = camera(tmp_path / "card", **faults)
    record(cam, 2.0)
    web = web_to(cam)
    (media,) = web.media()
    got = web.download(media, tmp_path / media.name)
    assert got.read_bytes() == (tmp_path / "card" / media.path).read_bytes()
    assert [p.name for p in tmp_path.iterdir() if p.is_file()] == [media.name]
    assert web.opener.server.downloads == len(faults.get("downloads_break", ())) + 1
    assert web.download(media, got) == got  # there already


def test_a_later_program_goes_on_where_an_earlier_stopped(tmp_path):
    cam = camera(tmp_path / "card", downloads_break=(2000, *[0] * 4))
    record(cam, 2.0)
    web = web_to(cam)
    (media,) = web.media()
    with pytest.raises(DeviceError, match="breaks off again and again"):
        web.download(media, tmp_path / media.name)
    (part,) = tmp_path.glob(".*.part")
    assert part.stat().st_size == 2000
    again = Web(web.opener, cam.host)
    got = again.download(media, tmp_path / media.name)
    assert got.read_bytes() == (tmp_path / "card" / media.path).read_bytes()


def test_downloads_that_cannot_be(tmp_path):
    cam = camera(tmp_path / "card")
    record(cam)
    web = web_to(cam)
    (media,) = web.media()
    with pytest.raises(DeviceError, match="changed"):
        web.download(Media(media.folder, media.name, media.size_bytes + 7, 0), tmp_path / "a.MP4")
    with pytest.raises(DeviceError, match="refuses"):
        web.download(Media(media.folder, "GX019999.MP4", 10, 0), tmp_path / "b.MP4")
    (tmp_path / "c.MP4").write_bytes(b"x")
    with pytest.raises(UsageError, match="another size"):
        web.download(media, tmp_path / "c.MP4")
    with pytest.raises(HostError, match="cannot be written"):
        web.download(media, tmp_path / "none" / "d.MP4")


def test_over_a_real_socket(tmp_path):
    cam = camera(tmp_path / "card", downloads_break=(1500,))
    record(cam)
    host = RealHost()
    with serve(WebServer(cam)) as address:
        web = Web(Wifi(address), host)
        assert web.version() == "2.0"
        (media,) = web.media()
        got = web.download(media, tmp_path / media.name)
        assert got.read_bytes() == (tmp_path / "card" / media.path).read_bytes()
        with pytest.raises(DeviceError, match="refuses a setting"):
            web.set(3, 1)
        cam.encoding = True
        with pytest.raises(Dark):
            web.state()
    with pytest.raises(Dark):
        web.state()  # nobody listens any more
    assert isinstance(Wifi(address)(1.0), http.client.HTTPConnection)


# ---- bleak ----------------------------------------------------------------------------------------------------------


class FakeBleak:
    """The parts of bleak that the link uses; answers each write to 0072 with a packet on 0073."""

    def __init__(self, heard=True, fails=None):
        told = types.SimpleNamespace(service_uuids=[SERVICE], local_name="GoPro 1234")
        device = types.SimpleNamespace(name="GoPro 1234")
        box = self

        class BleakError(Exception):
            pass

        class Scanner:
            @staticmethod
            async def find_device_by_filter(good, timeout):
                return device if heard and good(device, told) else None

        class Client:
            def __init__(self, device, disconnected_callback, timeout):
                self.lost, self.notes = disconnected_callback, {}
                box.client = self

            async def connect(self):
                if fails:
                    raise fails

            async def start_notify(self, characteristic, callback):
                self.notes[characteristic] = callback

            async def write_gatt_char(self, characteristic, data, response):
                assert response
                self.notes[ble.uuid("0073")](None, bytearray(b"\x02" + data[2:3] + b"\x00"))

            async def disconnect(self):
                box.closed = True

        self.module = types.ModuleType("bleak")
        self.module.exc = types.ModuleType("bleak.exc")
        self.module.exc.BleakError = BleakError
        self.module.BleakScanner, self.module.BleakClient = Scanner, Client

    def install(self, patch):
        patch.setitem(sys.modules, "bleak", self.module)
        patch.setitem(sys.modules, "bleak.exc", self.module.exc)
        return self


def test_bleak_carries_questions_and_answers(monkeypatch):
    fake = FakeBleak().install(monkeypatch)
    before = threading.active_count()
    radio = Radio(lambda: BleakLink("1234"), RealHost())
    assert radio.do(ble.SLEEP) == b""
    fake.client.lost(fake.client)
    with pytest.raises(LinkLost):
        radio._link.receive(1000)
    radio.close()
    radio.close()
    for _ in range(100):
        if threading.active_count() == before:
            break
        time.sleep(0.01)
    assert threading.active_count() == before


@pytest.mark.parametrize(("heard", "name", "fails"), [
    (False, "", None), (True, "9999", None), (True, "", TimeoutError()), (True, "", EOFError()),
])  # fmt: skip
def test_bleak_without_a_camera_is_a_lost_link(monkeypatch, heard, name, fails):
    FakeBleak(heard, fails).install(monkeypatch)
    with pytest.raises(LinkLost):
        BleakLink(name)


def test_without_bleak_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "bleak", None)
    with pytest.raises(HostError) as told:
        BleakLink()
    assert told.value.exit_code == 6
    assert "spikerig[ble]" in told.value.next
