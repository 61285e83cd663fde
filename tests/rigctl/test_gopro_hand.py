"""A camera without Bluetooth: somebody presses the button, and HTTP tells the rest."""

import pytest
from gopro_cameras import S, rig, wait
from gopro_clips import pictures

from spikerig.dataset.errors import DeviceError, UsageError
from spikerig.dataset.gopro_file import open_gopro
from spikerig.rigctl.gopro import GoProSource
from spikerig.rigctl.gopro_check import verify_clip
from spikerig.rigctl.gopro_http import Dark, Web
from spikerig.rigctl.gopro_settings import DEFAULTS
from spikerig.rigctl.sim.emulate.gopro_camera import GoProCamera
from spikerig.rigctl.sim.emulate.gopro_web import AirWifi, WebServer
from spikerig.rigctl.sim.emulate.virtual import VirtualHost


def person(camera, source):
    """Somebody who does as told, half a second to two seconds later."""
    said = []

    def say(text):
        said.append(text)
        on = "start" in text
        camera.at(camera.host.now_ns() + round(1.2 * S), lambda: camera.shutter(on))

    source.say = say
    return said


@pytest.mark.parametrize("hangs", [False, True])
def test_by_hand_the_start_is_seen_by_http_going_dark(tmp_path, hangs):
    source, camera = rig(tmp_path, hand=True, dark_hangs=hangs)
    said = person(camera, source)
    source.start()
    wait(source, 3)
    state = source.poll()
    assert (state["dark"], state["encoding"], state["ended_early"]) == (True, None, False)
    clip = source.stop()
    (truth,) = camera.truth
    assert len(said) == 2
    assert clip.start_ns[0] < truth["first_true_ns"] < clip.start_ns[1]
    assert clip.stop_ns[0] < truth["true_ns"][-1] + 3 * S
    read = open_gopro(source.fetch(clip, tmp_path))
    assert verify_clip(DEFAULTS, read) == []


def test_by_hand_nobody_comes(tmp_path):
    source, camera = rig(tmp_path, hand=True)
    with pytest.raises(DeviceError, match="nobody pressed start"):
        source.start()
    assert camera.host.now_ns() > 60 * S
    with pytest.raises(UsageError):
        source.wake()
    source.close()


def test_by_hand_a_dark_camera_is_not_found(tmp_path):
    host = VirtualHost()
    camera = GoProCamera(host, tmp_path, pictures())
    camera.asleep = True
    with pytest.raises(Dark, match="WiFi"):
        GoProSource(host, Web(AirWifi(WebServer(camera)), host))
