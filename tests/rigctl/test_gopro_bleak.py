"""The link by bleak: questions and answers, and no camera, and no bleak."""

import sys
import threading
import time
import types

import pytest

from spikerig.dataset.errors import HostError
from spikerig.rigctl import gopro_ble as ble
from spikerig.rigctl.gopro_bleak import SERVICE, BleakLink
from spikerig.rigctl.gopro_radio import LinkLost, Radio
from spikerig.rigctl.host import RealHost


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
