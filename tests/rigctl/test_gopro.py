"""The GoPro driver against the emulated camera: settled, recorded, fetched, verified; and all that goes wrong."""

import sys

import numpy as np
import pytest
from gopro_cameras import S, rig, wait
from gopro_clips import clip as write
from gopro_clips import grey, pictures

from spikerig.dataset.errors import DeviceError, HostError, UsageError
from spikerig.dataset.gopro_file import open_gopro
from spikerig.dataset.gopro_pictures import read_pictures
from spikerig.rigctl import gopro_ble as ble
from spikerig.rigctl.gopro import find
from spikerig.rigctl.gopro import open_gopro as open_camera
from spikerig.rigctl.gopro_check import verify_clip
from spikerig.rigctl.gopro_http import Dark, Web
from spikerig.rigctl.gopro_radio import Radio
from spikerig.rigctl.gopro_settings import DEFAULTS
from spikerig.rigctl.host import RealHost
from spikerig.rigctl.sim.emulate import gopro_menu
from spikerig.rigctl.sim.emulate.gopro_air import Air
from spikerig.rigctl.sim.emulate.gopro_camera import Faults, GoProCamera, Nature
from spikerig.rigctl.sim.emulate.gopro_web import AirWifi, WebServer
from spikerig.rigctl.sim.emulate.virtual import VirtualHost

# ---- a recording ----------------------------------------------------------------------------------------------------


def test_a_recording_from_settings_to_verified_file(tmp_path):
    source, camera = rig(tmp_path)
    source.start()
    for _ in range(3):
        wait(source, 1)
        state = source.poll()
        assert (state["encoding"], state["ended_early"], state["trouble"]) == (True, False, "")
    clip = source.stop()
    paths = source.fetch(clip, tmp_path)
    source.close()
    read = open_gopro(paths)
    (truth,) = camera.truth
    assert verify_clip(DEFAULTS, read) == []
    assert read.frames == truth["frames"]
    assert clip.start_ns[0] < truth["first_true_ns"] < clip.start_ns[1] + S // 5
    assert clip.stop_ns[0] < truth["true_ns"][-1] < clip.stop_ns[1]
    assert np.abs(read.start_ns - np.array(truth["media_ns"])).max() <= 1000
    for number, frame in read_pictures(read, [0, read.frames - 1]):
        assert abs(frame.pixels.mean() - grey(truth["true_ns"][number])) < 3
    assert not camera.turbo


def test_the_clips_clock_is_the_cameras_crystal(tmp_path):
    source, camera = rig(tmp_path)
    source.start()
    wait(source, 20)
    read = open_gopro(source.fetch(source.stop(), tmp_path))
    true = np.array(camera.truth[0]["true_ns"])
    rate = (read.start_ns[-1] - read.start_ns[0]) / (true[-1] - true[0]) - 1
    assert rate * 1e6 == pytest.approx(43, abs=1)


def test_starts_are_late_by_a_tenth_of_a_second_and_by_chance(tmp_path):
    late = []
    for seed in range(12):
        source, camera = rig(tmp_path / str(seed), seed=seed)
        before = camera.host.now_ns()
        source.start()
        wait(source, 1)
        source.stop()
        late.append((camera.truth[0]["first_true_ns"] - before) / 1e6)
    assert 80 < np.mean(late) < 320  # the link's and the questions' delays on top of the camera's 132 ms
    assert np.std(late) > 5


def test_several_takes_and_chapters(tmp_path):
    source, _ = rig(tmp_path, nature=Nature(chapter_bytes=8_000))
    clips = []
    for _ in range(2):
        source.start()
        wait(source, 3)
        clips.append(source.stop())
    assert clips[0].name != clips[1].name
    paths = source.fetch(clips[1], tmp_path)
    assert len(paths) >= 2
    assert {p.name[4:8] for p in paths} == {"0002"}
    assert open_gopro(paths).frames > 300


def test_the_order_of_use(tmp_path):
    source, _ = rig(tmp_path)
    with pytest.raises(UsageError):
        source.stop()
    source.start()
    with pytest.raises(UsageError):
        source.start()
    source.close()
    source.close()


def test_close_ends_a_running_recording(tmp_path):
    source, camera = rig(tmp_path)
    source.start()
    wait(source, 1)
    source.close()
    camera.host.sleep_until(camera.host.now_ns() + 3 * S)
    camera.advance()
    assert not camera.encoding
    assert camera.truth[0]["why"] == "shutter"


# ---- settings -------------------------------------------------------------------------------------------------------


def test_settings_are_taken_read_back_or_left_to_the_file(tmp_path):
    source, camera = rig(tmp_path, settle=False)
    done = source.settle({"fps": 60, "resolution": "4k"})
    assert done["set"]["fps"] == "60"
    assert done["not_set"] == {}
    assert set(done["file_tells"]) >= {"shutter", "iso_max", "white_balance"}
    assert gopro_menu.size(camera.settings) == (3840, 2160)
    assert camera.settings[121] == 0  # lens wide
    assert camera.settings[135] == 0  # no stabilisation


def test_what_the_camera_cannot_do_is_refused_with_what_it_can(tmp_path):
    source, _ = rig(tmp_path, settle=False)
    with pytest.raises(DeviceError) as told:
        source.settle({"resolution": "4k", "fps": 120})
    assert "fps" in str(told.value.value)
    assert "60" in told.value.expected
    with pytest.raises(UsageError, match="no such settings") as told:
        source.settle({"fps": 33, "colors": "x"})
    assert "colors" in str(told.value.value)
    assert "fps" in str(told.value.value)


def test_hindsight_is_switched_off_first(tmp_path):
    source, camera = rig(tmp_path, settle=False)
    camera.settings[gopro_menu.HINDSIGHT] = 2
    assert source.settle({})["set"]["hindsight"] == "off"


def test_protune_that_is_refused_is_told(tmp_path):
    source, _ = rig(tmp_path, protune_refused=True, settle=False)
    done = source.settle({})
    assert "shutter" in done["not_set"]
    assert "fps" in done["set"]


def recorded(source, folder):
    source.start()
    wait(source, 2)
    return open_gopro(source.fetch(source.stop(), folder))


def test_protune_that_is_taken_without_effect_is_found_in_the_file(tmp_path):
    source, _ = rig(tmp_path, protune_ignored=True)
    found = {f.check: f for f in verify_clip(DEFAULTS, recorded(source, tmp_path))}
    assert {"protune", "shutter", "iso", "white_balance", "colour", "sharpness", "bit_rate"} <= set(found)
    assert "1/480" in found["shutter"].message


def test_settings_that_fall_back_are_found_in_the_file(tmp_path):
    forgets = (gopro_menu.HYPERSMOOTH, gopro_menu.LENS, gopro_menu.FPS)
    source, _ = rig(tmp_path, forgets=forgets)
    found = verify_clip(DEFAULTS, recorded(source, tmp_path))
    assert {f.check for f in found if f.importance == "critical"} == {"lens", "hypersmooth", "fps"}
    assert [f.importance for f in found] == sorted(f.importance for f in found)


def test_frames_lost_in_the_camera_are_found(tmp_path):
    source, _ = rig(tmp_path, skipped=(30, 31))
    (found,) = verify_clip(DEFAULTS, recorded(source, tmp_path))
    assert found.check == "skipped"
    assert "[30, 31]" in found.message


def test_a_read_out_longer_than_a_frame_and_a_file_that_tells_nothing(tmp_path):
    paths, _ = write(tmp_path, srot_ms=9.0)
    assert [f.check for f in verify_clip({}, paths[0])] == ["readout"]
    bare = tmp_path / "bare.mp4"
    bare.write_bytes(paths[0].read_bytes().replace(b"gpmd", b"xxxx").replace(b"GPMF", b"free"))
    found = verify_clip({"lens": "wide"}, bare)
    assert [f.importance for f in found] == ["critical"] * 3 + ["suggestion"]


@pytest.mark.real
def test_the_real_clip_is_not_what_the_rig_records(shared_data):
    found = {f.check for f in verify_clip(DEFAULTS, shared_data("gopro/max-heromode.mp4"))}
    assert {"fps", "hypersmooth", "shutter", "white_balance", "iso", "iso_max"} <= found
    assert not {"lens", "protune", "stamps", "readout", "skipped"} & found


# ---- what goes wrong ------------------------------------------------------------------------------------------------


def test_a_start_that_is_accepted_and_not_done_is_an_error(tmp_path):
    source, _ = rig(tmp_path, never_encodes=True)
    with pytest.raises(DeviceError, match="does not get there") as told:
        source.start()
    assert "encoding" in str(told.value.value)


@pytest.mark.parametrize(
    ("faults", "words"),
    [
        ({"no_card": True}, "there is no card"),
        ({"card_full_s": 0.0}, "the card is full"),
    ],
)
def test_a_start_that_is_refused_says_why(tmp_path, faults, words):
    source, _ = rig(tmp_path, **faults)
    with pytest.raises(DeviceError) as told:
        source.start()
    assert words in told.value.cause


@pytest.mark.parametrize(
    ("fault", "words"), [("card_full_s", "no space"), ("too_hot_s", "too hot"), ("battery_flat_s", "battery")]
)
def test_a_recording_that_ends_by_itself_is_noticed(tmp_path, fault, words):
    source, camera = rig(tmp_path, **{fault: 12.0})
    source.start()
    while not (state := source.poll())["ended_early"]:
        assert source.host.now_ns() < 15 * S
        wait(source, 0.5)
    assert words in state["trouble"]
    assert source.host.now_ns() > 12 * S
    clip = source.stop()
    assert clip.size_bytes > 0
    assert camera.truth[0]["why"] != "shutter"


@pytest.mark.parametrize("which", [0, 1])
def test_a_lost_answer_to_the_shutter_is_decided_by_the_state(tmp_path, which):
    source, camera = rig(tmp_path, answer_lost=(which,))
    source.start()
    wait(source, 1)
    source.stop()
    assert len(camera.truth) == 1
    assert source.radio.dial.__self__.shutters == 2  # pressed once each, not again


def test_stop_waits_until_it_is_idle_though_http_is_back_before(tmp_path):
    source, camera = rig(tmp_path, nature=Nature(stop_ms=(1500, 1600), back_ms=(-1450, -1400)))
    source.start()
    wait(source, 1)
    source.stop()
    assert not camera.busy


def test_a_link_that_breaks_while_it_records_is_mended(tmp_path):
    source, camera = rig(tmp_path, link_lost_s=(7.0, 9.5))
    source.start()
    assert source.host.now_ns() < 7 * S
    for _ in range(8):
        wait(source, 1)
        assert source.poll()["encoding"]
    assert source.stop().size_bytes > 0
    assert len(camera.truth) == 1


def test_damaged_answers_while_it_records(tmp_path):
    source, _ = rig(tmp_path, broken_replies=tuple(range(3, 60, 4)), broken_how="repeated")
    source.start()
    for _ in range(10):
        wait(source, 0.5)
        assert source.poll()["encoding"]
    source.stop()
    assert source.radio.requeries > 0


def test_a_camera_that_goes_away_for_good(tmp_path):
    source, camera = rig(tmp_path)
    source.start()
    camera.faults = Faults(dials_fail=10**9, link_lost_s=(camera.host.now_ns() / S + 1,))
    wait(source, 2)
    with pytest.raises(DeviceError, match="Bluetooth"):
        source.poll()
    source.close()


def test_a_card_that_was_changed_is_noticed(tmp_path):
    source, camera = rig(tmp_path)
    source.start()
    wait(source, 1)
    clip = source.stop()
    for path in camera.files():
        path.write_bytes(path.read_bytes() + b"x")
    with pytest.raises(DeviceError, match="not the one that was recorded"):
        source.fetch(clip, tmp_path)


def test_no_new_clip_is_an_error(tmp_path):
    source, camera = rig(tmp_path)
    source.start()
    wait(source, 1)
    camera.files = lambda: []
    with pytest.raises(DeviceError, match="no new clip"):
        source.stop()


def test_it_is_never_asked_faster_than_it_likes_and_kept_awake(tmp_path):
    source, camera = rig(tmp_path)
    asked, alive = [], []
    before = source.radio.ask

    def ask(characteristic, message, **more):
        if message[0] == ble.ASK_STATUS:
            asked.append(camera.host.now_ns())
        if message[0] == ble.ALIVE:
            alive.append(camera.host.now_ns())
        return before(characteristic, message, **more)

    source.radio.ask = ask
    source.start()
    while camera.host.now_ns() < 30 * S:
        source.poll()
    source.stop()
    assert min(np.diff(asked)) >= 50e6
    assert max(np.diff(alive)) < 3.5 * S


def test_sleep_and_wake(tmp_path):
    source, camera = rig(tmp_path)
    source.sleep()
    wait(source, 1)
    camera.advance()
    assert camera.asleep
    with pytest.raises(Dark):
        source.web.state()
    source.wake()
    assert not camera.asleep
    source.start()


def test_a_camera_that_just_woke_is_waited_for(tmp_path):
    source, _ = rig(tmp_path, not_ready=3, settle=False)
    assert source.facts.firmware == "HD9.01.01.72.00"
    assert (source.facts.kind, source.facts.model, source.facts.serial) == ("rgb", "HERO9 Black", "C3441325000001")


@pytest.mark.parametrize(
    ("faults", "asleep", "link", "reasons"),
    [({}, False, "ble", 0), ({"dials_fail": 9}, False, "hand", 1), ({"dials_fail": 9}, True, None, 2)],
)
def test_it_is_found_one_way_or_another_or_the_reasons_are_told(tmp_path, faults, asleep, link, reasons):
    host = VirtualHost()
    camera = GoProCamera(host, tmp_path, pictures(), faults=Faults(**faults))
    camera.asleep = asleep
    facts, why = find(host, Web(AirWifi(WebServer(camera)), host), Radio(Air(camera).dial, host, tries=1))
    assert [f.more["link"] for f in facts] == ([link] if link else [])
    assert len(why) == reasons
    assert not camera.changed  # no link is left open


def test_a_real_camera_is_connected_to_by_ble_or_by_hand(monkeypatch):
    monkeypatch.setitem(sys.modules, "bleak", None)
    with pytest.raises(HostError, match="bleak"):
        open_camera(RealHost())
    with pytest.raises(UsageError):
        open_camera(RealHost(), link="usb")
    with pytest.raises(Dark):
        open_camera(RealHost(), link="hand", address="127.0.0.1:9")
