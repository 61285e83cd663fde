"""The clock box's driver on the emulated wire: both firmwares, and everything that goes wrong on a cable."""

import os
import tty

import numpy as np
import pytest
import serial
from harp_rigs import S, box_on, rig

from spikerig.dataset.errors import DeviceError
from spikerig.rigctl import harp
from spikerig.rigctl.sim.emulate.harpbox import BoxFaults, HarpBoxWire
from spikerig.rigctl.sim.emulate.latency import Latency
from spikerig.rigctl.sim.emulate.oscillator import Oscillator
from spikerig.rigctl.sim.emulate.serialport import device_errors
from spikerig.rigctl.syncbox import HarpBox, find, serial_opener

FIRMWARES = ["atxmega", "pico"]


def probes(host, box, count, every_ns=100_000_000):
    found = []
    for _ in range(count):
        host.sleep_until(host.now_ns() + every_ns + 777_777)
        try:
            found.append(box.probe())
        except DeviceError:
            continue
    return found


def errors_us(wire, found):
    """Of the device time against truth at the middle of question and answer."""
    return [(p.device_ns - int(wire.box_ns((p.sent_ns + p.received_ns) // 2))) / 1e3 for p in found]


@pytest.mark.parametrize("firmware", FIRMWARES)
def test_the_box_tells_who_it_is(firmware):
    _, _, box = box_on(firmware, serial=4321)
    assert box.facts.serial == "4321"
    assert box.facts.model == "harp-1216"
    assert box.facts.more["link"] == {"atxmega": "uart", "pico": "cdc"}[firmware]


@pytest.mark.parametrize("firmware", FIRMWARES)
def test_a_probe_tells_the_boxs_time(firmware):
    host, wire, box = box_on(firmware, to_box=Latency(60, 5), to_host=Latency(60, 5))
    found = probes(host, box, 200)
    assert len(found) == 200
    quick = sorted(found, key=lambda p: p.received_ns - p.sent_ns)[:10]
    # equal ways: of the quickest, half a step of 32 us and the tails are left; an ATxmega adds half its slot's wait
    assert np.abs(errors_us(wire, quick)).max() < (60 if firmware == "atxmega" else 25)
    assert abs(np.mean(errors_us(wire, quick))) < (35 if firmware == "atxmega" else 10)
    assert all(p.clock == "box" and p.epoch == 0 for p in found)


@pytest.mark.parametrize("firmware", FIRMWARES)
def test_it_speaks_once_a_second_by_itself(firmware):
    host, wire, box = box_on(firmware)
    box.heard()
    told = []
    for _ in range(20):
        host.sleep_until(host.now_ns() + S // 2)
        told += box.heard()
    assert 9 <= len(told) <= 10
    assert all(p.sent_ns is None for p in told)
    late = [p.received_ns - int(wire.clock.true_from_device(p.device_ns - wire.box_ns(0))) for p in told]
    assert min(late) > 0
    assert np.allclose(np.diff([p.device_ns for p in told]), S, atol=40_000)


def test_a_damaged_answer_is_one_error_and_the_next_is_well():
    host, wire, box = box_on()
    wire.faults = BoxFaults(corrupt=0.3, lose=0.1)
    found = probes(host, box, 150)
    bad = sum(t["what"] in ("corrupt", "lost") for t in wire.truth)
    assert bad > 20
    assert 150 - bad <= len(found) <= 150 - bad // 2
    assert np.abs(errors_us(wire, found)).max() < 1500  # no damaged time came through
    assert box.epoch == 0


def test_an_answer_that_comes_twice_is_one_answer():
    host, wire, box = box_on()
    wire.faults = BoxFaults(twice=1.0)
    found = probes(host, box, 30)
    assert len(found) == 30
    assert np.abs(errors_us(wire, found)).max() < 1500


def test_a_late_answer_is_not_taken_for_the_next():
    host, wire, box = box_on(to_host=Latency(60, 40, stall=0.3, stall_ms=200))
    found = probes(host, box, 60, every_ns=400_000_000)
    assert len(found) < 60
    assert all(p.sent_ns <= p.received_ns <= p.sent_ns + 101_000_000 for p in found)
    middle = np.abs(errors_us(wire, found))
    assert (middle <= [(p.received_ns - p.sent_ns) / 2e3 + 60 for p in found]).all()


@pytest.mark.parametrize("firmware", FIRMWARES)
def test_unplugged_and_back_is_a_new_epoch(firmware):
    host, wire, box = box_on(firmware, BoxFaults(unplugged=((20 * S, 23 * S),)))
    assert box.probe().epoch == 0
    host.sleep_until(20 * S + 1)
    with pytest.raises(DeviceError, match="gone"):
        box.probe()
    with pytest.raises(DeviceError, match="gone"):
        box.heard()
    box.reopen()
    assert host.now_ns() >= 23 * S
    again = box.probe()
    assert again.epoch == 1
    assert np.abs(errors_us(wire, [again]))[0] < 1500


def test_pulled_while_waiting_for_an_answer():
    host, _, box = box_on(faults=BoxFaults(unplugged=((6 * S, 7 * S),)), to_host=Latency(floor_us=5000))
    host.sleep_until(6 * S - 1_000_000)
    with pytest.raises(DeviceError, match="gone"):
        box.probe()
    assert host.now_ns() == 6 * S


def test_it_does_not_wait_for_ever():
    host, _, box = box_on(faults=BoxFaults(unplugged=((6 * S, 999 * S),)))
    host.sleep_until(6 * S)
    with pytest.raises(DeviceError):
        box.reopen(patience_ns=3 * S)
    assert host.now_ns() < 10 * S


def test_another_box_on_the_port_is_refused():
    _, wire, box = box_on()
    wire._serial = 99
    wire._boot()
    with pytest.raises(DeviceError, match="another box"):
        box.reopen()


@pytest.mark.parametrize("firmware", FIRMWARES)
@pytest.mark.parametrize("by_ns", [-3 * S, 700_000_000, 3600 * S])
def test_a_step_of_its_clock_is_a_new_epoch(firmware, by_ns):
    host, wire, box = box_on(firmware, BoxFaults(steps=((30 * S, by_ns),)))
    found = probes(host, box, 400)
    assert {p.epoch for p in found} == {0, 1}
    before = [p for p in found if p.received_ns < 30 * S]
    after = [p for p in found if p.sent_ns > 30 * S]
    assert {p.epoch for p in before} == {0}
    assert {p.epoch for p in after} == {1}
    assert np.abs(errors_us(wire, found)).max() < 1500


@pytest.mark.parametrize("firmware", FIRMWARES)
def test_a_reset_is_a_new_epoch(firmware):
    host, wire, box = box_on(firmware, BoxFaults(resets=(30 * S,)))
    found = probes(host, box, 400)
    assert [p.epoch for p in found] == sorted(p.epoch for p in found)
    assert {p.epoch for p in found} == {0, 1}
    assert found[-1].device_ns < 30 * S
    assert wire.truth[0]["what"] == "reset"


def test_seconds_that_roll_over_go_on():
    host, wire, box = box_on(start_second=harp.ROLL_S - 20)
    found = probes(host, box, 400)
    assert {p.epoch for p in found} == {0}
    assert found[0].device_ns < harp.ROLL_S * S < found[-1].device_ns
    assert np.diff([p.device_ns - p.received_ns for p in found]).max() < 2_000_000
    assert np.abs(errors_us(wire, found)).max() < 1500


def test_drift_is_not_a_step():
    host, _, box = box_on(clock=Oscillator(ppm=200, ramp_ppm_per_min=5))
    box.probe()
    host.sleep_until(3600 * S)  # an hour without a word: 0.7 s apart by the rate, 0.5 s by the ramp
    assert box.probe().epoch == 0
    told = box.heard()
    assert len(told) > 3500
    assert {p.epoch for p in told} == {0}
    assert box.probe().epoch == 0


def test_set_and_locked():
    _, _, box = box_on()
    box.set_second(1_700_000_000)
    told = box.probe()
    assert told.epoch == 1
    assert 0 <= told.device_ns - 1_700_000_000 * S < S
    box._ask(harp.write(harp.CLOCK_CONFIG, harp.U8, 0x80))
    with pytest.raises(DeviceError, match="refuses"):
        box.set_second(5)


def test_nothing_answers():
    host, wire = rig(faults=BoxFaults(lose=1.0))
    with pytest.raises(DeviceError, match="does not answer") as told:
        HarpBox(device_errors(wire.port), host, timeout_ns=50_000_000)
    assert "rig find" in str(told.value)


def test_a_port_is_one_programs():
    host, wire, _ = box_on()
    with pytest.raises(DeviceError, match="cannot be opened"):
        HarpBox(device_errors(wire.port), host)


def test_closed_twice_and_used_after():
    _, _, box = box_on()
    box.close()
    box.close()
    with pytest.raises(DeviceError, match="closed"):
        box.probe()


# ---- a real pseudo-terminal below the real pyserial


@pytest.fixture
def terminal():
    master, slave = os.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    for handle in (master, slave):
        try:
            os.close(handle)
        except OSError:
            pass


def test_a_real_port_is_exclusive_and_says_when_it_is_taken(terminal):
    _, path = terminal
    first = serial_opener(path)()
    with pytest.raises(DeviceError, match="taken"):
        serial_opener(path)()
    first.close()
    serial_opener(path)().close()


def test_a_real_port_that_is_not_there():
    with pytest.raises(DeviceError, match="cannot be opened"):
        serial_opener("/dev/no-such-port")()


def test_the_emulator_behind_a_real_port(terminal):
    """Byte for byte the same conversation through the kernel: pyserial on one end, the emulator on the other."""
    import threading

    from spikerig.rigctl.host import RealHost

    master, path = terminal
    host, stop = RealHost(), threading.Event()
    wire = HarpBoxWire(host, Oscillator(offset_ns=-host.now_ns() + 10 * S), firmware="pico")
    inner = wire.port()

    def carry():
        os.set_blocking(master, False)
        while not stop.is_set():
            try:
                inner.write(os.read(master, 4096))
            except BlockingIOError:
                pass
            if inner.in_waiting:
                os.write(master, inner.read(inner.in_waiting))
            stop.wait(0.0005)

    thread = threading.Thread(target=carry)
    thread.start()
    try:
        box = HarpBox(serial_opener(path), host, address=path)
        told = [box.probe() for _ in range(5)]
        assert box.facts.more["link"] == "cdc"
        for probe in told:
            assert wire.box_ns(probe.sent_ns) - 50_000 < probe.device_ns < wire.box_ns(probe.received_ns) + 50_000
        box.close()
    finally:
        stop.set()
        thread.join()


def test_the_port_is_a_serial_exception_when_closed():
    _, wire = rig()
    port = wire.port()
    port.close()
    with pytest.raises(serial.SerialException):
        port.read(1)


def test_find_tells_what_each_port_holds():
    host, wire = rig()
    _, dumb = rig(faults=BoxFaults(lose=1.0), host=host)
    wires = {"/dev/a": wire, "/dev/b": dumb}
    found, told = find(
        host, [("/dev/a", "FTDI"), ("/dev/b", "Pico"), ("/dev/c", "?")], lambda path: device_errors(_port(wires, path))
    )
    assert [facts.address for facts in found] == ["/dev/a"]
    assert found[0].kind == "sync"
    assert len(told) == 2
    assert "does not answer" in told[0]
    assert "cannot be opened" in told[1]
    wire.port()  # find gave it back


def _port(wires, path):
    def opened():
        if path not in wires:
            raise serial.SerialException("no such file")
        return wires[path].port()

    return opened
