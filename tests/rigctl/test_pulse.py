"""The take's pulse on the emulated box: what its default rate of questions is good for, and that it keeps to it."""

import numpy as np
import pytest

from spikerig.calib.clock import fit_rig
from spikerig.dataset.clocktime import NS
from spikerig.dataset.marks import Probe
from spikerig.rigctl.pulse import Pulse
from spikerig.rigctl.sim.emulate.harpbox import BoxFaults, HarpBoxWire
from spikerig.rigctl.sim.emulate.latency import Latency
from spikerig.rigctl.sim.emulate.oscillator import Oscillator
from spikerig.rigctl.sim.emulate.serialport import device_errors
from spikerig.rigctl.sim.emulate.virtual import VirtualHost
from spikerig.rigctl.syncbox import HarpBox
from spikerig.rigctl.take_plan import Sync


class NoStream:
    """A recorder that records nothing."""

    def progress(self):
        return []


def asked(seed, seconds, probe_s=None, faults=None):
    """(wire, marks): what the pulse wrote down of a box over full-speed USB."""
    host = VirtualHost()
    clock = Oscillator(ppm=35, ramp_ppm_per_min=1, walk=1e-8, seed=seed, name="box")
    wire = HarpBoxWire(
        host, clock, firmware="pico", seed=seed, start_second=1_700_000_000, faults=faults,
        to_box=Latency(60, 40, 0, 0.02, 5), to_host=Latency(140, 40, 1000, 0.02, 5),
    )  # fmt: skip
    box = HarpBox(device_errors(wire.port), host, address="emulated", timeout_ns=50_000_000)
    marks, told = [], []
    probe_ns = round((Sync().probe_s if probe_s is None else probe_s) * NS)
    pulse = Pulse(host, box, None, NoStream(), probe_ns, marks.extend, told.append)
    with host.worker("main"):
        pulse.start()
        host.sleep_until(seconds * NS)
        pulse.close()
    return wire, marks, told


def off_us(wire, marks, at_s):
    clocks = fit_rig(marks)
    at = np.asarray(at_s) * NS
    true = wire.box_ns(at) - clocks.origin_ns
    fit = clocks.fit("host")
    off = np.abs(fit.model.rig_from_device(at) - true) / 1e3
    return off, np.asarray(fit.uncertainty_ns(at)) / 1e3


@pytest.mark.parametrize("seed", range(6))
def test_the_default_rate_carries_through_a_minute_within_100_us(seed):
    wire, marks, _ = asked(seed, 120)
    probes = [m for m in marks if isinstance(m, Probe) and m.sent_ns is not None]
    assert 16 <= len(probes) / 120 <= 17
    off, claim = off_us(wire, marks, [30, 60, 90, 118, 180])
    assert (off <= 100).all()
    assert (off <= claim).all()


def test_questions_do_not_keep_step_with_the_bus():
    _, marks, _ = asked(0, 20)
    phase = np.array([m.sent_ns % 1_000_000 for m in marks if isinstance(m, Probe) and m.sent_ns is not None])
    assert np.histogram(phase, 10, (0, 1e6))[0].min() > 0.03 * len(phase)


def test_a_box_that_is_away_is_told_once_and_asked_again():
    _, marks, told = asked(0, 12, faults=BoxFaults(unplugged=((4 * NS, 6 * NS),)))
    assert [t["words"] for t in told][-1] == "clock box: it is back"
    assert len(told) <= 4
    sent = np.array([m.sent_ns for m in marks if isinstance(m, Probe) and m.sent_ns is not None]) / NS
    assert np.diff(sent).max() == pytest.approx(2, abs=0.3)
