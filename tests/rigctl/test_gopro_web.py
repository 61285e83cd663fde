"""HTTP: what a camera says of itself, settings and their refusals, and downloads."""

import http.client

import pytest
from gopro_cameras import S, camera, record, rig, wait, web_to

from spikerig.dataset.errors import DeviceError, HostError, UsageError
from spikerig.rigctl.gopro_http import Dark, Media, Web, Wifi
from spikerig.rigctl.gopro_settings import DEFAULTS, SETTINGS, in_order
from spikerig.rigctl.host import RealHost
from spikerig.rigctl.sim.emulate import gopro_menu
from spikerig.rigctl.sim.emulate.gopro_web import AirWifi, WebServer, serve

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


@pytest.mark.parametrize(("faults", "breaks"), [({}, False), ({"downloads_break": (2000, *[0] * 20)}, True)])
def test_turbo_is_on_while_it_downloads_and_off_whatever_came_of_it(tmp_path, faults, breaks):
    source, cam = rig(tmp_path, **faults)
    source.start()
    wait(source, 2)
    clip = source.stop()
    during, get = [], source.web.download

    def download(*of):
        cam.advance()
        during.append(cam.turbo)
        return get(*of)

    source.web.download = download
    if breaks:
        with pytest.raises(DeviceError, match="breaks off"):
            source.fetch(clip, tmp_path)
    else:
        source.fetch(clip, tmp_path)
    assert during == [True]
    assert not cam.turbo


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
