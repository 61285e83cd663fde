"""Emulated cameras, what speaks with them, and clips on their cards."""

from gopro_clips import pictures

from spikerig.rigctl.gopro import GoProSource
from spikerig.rigctl.gopro_http import Web
from spikerig.rigctl.gopro_radio import Radio
from spikerig.rigctl.sim.emulate.gopro_air import Air
from spikerig.rigctl.sim.emulate.gopro_camera import Faults, GoProCamera, Nature
from spikerig.rigctl.sim.emulate.gopro_web import AirWifi, WebServer
from spikerig.rigctl.sim.emulate.oscillator import Oscillator
from spikerig.rigctl.sim.emulate.virtual import VirtualHost

S = 1_000_000_000


def camera(folder, **faults):
    return GoProCamera(VirtualHost(), folder, pictures(), faults=Faults(**faults), nature=Nature(stop_ms=(400, 500)))


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


def rig(folder, *, hand=False, nature=None, seed=0, settle=True, **faults):
    """An emulated camera and its driver, on one emulated time."""
    host = VirtualHost()
    clock = Oscillator(offset_ns=S, ppm=43, walk=1e-8, seed=seed, name="gopro")
    camera = GoProCamera(host, folder / "card", pictures(), clock, nature or Nature(), Faults(**faults), seed)
    web = Web(AirWifi(WebServer(camera)), host)
    radio = None if hand else Radio(Air(camera).dial, host)
    source = GoProSource(host, web, radio, patience_s=8.0, say=lambda text: None)
    if settle:
        source.settle({})
    return source, camera


def wait(source, seconds):
    source.host.sleep_until(source.host.now_ns() + round(seconds * S))
